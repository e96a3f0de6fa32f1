//! `neurodin mesh`: the zero surface of what a run has learned, as triangles in the coordinates of the input.

use super::progress::Progress;
use super::{Context, interrupt, scene_args};
use crate::Error;
use crate::gpu::Gpu;
use crate::mesh::extract::ExtractStats;
use crate::mesh::{ExtractOptions, Field, Mesh, clean, extract, write};
use crate::train::run_directory::RunDirectory;
use crate::train::trained::Trained;
use clap::{Args, ValueEnum};
use glam::{DMat4, DVec3};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// Take the triangle mesh out of a run
#[derive(Args, Default)]
#[command(after_help = "\
Example:
  neurodin mesh run -o mesh.ply
  neurodin mesh run -o mesh.glb --resolution 1024 --keep-largest
  neurodin mesh run -o part.obj --crop -1,-1,0,1,1,2")]
pub(super) struct MeshArgs {
    /// Run directory, as `neurodin train --out` wrote it
    pub run: PathBuf,
    /// File to write: .ply, .obj or .glb [default: mesh.ply in the run directory]
    #[arg(short, long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Cells along the longest side of the region
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(8..=16384))]
    pub resolution: u32,
    /// Keep only what lies in this box, in the input's coordinates
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = scene_args::numbers::<6>, allow_hyphen_values = true)]
    pub crop: Option<[f64; 6]>,
    /// Keep only the largest connected part
    #[arg(long, conflicts_with = "min_faces")]
    pub keep_largest: bool,
    /// Drop connected parts of fewer faces
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub min_faces: usize,
    /// Evaluate every cell, also far from where the surface can be
    #[arg(long)]
    pub exhaustive: bool,
    /// Coordinates of the mesh
    #[arg(long, value_enum, default_value_t, value_name = "FRAME")]
    pub frame: Frame,
    /// Replace the file if it exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum Frame {
    /// Those of the input's cameras
    #[default]
    World,
    /// Those of training: the region has radius 1 about the origin
    Region,
}

/// Cells are left out where the signed distance says that the surface is far, supposing that it is nowhere steeper than this. Training
/// holds slopes near 1, up to 8 here and there; whether it held is measured, and said.
const STEEPEST: f64 = 10.0;

pub(super) fn run(args: &MeshArgs, context: &Context) -> anyhow::Result<()> {
    let written = take(args, context)?.ok_or_else(|| no_surface(&args.run))?;
    Ok(context.result(&written.to_json(), &written.text())?)
}

/// Said of a run that has learned no surface.
pub(super) const NO_SURFACE: &str = "the signed distance has no zero surface in the region";

/// The error of a run that has learned no surface, for those who cannot do without.
pub(super) fn no_surface(run: &Path) -> Error {
    Error::input(
        run,
        NO_SURFACE,
        "look at the previews: train longer, or choose the region by --center and --radius (`neurodin inspect --preview` shows it)",
    )
}

/// A mesh that was taken out of a run.
pub(super) struct Written {
    pub file: PathBuf,
    pub mesh: Mesh,
    stats: ExtractStats,
    /// Side of a cell, in the mesh's units.
    cell: f64,
    /// Steps that the run was trained for.
    step: u64,
}

impl Written {
    fn to_json(&self) -> Value {
        json!({
            "mesh": self.file,
            "vertices": self.mesh.positions.len(),
            "faces": self.mesh.faces.len(),
            "bounds": self.mesh.bounds().map(|corners| corners.map(|corner| corner.to_array())),
            "cells": self.stats.cells,
            "cell": self.cell,
            "step": self.step,
        })
    }

    pub fn text(&self) -> String {
        format!(
            "done     {}: {} vertices, {} faces",
            self.file.display(),
            self.mesh.positions.len(),
            self.mesh.faces.len()
        )
    }
}

/// Takes the mesh out as `args` say; `None`, and no file, where there is no zero surface.
///
/// # Errors
/// Those of reading the run and of writing the mesh; [`Error::Interrupted`] after Ctrl-C; whatever the device fails with.
pub(super) fn take(args: &MeshArgs, context: &Context) -> anyhow::Result<Option<Written>> {
    let run = RunDirectory::open(&args.run)?;
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| run.root().join("mesh.ply"));
    write::check_destination(&out, args.force)?;
    let gpu = context.gpu()?;
    let trained = Trained::open(&gpu, &run)?;
    for refused in &trained.refused {
        context.warn(&refused.to_string());
    }
    context.say(&format!(
        "run      {}, {} of {} steps, on {}",
        run.root().display(),
        trained.step,
        trained.config().total_steps(),
        gpu.info().name
    ));
    let world_from_region = trained.region.world_from_region();
    let options = ExtractOptions {
        resolution: args.resolution,
        crop: args.crop.map(corners),
        steepest: (!args.exhaustive).then_some(STEEPEST),
        ..ExtractOptions::of(&trained.region)
    };
    let (mut mesh, stats) = surface(&gpu, &trained, &options, context)?;
    if let (true, Some([x0, y0, z0, x1, y1, z1])) = (mesh.faces.is_empty(), args.crop) {
        return Err(Error::Config {
            what: format!(
                "--crop {x0},{y0},{z0},{x1},{y1},{z1}: no surface crosses that box\n  next: look at the mesh without --crop for where it is, \
                 in the coordinates of the cameras"
            ),
        }
        .into());
    }
    if stats.blocks_skipped > 0 && stats.steepest > STEEPEST {
        context.warn(&format!(
            "{} of {} blocks were left out as far from the surface, but the signed distance has slopes up to {:.1}, above the {STEEPEST} that was \
             supposed: --exhaustive makes sure that nothing is missing",
            stats.blocks_skipped, stats.blocks, stats.steepest
        ));
    }
    let out_from_region = match args.frame {
        Frame::World => world_from_region,
        Frame::Region => DMat4::IDENTITY,
    };
    extract::to_world(&mut mesh, out_from_region);
    if args.keep_largest {
        clean::keep_largest(&mut mesh);
    } else if args.min_faces > 0 {
        let faces = mesh.faces.len();
        clean::drop_small(&mut mesh, args.min_faces);
        if mesh.faces.is_empty() && faces > 0 {
            return Err(Error::Config {
                what: format!(
                    "--min-faces {}: none of the {faces} faces is part of so large a piece\n  next: a smaller number, or --keep-largest",
                    args.min_faces
                ),
            }
            .into());
        }
    }
    if mesh.faces.is_empty() {
        return Ok(None);
    }
    write::write_mesh(&out, &mesh, args.force)?;
    Ok(Some(Written {
        file: out,
        cell: stats.step * out_from_region.x_axis.truncate().length(),
        step: trained.step,
        mesh,
        stats,
    }))
}

/// The mesh in region coordinates, with normals and colours.
fn surface(
    gpu: &Gpu,
    trained: &Trained,
    options: &ExtractOptions,
    context: &Context,
) -> anyhow::Result<(Mesh, ExtractStats)> {
    let interrupted = interrupt::flag(context, "stopping")?;
    let mut field = Field::new(gpu, trained.config(), &trained.model, trained.annealed())?;
    let mut stage = None;
    let mut shown: Option<Progress> = None;
    let mut tell = |progress: extract::Progress| {
        if stage != Some(progress.stage) {
            stage = Some(progress.stage);
            let what = match progress.stage {
                extract::Stage::Lattice => "surface",
                extract::Stage::Attributes => "colours",
            };
            // The bar of the stage before goes first.
            shown = None;
            shown = Some(Progress::new(context, what, progress.total));
        }
        if let Some(shown) = &mut shown {
            shown.at(progress.done, &format!("{} faces", progress.faces));
        }
        !interrupted.load(Ordering::SeqCst)
    };
    let (mut mesh, stats) = extract::extract_surface(&mut field, options, &mut tell)?;
    extract::add_attributes(&mut mesh, &mut field, &mut tell)?;
    Ok((mesh, stats))
}

/// Two opposite corners, the lower one first.
fn corners([x0, y0, z0, x1, y1, z1]: [f64; 6]) -> [DVec3; 2] {
    let (a, b) = (DVec3::new(x0, y0, z0), DVec3::new(x1, y1, z1));
    [a.min(b), a.max(b)]
}
