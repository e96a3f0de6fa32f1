//! The few ways in which the outside world fails us, each with its exit code.

use std::path::{Path, PathBuf};

/// Result of the library's fallible calls.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What can go wrong. Messages name the thing, the numbers and the next move.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A dataset, checkpoint or mesh that cannot be used as it is.
    #[error("{path}: {what}\n  next: {next}", path = path.display())]
    Input {
        path: PathBuf,
        what: String,
        next: String,
    },
    /// A setting that makes no sense, or an unknown key or preset.
    #[error("{what}")]
    Config { what: String },
    /// No Vulkan loader, driver or device that can run the kernels.
    #[error("{what}")]
    NoDevice { what: String },
    /// The plan does not fit, or an allocation failed.
    #[error("{what}")]
    OutOfMemory { what: String },
    /// The driver gave the device up.
    #[error("{what}")]
    DeviceLost { what: String },
    /// Losses or parameters that are no longer finite.
    #[error("{what}")]
    Numerical { what: String },
    /// An output that exists already, or cannot be written.
    #[error("{path}: {what}\n  next: {next}", path = path.display())]
    Output {
        path: PathBuf,
        what: String,
        next: String,
    },
    /// Stopped on request, after what was done had been saved.
    #[error("{what}")]
    Interrupted { what: String },
    /// A Vulkan call that returned what it should not.
    #[error("{call} failed: {code}")]
    Vulkan { call: &'static str, code: String },
}

impl Error {
    /// An unusable input, with what to do about it.
    pub fn input(path: impl AsRef<Path>, what: impl Into<String>, next: impl Into<String>) -> Self {
        Error::Input {
            path: path.as_ref().to_path_buf(),
            what: what.into(),
            next: next.into(),
        }
    }

    /// An input file or folder that cannot be read.
    pub fn unreadable(path: impl AsRef<Path>, error: &std::io::Error) -> Self {
        let next = "see that it is there and may be read, or name another";
        Error::input(path, format!("cannot be read: {error}"), next)
    }

    /// An output that cannot be made, with what to do about it.
    pub fn output(
        path: impl AsRef<Path>,
        what: impl Into<String>,
        next: impl Into<String>,
    ) -> Self {
        Error::Output {
            path: path.as_ref().to_path_buf(),
            what: what.into(),
            next: next.into(),
        }
    }

    /// An output that cannot be written, made, or cleared away.
    pub fn unwritable(path: impl AsRef<Path>, error: &dyn std::fmt::Display) -> Self {
        let next = "make room or mend the permissions there, or name another place";
        Error::output(path, format!("cannot be written: {error}"), next)
    }

    /// The process exit code for this error.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Input { .. } | Error::Config { .. } => 3,
            Error::NoDevice { .. } => 4,
            Error::OutOfMemory { .. } => 5,
            Error::DeviceLost { .. } => 6,
            Error::Numerical { .. } => 7,
            Error::Output { .. } => 8,
            Error::Interrupted { .. } => 130,
            Error::Vulkan { .. } => 1,
        }
    }
}
