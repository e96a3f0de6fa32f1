//! Kernels: pipelines built from the SPIR-V that build.rs embedded, one for each set of specialisation constants.

use super::device::{Context, Gpu, GpuOptions, vulkan};
use super::instance::DeviceInfo;
use crate::{Error, Result, whole_file};
use ash::vk;
use bytemuck::Pod;
use std::collections::HashMap;
use std::io::Write;
use std::marker::PhantomData;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// What build.rs found in a kernel's SPIR-V.
#[derive(Debug)]
pub struct KernelModule {
    /// File stem; also the pipeline's debug name and the profiler's row.
    pub name: &'static str,
    pub local_size: [u32; 3],
    /// SPIR-V 1.5, little-endian words.
    pub spirv: &'static [u8],
    /// The variant for devices without float atomics or without 64-bit integers, where the kernel uses them.
    pub spirv_of_core: Option<&'static [u8]>,
    /// The variant whose gradients do not depend on the order in which they are added up, where the kernel handles any.
    pub deterministic_spirv: Option<&'static [u8]>,
    /// The same by cooperative matrices, with the same arguments and constants, where the kernel has such a form.
    pub cooperative: Option<&'static KernelModule>,
    /// Where the kernel multiplies by cooperative matrices: rows and columns of the product that a workgroup computes, and what of the sum
    /// it has in shared memory at once.
    pub matrix_tile: Option<[u32; 3]>,
    /// The pointers in the push-constant block.
    pub pointers: &'static [PointerArg],
    /// Whether it reads, or writes, through pointers found elsewhere than in the block.
    pub indirect_reads: bool,
    pub indirect_writes: bool,
    /// Whether its lanes may read items abreast (glsl/lib/abreast.glsl).
    pub lanes: bool,
}

/// A pointer in a push-constant block.
#[derive(Debug)]
pub struct PointerArg {
    pub name: &'static str,
    /// Byte offset in the block.
    pub offset: usize,
    /// Not declared `readonly`.
    pub writable: bool,
}

/// A kernel's specialisation constants; implemented by every generated `kernels::<stem>::Shape`.
pub trait KernelShape {
    /// The push-constant block.
    type Args: Pod;
    fn module() -> &'static KernelModule;
    /// (constant id, bits) of every constant.
    fn constants(&self) -> Vec<(u32, u32)>;
}

/// A kernel, ready to run with arguments `A`. Cheap to clone.
pub struct Kernel<A> {
    pub(super) pipeline: vk::Pipeline,
    pub(super) module: &'static KernelModule,
    pub(super) row: Arc<str>,
    constants: Arc<[(u32, u32)]>,
    /// Keeps the pipeline alive.
    pub(super) gpu: Gpu,
    args: PhantomData<fn(A)>,
}

impl<A> Clone for Kernel<A> {
    fn clone(&self) -> Self {
        Kernel {
            pipeline: self.pipeline,
            module: self.module,
            row: self.row.clone(),
            constants: self.constants.clone(),
            gpu: self.gpu.clone(),
            args: PhantomData,
        }
    }
}

impl<A> std::fmt::Debug for Kernel<A> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Kernel({})", self.row)
    }
}

impl<A> Kernel<A> {
    /// The same kernel under its own profiler row: its name, a space, `label`.
    pub fn labelled(&self, label: &str) -> Kernel<A> {
        Kernel {
            row: format!("{} {label}", self.module.name).into(),
            ..self.clone()
        }
    }

    /// Name of its profiler row.
    pub fn row(&self) -> &str {
        &self.row
    }

    /// Invocations per workgroup.
    pub fn local_size(&self) -> u32 {
        self.module.local_size.iter().product()
    }

    /// Rows and columns of the product that a workgroup computes, where it does so by cooperative matrices (glsl/lib/cooperative.glsl).
    pub fn matrix_tile(&self) -> Option<[u32; 2]> {
        self.module
            .matrix_tile
            .map(|[rows, columns, _]| [rows, columns])
    }
}

/// A pipeline's identity: kernel and specialisation constants.
type Key = (&'static str, Arc<[(u32, u32)]>);

/// Pipelines by kernel and constants.
pub(super) struct Pipelines {
    pub(super) layout: vk::PipelineLayout,
    built: Mutex<HashMap<Key, (vk::Pipeline, Arc<str>)>>,
    cache: vk::PipelineCache,
    /// What cooperative kernels know of the device (glsl/lib/cooperative.glsl: from constant 100 on).
    matrix_constants: Vec<(u32, u32)>,
    /// Where the cache lies on disk, and its bytes when it was read.
    cache_file: Option<(PathBuf, usize)>,
    device: ash::Device,
}

/// The constant of glsl/lib/cooperative.glsl that the caller decides.
const COMPENSATED: u32 = 104;

/// The constant of glsl/lib/abreast.glsl.
const LANES: u32 = 110;

/// Bytes of push constants that the common pipeline layout has; build.rs holds every kernel to them.
const PUSH_CONSTANT_BYTES: u32 = 128;

impl Pipelines {
    pub(super) fn new(
        context: &Context,
        info: &DeviceInfo,
        options: &GpuOptions,
    ) -> Result<Pipelines> {
        let device = &context.device;
        let cache_dir = options.cache_dir.as_ref();
        let cache_file = cache_dir.map(|dir| dir.join(cache_name(info)));
        let known = cache_file
            .as_ref()
            .and_then(|file| std::fs::read(file).ok())
            .filter(|data| is_for(data, info))
            .unwrap_or_default();
        match &cache_file {
            Some(file) => {
                tracing::info!(file = %file.display(), bytes = known.len(), "pipeline cache opened")
            }
            None => tracing::info!("no pipeline cache"),
        }
        let create = vk::PipelineCacheCreateInfo::default().initial_data(&known);
        // SAFETY: a live device; data with this device's header, which drivers check once more.
        let cache = unsafe { device.create_pipeline_cache(&create, None) }
            .map_err(vulkan("vkCreatePipelineCache"))?;
        let cache_file = cache_file.map(|file| (file, known.len()));
        let ranges = [vk::PushConstantRange::default()
            .stage_flags(vk::ShaderStageFlags::COMPUTE)
            .size(PUSH_CONSTANT_BYTES)];
        let create = vk::PipelineLayoutCreateInfo::default().push_constant_ranges(&ranges);
        // SAFETY: a live device.
        let layout = unsafe { device.create_pipeline_layout(&create, None) };
        let layout = layout.map_err(|error| {
            // SAFETY: nothing uses it yet.
            unsafe { device.destroy_pipeline_cache(cache, None) };
            vulkan("vkCreatePipelineLayout")(error)
        })?;
        let [m, n, k] = info.matrix.unwrap_or_default();
        Ok(Pipelines {
            matrix_constants: (100..).zip([m, n, k, info.subgroup_size]).collect(),
            layout,
            built: Mutex::default(),
            cache,
            cache_file,
            device: device.clone(),
        })
    }

    /// Writes the cache where it has grown.
    fn save(&self) -> Result<()> {
        let Some((file, known)) = &self.cache_file else {
            return Ok(());
        };
        // SAFETY: a live cache.
        let data = unsafe { self.device.get_pipeline_cache_data(self.cache) }
            .map_err(vulkan("vkGetPipelineCacheData"))?;
        if data.len() == *known {
            return Ok(());
        }
        let folder = file.parent().expect("the file lies in the cache's folder");
        std::fs::create_dir_all(folder)
            .and_then(|()| whole_file::replace(file, |out| out.write_all(&data)))
            .map_err(|error| Error::unwritable(file, &error))?;
        tracing::info!(file = %file.display(), bytes = data.len(), "pipeline cache written");
        Ok(())
    }

    fn build(
        &self,
        context: &Context,
        info: &DeviceInfo,
        module: &'static KernelModule,
        constants: &[(u32, u32)],
        deterministic: bool,
    ) -> Result<vk::Pipeline> {
        let spirv = match (module.deterministic_spirv, module.spirv_of_core) {
            (Some(ordered), _) if deterministic => ordered,
            (_, Some(fallback)) if !(info.float_atomics && info.int64) => fallback,
            _ => module.spirv,
        };
        let mut constants = constants.to_vec();
        if module.lanes && constants.iter().all(|&(id, _)| id != LANES) {
            constants.push((LANES, info.lanes_at_once));
        }
        if module.matrix_tile.is_some() {
            constants.extend(&self.matrix_constants);
        }
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(spirv);
        let create = vk::ShaderModuleCreateInfo::default().code(&words);
        // SAFETY: SPIR-V from glslang, of the version that the device's Vulkan 1.2 takes.
        let shader = unsafe { self.device.create_shader_module(&create, None) }
            .map_err(vulkan("vkCreateShaderModule"))?;

        let entries: Vec<vk::SpecializationMapEntry> = constants
            .iter()
            .enumerate()
            .map(|(i, &(id, _))| vk::SpecializationMapEntry {
                constant_id: id,
                offset: 4 * i as u32,
                size: 4,
            })
            .collect();
        let values: Vec<u32> = constants.iter().map(|&(_, bits)| bits).collect();
        let specialization = vk::SpecializationInfo::default()
            .map_entries(&entries)
            .data(bytemuck::cast_slice(&values));
        let invocations: u32 = module.local_size.iter().product();
        let mut size = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default()
            .required_subgroup_size(info.subgroup_size);
        let full = vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS;
        // Without it, gl_SubgroupSize is the device's largest even where a narrower subgroup runs, and who strides by it leaves items out.
        let varying = vk::PipelineShaderStageCreateFlags::ALLOW_VARYING_SUBGROUP_SIZE;
        let flags = match info.full_subgroups {
            _ if module.matrix_tile.is_some() => full,
            Some(largest) if module.local_size[0].is_multiple_of(largest) => varying | full,
            Some(_) => varying,
            None => vk::PipelineShaderStageCreateFlags::empty(),
        };
        let mut stage = vk::PipelineShaderStageCreateInfo::default()
            .flags(flags)
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(shader)
            .name(c"main")
            .specialization_info(&specialization);
        if module.matrix_tile.is_some() {
            stage = stage.push_next(&mut size);
        }
        let create = [vk::ComputePipelineCreateInfo::default()
            .flags(vk::PipelineCreateFlags::DISPATCH_BASE)
            .stage(stage)
            .layout(self.layout)];
        let built = if invocations > info.max_workgroup {
            Err(Error::NoDevice {
                what: format!(
                    "kernel {} has workgroups of {invocations}, {} ends at {}\n  next: choose another device",
                    module.name, info.name, info.max_workgroup
                ),
            })
        } else {
            // SAFETY: everything that `create` names outlives the call.
            unsafe {
                self.device
                    .create_compute_pipelines(self.cache, &create, None)
            }
            .map_err(|(_, error)| vulkan("vkCreateComputePipelines")(error))
        };
        // SAFETY: pipelines do not need their shader module once they are made.
        unsafe { self.device.destroy_shader_module(shader, None) };
        let pipeline = built?[0];
        context.name(pipeline, module.name);
        Ok(pipeline)
    }
}

/// One file for each device and driver: what one driver compiled, another must not read.
pub(super) fn cache_name(info: &DeviceInfo) -> String {
    let uuid: String = info
        .cache_uuid
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    format!("pipelines-{uuid}-{:08x}.bin", info.driver_version)
}

/// Whether cached data begins with this device's header: length, version 1, vendor, device, UUID (VkPipelineCacheHeaderVersionOne).
fn is_for(data: &[u8], info: &DeviceInfo) -> bool {
    let word = |at: usize| {
        data.get(at..at + 4)
            .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
    };
    word(0) == Some(32)
        && word(4) == Some(1)
        && word(8) == Some(info.vendor_device.0)
        && word(12) == Some(info.vendor_device.1)
        && data.get(16..32) == Some(info.cache_uuid.as_slice())
}

impl Drop for Pipelines {
    fn drop(&mut self) {
        // A cache that cannot be written only costs time at the next start.
        if let Err(error) = self.save() {
            tracing::info!(%error, "pipeline cache not written");
        }
        // SAFETY: the last owner waited for all work.
        unsafe {
            self.device.destroy_pipeline_cache(self.cache, None);
            for (pipeline, _) in self.built.lock().expect("no panic under the lock").values() {
                self.device.destroy_pipeline(*pipeline, None);
            }
            self.device.destroy_pipeline_layout(self.layout, None);
        }
    }
}

impl Gpu {
    /// The kernel with these specialisation constants, built at the first call.
    pub fn kernel<S: KernelShape>(&self, shape: S) -> Result<Kernel<S::Args>> {
        self.kernel_of(S::module(), shape.constants().into())
    }

    /// The same by cooperative matrices, operands in two float16s (`compensated`) or one; [`Kernel::matrix_tile`] divides its work.
    ///
    /// # Panics
    /// If the kernel has no such form, or the device no such matrices.
    pub fn matrix_kernel<S: KernelShape>(
        &self,
        shape: S,
        compensated: bool,
    ) -> Result<Kernel<S::Args>> {
        let module = S::module().cooperative.expect("a cooperative form");
        assert!(self.inner.info.matrix.is_some(), "cooperative matrices");
        let mut constants = shape.constants();
        constants.push((COMPENSATED, u32::from(compensated)));
        self.kernel_of(module, constants.into())
    }

    /// The kernel's pipeline for so many items: where they are fewer than lanes read at once, each lane reads for itself.
    pub(super) fn pipeline_for<A>(&self, kernel: &Kernel<A>, items: u64) -> Result<vk::Pipeline> {
        if !kernel.module.lanes || items >= u64::from(self.inner.info.lanes_at_once) {
            return Ok(kernel.pipeline);
        }
        let constants = kernel.constants.iter().copied().chain([(LANES, 0)]);
        let few: Kernel<A> = self.kernel_of(kernel.module, constants.collect())?;
        Ok(few.pipeline)
    }

    fn kernel_of<A>(
        &self,
        module: &'static KernelModule,
        constants: Arc<[(u32, u32)]>,
    ) -> Result<Kernel<A>> {
        let info = &self.inner.info;
        let pipelines = &self.inner.pipelines;
        let key = (module.name, constants.clone());
        let mut built = pipelines.built.lock().expect("no panic under the lock");
        let (pipeline, row) = match built.get(&key) {
            Some((pipeline, row)) => (*pipeline, row.clone()),
            None => {
                let deterministic = self.deterministic();
                let begun = Instant::now();
                let pipeline =
                    pipelines.build(&self.inner.context, info, module, &key.1, deterministic)?;
                tracing::debug!(
                    kernel = module.name,
                    constants = ?key.1,
                    ms = 1e3 * begun.elapsed().as_secs_f64(),
                    "pipeline built"
                );
                let row: Arc<str> = module.name.into();
                built.insert(key, (pipeline, row.clone()));
                (pipeline, row)
            }
        };
        Ok(Kernel {
            pipeline,
            module,
            row,
            constants,
            gpu: self.clone(),
            args: PhantomData,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::GpuOptions;
    use crate::gpu::device::Inner;

    #[test]
    fn every_kernel_builds_in_every_variant_and_the_layer_agrees() -> Result<()> {
        for (portable, deterministic) in [(false, false), (false, true), (true, false)] {
            let options = GpuOptions {
                validation: true,
                portable,
                deterministic,
                ..GpuOptions::default()
            };
            let gpu = Gpu::new(&options)?;
            let Inner {
                pipelines,
                context,
                info,
                ..
            } = &*gpu.inner;
            let with_matrices = crate::kernels::ALL
                .iter()
                .filter_map(|module| module.cooperative)
                .filter(|_| info.matrix.is_some());
            for module in crate::kernels::ALL.iter().copied().chain(with_matrices) {
                let pipeline = pipelines.build(context, info, module, &[], deterministic)?;
                // SAFETY: nothing uses it.
                unsafe { context.device.destroy_pipeline(pipeline, None) };
                assert_eq!(
                    gpu.validation_messages(),
                    Vec::<String>::new(),
                    "{}",
                    module.name
                );
            }
        }
        Ok(())
    }
}
