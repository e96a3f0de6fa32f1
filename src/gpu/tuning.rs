//! Which of several ways of doing the same is fastest on this device: measured once, remembered beside the pipeline cache.

use super::device::Gpu;
use super::kernel::cache_name;
use super::recorder::Recorder;
use crate::{Result, kernels, whole_file};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::Write;
use std::path::PathBuf;
use std::sync::Mutex;

/// What was measured, in a file.
pub(super) struct Tuning {
    answers: Mutex<Answers>,
    file: Option<PathBuf>,
}

/// Answers by what was asked ([`asked`]), as names of ways.
type Answers = BTreeMap<String, String>;

/// The file's contents.
#[derive(Serialize, Deserialize)]
struct Kept {
    /// With which kernels: other ones may have other answers.
    kernels: String,
    answers: Answers,
}

/// A name for the kernels of this program, such as they are.
fn kernels_at_hand() -> String {
    let mut hasher = DefaultHasher::new();
    for module in kernels::ALL {
        module.spirv.hash(&mut hasher);
        let by_matrices = module.cooperative.map(|module| module.spirv);
        by_matrices.hash(&mut hasher);
    }
    format!("{:016x}", hasher.finish())
}

/// A question together with the ways it was asked of, in any order: the fastest of some need not be the fastest where there are others.
fn asked(question: &str, ways: &[String]) -> String {
    let mut ways = ways.to_vec();
    ways.sort();
    format!("{question}: {}", ways.join(" | "))
}

/// A way takes the place of the first where it needs no more than this share of its time: less of a difference is noise.
const WORTH: f64 = 0.9;

impl Tuning {
    /// What is known already. An unreadable file is no error: what it said is measured again.
    pub(super) fn new(file: Option<PathBuf>) -> Tuning {
        let text = file
            .as_ref()
            .and_then(|file| std::fs::read_to_string(file).ok());
        let answers = text
            .and_then(|text| serde_json::from_str(&text).ok())
            .filter(|kept: &Kept| kept.kernels == kernels_at_hand())
            .map(|kept| kept.answers)
            .unwrap_or_default();
        if let Some(file) = &file {
            tracing::info!(file = %file.display(), ?answers, "tuning answers taken");
        }
        Tuning {
            answers: Mutex::new(answers),
            file,
        }
    }

    fn save(&self, answers: &Answers) -> std::io::Result<()> {
        let Some(file) = &self.file else {
            return Ok(());
        };
        std::fs::create_dir_all(file.parent().expect("a file in a folder"))?;
        let kept = Kept {
            kernels: kernels_at_hand(),
            answers: answers.clone(),
        };
        let text = serde_json::to_string_pretty(&kept).expect("names are text") + "\n";
        whole_file::replace(file, |out| out.write_all(text.as_bytes()))
    }
}

/// The file of a device and driver, beside its pipelines.
pub(super) fn file_name(info: &super::DeviceInfo) -> String {
    cache_name(info)
        .replace("pipelines", "tuning")
        .replace(".bin", ".json")
}

impl Gpu {
    /// The fastest of some `ways` of doing the same, each under a name: an index. `question` names what is done; `prepare` makes what
    /// `run` records it with, where it is not known yet. A way that the device was opened for ([`super::GpuOptions::ways`]) is the fastest
    /// unmeasured; where it was opened without [`super::GpuOptions::autotune`], the first is.
    ///
    /// # Errors
    /// What `prepare`, `run` or the device fails with.
    pub fn fastest<T>(
        &self,
        question: &str,
        ways: &[String],
        prepare: impl FnOnce() -> Result<T>,
        mut run: impl FnMut(&T, usize, &mut Recorder),
    ) -> Result<usize> {
        let options = self.options();
        let wanted = |way: &String| options.ways.contains(way);
        if let Some(way) = ways.iter().position(wanted) {
            return Ok(way);
        }
        if !options.autotune || ways.len() < 2 {
            return Ok(0);
        }
        let tuning = &self.inner.tuning;
        let mut answers = tuning.answers.lock().expect("no panic under the lock");
        let asked = asked(question, ways);
        let known = answers.get(&asked);
        if let Some(way) = known.and_then(|known| ways.iter().position(|way| way == known)) {
            return Ok(way);
        }
        let prepared = prepare()?;
        let mut seconds = Vec::new();
        for (way, name) in ways.iter().enumerate() {
            let of_this = self.seconds_of(|rec| run(&prepared, way, rec))?;
            tracing::debug!(question, way = name, ms = 1e3 * of_this, "way measured");
            seconds.push(of_this);
        }
        let fastest = (0..ways.len()).min_by(|&a, &b| seconds[a].total_cmp(&seconds[b]));
        let better = fastest.filter(|&way| seconds[way] < WORTH * seconds[0]);
        let chosen = better.unwrap_or(0);
        tracing::info!(question, way = ways[chosen], "tuning answer measured");
        answers.insert(asked, ways[chosen].clone());
        // An answer that cannot be kept costs time at the next start, and nothing else.
        if let Err(error) = tuning.save(&answers) {
            tracing::info!(%error, "tuning answers not written");
        }
        Ok(chosen)
    }
}
