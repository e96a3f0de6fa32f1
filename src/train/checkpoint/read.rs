//! Checkpoints read back: checked to the last bit first, then piece by piece.

use super::{CHECKSUMS, FORMAT, FORMAT_VERSION, PIECE, State, Tensor, files, pieces};
use crate::config::Config;
use crate::{Error, Result};
use safetensors::Dtype;
use safetensors::tensor::Metadata;
use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The format's own limit on the header.
const MAX_HEADER: u64 = 100_000_000;

/// An opened checkpoint whose every bit has been checked.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    state: State,
    tensors: Vec<Tensor>,
    /// Byte offset of each tensor in the file.
    firsts: Vec<u64>,
}

/// Why a file is not a usable checkpoint.
enum Refusal {
    /// It was one; the one before it may still be.
    Damaged(String),
    /// It is something else, or of another version.
    Foreign(String),
    Io(io::Error),
}

impl From<io::Error> for Refusal {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => Refusal::Damaged("truncated while it was read".into()),
            _ => Refusal::Io(error),
        }
    }
}

impl Refusal {
    fn at(self, path: &Path) -> Error {
        match self {
            Refusal::Damaged(why) => Error::input(
                path,
                format!("damaged checkpoint: {why}"),
                "delete it; --resume goes on from the newest one that is whole",
            ),
            Refusal::Foreign(why) => Error::input(
                path,
                why,
                "use the version of neurodin that wrote it, or begin a new run",
            ),
            Refusal::Io(error) => Error::unreadable(path, &error),
        }
    }
}

/// The newest whole checkpoint of a folder.
#[derive(Debug)]
pub struct Latest {
    pub checkpoint: Checkpoint,
    /// Newer ones that were refused, with the reasons.
    pub refused: Vec<Error>,
}

/// The newest checkpoint of a folder that is whole.
///
/// # Errors
/// [`Error::Input`] if there is none, with what is wrong with those that there are; if one is whole but of another version.
pub fn latest(folder: &Path) -> Result<Latest> {
    let mut refused = Vec::new();
    for (_, path) in files(folder)?.into_iter().rev() {
        match inspect(&path) {
            Ok(checkpoint) => {
                return Ok(Latest {
                    checkpoint,
                    refused,
                });
            }
            Err(refusal @ Refusal::Damaged(_)) => refused.push(refusal.at(&path)),
            Err(refusal) => return Err(refusal.at(&path)),
        }
    }
    let what = match refused.len() {
        0 => "holds no checkpoint".into(),
        count => {
            let reasons: Vec<String> = refused.iter().map(Error::to_string).collect();
            format!(
                "none of its {count} checkpoints is whole:\n{}",
                reasons.join("\n")
            )
        }
    };
    Err(Error::input(
        folder,
        what,
        "begin again: train with --force, or into another --out",
    ))
}

impl Checkpoint {
    /// Opens a checkpoint and checks every bit of it.
    ///
    /// # Errors
    /// [`Error::Input`] for a damaged file, with what is wrong with it, and for files of another kind or version.
    pub fn open(path: &Path) -> Result<Checkpoint> {
        inspect(path).map_err(|refusal| refusal.at(path))
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What it holds besides tensors.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Its tensors, in the order in which they were saved.
    pub fn tensors(&self) -> &[Tensor] {
        &self.tensors
    }

    /// Passes a tensor's elements to `take`, in consecutive ranges of at most [`PIECE`] that begin at the index given.
    ///
    /// # Errors
    /// [`Error::Input`] if there is no tensor of that name and shape, or the file cannot be read; what `take` returns.
    pub fn read(
        &self,
        tensor: &Tensor,
        take: &mut dyn FnMut(u64, &[f32]) -> Result<()>,
    ) -> Result<()> {
        let mismatch = |what: String| {
            Error::input(
                &self.path,
                what,
                "train with the configuration that the checkpoint was written with",
            )
        };
        let index = self
            .tensors
            .iter()
            .position(|ours| ours.name == tensor.name)
            .ok_or_else(|| mismatch(format!("holds no tensor '{}'", tensor.name)))?;
        if self.tensors[index].shape != tensor.shape {
            return Err(mismatch(format!(
                "its tensor '{}' has shape {:?}, expected {:?}",
                tensor.name, self.tensors[index].shape, tensor.shape
            )));
        }
        let failed = |error| Error::unreadable(&self.path, &error);
        let mut file = File::open(&self.path).map_err(failed)?;
        file.seek(SeekFrom::Start(self.firsts[index]))
            .map_err(failed)?;
        for range in pieces(tensor.len()) {
            let mut numbers = vec![0f32; (range.end - range.start) as usize];
            file.read_exact(bytemuck::cast_slice_mut(&mut numbers))
                .map_err(failed)?;
            take(range.start, &numbers)?;
        }
        Ok(())
    }

    /// A whole tensor by name, with its shape.
    ///
    /// # Errors
    /// As [`Checkpoint::read`].
    pub fn tensor(&self, name: &str) -> Result<(Vec<u64>, Vec<f32>)> {
        let shape = self
            .tensors
            .iter()
            .find(|ours| ours.name == name)
            .map(|ours| ours.shape.clone())
            .unwrap_or_default();
        let tensor = Tensor {
            name: name.into(),
            shape,
        };
        let mut numbers = Vec::new();
        self.read(&tensor, &mut |_, piece| {
            numbers.extend_from_slice(piece);
            Ok(())
        })?;
        Ok((tensor.shape, numbers))
    }
}

/// Reads the header, then every byte.
fn inspect(path: &Path) -> Result<Checkpoint, Refusal> {
    let mut file = File::open(path)?;
    let size = file.metadata()?.len();
    if size < 8 {
        return Err(Refusal::Damaged(format!("{size} bytes are no checkpoint")));
    }
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let json_bytes = u64::from_le_bytes(length);
    if json_bytes > (size - 8).min(MAX_HEADER) {
        return Err(Refusal::Damaged(format!(
            "its header should have {json_bytes} bytes, the file has {size}"
        )));
    }
    let mut json = vec![0; json_bytes as usize];
    file.read_exact(&mut json)?;
    let infos: Metadata = serde_json::from_slice(&json)
        .map_err(|error| Refusal::Damaged(format!("unreadable header: {error}")))?;
    let metadata = infos.metadata().clone().unwrap_or_default();
    let expected = (infos.data_len() as u64).saturating_add(8 + json_bytes);
    let names = infos.offset_keys();
    if names.last().map(String::as_str) != Some(CHECKSUMS) {
        return Err(match metadata.get("format").map(String::as_str) {
            Some(FORMAT) => Refusal::Damaged("its header names no checksums".into()),
            _ => Refusal::Foreign("not a checkpoint of neurodin".into()),
        });
    }
    if size != expected {
        return Err(Refusal::Damaged(format!(
            "{size} bytes where its header promises {expected}"
        )));
    }

    let mut header = crc32fast::Hasher::new();
    header.update(&length);
    header.update(&json);
    let mut checksums = vec![header.finalize()];
    let mut tensors = Vec::new();
    let mut firsts = Vec::new();
    let mut buffer = vec![0u8; 4 * PIECE as usize];
    for name in &names[..names.len() - 1] {
        let info = infos.info(name).expect("the header names it");
        firsts.push(8 + json_bytes + info.data_offsets.0 as u64);
        let mut checksum = crc32fast::Hasher::new();
        let mut left = info.data_offsets.1 - info.data_offsets.0;
        while left > 0 {
            let piece = &mut buffer[..left.min(4 * PIECE as usize)];
            file.read_exact(piece)?;
            checksum.update(piece);
            left -= piece.len();
        }
        checksums.push(checksum.finalize());
        tensors.push(Tensor {
            name: name.clone(),
            shape: info.shape.iter().map(|size| *size as u64).collect(),
        });
    }
    checksums.push(crc32fast::hash(bytemuck::cast_slice(&checksums)));
    let mut stored = vec![0u32; checksums.len()];
    if infos.info(CHECKSUMS).map(|info| info.shape.clone()) != Some(vec![stored.len()]) {
        return Err(Refusal::Damaged(
            "its checksums are not one for each part".into(),
        ));
    }
    file.read_exact(bytemuck::cast_slice_mut(&mut stored))?;
    if let Some(wrong) = (0..stored.len()).find(|index| stored[*index] != checksums[*index]) {
        let part = match wrong {
            0 => "the header",
            wrong => names.get(wrong - 1).map_or("the checksums", String::as_str),
        };
        return Err(Refusal::Damaged(format!(
            "checksum of {part} is {:08x}, should be {:08x}",
            checksums[wrong], stored[wrong]
        )));
    }
    if names[..names.len() - 1]
        .iter()
        .any(|name| infos.info(name).expect("the header names it").dtype != Dtype::F32)
    {
        return Err(Refusal::Foreign(
            "holds tensors that are not float32".into(),
        ));
    }
    let state = read_state(&metadata)?;
    tracing::info!(
        file = %path.display(),
        step = state.step,
        tensors = tensors.len(),
        bytes = size,
        "checkpoint read"
    );
    Ok(Checkpoint {
        path: path.to_path_buf(),
        state,
        tensors,
        firsts,
    })
}

/// The state in an undamaged header.
fn read_state(metadata: &HashMap<String, String>) -> Result<State, Refusal> {
    let text = |name: &str| {
        metadata
            .get(name)
            .map(String::as_str)
            .ok_or_else(|| Refusal::Foreign(format!("its header does not say '{name}'")))
    };
    let version = text("format_version")?;
    if version.parse() != Ok(FORMAT_VERSION) {
        return Err(Refusal::Foreign(format!(
            "checkpoint format {version}, written by neurodin {}; this one reads format {FORMAT_VERSION}",
            text("neurodin_version")?
        )));
    }
    let unreadable = |what: &str, why: &dyn std::fmt::Display| {
        Refusal::Foreign(format!("unreadable {what}: {why}"))
    };
    Ok(State {
        step: text("step")?
            .parse()
            .map_err(|error| unreadable("step", &error))?,
        config: Config::recorded(text("config")?, "its configuration")
            .map_err(|error| unreadable("configuration", &error))?,
        region: serde_json::from_str(text("region")?)
            .map_err(|error| unreadable("region", &error))?,
        extra: metadata
            .iter()
            .filter_map(|(name, text)| {
                Some((name.strip_prefix("extra.")?.to_string(), text.clone()))
            })
            .collect(),
    })
}
