//! The device: how it is opened, and the handle that everything else hangs on.

use super::instance::{DeviceInfo, Instance, choose};
use super::kernel::Pipelines;
use super::memory::Memory;
use super::profile::Profiler;
use super::queue::Queue;
use super::tuning::{self, Tuning};
use super::validation::ValidationLog;
use crate::{Error, Result};
use ash::{ext, khr, vk};
use serde::{Deserialize, Serialize};
use std::ffi::CStr;
use std::path::PathBuf;
use std::sync::Arc;

/// Which device, and how closely it is watched.
#[derive(Clone, Debug, Default)]
pub struct GpuOptions {
    /// Index in [`Gpu::list`], or part of a device's name in any case. `None`: the first of the best kind.
    pub device: Option<String>,
    /// Runs under VK_LAYER_KHRONOS_validation, with synchronisation checks; see [`Gpu::validation_messages`].
    pub validation: bool,
    /// Writes guard words behind every buffer and fills scratch with NaN; see [`Gpu::check_guards`].
    pub guard: bool,
    /// Puts a barrier behind every command instead of the derived ones: a run that differs with it lacks a barrier without it.
    pub barrier_everywhere: bool,
    /// Times every launch. Launches are kept apart by barriers, so that a row's time is its own.
    pub profile: bool,
    /// Ignores what only some devices offer, so that the variants run that run everywhere. (Full subgroups make no variant: they are asked
    /// for where they can be.)
    pub portable: bool,
    /// Takes the device for one with many cores, so that what runs on GPUs runs on a software device.
    pub many_cores: bool,
    /// Adds gradients up so that their order does not count: the same run comes out in the same bits, on one device. Needs 64-bit
    /// atomics, which `portable` leaves out.
    pub deterministic: bool,
    /// How wide layers and networks are multiplied.
    pub matrices: Matrices,
    /// Measures which shapes of kernels are fastest here, at the first start, and remembers it in the cache folder. Without it, and with
    /// `deterministic`, everything has its usual shape.
    pub autotune: bool,
    /// Ways that are taken unmeasured wherever they are among those to choose from ([`Gpu::fastest`]).
    pub ways: Vec<String>,
    /// Bytes of device memory that buffers may take; `None`: what the device has.
    pub memory_limit: Option<u64>,
    /// Folder that keeps compiled pipelines from one run to the next; `None` keeps none. (Software drivers have their own cache and
    /// ignore this one.)
    pub cache_dir: Option<PathBuf>,
}

/// Whether products of matrices go to the device's units for them (VK_KHR_cooperative_matrix), and how exactly. Operands are float16
/// there, each chunk of them scaled to fit; sums are float32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Matrices {
    /// Compensated where that has been measured to be faster ([`GpuOptions::autotune`]), otherwise off.
    #[default]
    Auto,
    Off,
    /// Each operand in two float16s: three products, as exact as float32.
    Compensated,
    /// Operands rounded to float16, but for those of which a gradient is taken by differences.
    Float16,
}

impl Matrices {
    /// Whether nothing else will do.
    pub fn is_demanded(self) -> bool {
        matches!(self, Matrices::Compensated | Matrices::Float16)
    }
}

/// A Vulkan device, ready to work. Cheap to clone; all clones are the same device.
#[derive(Clone)]
pub struct Gpu {
    pub(super) inner: Arc<Inner>,
}

/// Fields are dropped in this order: what lives on the device goes before the device, the device before the instance.
pub(super) struct Inner {
    pub(super) queue: Queue,
    pub(super) pipelines: Pipelines,
    pub(super) memory: Memory,
    pub(super) profiler: Profiler,
    pub(super) tuning: Tuning,
    pub(super) info: DeviceInfo,
    pub(super) options: GpuOptions,
    pub(super) context: Context,
}

/// Instance and device.
pub(super) struct Context {
    pub(super) device: ash::Device,
    pub(super) physical: vk::PhysicalDevice,
    pub(super) debug: Option<ext::debug_utils::Device>,
    pub(super) queue: vk::Queue,
    pub(super) family: u32,
    pub(super) has_memory_budget: bool,
    pub(super) timestamp_bits: u32,
    pub(super) instance: Instance,
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: everything made from the device is gone, and nothing runs on it: Queue waited when it was dropped.
        unsafe { self.device.destroy_device(None) };
    }
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Gpu({})", self.inner.info.name)
    }
}

impl Gpu {
    /// Opens a device. Fails with [`Error::NoDevice`] where there is no Vulkan, no device of that name, or none that can run the kernels.
    pub fn new(options: &GpuOptions) -> Result<Gpu> {
        let instance = Instance::new(options.validation)?;
        let devices = instance.devices()?;
        let chosen = choose(&devices, options.device.as_deref())?;
        let offered = devices.len();
        let (physical, mut info) = devices.into_iter().nth(chosen).expect("chosen from these");
        // What the device has, before what is not to be used of it is taken away.
        let has_matrix = info.matrix.is_some();
        let has_int64 = info.int64 && info.int64_atomics;
        if options.portable || options.many_cores {
            info.few_cores = false;
            info.lanes_at_once = 0;
        }
        if options.portable {
            info.float_atomics = false;
            info.int64 = false;
            info.matrix = None;
        }
        let lacking = |has: bool, what: &str, next: &str| Error::NoDevice {
            what: match has {
                true => format!(
                    "GpuOptions::portable leaves out {what}\n  next: {next}, or open {} without portable",
                    info.name
                ),
                false => format!(
                    "{} has no {what}\n  next: {next}, or choose another device",
                    info.name
                ),
            },
        };
        if info.matrix.is_none() && options.matrices.is_demanded() {
            return Err(lacking(
                has_matrix,
                "cooperative matrices of float16 with float32 sums, which matrices = \"compensated\" and \"float16\" need",
                "set it to \"auto\"",
            ));
        }
        if options.deterministic && !(info.int64 && info.int64_atomics) {
            return Err(lacking(
                has_int64,
                "64-bit integers with atomic addition, which deterministic training needs",
                "train without --deterministic",
            ));
        }
        tracing::info!(
            device = info.name,
            driver = info.driver,
            kind = %info.kind,
            index = info.index,
            offered,
            subgroup_size = info.subgroup_size,
            few_cores = info.few_cores,
            lanes_at_once = info.lanes_at_once,
            float_atomics = info.float_atomics,
            matrix = ?info.matrix,
            "device chosen"
        );
        let context = Context::new(instance, physical, &info)?;
        let memory = Memory::new(&context, options.memory_limit)?;
        let pipelines = Pipelines::new(&context, &info, options)?;
        let queue = Queue::new(&context)?;
        let profiler = Profiler::new(&info, context.timestamp_bits);
        if options.profile {
            profiler.check(&info)?;
        }
        let mut options = options.clone();
        options.autotune &= !options.deterministic;
        let tuning_file = (options.cache_dir.as_ref())
            .filter(|_| options.autotune)
            .map(|dir| dir.join(tuning::file_name(&info)));
        let inner = Inner {
            queue,
            pipelines,
            memory,
            profiler,
            tuning: Tuning::new(tuning_file),
            info,
            options,
            context,
        };
        let gpu = Gpu {
            inner: Arc::new(inner),
        };
        if gpu.options().profile {
            gpu.set_clock()?;
        }
        Ok(gpu)
    }

    /// All devices that drivers offer, also those that cannot run the kernels ([`DeviceInfo::missing`]).
    pub fn list() -> Result<Vec<DeviceInfo>> {
        let instance = Instance::new(false)?;
        Ok(instance
            .devices()?
            .into_iter()
            .map(|(_, info)| info)
            .collect())
    }

    /// The device in use.
    pub fn info(&self) -> &DeviceInfo {
        &self.inner.info
    }

    /// Whether gradients are summed up in fixed point; see [`GpuOptions::deterministic`].
    pub fn deterministic(&self) -> bool {
        self.inner.options.deterministic
    }

    /// What the validation layer has said so far; nothing where the device was opened without [`GpuOptions::validation`].
    pub fn validation_messages(&self) -> Vec<String> {
        self.validation_log().messages()
    }

    /// The layer's log, which outlives the device: what was leaked is reported when the device goes.
    pub fn validation_log(&self) -> ValidationLog {
        self.inner.context.instance.log.clone()
    }

    /// How it was opened.
    pub fn options(&self) -> &GpuOptions {
        &self.inner.options
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.queue.collect_all(&self.memory);
    }
}

impl Inner {
    pub(super) fn device(&self) -> &ash::Device {
        &self.context.device
    }
}

impl Context {
    fn new(instance: Instance, physical: vk::PhysicalDevice, info: &DeviceInfo) -> Result<Context> {
        // SAFETY: a device of this instance.
        let families = unsafe {
            instance
                .raw
                .get_physical_device_queue_family_properties(physical)
        };
        let computes = |family: &vk::QueueFamilyProperties| {
            family.queue_flags.contains(vk::QueueFlags::COMPUTE)
        };
        let family = families
            .iter()
            .position(computes)
            .expect("checked when the device was described") as u32;
        let extensions = instance.extensions(physical)?;
        let offers = |name: &CStr| {
            extensions
                .iter()
                .any(|e| e.extension_name_as_c_str() == Ok(name))
        };
        let mut names = Vec::new();
        let size_control_is_core = info.vulkan >= (1, 3, 0);
        if info.float_atomics {
            names.push(ext::shader_atomic_float::NAME.as_ptr());
        }
        if info.full_subgroups.is_some() && !size_control_is_core {
            names.push(ext::subgroup_size_control::NAME.as_ptr());
        }
        if info.matrix.is_some() {
            names.push(khr::cooperative_matrix::NAME.as_ptr());
        }
        let has_memory_budget = offers(ext::memory_budget::NAME);
        if has_memory_budget {
            names.push(ext::memory_budget::NAME.as_ptr());
        }
        if offers(khr::portability_subset::NAME) {
            names.push(khr::portability_subset::NAME.as_ptr());
        }
        let priorities = [1.0];
        let queues = [vk::DeviceQueueCreateInfo::default()
            .queue_family_index(family)
            .queue_priorities(&priorities)];
        let core = vk::PhysicalDeviceFeatures::default().shader_int64(info.int64);
        let mut twelve = vk::PhysicalDeviceVulkan12Features::default()
            .buffer_device_address(true)
            .scalar_block_layout(true)
            .timeline_semaphore(true)
            .shader_buffer_int64_atomics(info.int64_atomics)
            .shader_float16(info.matrix.is_some())
            .vulkan_memory_model(info.matrix.is_some())
            .vulkan_memory_model_device_scope(info.matrix.is_some());
        let mut atomics = vk::PhysicalDeviceShaderAtomicFloatFeaturesEXT::default()
            .shader_buffer_float32_atomic_add(true);
        let mut control = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
            .subgroup_size_control(true)
            .compute_full_subgroups(true);
        let mut matrices =
            vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
        let mut create = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .enabled_extension_names(&names)
            .enabled_features(&core)
            .push_next(&mut twelve);
        if info.float_atomics {
            create = create.push_next(&mut atomics);
        }
        if info.full_subgroups.is_some() {
            create = create.push_next(&mut control);
        }
        if info.matrix.is_some() {
            create = create.push_next(&mut matrices);
        }
        // SAFETY: only features and extensions that the device offers are asked for; the chain outlives the call.
        let device = unsafe { instance.raw.create_device(physical, &create, None) }
            .map_err(vulkan("vkCreateDevice"))?;
        // SAFETY: the queue was asked for just now.
        let queue = unsafe { device.get_device_queue(family, 0) };
        let debug = instance
            .has_debug_utils
            .then(|| ext::debug_utils::Device::new(&instance.raw, &device));
        Ok(Context {
            device,
            physical,
            debug,
            queue,
            family,
            has_memory_budget,
            timestamp_bits: families[family as usize].timestamp_valid_bits,
            instance,
        })
    }

    /// Names an object for debuggers and validation messages.
    pub(super) fn name<H: vk::Handle>(&self, handle: H, name: &str) {
        let Some(debug) = &self.debug else { return };
        let name = std::ffi::CString::new(name.replace('\0', " ")).expect("zeros were replaced");
        let info = vk::DebugUtilsObjectNameInfoEXT::default()
            .object_handle(handle)
            .object_name(&name);
        // A name that cannot be set is no reason to stop.
        // SAFETY: a live object of this device.
        let _ = unsafe { debug.set_debug_utils_object_name(&info) };
    }
}

/// Turns a Vulkan result into the library's error, naming the call.
pub(super) fn vulkan(call: &'static str) -> impl Fn(vk::Result) -> Error {
    move |code| match code {
        vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost {
            what: format!(
                "the driver gave the device up ({call}): it hung, was reset, or a kernel broke it\n  next: resume from the last checkpoint"
            ),
        },
        vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
            Error::OutOfMemory {
                what: format!(
                    "{call}: {code}\n  next: close what else uses memory, or ask for less"
                ),
            }
        }
        code => Error::Vulkan {
            call,
            code: code.to_string(),
        },
    }
}
