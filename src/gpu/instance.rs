//! The instance, and what the devices are that drivers offer.
//!
//! Needed: Vulkan 1.2 with buffer device addresses, scalar block layout and timeline semaphores, and the subgroup operations that
//! lib/prelude.glsl names. Used where present: float atomics, 64-bit integers, full subgroups, memory budgets, debug names.

use super::device::vulkan;
use super::validation::{self, Channel, ValidationLog};
use crate::{Error, Result};
use ash::{ext, khr, vk};
use std::ffi::CStr;

/// What kind of device this is; also the order in which devices are preferred.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceKind {
    Discrete,
    Integrated,
    Virtual,
    Cpu,
    Other,
}

impl std::fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Virtual => "virtual",
            DeviceKind::Cpu => "cpu",
            DeviceKind::Other => "other",
        })
    }
}

/// A device as the driver describes it.
#[derive(Clone, Debug)]
pub struct DeviceInfo {
    /// Position in [`super::Gpu::list`], accepted by [`super::GpuOptions::device`].
    pub index: usize,
    pub name: String,
    pub kind: DeviceKind,
    /// Driver's name and version, as it reports them.
    pub driver: String,
    /// Vulkan version of the device: (major, minor, patch).
    pub vulkan: (u32, u32, u32),
    /// Bytes of the largest device-local heap.
    pub memory: u64,
    /// Largest single allocation in bytes, and with it the largest buffer.
    pub max_buffer: u64,
    /// Invocations per subgroup.
    pub subgroup_size: u32,
    /// Shared memory per workgroup in bytes.
    pub shared_memory: u32,
    /// Invocations per workgroup.
    pub max_workgroup: u32,
    /// Whether floats in memory can be added to atomically; otherwise a compare-and-swap loop does it.
    pub float_atomics: bool,
    /// Whether a handful of cores do all the work, as on software devices: kernels then keep them apart where a GPU's invocations would
    /// meet in memory, and go through memory in pieces that fit a core's cache.
    pub few_cores: bool,
    /// Lanes of a subgroup that read neighbouring numbers at once where a kernel says so (glsl/lib/abreast.glsl); 0 on devices that see it
    /// themselves, and on software devices that lose by it: of lavapipe, 26.1 gains a third to a half, 22.3 takes twice as long.
    pub lanes_at_once: u32,
    /// (M, N, K) of the products of float16 matrices, M × K by K × N, with float32 sums that a subgroup makes; `None` where there are
    /// none, or where the device was opened without them ([`super::GpuOptions::matrices`]).
    pub matrix: Option<[u32; 3]>,
    /// What this device lacks to run the kernels; empty where it can.
    pub missing: Vec<String>,
    pub(super) int64: bool,
    pub(super) int64_atomics: bool,
    pub(super) timestamp_period: f64,
    pub(super) cache_uuid: [u8; 16],
    pub(super) driver_version: u32,
    pub(super) vendor_device: (u32, u32),
    /// The largest subgroup size, where full subgroups can be asked for, whatever size they have.
    pub(super) full_subgroups: Option<u32>,
}

/// Loader and instance, and under validation the messenger.
pub(super) struct Instance {
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    pub(super) raw: ash::Instance,
    pub(super) log: ValidationLog,
    pub(super) has_debug_utils: bool,
    entry: ash::Entry,
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: the device made from the instance is gone.
        unsafe {
            if let Some((debug, messenger)) = self.messenger.take() {
                debug.destroy_debug_utils_messenger(messenger, None);
            }
            self.raw.destroy_instance(None);
        }
    }
}

impl Instance {
    pub(super) fn new(validate: bool) -> Result<Instance> {
        // SAFETY: loading the Vulkan loader runs its initialisers, as every Vulkan program does.
        let entry = unsafe { ash::Entry::load() }.map_err(|error| Error::NoDevice {
            what: format!("no Vulkan loader: {error}\n  next: install a Vulkan driver (Debian, Ubuntu: libvulkan1 and mesa-vulkan-drivers)"),
        })?;
        let no_instance = |error: vk::Result| Error::NoDevice {
            what: format!(
                "no Vulkan instance: {error}\n  next: install or update your GPU's Vulkan driver"
            ),
        };
        // SAFETY: a loaded entry; the call only reads.
        let offered =
            unsafe { entry.enumerate_instance_extension_properties(None) }.map_err(no_instance)?;
        let offers = |name: &CStr| {
            offered
                .iter()
                .any(|e| e.extension_name_as_c_str() == Ok(name))
        };
        let settings = match validate {
            true => Channel::find(&entry)?,
            false => Channel::Neither,
        };
        let mut extensions = Vec::new();
        let mut flags = vk::InstanceCreateFlags::empty();
        if offers(khr::portability_enumeration::NAME) {
            extensions.push(khr::portability_enumeration::NAME.as_ptr());
            flags |= vk::InstanceCreateFlags::ENUMERATE_PORTABILITY_KHR;
        }
        // The layer brings debug_utils where the loader does not.
        let has_debug_utils = validate || offers(ext::debug_utils::NAME);
        if has_debug_utils {
            extensions.push(ext::debug_utils::NAME.as_ptr());
        }
        extensions.extend(settings.extension().map(CStr::as_ptr));

        let layers = [validation::LAYER.as_ptr()];
        let log = ValidationLog::default();
        let mut early = validation::messenger(&log);
        let mut features =
            vk::ValidationFeaturesEXT::default().enabled_validation_features(&validation::FEATURES);
        let named = validation::layer_settings();
        let mut layer_settings = vk::LayerSettingsCreateInfoEXT::default().settings(&named);
        let application = vk::ApplicationInfo::default()
            .application_name(c"neurodin")
            .api_version(vk::API_VERSION_1_3);
        let mut create = vk::InstanceCreateInfo::default()
            .flags(flags)
            .application_info(&application)
            .enabled_extension_names(&extensions);
        if validate {
            create = create.enabled_layer_names(&layers).push_next(&mut early);
        }
        match settings {
            Channel::LayerSettings => create = create.push_next(&mut layer_settings),
            Channel::ValidationFeatures => create = create.push_next(&mut features),
            Channel::Neither => {}
        }
        // SAFETY: every pointer in `create` outlives the call; `log` outlives the instance.
        let raw = unsafe { entry.create_instance(&create, None) }.map_err(no_instance)?;
        let mut instance = Instance {
            messenger: None,
            raw,
            log,
            has_debug_utils,
            entry,
        };
        if validate {
            let debug = ext::debug_utils::Instance::new(&instance.entry, &instance.raw);
            // SAFETY: a live instance; `log` outlives the messenger.
            let made = unsafe {
                debug.create_debug_utils_messenger(&validation::messenger(&instance.log), None)
            };
            instance.messenger = Some((
                debug,
                made.map_err(vulkan("vkCreateDebugUtilsMessengerEXT"))?,
            ));
        }
        Ok(instance)
    }

    pub(super) fn devices(&self) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>> {
        // SAFETY: a live instance.
        let devices = unsafe { self.raw.enumerate_physical_devices() };
        let devices = devices.map_err(vulkan("vkEnumeratePhysicalDevices"))?;
        devices
            .into_iter()
            .enumerate()
            .map(|(index, physical)| Ok((physical, self.describe(index, physical)?)))
            .collect()
    }

    pub(super) fn extensions(
        &self,
        physical: vk::PhysicalDevice,
    ) -> Result<Vec<vk::ExtensionProperties>> {
        // SAFETY: a device of this instance.
        unsafe { self.raw.enumerate_device_extension_properties(physical) }
            .map_err(vulkan("vkEnumerateDeviceExtensionProperties"))
    }

    fn describe(&self, index: usize, physical: vk::PhysicalDevice) -> Result<DeviceInfo> {
        let extensions = self.extensions(physical)?;
        let offers = |name: &CStr| {
            extensions
                .iter()
                .any(|e| e.extension_name_as_c_str() == Ok(name))
        };
        // SAFETY: a device of this instance; Vulkan 1.0 call.
        let first = unsafe { self.raw.get_physical_device_properties(physical) };
        let version = first.api_version;
        let vulkan = (
            vk::api_version_major(version),
            vk::api_version_minor(version),
            vk::api_version_patch(version),
        );
        let text = |name: std::result::Result<&CStr, _>| {
            name.map(|n: &CStr| n.to_string_lossy().into_owned())
                .unwrap_or_default()
        };
        let mut info = DeviceInfo {
            index,
            name: text(first.device_name_as_c_str().map_err(drop)),
            kind: match first.device_type {
                vk::PhysicalDeviceType::DISCRETE_GPU => DeviceKind::Discrete,
                vk::PhysicalDeviceType::INTEGRATED_GPU => DeviceKind::Integrated,
                vk::PhysicalDeviceType::VIRTUAL_GPU => DeviceKind::Virtual,
                vk::PhysicalDeviceType::CPU => DeviceKind::Cpu,
                _ => DeviceKind::Other,
            },
            driver: String::new(),
            vulkan,
            memory: 0,
            max_buffer: 0,
            subgroup_size: 0,
            shared_memory: first.limits.max_compute_shared_memory_size,
            max_workgroup: first.limits.max_compute_work_group_invocations,
            float_atomics: false,
            few_cores: false,
            lanes_at_once: 0,
            matrix: None,
            missing: Vec::new(),
            int64: false,
            int64_atomics: false,
            timestamp_period: 0.0,
            cache_uuid: first.pipeline_cache_uuid,
            driver_version: first.driver_version,
            vendor_device: (first.vendor_id, first.device_id),
            full_subgroups: None,
        };
        // SAFETY: a device of this instance; Vulkan 1.0 call.
        let heaps = unsafe { self.raw.get_physical_device_memory_properties(physical) };
        let local = heaps
            .memory_heaps_as_slice()
            .iter()
            .filter(|heap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
        info.memory = local.map(|heap| heap.size).max().unwrap_or(0);
        if version < vk::API_VERSION_1_2 {
            info.missing
                .push(format!("Vulkan 1.2 (it has {}.{})", vulkan.0, vulkan.1));
            return Ok(info);
        }

        let atomics_offered = offers(ext::shader_atomic_float::NAME);
        let size_control_offered =
            version >= vk::API_VERSION_1_3 || offers(ext::subgroup_size_control::NAME);
        let mut subgroups = vk::PhysicalDeviceSubgroupProperties::default();
        let mut sizes = vk::PhysicalDeviceSubgroupSizeControlProperties::default();
        let mut eleven = vk::PhysicalDeviceMaintenance3Properties::default();
        let mut thirteen = vk::PhysicalDeviceMaintenance4Properties::default();
        let mut driver = vk::PhysicalDeviceDriverProperties::default();
        let mut properties = vk::PhysicalDeviceProperties2::default()
            .push_next(&mut subgroups)
            .push_next(&mut eleven)
            .push_next(&mut driver);
        if size_control_offered {
            properties = properties.push_next(&mut sizes);
        }
        if version >= vk::API_VERSION_1_3 {
            properties = properties.push_next(&mut thirteen);
        }
        // SAFETY: a Vulkan 1.2 device; the chain's structures outlive the call.
        unsafe {
            self.raw
                .get_physical_device_properties2(physical, &mut properties)
        };
        let limits = properties.properties.limits;
        let mut twelve = vk::PhysicalDeviceVulkan12Features::default();
        let mut atomics = vk::PhysicalDeviceShaderAtomicFloatFeaturesEXT::default();
        let mut control = vk::PhysicalDeviceSubgroupSizeControlFeatures::default();
        let mut matrices = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default();
        let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut twelve);
        if atomics_offered {
            features = features.push_next(&mut atomics);
        }
        if size_control_offered {
            features = features.push_next(&mut control);
        }
        let matrices_offered = offers(khr::cooperative_matrix::NAME);
        if matrices_offered {
            features = features.push_next(&mut matrices);
        }
        // SAFETY: as above.
        unsafe {
            self.raw
                .get_physical_device_features2(physical, &mut features)
        };
        info.driver = format!(
            "{} {}",
            text(driver.driver_name_as_c_str().map_err(drop)),
            text(driver.driver_info_as_c_str().map_err(drop))
        );
        info.max_buffer = match version >= vk::API_VERSION_1_3 {
            true => eleven
                .max_memory_allocation_size
                .min(thirteen.max_buffer_size),
            false => eleven.max_memory_allocation_size,
        };
        info.int64 = features.features.shader_int64 != 0;
        info.int64_atomics = twelve.shader_buffer_int64_atomics != 0;
        info.subgroup_size = subgroups.subgroup_size;
        info.float_atomics = atomics.shader_buffer_float32_atomic_add != 0;
        // hash_grid_backward_owned counts on eight lanes of one subgroup.
        info.few_cores = info.kind == DeviceKind::Cpu && info.subgroup_size >= 8;
        let is_lavapipe = driver.driver_id == vk::DriverId::MESA_LLVMPIPE;
        if info.few_cores && is_lavapipe && vk::api_version_major(info.driver_version) >= 26 {
            info.lanes_at_once = info.subgroup_size;
        }
        info.timestamp_period = limits.timestamp_period as f64;
        if control.subgroup_size_control != 0 && control.compute_full_subgroups != 0 {
            info.full_subgroups = Some(sizes.max_subgroup_size);
        }

        let has_required_size =
            (sizes.required_subgroup_size_stages).contains(vk::ShaderStageFlags::COMPUTE);
        let usable = matrices.cooperative_matrix != 0
            && twelve.shader_float16 != 0
            && twelve.vulkan_memory_model != 0
            && twelve.vulkan_memory_model_device_scope != 0
            && info.full_subgroups.is_some()
            && has_required_size;
        if usable {
            info.matrix = self.matrix(physical, info.subgroup_size)?;
        }

        let mut need = |there: bool, what: &str| {
            if !there {
                info.missing.push(what.into());
            }
        };
        need(twelve.buffer_device_address != 0, "buffer device addresses");
        need(twelve.scalar_block_layout != 0, "scalar block layout");
        need(twelve.timeline_semaphore != 0, "timeline semaphores");
        need(
            subgroups
                .supported_stages
                .contains(vk::ShaderStageFlags::COMPUTE),
            "subgroups in compute shaders",
        );
        let operations = [
            (vk::SubgroupFeatureFlags::BASIC, "basic subgroup operations"),
            (vk::SubgroupFeatureFlags::ARITHMETIC, "subgroup arithmetic"),
        ];
        for (operation, what) in operations {
            need(subgroups.supported_operations.contains(operation), what);
        }
        // SAFETY: a device of this instance.
        let families = unsafe {
            self.raw
                .get_physical_device_queue_family_properties(physical)
        };
        need(
            families
                .iter()
                .any(|family| family.queue_flags.contains(vk::QueueFlags::COMPUTE)),
            "a compute queue",
        );
        Ok(info)
    }

    /// The product of cooperative matrices that kernels use: of those that fill the tiles of glsl/lib/cooperative.glsl and have no more
    /// rows or columns than the subgroup has invocations, the largest.
    fn matrix(&self, physical: vk::PhysicalDevice, subgroup: u32) -> Result<Option<[u32; 3]>> {
        let cooperative = khr::cooperative_matrix::Instance::new(&self.entry, &self.raw);
        // SAFETY: a device of this instance, which offers the extension.
        let offered =
            unsafe { cooperative.get_physical_device_cooperative_matrix_properties(physical) };
        let offered =
            offered.map_err(vulkan("vkGetPhysicalDeviceCooperativeMatrixPropertiesKHR"))?;
        let (half, single) = (vk::ComponentTypeKHR::FLOAT16, vk::ComponentTypeKHR::FLOAT32);
        let tiles =
            (crate::kernels::ALL.iter()).filter_map(|module| module.cooperative?.matrix_tile);
        let usable = offered.iter().filter(|p| {
            (p.a_type, p.b_type, p.c_type, p.result_type) == (half, half, single, single)
                && p.scope == vk::ScopeKHR::SUBGROUP
                && tiles
                    .clone()
                    .all(|[m, n, k]| m % p.m_size == 0 && n % p.n_size == 0 && k % p.k_size == 0)
                && p.m_size.max(p.n_size) <= subgroup
        });
        let sizes = usable.map(|p| [p.m_size, p.n_size, p.k_size]);
        Ok(sizes.max_by_key(|size| size.iter().product::<u32>()))
    }
}

/// Index of the device that `wanted` means, or of the best.
pub(super) fn choose(
    devices: &[(vk::PhysicalDevice, DeviceInfo)],
    wanted: Option<&str>,
) -> Result<usize> {
    let listing = || {
        let lines = devices.iter().map(|(_, info)| {
            format!(
                "\n  {}: {} ({}, {})",
                info.index, info.name, info.kind, info.driver
            )
        });
        lines.collect::<String>()
    };
    let no_device = |what: String| Err(Error::NoDevice { what });
    if devices.is_empty() {
        return no_device(
            "no Vulkan device: a loader is installed, but no driver offers a device\n  next: install your GPU's Vulkan driver, or \
             Mesa's software device (package mesa-vulkan-drivers)"
                .into(),
        );
    }
    let chosen = match wanted {
        Some(wanted) => {
            // Short numbers are of the list, long ones may be of a name.
            let chosen = match wanted.parse::<usize>() {
                Ok(index) if index < 100 => Some(index).filter(|&index| index < devices.len()),
                _ if wanted.is_empty() => None,
                _ => {
                    let lower = wanted.to_lowercase();
                    devices
                        .iter()
                        .position(|(_, info)| info.name.to_lowercase().contains(&lower))
                }
            };
            match chosen {
                Some(index) => index,
                None => {
                    return no_device(format!(
                        "no Vulkan device \"{wanted}\"; there are{}\n  next: name one by its number or part of its name",
                        listing()
                    ));
                }
            }
        }
        None => {
            let able = devices.iter().filter(|(_, info)| info.missing.is_empty());
            match able.min_by_key(|(_, info)| info.kind) {
                Some((_, info)) => info.index,
                None => 0,
            }
        }
    };
    let info = &devices[chosen].1;
    if !info.missing.is_empty() {
        let missing = info.missing.join(", ");
        return no_device(format!(
            "{} lacks {missing}; there are{}\n  next: update its driver or choose another device",
            info.name,
            listing()
        ));
    }
    Ok(chosen)
}
