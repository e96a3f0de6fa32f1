//! Files that appear whole or not at all: written beside their place, synced, and renamed into it.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, ErrorKind::AlreadyExists, ErrorKind::NotFound};
use std::path::{Path, PathBuf};

use tempfile::{PathPersistError, TempPath};

/// Puts what `write` writes at `path`, in the place of a file that is there. On an error that file is as it was, and nothing half-written
/// stays.
pub(crate) fn replace<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut File) -> Result<(), E>,
) -> Result<(), E> {
    put(path, write, |part| {
        part.persist(path).map_err(|error| error.error)
    })
}

/// As [`replace`], but fails with [`io::ErrorKind::AlreadyExists`] where there is a file by the time that this one is written.
pub(crate) fn create<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut File) -> Result<(), E>,
) -> Result<(), E> {
    put(path, write, |part| {
        rename_new(part, path, |part| part.persist_noclobber(path))
    })
}

/// Renames `part` by `noclobber`, which keeps a file that is there. Shared folders and some other file systems know no such way and
/// refuse it: there, looking first is the best that can be done for a file that is already written.
fn rename_new(
    part: TempPath,
    path: &Path,
    noclobber: impl FnOnce(TempPath) -> Result<(), PathPersistError>,
) -> io::Result<()> {
    let is_free = || path.symlink_metadata().is_err_and(|e| e.kind() == NotFound);
    match noclobber(part) {
        Err(refused) if refused.error.kind() != AlreadyExists && is_free() => {
            refused.path.persist(path).map_err(|error| error.error)
        }
        renamed => renamed.map_err(|error| error.error),
    }
}

/// Where this process writes what is to be at `path`. What a process that was killed left behind has the same ending.
pub(crate) fn part_of(path: &Path) -> PathBuf {
    let mut name = path.file_name().map(OsString::from).unwrap_or_default();
    name.push(format!(".{}.part", std::process::id()));
    path.with_file_name(name)
}

/// The folder of a file.
pub(crate) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    }
}

fn put<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut File) -> Result<(), E>,
    rename: impl FnOnce(TempPath) -> io::Result<()>,
) -> Result<(), E> {
    // Removed when it is dropped, unless it was renamed.
    let part = TempPath::try_from_path(part_of(path))?;
    let mut file = File::create(&part)?;
    write(&mut file)?;
    file.sync_all()?;
    drop(file);
    rename(part)?;
    // The name itself reaches the disk with its folder; not every system can sync one, and the file is complete either way.
    let _ = File::open(folder_of(path)).and_then(|folder| folder.sync_all());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::io::Write;

    fn names(folder: &Path) -> Vec<OsString> {
        let entries = fs::read_dir(folder).unwrap();
        entries.map(|entry| entry.unwrap().file_name()).collect()
    }

    #[test]
    fn a_file_is_the_former_one_until_it_is_the_new_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file.txt");
        let read = || fs::read_to_string(&path).unwrap();
        replace(&path, |file| file.write_all(b"first")).unwrap();
        replace(&path, |file| {
            file.write_all(b"second")?;
            assert_eq!(read(), "first");
            io::Result::Ok(())
        })
        .unwrap();
        assert_eq!(read(), "second");
        let failed = replace(&path, |file| {
            file.write_all(b"third")?;
            Err(io::Error::other("no more"))
        });
        assert_eq!(failed.unwrap_err().to_string(), "no more");
        let exists = create(&path, |file| file.write_all(b"fourth")).unwrap_err();
        assert_eq!(exists.kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(read(), "second");
        assert_eq!(names(folder.path()), ["file.txt"]);
    }

    /// The errors of file systems that can neither rename without replacing nor link.
    #[test]
    fn a_new_file_is_renamed_where_nothing_but_replacing_works() {
        let folder = tempfile::tempdir().unwrap();
        let (path, other) = (folder.path().join("file"), folder.path().join("other"));
        let refuse = |kind: io::ErrorKind| {
            move |path| {
                let error = kind.into();
                Err(PathPersistError { error, path })
            }
        };
        let put = |kind: io::ErrorKind| {
            fs::write(&other, "new").unwrap();
            let part = TempPath::try_from_path(&other).unwrap();
            rename_new(part, &path, refuse(kind))
        };
        let gone = put(io::ErrorKind::AlreadyExists).unwrap_err();
        assert_eq!(gone.kind(), io::ErrorKind::AlreadyExists);
        assert!(!path.exists(), "told of by the system, and gone since");
        put(io::ErrorKind::InvalidInput).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        fs::write(&path, "there").unwrap();
        let refused = put(io::ErrorKind::Unsupported).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::Unsupported);
        assert_eq!(fs::read_to_string(&path).unwrap(), "there");
    }

    #[test]
    #[cfg(unix)]
    fn a_file_may_be_read_like_any_other() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let mode = |name: &str| {
            let metadata = fs::metadata(folder.path().join(name)).unwrap();
            metadata.permissions().mode()
        };
        fs::write(folder.path().join("other"), "").unwrap();
        create(&folder.path().join("file"), |file| file.write_all(b"")).unwrap();
        assert_eq!(mode("file"), mode("other"));
    }
}
