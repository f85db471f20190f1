//! Files of bounded length.
//!
//! `radome-sim` has the same reader: neither crate depends on the other, and `radome-dsp` reads no files.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// Longest spec, header or other single document that is read: those of this project have 6 kB at most.
pub const TEXT_LIMIT_BYTES: u64 = 1 << 20;

/// Largest model that is read, bytes: the largest network here has 45 MB.
pub const MODEL_LIMIT_BYTES: u64 = 512 << 20;

/// Reason why a file is not read. It comes inside an [`io::Error`].
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Refused {
    /// The file is longer than any of its kind has to be.
    #[error(
        "it has {found_bytes} bytes or more, and at most {limit_bytes} are read of such a file\n\nhint: check that it is the \
         file you mean; reduce or split what it holds"
    )]
    TooLarge {
        /// Length, bytes; for a file that grows, the number of bytes that were read.
        found_bytes: u64,
        /// Largest number of bytes that are read.
        limit_bytes: u64,
    },
    /// The path is a folder, a device, a pipe or a socket.
    #[error("it is not a regular file\n\nhint: write its content to a file and name that")]
    NotRegular,
    /// The file is a link that leads out of the folder that it belongs to.
    #[error("{name:?} is a link that leads out of its folder\n\nhint: copy the file into the folder")]
    Outside {
        /// Name of the link in the folder.
        name: String,
    },
}

impl From<Refused> for io::Error {
    fn from(refused: Refused) -> Self {
        let kind = match refused {
            Refused::TooLarge { .. } => ErrorKind::FileTooLarge,
            Refused::NotRegular => ErrorKind::InvalidInput,
            Refused::Outside { .. } => ErrorKind::PermissionDenied,
        };
        io::Error::new(kind, refused)
    }
}

/// Reads a regular file of at most `limit_bytes`.
///
/// # Errors
/// Errors of the system, and [`Refused`] for a longer file or one that is not a regular file.
pub fn read(path: &Path, limit_bytes: u64) -> io::Result<Vec<u8>> {
    // This check comes before opening, because opening a pipe waits for its writer.
    if !fs::metadata(path)?.is_file() {
        return Err(Refused::NotRegular.into());
    }
    let file = File::open(path)?;
    let length = file.metadata()?.len();
    if length > limit_bytes {
        return Err(Refused::TooLarge { found_bytes: length, limit_bytes }.into());
    }
    let mut bytes = Vec::with_capacity(length as usize);
    // A file may grow in the meantime, and files of /proc have no length.
    file.take(limit_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit_bytes {
        return Err(Refused::TooLarge { found_bytes: bytes.len() as u64, limit_bytes }.into());
    }
    Ok(bytes)
}

/// Reads a text file of at most `limit_bytes`.
///
/// # Errors
/// As [`read`], and [`ErrorKind::InvalidData`] where the file is not UTF-8.
pub fn read_text(path: &Path, limit_bytes: u64) -> io::Result<String> {
    String::from_utf8(read(path, limit_bytes)?).map_err(|e| io::Error::new(ErrorKind::InvalidData, e.utf8_error()))
}

/// Resolves the path of a file in a folder, including links, and checks that it lies within that folder.
///
/// # Errors
/// Errors of the system, and [`Refused::Outside`].
pub fn within(folder: &Path, name: &str) -> io::Result<PathBuf> {
    let path = folder.join(name);
    // A path without a parent folder refers to the working directory.
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    if path.canonicalize()?.starts_with(folder.canonicalize()?) {
        Ok(path)
    } else {
        Err(Refused::Outside { name: name.to_owned() }.into())
    }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    fn refused(result: io::Result<impl std::fmt::Debug>) -> Refused {
        let error = result.expect_err("refused");
        error.get_ref().and_then(|inner| inner.downcast_ref::<Refused>()).cloned().expect("a reason of ours")
    }

    #[test]
    fn long_files_devices_folders_and_pipes_are_refused_at_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        fs::write(&path, [b'x'; 100]).expect("written");
        assert_eq!(read(&path, 100).expect("read").len(), 100);
        assert_eq!(refused(read(&path, 99)), Refused::TooLarge { found_bytes: 100, limit_bytes: 99 });
        let error = read(&path, 99).expect_err("too long");
        assert_eq!(error.kind(), ErrorKind::FileTooLarge);
        assert!(error.to_string().contains("100 bytes") && error.to_string().contains("hint"), "{error}");
        assert_eq!(refused(read(folder.path(), 99)), Refused::NotRegular);
        assert_eq!(read(&folder.path().join("none"), 99).expect_err("absent").kind(), ErrorKind::NotFound);
        fs::write(&path, [0xFF, 0xFE]).expect("written");
        assert_eq!(read_text(&path, 99).expect_err("no text").kind(), ErrorKind::InvalidData);
        #[cfg(target_os = "linux")]
        {
            assert_eq!(refused(read(Path::new("/dev/zero"), 99)), Refused::NotRegular);
            let pipe = folder.path().join("pipe");
            let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo");
            assert!(made.success());
            assert_eq!(refused(read(&pipe, 99)), Refused::NotRegular);
            // No length, and no end before the limit.
            assert!(matches!(
                refused(read(Path::new("/proc/self/maps"), 9)),
                Refused::TooLarge { found_bytes: 10, .. }
            ));
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_do_not_lead_out_of_the_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let inner = folder.path().join("set");
        fs::create_dir(&inner).expect("made");
        fs::write(folder.path().join("a"), "x").expect("written");
        fs::write(inner.join("b"), "x").expect("written");
        std::os::unix::fs::symlink("../a", inner.join("link")).expect("linked");
        std::os::unix::fs::symlink("b", inner.join("own")).expect("linked");
        assert!(within(&inner, "b").is_ok() && within(&inner, "own").is_ok());
        assert!(matches!(refused(within(&inner, "link")), Refused::Outside { .. }));
    }
}
