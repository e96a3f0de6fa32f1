//! The flags that say how a dataset is read and which region is reconstructed; shared by every command that opens one.

use clap::Args;

use crate::config::{Config, MaskUse};
use crate::scene::RegionOverrides;
use crate::train::run_directory::region_overrides;

/// How to read the dataset, and the region to reconstruct.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Scene")]
pub struct SceneArgs {
    /// Centre of the region, in the input's coordinates
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    pub center: Option<[f64; 3]>,
    /// Radius of the region, in the input's units
    #[arg(long, value_name = "R")]
    pub radius: Option<f64>,
    /// Two opposite corners of a box to use as the region
    #[arg(
        long = "box",
        value_name = "X0,Y0,Z0,X1,Y1,Z1",
        value_parser = numbers::<6>,
        allow_hyphen_values = true,
        conflicts_with_all = ["center", "radius"]
    )]
    pub boxed: Option<[f64; 6]>,
    /// Enlarge the region by this factor about its centre
    #[arg(long, value_name = "FACTOR")]
    pub region_scale: Option<f64>,
    /// Reduce the images by this factor
    #[arg(long, value_name = "FACTOR")]
    pub downscale: Option<f64>,
    /// Hold out every N-th view where the dataset has no split of its own (0: none)
    #[arg(long, value_name = "N")]
    pub holdout: Option<u32>,
    /// Do not use masks and alpha channels
    #[arg(long)]
    pub no_masks: bool,
}

impl SceneArgs {
    /// `defaults`, with what was typed in place of it. A size that was typed is not enlarged, unless that was typed, too.
    pub fn overrides(&self, defaults: &RegionOverrides) -> RegionOverrides {
        RegionOverrides {
            center: self.center.or(defaults.center),
            radius: self.radius.or(defaults.radius),
            boxed: self
                .boxed
                .map(|[x0, y0, z0, x1, y1, z1]| [[x0, y0, z0], [x1, y1, z1]])
                .or(defaults.boxed),
            scale: match self.boxed.is_some() || self.radius.is_some() {
                true => self.region_scale.unwrap_or(1.0),
                false => self.region_scale.unwrap_or(defaults.scale),
            },
            prefer_box: defaults.prefer_box,
        }
    }

    /// What these flags and a configuration say of the region.
    pub(super) fn region(&self, config: &Config) -> RegionOverrides {
        self.overrides(&region_overrides(config))
    }

    /// These flags' share of the settings, put into them.
    ///
    /// # Errors
    /// [`crate::Error::Config`] for values that make no sense.
    pub(super) fn put_into(&self, config: Config) -> crate::Result<Config> {
        let mut config = config;
        if let Some(downscale) = self.downscale {
            config.scene.downscale = downscale;
        }
        if let Some(holdout) = self.holdout {
            config.scene.holdout = holdout;
        }
        if let Some(scale) = self.region_scale {
            config.scene.region_scale = scale;
        }
        if self.no_masks {
            config.scene.masks = MaskUse::Ignore;
        }
        config.validated()
    }
}

/// `N` numbers with commas between them.
pub(super) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let wanted = || format!("{N} numbers with commas between them, not {}", parts.len());
    if parts.len() != N {
        return Err(wanted());
    }
    let mut values = [0.0f64; N];
    for (slot, part) in values.iter_mut().zip(&parts) {
        *slot = part
            .parse()
            .map_err(|_| format!("{part:?} is not a number"))?;
        if !slot.is_finite() {
            return Err(format!("{part} is not finite"));
        }
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Typed {
        #[command(flatten)]
        scene: SceneArgs,
    }

    #[test]
    fn negative_coordinates_are_numbers_not_flags() {
        let typed =
            Typed::try_parse_from(["x", "--center", "-1,2.5,-3e-1", "--radius", "2"]).unwrap();
        let overrides = typed.scene.overrides(&RegionOverrides::default());
        assert_eq!(overrides.center, Some([-1.0, 2.5, -0.3]));
        assert_eq!(overrides.radius, Some(2.0));
        let typed = Typed::try_parse_from(["x", "--box", "-1,-1,0,1,1,2", "--no-masks"]).unwrap();
        assert_eq!(
            typed.scene.overrides(&RegionOverrides::default()).boxed,
            Some([[-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]])
        );
        let mut config = Config::default();
        config.scene.masks = MaskUse::Exclude;
        let config = typed.scene.put_into(config).unwrap();
        assert_eq!(config.scene.masks, MaskUse::Ignore);
    }

    #[test]
    fn a_size_that_was_typed_is_not_enlarged() {
        let preset = RegionOverrides {
            scale: 1.5,
            ..RegionOverrides::default()
        };
        for (words, scale) in [
            (&["x"][..], 1.5),
            (&["x", "--center", "0,0,0"], 1.5),
            (&["x", "--radius", "2"], 1.0),
            (&["x", "--box", "0,0,0,1,1,1"], 1.0),
            (&["x", "--radius", "2", "--region-scale", "3"], 3.0),
        ] {
            let typed = Typed::try_parse_from(words).unwrap();
            assert_eq!(typed.scene.overrides(&preset).scale, scale, "{words:?}");
        }
    }

    #[test]
    fn what_is_no_vector_is_refused() {
        for wrong in [
            ["--center", "1,2"],
            ["--center", "1,2,x"],
            ["--center", "1,2,inf"],
            ["--box", "1,2,3"],
        ] {
            assert!(
                Typed::try_parse_from(["x", wrong[0], wrong[1]]).is_err(),
                "{wrong:?}"
            );
        }
        assert!(Typed::try_parse_from(["x", "--box", "0,0,0,1,1,1", "--radius", "1"]).is_err());
    }
}
