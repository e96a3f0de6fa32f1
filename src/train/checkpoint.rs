//! Checkpoints: everything a run needs to go on, in one safetensors file that is either complete and unharmed or refused.
//!
//! Layout: u64 header length · JSON header · float32 tensors in the order given · one uint32 tensor `checksums`.
//! The header's `__metadata__` holds step, configuration (TOML), region (JSON), versions, and whatever else the run wants to keep.
//! `checksums` is [tensors + 2]: CRC-32 of length and header, of each tensor, and of the words before it, so no bit is unguarded.
//!
//! A checkpoint is written to `*.part`, synced, renamed, and its folder synced: at every instant the newest complete file is a good one.
//! Tensors pass through in pieces of [`PIECE`] numbers, so that a table of gigabytes needs no second copy of itself.

use crate::config::Config;
use crate::scene::Region;
use crate::{Error, Result, whole_file};
use safetensors::Dtype;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

mod read;

pub use read::{Checkpoint, Latest, latest};

/// Numbers that are read from the device, written, or checked at a time (16 MiB).
pub const PIECE: u64 = 4 << 20;

const FORMAT: &str = "neurodin checkpoint";
/// Version of the format; readers accept this and the one before.
const FORMAT_VERSION: u32 = 1;
const CHECKSUMS: &str = "checksums";

// Tensors are little-endian in the file and are copied as they lie in memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// What a checkpoint holds besides tensors. Random numbers are functions of seed, step, ray and purpose, so that seed
/// (in the configuration) and step are the whole random state, and the whole schedule position.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Steps done; the next one to be done has this number.
    pub step: u64,
    pub config: Config,
    /// The region (normalisation) that the parameters refer to.
    pub region: Region,
    /// Anything else, by name.
    pub extra: BTreeMap<String, String>,
}

/// Name and shape of a float32 tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    pub name: String,
    pub shape: Vec<u64>,
}

impl Tensor {
    /// Number of elements.
    pub fn len(&self) -> u64 {
        self.shape.iter().product()
    }

    /// Whether some dimension is zero.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Where a save gets its numbers: the elements of a tensor in a range of indices.
pub type Source<'s> = dyn FnMut(&Tensor, Range<u64>) -> Result<Vec<f32>> + 's;

/// Writes a checkpoint, named after its step, then removes what is beyond the newest `keep` of that folder.
///
/// `read` returns elements of a tensor; it is called for every tensor in turn, for consecutive ranges of at most [`PIECE`].
///
/// # Errors
/// [`Error::Output`] if the file cannot be written (disk full, no permission): older checkpoints are untouched then and no partial file
/// remains. Errors of `read` are passed on, likewise.
pub fn save(
    folder: &Path,
    keep: u32,
    state: &State,
    tensors: &[Tensor],
    read: &mut Source,
) -> Result<PathBuf> {
    let path = path_of(folder, state.step);
    let header = header(state, tensors);
    let total = 8
        + header.len() as u64
        + tensors.iter().map(Tensor::len).sum::<u64>() * 4
        + 4 * (tensors.len() as u64 + 2);
    let failed = |done: u64, error: io::Error| Error::Output {
        path: path.clone(),
        what: format!(
            "cannot write this checkpoint: {error} (after {:.1} of {:.1} MB)",
            done as f64 / 1e6,
            total as f64 / 1e6
        ),
        next: match files(folder)
            .ok()
            .and_then(|files| files.into_iter().next_back())
        {
            Some((step, _)) => format!(
                "make room or mend the permissions, then go on with --resume; the checkpoint of step {step} is intact"
            ),
            None => "make room or mend the permissions there, or give another --out".into(),
        },
    };

    fs::create_dir_all(folder).map_err(|error| failed(0, error))?;
    remove_leftovers(folder, &whole_file::part_of(&path));
    let mut done = 0;
    let written = whole_file::replace(&path, |file| {
        let mut file = Counted {
            inner: file,
            done: &mut done,
        };
        write(&mut file, &header, tensors, read)
    });
    written.map_err(|error| match error {
        Failure::Write(error) => failed(done, error),
        Failure::Read(error) => error,
    })?;
    tracing::info!(
        file = %path.display(),
        step = state.step,
        tensors = tensors.len(),
        bytes = total,
        "checkpoint written"
    );
    prune(folder, state.step, keep)?;
    Ok(path)
}

/// `step-00012345.safetensors` for step 12345.
fn path_of(folder: &Path, step: u64) -> PathBuf {
    folder.join(format!("step-{step:08}.safetensors"))
}

/// The checkpoints of a folder by step, oldest first, damaged ones included.
///
/// # Errors
/// [`Error::Input`] if the folder cannot be listed; a folder that does not exist holds none.
pub fn files(folder: &Path) -> Result<Vec<(u64, PathBuf)>> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(Error::unreadable(folder, &error)),
    };
    let mut found = Vec::new();
    for entry in entries {
        let path = entry
            .map_err(|error| Error::unreadable(folder, &error))?
            .path();
        let name = path
            .file_name()
            .and_then(|name| name.to_str())
            .unwrap_or("");
        let step = name
            .strip_prefix("step-")
            .and_then(|rest| rest.strip_suffix(".safetensors"))
            .and_then(|digits| digits.parse().ok());
        if let Some(step) = step {
            found.push((step, path));
        }
    }
    found.sort();
    Ok(found)
}

/// Removes what an interrupted save left behind.
fn remove_leftovers(folder: &Path, current: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let leftover = path
            .extension()
            .is_some_and(|extension| extension == "part");
        if leftover && path != current {
            let _ = fs::remove_file(path);
        }
    }
}

/// Keeps the checkpoint of `step` and the newest before it. Later ones can only be those that were refused when the run went on from an
/// earlier one.
fn prune(folder: &Path, step: u64, keep: u32) -> Result<()> {
    let mut kept = 0;
    for (other, path) in files(folder)?.into_iter().rev() {
        if other <= step && kept < keep.max(1) {
            kept += 1;
            continue;
        }
        fs::remove_file(&path).map_err(|error| Error::unwritable(&path, &error))?;
    }
    Ok(())
}

/// A file that tells how much was written.
struct Counted<'a> {
    inner: &'a mut File,
    done: &'a mut u64,
}

impl Write for Counted<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.inner.write(bytes)?;
        *self.done += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

enum Failure {
    Write(io::Error),
    Read(Error),
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Failure {
        Failure::Write(error)
    }
}

/// Length and JSON header, padded to eight bytes. The same state gives the same bytes.
fn header(state: &State, tensors: &[Tensor]) -> Vec<u8> {
    let mut metadata: BTreeMap<String, String> = state
        .extra
        .iter()
        .map(|(name, text)| (format!("extra.{name}"), text.clone()))
        .collect();
    metadata.extend(
        [
            ("format", FORMAT.to_string()),
            ("format_version", FORMAT_VERSION.to_string()),
            ("neurodin_version", env!("CARGO_PKG_VERSION").to_string()),
            ("step", state.step.to_string()),
            ("config", state.config.to_toml()),
            (
                "region",
                serde_json::to_string(&state.region).expect("a region is plain data"),
            ),
        ]
        .map(|(name, text)| (name.to_string(), text)),
    );
    let mut header = serde_json::Map::new();
    header.insert("__metadata__".into(), serde_json::json!(metadata));
    let mut first = 0;
    let mut push = |name: &str, dtype: Dtype, shape: &[u64]| {
        let end = first + 4 * shape.iter().product::<u64>();
        let info =
            serde_json::json!({ "dtype": dtype, "shape": shape, "data_offsets": [first, end] });
        assert!(
            header.insert(name.into(), info).is_none(),
            "two tensors are named {name}"
        );
        first = end;
    };
    for tensor in tensors {
        push(&tensor.name, Dtype::F32, &tensor.shape);
    }
    push(CHECKSUMS, Dtype::U32, &[tensors.len() as u64 + 2]);
    let mut json = serde_json::to_vec(&header).expect("a header is plain data");
    json.resize(json.len().next_multiple_of(8), b' ');
    [&(json.len() as u64).to_le_bytes()[..], &json].concat()
}

/// Everything from the header to the checksums.
fn write(
    file: &mut impl Write,
    header: &[u8],
    tensors: &[Tensor],
    read: &mut Source,
) -> Result<(), Failure> {
    file.write_all(header)?;
    let mut checksums = vec![crc32fast::hash(header)];
    for tensor in tensors {
        let mut checksum = crc32fast::Hasher::new();
        for range in pieces(tensor.len()) {
            let numbers = read(tensor, range.clone()).map_err(Failure::Read)?;
            let (asked, got) = (range.end - range.start, numbers.len() as u64);
            assert_eq!(
                got, asked,
                "elements read of {} at {}",
                tensor.name, range.start
            );
            let bytes: &[u8] = bytemuck::cast_slice(&numbers);
            checksum.update(bytes);
            file.write_all(bytes)?;
        }
        checksums.push(checksum.finalize());
    }
    checksums.push(crc32fast::hash(bytemuck::cast_slice(&checksums)));
    file.write_all(bytemuck::cast_slice(&checksums))?;
    Ok(())
}

/// 0..len in consecutive ranges.
fn pieces(len: u64) -> impl Iterator<Item = Range<u64>> {
    (0..len)
        .step_by(PIECE as usize)
        .map(move |first| first..(first + PIECE).min(len))
}
