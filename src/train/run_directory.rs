//! Where a run keeps what it makes: a folder with `config.toml`, `scene.json`, `log.jsonl`, `previews/` and `ckpt/`.

use crate::config::{Config, RegionKind};
use crate::scene::{Format, Region, RegionOverrides, Scene, SceneOptions, Split};
use crate::{Error, Result, whole_file};
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

/// The folder of a run.
#[derive(Debug)]
pub struct RunDirectory {
    root: PathBuf,
    /// Held while a process writes here; the system lets go of it when the process ends, however it ends.
    _lock: Option<File>,
}

impl RunDirectory {
    /// Makes the folder for a new run. One that holds anything already is refused unless `replace`, which removes the parts of a
    /// former run and nothing else.
    ///
    /// # Errors
    /// [`Error::Output`] if it exists, is in use by another process, or cannot be written.
    pub fn create(root: &Path, replace: bool) -> Result<RunDirectory> {
        RunDirectory::check_free(root, replace)?;
        let failed = |path: &Path, error: std::io::Error| {
            Error::output(
                path,
                format!("cannot write there: {error}"),
                "give another --out",
            )
        };
        fs::create_dir_all(root).map_err(|error| failed(root, error))?;
        let run = RunDirectory {
            root: root.into(),
            _lock: lock(root)?,
        };
        for file in [run.config(), run.scene(), run.log()] {
            remove(&file, |path| fs::remove_file(path))?;
        }
        for folder in [run.previews(), run.checkpoints()] {
            remove(&folder, |path| fs::remove_dir_all(path))?;
            fs::create_dir_all(&folder).map_err(|error| failed(&folder, error))?;
        }
        Ok(run)
    }

    /// Whether [`RunDirectory::create`] would find the place free; changes nothing.
    ///
    /// # Errors
    /// [`Error::Output`] if not.
    pub fn check_free(root: &Path, replace: bool) -> Result<()> {
        let entries: Vec<fs::DirEntry> = match fs::read_dir(root).and_then(Iterator::collect) {
            Ok(entries) => entries,
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(Error::output(root, error.to_string(), "give another --out")),
        };
        let holds = |name: &str| entries.iter().any(|entry| entry.file_name() == name);
        let refusal = |what: &str, next: &str| Err(Error::output(root, what, next));
        match (holds(CONFIG) && holds(SCENE), replace) {
            (true, true) => Ok(()),
            (true, false) => refusal(
                "holds a run already",
                "go on with it by --resume, replace it by --force, or give another --out",
            ),
            (false, _) if !holds(CONFIG) && entries.iter().all(is_of_a_start) => Ok(()),
            (false, true) => match PARTS.iter().find(|part| holds(part)) {
                Some(part) => refusal(
                    &format!("holds '{part}', but no run that it could belong to"),
                    "move it away, or give another --out: a run would take its place",
                ),
                None => Ok(()),
            },
            (false, false) => refusal(
                "exists and is not empty",
                "give another --out, or --force to write into it",
            ),
        }
    }

    /// An existing run, to be gone on with.
    ///
    /// # Errors
    /// As [`RunDirectory::open`]; [`Error::Output`] if another process is writing there.
    pub fn resume(root: &Path) -> Result<RunDirectory> {
        let run = RunDirectory::open(root)?;
        Ok(RunDirectory {
            _lock: lock(root)?,
            ..run
        })
    }

    /// An existing run, to be read.
    ///
    /// # Errors
    /// [`Error::Input`] if there is none.
    pub fn open(root: &Path) -> Result<RunDirectory> {
        let run = RunDirectory {
            root: root.into(),
            _lock: None,
        };
        match run.config().is_file() {
            true => Ok(run),
            false => Err(Error::input(
                root,
                "is no run directory: it holds no config.toml",
                "name the folder that `neurodin train --out` wrote",
            )),
        }
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The resolved configuration, commented.
    pub fn config(&self) -> PathBuf {
        self.root.join(CONFIG)
    }

    /// Dataset, region and views.
    pub fn scene(&self) -> PathBuf {
        self.root.join(SCENE)
    }

    pub fn log(&self) -> PathBuf {
        self.root.join(LOG)
    }

    pub fn checkpoints(&self) -> PathBuf {
        self.root.join(CHECKPOINTS)
    }

    pub fn previews(&self) -> PathBuf {
        self.root.join(PREVIEWS)
    }

    /// The picture of a held-out view after so many steps.
    pub fn preview(&self, step: u64) -> PathBuf {
        self.previews().join(format!("step-{step:08}.png"))
    }

    /// Writes a small text file whole or not at all.
    ///
    /// # Errors
    /// [`Error::Output`] if it cannot be written.
    pub fn write(&self, path: &Path, text: &str) -> Result<()> {
        whole_file::replace(path, |file| file.write_all(text.as_bytes()))
            .map_err(|error| Error::unwritable(path, &error))
    }
}

fn remove(path: &Path, remove: impl Fn(&Path) -> std::io::Result<()>) -> Result<()> {
    match remove(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(Error::output(
            path,
            format!("cannot be replaced: {error}"),
            "give another --out",
        )),
        _ => Ok(()),
    }
}

/// What a run's folder holds.
const PARTS: [&str; 5] = [CONFIG, SCENE, LOG, CHECKPOINTS, PREVIEWS];
const CONFIG: &str = "config.toml";
const SCENE: &str = "scene.json";
const LOG: &str = "log.jsonl";
const CHECKPOINTS: &str = "ckpt";
const PREVIEWS: &str = "previews";

/// Whether this may be what a start leaves behind that was broken off before there was a configuration.
fn is_of_a_start(entry: &fs::DirEntry) -> bool {
    let is_empty = || fs::read_dir(entry.path()).is_ok_and(|mut inside| inside.next().is_none());
    match entry.file_name().to_str() {
        Some(CHECKPOINTS | PREVIEWS) => is_empty(),
        Some(name) => name == LOCK || name == SCENE || name.ends_with(".part"),
        None => false,
    }
}

/// Name of the file whose lock says that a process writes to a run.
const LOCK: &str = ".lock";

/// Takes the folder for this process. File systems without locks go without.
fn lock(root: &Path) -> Result<Option<File>> {
    let path = root.join(LOCK);
    let file = File::create(&path).map_err(|error| Error::unwritable(root, &error))?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(fs::TryLockError::WouldBlock) => Err(Error::output(
            root,
            "another process is training there",
            "wait for it or stop it, or give another --out",
        )),
        Err(fs::TryLockError::Error(_)) => Ok(None),
    }
}

/// What a run was trained on: enough to open the same views again, and to take results to the input's coordinates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneRecord {
    /// Absolute path of the dataset.
    pub dataset: PathBuf,
    pub format: Format,
    pub region: Region,
    /// Rows of the matrix that takes region coordinates to the input's.
    pub world_from_region: [[f64; 4]; 4],
    pub views: Vec<ViewRecord>,
}

/// A view as a run knows it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ViewRecord {
    pub name: String,
    pub split: Split,
    /// Of the picture as it is trained with.
    pub width: u32,
    pub height: u32,
}

/// Which region a configuration takes of a dataset.
pub fn region_overrides(config: &Config) -> RegionOverrides {
    RegionOverrides {
        scale: config.scene.region_scale,
        prefer_box: config.scene.shape == RegionKind::Box,
        ..RegionOverrides::default()
    }
}

fn absolute(dataset: &Path) -> Result<PathBuf> {
    fs::canonicalize(dataset).map_err(|error| Error::unreadable(dataset, &error))
}

/// How a configuration reads its dataset.
pub fn scene_options(config: &Config) -> SceneOptions {
    SceneOptions {
        downscale: config.scene.downscale,
        holdout: config.scene.holdout,
        masks: config.scene.masks.reads(),
    }
}

impl SceneRecord {
    /// What `scene`, opened from `dataset`, is to a run.
    ///
    /// # Errors
    /// [`Error::Input`] if the dataset's path cannot be resolved.
    pub fn new(dataset: &Path, scene: &Scene, region: &Region) -> Result<SceneRecord> {
        let rows = region.world_from_region().transpose().to_cols_array_2d();
        Ok(SceneRecord {
            dataset: absolute(dataset)?,
            format: scene.format,
            region: region.clone(),
            world_from_region: rows,
            views: views(scene),
        })
    }

    /// As JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a record is plain data") + "\n"
    }

    /// The record of a run.
    ///
    /// # Errors
    /// [`Error::Input`] if there is none or it cannot be read.
    pub fn load(run: &RunDirectory) -> Result<SceneRecord> {
        let path = run.scene();
        let unusable = |why: String| {
            Error::input(
                &path,
                why,
                "a run's scene.json is written by `neurodin train`; restore it from there",
            )
        };
        let text = fs::read_to_string(&path).map_err(|error| unusable(error.to_string()))?;
        serde_json::from_str(&text).map_err(|error| unusable(error.to_string()))
    }

    /// Remembers where the dataset is now.
    ///
    /// # Errors
    /// [`Error::Input`] if the path cannot be resolved.
    pub fn move_to(&mut self, dataset: &Path) -> Result<()> {
        self.dataset = absolute(dataset)?;
        Ok(())
    }

    /// Opens the dataset again, here or at `moved`, as `config` says.
    ///
    /// # Errors
    /// What [`Scene::open`] fails with; [`Error::Input`] if it no longer holds the views that were trained with.
    pub fn open(&self, moved: Option<&Path>, config: &Config) -> Result<Scene> {
        let dataset = moved.unwrap_or(&self.dataset);
        if moved.is_none() && !dataset.exists() {
            return Err(Error::input(
                dataset,
                "is no longer there: the run was trained on it",
                "name its new place: DATASET for `neurodin train --resume`, --dataset elsewhere",
            ));
        }
        let scene = Scene::open(dataset, &scene_options(config))?;
        let now = views(&scene);
        if now == self.views {
            return Ok(scene);
        }
        let changed = self
            .views
            .iter()
            .zip(&now)
            .find(|(was, is)| was != is)
            .map_or_else(
                || format!("it holds {} views", now.len()),
                |(was, is)| {
                    format!(
                        "where there was '{}' ({} x {}, {:?}) there is '{}' ({} x {}, {:?})",
                        was.name,
                        was.width,
                        was.height,
                        was.split,
                        is.name,
                        is.width,
                        is.height,
                        is.split
                    )
                },
            );
        Err(Error::input(
            dataset,
            format!(
                "is not the dataset that the run was trained on, which held {} views: {changed}",
                self.views.len()
            ),
            "restore it, name where it is now, or begin a new run",
        ))
    }
}

fn views(scene: &Scene) -> Vec<ViewRecord> {
    scene
        .views
        .iter()
        .map(|view| ViewRecord {
            name: view.name.clone(),
            split: view.split,
            width: view.camera.width,
            height: view.camera.height,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_neither_overwritten_nor_shared() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("run");
        assert!(
            RunDirectory::open(&root)
                .unwrap_err()
                .to_string()
                .contains("no run directory")
        );
        let run = RunDirectory::create(&root, false).unwrap();
        run.write(&run.scene(), "{}").unwrap();
        run.write(&run.config(), "steps = 1\n").unwrap();
        fs::write(run.preview(5), b"png").unwrap();
        fs::write(root.join("notes.txt"), b"mine").unwrap();
        assert!(matches!(
            RunDirectory::create(&root, false),
            Err(Error::Output { .. })
        ));
        let shared = RunDirectory::resume(&root).unwrap_err().to_string();
        assert!(shared.contains("another process"), "{shared}");
        let shared = RunDirectory::create(&root, true).unwrap_err().to_string();
        assert!(shared.contains("another process"), "{shared}");
        assert!(run.preview(5).exists(), "nothing was removed");
        drop(run);
        drop(RunDirectory::resume(&root).unwrap());
        let run = RunDirectory::create(&root, true).unwrap();
        assert!(!run.preview(5).exists() && !run.config().exists());
        assert!(
            root.join("notes.txt").exists(),
            "what is not of a run stays"
        );
    }

    /// What a start left behind that was broken off is nobody's; what only looks like a run's is somebody else's.
    #[test]
    fn places_are_free_or_not() {
        let folder = tempfile::tempdir().unwrap();
        let begun = folder.path().join("begun");
        let run = RunDirectory::create(&begun, false).unwrap();
        run.write(&run.scene(), "{}").unwrap();
        fs::write(begun.join("config.part"), b"ste").unwrap();
        drop(run);
        RunDirectory::create(&begun, false).unwrap();

        let theirs = folder.path().join("theirs");
        fs::create_dir_all(theirs.join("previews")).unwrap();
        let picture = theirs.join("previews/mine.jpg");
        fs::write(&picture, b"jpg").unwrap();
        fs::write(theirs.join("config.toml"), b"mine = true").unwrap();
        for replace in [false, true] {
            let refused = RunDirectory::create(&theirs, replace).unwrap_err();
            assert_eq!(refused.exit_code(), 8, "{refused}");
        }
        assert!(picture.exists() && theirs.join("config.toml").exists());

        let other = folder.path().join("other");
        fs::create_dir_all(&other).unwrap();
        fs::write(other.join("notes.txt"), b"mine").unwrap();
        assert!(RunDirectory::create(&other, false).is_err());
        RunDirectory::create(&other, true).unwrap();
    }
}
