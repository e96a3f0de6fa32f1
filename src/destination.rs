//! Files that somebody asked for: their place is looked at before work begins, and they are written whole when it is done.

use crate::whole_file::{self, folder_of};
use crate::{Error, Result};
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::Path;

/// Whether a file can be written to `path`, as far as that is known before there is anything to write.
///
/// # Errors
/// [`Error::Output`] if the folder is missing, or something is there that `force` does not let replace.
pub(crate) fn check(path: &Path, force: bool) -> Result<()> {
    if !folder_of(path).is_dir() {
        return Err(Error::output(
            path,
            "its folder does not exist",
            format!("mkdir -p {}", folder_of(path).display()),
        ));
    }
    if path.is_dir() {
        return Err(Error::output(path, "is a folder", "name a file"));
    }
    if !force && path.symlink_metadata().is_ok() {
        return Err(exists(path));
    }
    Ok(())
}

/// Puts what `write` writes at `path`, whole or not at all; an existing file is replaced only with `force`.
///
/// # Errors
/// [`Error::Output`]; what was at `path` is then as it was.
pub(crate) fn write(
    path: &Path,
    force: bool,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<()> {
    let write = |file: &mut File| {
        let mut out = BufWriter::with_capacity(1 << 20, file);
        write(&mut out)?;
        out.flush()
    };
    let written = match force {
        true => whole_file::replace(path, write),
        false => whole_file::create(path, write),
    };
    written.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => exists(path),
        _ => Error::unwritable(path, &error),
    })
}

fn exists(path: &Path) -> Error {
    Error::output(
        path,
        "exists already",
        "name another file, or replace it with --force",
    )
}
