//! `neurodin devices`: what Vulkan offers, and what each device lacks.

use super::Context;
use crate::gpu::Gpu;
use clap::Args;
use serde_json::json;
use std::fmt::Write;

/// List the Vulkan devices
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin devices
  neurodin devices --json
  neurodin train photos/ --out run --device llvmpipe")]
pub(super) struct DevicesArgs {}

pub(super) fn run(_: &DevicesArgs, context: &Context) -> anyhow::Result<()> {
    let devices = Gpu::list()?;
    let mut text = String::new();
    for device in &devices {
        let (major, minor, patch) = device.vulkan;
        let _ = writeln!(
            text,
            "{}: {} ({}, {}, Vulkan {major}.{minor}.{patch}, {:.1} GiB{})",
            device.index,
            device.name,
            device.kind,
            device.driver,
            device.memory as f64 / f64::from(1 << 30),
            match device.missing.is_empty() {
                true => String::new(),
                false => format!("; unusable, it lacks {}", device.missing.join(", ")),
            }
        );
    }
    let listed: Vec<_> = devices
        .iter()
        .map(|device| {
            let (major, minor, patch) = device.vulkan;
            json!({
                "index": device.index,
                "name": device.name,
                "kind": device.kind.to_string(),
                "driver": device.driver,
                "vulkan": format!("{major}.{minor}.{patch}"),
                "memory": device.memory,
                "max_buffer": device.max_buffer,
                "subgroup_size": device.subgroup_size,
                "shared_memory": device.shared_memory,
                "max_workgroup": device.max_workgroup,
                "float_atomics": device.float_atomics,
                "matrix": device.matrix,
                "usable": device.missing.is_empty(),
                "missing": device.missing,
            })
        })
        .collect();
    context.result(&json!({ "devices": listed }), &text)?;
    Ok(())
}
