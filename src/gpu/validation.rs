//! Validation on request: the Khronos layer with its synchronisation checks, and what it says.
//!
//! The layers of 1.3.239 (Debian 12) take VK_EXT_validation_features; newer ones VK_EXT_layer_settings, where the check of accesses in
//! shaders is asked for by name. Neither sees accesses through device addresses: that is what guard mode and `barrier_everywhere` are for.

use super::device::vulkan;
use crate::{Error, Result};
use ash::{ext, vk};
use std::ffi::{CStr, c_void};
use std::sync::{Arc, Mutex};

/// The layer's name.
pub(super) const LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";
/// Beyond this many, messages only count.
const MOST_MESSAGES: usize = 1000;

/// What the validation layer said. Stays readable after the device is gone, since leaks are reported then.
#[derive(Clone, Debug, Default)]
pub struct ValidationLog(Arc<Mutex<Vec<String>>>);

impl ValidationLog {
    /// Warnings and errors so far.
    pub fn messages(&self) -> Vec<String> {
        self.0
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .clone()
    }
}

/// How the layer takes its settings.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Channel {
    LayerSettings,
    ValidationFeatures,
    Neither,
}

impl Channel {
    /// What the installed layer offers; refuses where there is no layer.
    pub(super) fn find(entry: &ash::Entry) -> Result<Channel> {
        // SAFETY: a loaded entry; the call only reads.
        let layers = unsafe { entry.enumerate_instance_layer_properties() };
        let layers = layers.map_err(vulkan("vkEnumerateInstanceLayerProperties"))?;
        if !layers
            .iter()
            .any(|layer| layer.layer_name_as_c_str() == Ok(LAYER))
        {
            return Err(Error::NoDevice {
                what: "validation was asked for, but VK_LAYER_KHRONOS_validation is not installed\n  next: install it (Debian, Ubuntu: \
                       vulkan-validationlayers) or run without"
                    .into(),
            });
        }
        // SAFETY: as above.
        let offered = unsafe { entry.enumerate_instance_extension_properties(Some(LAYER)) };
        let offered = offered.map_err(vulkan("vkEnumerateInstanceExtensionProperties"))?;
        let offers = |name: &CStr| {
            offered
                .iter()
                .any(|e| e.extension_name_as_c_str() == Ok(name))
        };
        Ok(if offers(ext::layer_settings::NAME) {
            Channel::LayerSettings
        } else if offers(ext::validation_features::NAME) {
            Channel::ValidationFeatures
        } else {
            Channel::Neither
        })
    }

    /// The instance extension to enable.
    pub(super) fn extension(self) -> Option<&'static CStr> {
        match self {
            Channel::LayerSettings => Some(ext::layer_settings::NAME),
            Channel::ValidationFeatures => Some(ext::validation_features::NAME),
            Channel::Neither => None,
        }
    }
}

/// Features for VK_EXT_validation_features.
pub(super) const FEATURES: [vk::ValidationFeatureEnableEXT; 1] =
    [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];

/// Settings for VK_EXT_layer_settings; both are booleans, and on.
pub(super) fn layer_settings() -> [vk::LayerSettingEXT<'static>; 2] {
    static ON: [vk::Bool32; 1] = [vk::TRUE];
    let on = |name: &'static CStr| vk::LayerSettingEXT {
        p_layer_name: LAYER.as_ptr(),
        p_setting_name: name.as_ptr(),
        ty: vk::LayerSettingTypeEXT::BOOL32,
        value_count: 1,
        p_values: ON.as_ptr().cast(),
        ..Default::default()
    };
    [
        on(c"validate_sync"),
        on(c"syncval_shader_accesses_heuristic"),
    ]
}

/// Description of a messenger that writes into `log`, which must outlive it.
pub(super) fn messenger(log: &ValidationLog) -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(
            vk::DebugUtilsMessageSeverityFlagsEXT::WARNING
                | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR,
        )
        .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
        .pfn_user_callback(Some(collect))
        .user_data(Arc::as_ptr(&log.0).cast_mut().cast())
}

/// # Safety
/// Called by the loader with the pointer that `messenger` gave.
unsafe extern "system" fn collect(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    log: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the instance that owns the messenger owns the log as well, and messages are valid during the call.
    let (log, message) = unsafe {
        (
            &*log.cast::<Mutex<Vec<String>>>(),
            (*data).message_as_c_str(),
        )
    };
    let mut messages = log.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if messages.len() < MOST_MESSAGES {
        messages.push(
            message
                .map(|text| text.to_string_lossy().into_owned())
                .unwrap_or_default(),
        );
    }
    vk::FALSE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Gpu, GpuOptions};

    #[test]
    fn the_layer_sees_a_misuse_and_a_leak() -> Result<()> {
        let options = GpuOptions {
            validation: true,
            ..GpuOptions::default()
        };
        let gpu = Gpu::new(&options)?;
        let log = gpu.validation_log();
        let create =
            vk::SemaphoreCreateInfo::default().flags(vk::SemaphoreCreateFlags::from_raw(1));
        // SAFETY: deliberately wrong flags, which drivers ignore; deliberately never destroyed.
        unsafe { gpu.inner.device().create_semaphore(&create, None) }
            .expect("drivers ignore the flags");
        let said = gpu.validation_messages();
        assert!(
            said.iter()
                .any(|text| text.contains("VkSemaphoreCreateInfo-flags")),
            "{said:?}"
        );
        drop(gpu);
        let said = log.messages();
        assert!(
            said.iter().any(|text| text.contains("vkDestroyDevice")),
            "{said:?}"
        );
        Ok(())
    }
}
