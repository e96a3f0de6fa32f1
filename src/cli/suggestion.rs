//! Which preset a dataset asks for, by where its cameras look and what lies beyond the region; and whether another one fits.

use super::scene_args::SceneArgs;
use crate::Result;
use crate::config::{BackgroundKind, Config};
use crate::scene::{Beyond, Facing, Looks, Region, Scene, Split};

/// What a dataset asks for, and why.
pub(super) struct Suggestion {
    pub looks: Looks,
    /// `None` for rooms, which end at their walls.
    pub beyond: Option<Beyond>,
}

impl Suggestion {
    /// Looks at the cameras, and at a few pictures where they do not stand in a room.
    ///
    /// # Errors
    /// [`crate::Error::Input`] for a picture that cannot be read.
    pub fn of(scene: &Scene, region: &Region) -> Result<Suggestion> {
        let looks = Looks::of(scene);
        let beyond = match looks.facing {
            Facing::Inward => Some(Beyond::of(scene, region)?),
            Facing::Outward => None,
        };
        Ok(Suggestion { looks, beyond })
    }

    /// The same with the region that the suggested preset would take.
    ///
    /// # Errors
    /// As [`Suggestion::of`] and [`Region::estimate`].
    pub fn for_scene(scene: &Scene, flags: &SceneArgs) -> Result<Suggestion> {
        let config = flags.put_into(Config::preset("outdoor-tiny")?)?;
        let region = Region::estimate(scene, &flags.region(&config))?;
        Suggestion::of(scene, &region)
    }

    /// What the names of fitting presets begin with.
    pub fn kind(&self) -> &'static str {
        match self.looks.facing {
            Facing::Inward => "outdoor",
            Facing::Outward => "indoor",
        }
    }

    /// The preset for a software device.
    pub fn preset(&self) -> String {
        format!("{}-tiny", self.kind())
    }

    /// What should differ from it.
    pub fn settings(&self) -> &'static [&'static str] {
        match &self.beyond {
            Some(Beyond { runs_on: true, .. }) => &["background.kind=field"],
            _ => &[],
        }
    }

    /// The preset with those settings.
    ///
    /// # Errors
    /// None that a preset of this program could have.
    pub fn config(&self) -> Result<Config> {
        let config = Config::preset(&self.preset())?;
        self.settings()
            .iter()
            .try_fold(config, |config, setting| config.with_assignment(setting))
    }

    /// Why it was chosen, for a line that names the preset.
    pub fn in_words(&self) -> String {
        let kind = match self.looks.facing {
            Facing::Inward => "inwards",
            Facing::Outward => "outwards",
        };
        let with: Vec<String> = self
            .settings()
            .iter()
            .map(|setting| format!(" with {setting}"))
            .collect();
        format!(
            "{} (the cameras look {kind}{}; --preset chooses another)",
            with.concat(),
            match &self.beyond {
                Some(Beyond { runs_on: true, why }) => format!(", and {why}"),
                _ => String::new(),
            }
        )
    }

    /// What its owner should do something about, whatever the settings.
    pub fn warnings(&self, scene: &Scene, region: &Region) -> Vec<String> {
        let facing = self.looks.facing;
        let mut warnings = Vec::new();
        let train = scene.split(Split::Train).count();
        if train < 20 {
            warnings.push(format!(
                "only {train} training views: surfaces that few of them see will be guesses"
            ));
        }
        let inside = region.cameras_inside(scene);
        if facing == Facing::Outward && inside < scene.views.len() {
            let outside = scene.views.len() - inside;
            warnings.push(format!(
                "the cameras look outwards, but {outside} of {} stand outside the region: enlarge it (--region-scale, --radius)",
                scene.views.len()
            ));
        }
        let points = region.points_inside(scene);
        if !scene.points.is_empty() && points * 5 < scene.points.len() {
            warnings.push(format!(
                "only {points} of {} points lie inside the region: look at the preview (--preview FILE)",
                scene.points.len()
            ));
        }
        let seeing = scene
            .views
            .iter()
            .filter(|view| view.sees(region.center).is_some())
            .count();
        if facing == Facing::Inward && seeing * 2 < scene.views.len() {
            warnings.push(format!(
                "the region's centre is in {seeing} of {} pictures only",
                scene.views.len()
            ));
        }
        warnings
    }

    /// What speaks against a configuration that was asked for. It is used all the same.
    pub fn doubts(&self, config: &Config, scene: &Scene, region: &Region) -> Vec<String> {
        let mut doubts: Vec<String> = cameras_in_matter(config, scene, region)
            .into_iter()
            .collect();
        let room = self.looks.facing == Facing::Outward;
        if config.surface.inside_out != room {
            let (meant, looks) = match room {
                true => ("objects and open scenes", "outwards, as from within a room"),
                false => ("rooms", "inwards, as at an object or building"),
            };
            doubts.push(format!(
                "{} is for {meant} (surface.inside_out = {}), but the cameras look {looks}: {}. It is used as asked; if the mesh is bad, \
                 try {}",
                config.preset,
                config.surface.inside_out,
                self.looks.why,
                self.preset()
            ));
        }
        if let Some(Beyond { runs_on: true, why }) = &self.beyond
            && !config.surface.inside_out
            && config.background.kind != BackgroundKind::Field
        {
            doubts.push(format!(
                "{why}, which one colour behind the region cannot explain: the surface may vanish over it; \
                 --set background.kind=field shows what lies beyond"
            ));
        }
        doubts
    }
}

/// In rooms, cameras that stand outside the sphere which is free space at first: they see fog that training is slow to clear.
fn cameras_in_matter(config: &Config, scene: &Scene, region: &Region) -> Option<String> {
    if !config.surface.inside_out {
        return None;
    }
    let region_from_world = region.region_from_world();
    let position = |view: usize| {
        let camera = scene.views[view].world_from_camera.w_axis.truncate();
        region_from_world.transform_point3(camera).length()
    };
    let farthest = scene.split(Split::Train).map(position).fold(0.0, f64::max);
    let free = config.surface.initial_radius();
    (farthest > free).then(|| {
        format!(
            "cameras stand up to {farthest:.2} from the centre of the region (in its units), and space is free up to {free:.2} at first: \
             fog around them is slow to go. A larger --region-scale, or --set surface.init_bias={:.1}, would hold them all",
            (farthest / free * config.surface.init_bias * 10.0).ceil() / 10.0
        )
    })
}
