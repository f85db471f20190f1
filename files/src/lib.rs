//! Reading of files of bounded length, locks, parsing of TOML documents, and resolution of paths that files name.
//!
//! ```
//! use std::collections::BTreeMap;
//!
//! type Rooms = BTreeMap<String, BTreeMap<String, [f64; 2]>>;
//!
//! let rooms: Rooms = radome_files::parse_toml("[room]\nsize_m = [4.0, 2.5]\n").expect("two values");
//! assert_eq!(rooms["room"]["size_m"], [4.0, 2.5]);
//! // Surplus values are an error.
//! assert!(radome_files::parse_toml::<Rooms>("[room]\nsize_m = [4.0, 2.5, 3.0]\n").is_err());
//! ```

mod lock;

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::{Component, Path, PathBuf};

use serde::de::DeserializeOwned;
use thiserror::Error;

pub use self::lock::lock;

/// Length limit of TOML files, headers and other single documents, bytes. The longest of this project has 6 kB, and
/// measured densities take about 100 kB.
pub const TEXT_LIMIT_BYTES: u64 = 1 << 20;
/// Length limit of mesh, actor and clip files, bytes: five million triangles as binary STL.
pub const MESH_LIMIT_BYTES: u64 = 256 << 20;
/// Length limit of models, bytes: the largest network here has 45 MB.
pub const MODEL_LIMIT_BYTES: u64 = 512 << 20;
/// Environment variable that lists folders (as `PATH` does). Scenes and specs may name files in these folders besides
/// their own.
pub const FOLDERS_VARIABLE: &str = "RADOME_PATH";

/// Fault of a path that leads out of the folder of the file with the path.
const LEAVES_ITS_FOLDER: &str = "leads out of the folder of the file that names it";

/// Reason why a file is refused. It is wrapped in an [`io::Error`].
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Refused {
    /// The file is longer than the limit for its kind.
    #[error(
        "it has {found_bytes} bytes or more, and at most {limit_bytes} are read of such a file\n\nhint: check that it is the \
         file you mean; reduce or split what it holds"
    )]
    TooLarge {
        /// Length, bytes; for a file that grows, the number of bytes read.
        found_bytes: u64,
        /// Largest number of bytes that is read.
        limit_bytes: u64,
    },
    /// The path names a folder, a device, a pipe or a socket.
    #[error("it is not a regular file\n\nhint: write its content to a file and name that")]
    NotRegular,
    /// The path leads out of the folder in which it has to lie.
    #[error("{name:?} {fault}\n\nhint: {hint}")]
    Outside {
        /// The path as written in the file that names it, or the name of a link.
        name: String,
        /// Where it leads.
        fault: &'static str,
        /// Remedy.
        hint: &'static str,
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
/// Errors of the system, and [`Refused`] for a longer file and for anything that is not a regular file.
pub fn read(path: &Path, limit_bytes: u64) -> io::Result<Vec<u8>> {
    // The check precedes opening, because opening a pipe waits for its writer.
    if !fs::metadata(path)?.is_file() {
        return Err(Refused::NotRegular.into());
    }
    let file = File::open(path)?;
    let length = file.metadata()?.len();
    if length > limit_bytes {
        return Err(Refused::TooLarge { found_bytes: length, limit_bytes }.into());
    }
    let mut bytes = Vec::with_capacity(length as usize);
    // A file may grow meanwhile, and files in /proc report no length.
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

/// Parses a TOML document. Unlike [`toml::from_str`] it refuses surplus values in an array of a fixed length.
///
/// # Errors
/// The text is no TOML, or its values are not those of the type. The error of a surplus value has no span; its message ends
/// with the path of the key in backticks.
pub fn parse_toml<T: DeserializeOwned>(text: &str) -> Result<T, toml::de::Error> {
    let parsed = toml::from_str(text)?;
    // The deserialiser of a table in memory detects surplus values of an array; that of a text does not. Such a table holds
    // only signed 64-bit integers; a document with a larger one is not checked.
    if let Ok(table) = toml::from_str::<toml::Table>(text) {
        table.try_into::<T>().map_err(|error| {
            let message = error.to_string().trim_end().replace('\n', " ");
            <toml::de::Error as serde::de::Error>::custom(message)
        })?;
    }
    Ok(parsed)
}

/// Resolves a path that a file in `folder` names, where both were written by other programs. The path must be relative
/// and, with links followed, lie within that folder.
///
/// # Errors
/// Errors of the system, and [`Refused::Outside`].
pub fn beside(folder: &Path, name: &str) -> io::Result<PathBuf> {
    let outside = || Refused::Outside {
        name: name.to_owned(),
        fault: LEAVES_ITS_FOLDER,
        hint: "put the file beside the one that names it, and name it without \"..\" and without a leading \"/\"",
    };
    if !Path::new(name).components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir)) {
        return Err(outside().into());
    }
    let path = folder_of(folder).join(name).canonicalize()?;
    if path.starts_with(folder_of(folder).canonicalize()?) { Ok(path) } else { Err(outside().into()) }
}

/// Resolves the path of a file or folder that a scene or a spec in `folder` names. With links followed, it must lie in
/// that folder or in one that [`FOLDERS_VARIABLE`] lists. A `.toml` file may also lie in a sibling of that folder, such
/// as `../receivers/desk.toml`.
///
/// # Errors
/// Errors of the system, and [`Refused::Outside`].
pub fn named_by_spec(folder: &Path, name: &Path) -> io::Result<PathBuf> {
    let path = folder.join(name);
    let (resolved, own_folder) = (path.canonicalize()?, folder_of(folder).canonicalize()?);
    let is_toml = resolved.extension().is_some_and(|extension| extension == "toml");
    let is_in_folder_of =
        |parent: &Path| resolved.strip_prefix(parent).is_ok_and(|rest| rest.components().count() <= 2);
    let variable = std::env::var_os(FOLDERS_VARIABLE).unwrap_or_default();
    let is_listed = || {
        let folders = std::env::split_paths(&variable).filter(|folder| !folder.as_os_str().is_empty());
        folders.filter_map(|folder| folder.canonicalize().ok()).any(|folder| resolved.starts_with(folder))
    };
    if resolved.starts_with(&own_folder) || (is_toml && own_folder.parent().is_some_and(is_in_folder_of)) || is_listed()
    {
        // The resolved path is not returned, so that messages and fingerprints keep the name that the user knows.
        return Ok(path);
    }
    let hint = "put the file beside the one that names it, or list its folder in RADOME_PATH";
    Err(Refused::Outside { name: name.display().to_string(), fault: LEAVES_ITS_FOLDER, hint }.into())
}

/// Resolves the path of a file in a folder, including links, and checks that it lies within that folder.
///
/// # Errors
/// Errors of the system, and [`Refused::Outside`].
pub fn within(folder: &Path, name: &str) -> io::Result<PathBuf> {
    let path = folder.join(name);
    if path.canonicalize()?.starts_with(folder_of(folder).canonicalize()?) {
        return Ok(path);
    }
    let (fault, hint) = ("is a link that leads out of its folder", "copy the file into the folder");
    Err(Refused::Outside { name: name.to_owned(), fault, hint }.into())
}

/// Returns the path beside another one whose name has an ending in addition: `set.parts` for `set`.
pub fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(suffix);
    path.with_file_name(name)
}

/// Returns the folder of a file, existing or not: `.` for a name alone.
pub fn parent_folder(path: &Path) -> &Path {
    folder_of(path.parent().unwrap_or(Path::new("")))
}

/// Returns the folder, or the working directory for an empty path.
fn folder_of(folder: &Path) -> &Path {
    if folder.as_os_str().is_empty() { Path::new(".") } else { folder }
}

#[cfg(test)]
mod hard_cases {
    use std::collections::BTreeMap;

    use super::*;

    /// Regression test: arrays of a fixed length took the first values of a longer list.
    #[test]
    fn surplus_values_are_refused_with_their_key() {
        type Rooms = BTreeMap<String, BTreeMap<String, [f64; 2]>>;
        let rooms: Rooms = parse_toml("[room]\nsize_m = [1, 2.5]\n").expect("two values");
        assert_eq!(rooms["room"]["size_m"], [1.0, 2.5]);
        for list in ["[1, 2, 3]", "[1, 2, \"junk\"]"] {
            let error = parse_toml::<Rooms>(&format!("[room]\nsize_m = {list}\n")).expect_err(list);
            assert!(error.message().ends_with("`room.size_m`"), "{list}: {error}");
        }
        assert!(parse_toml::<Rooms>("[room]\nsize_m = [1]\n").is_err());
        let seeds: BTreeMap<String, u64> = parse_toml("seed = 18446744073709551615\n").expect("a number");
        assert_eq!(seeds["seed"], u64::MAX);
    }

    fn refused(result: io::Result<impl std::fmt::Debug>) -> Refused {
        let error = result.expect_err("refused");
        error.get_ref().and_then(|inner| inner.downcast_ref::<Refused>()).cloned().expect("a reason of this crate")
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
            let status = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo");
            assert!(status.success());
            assert_eq!(refused(read(&pipe, 99)), Refused::NotRegular);
            // The file reports no length and does not end before the limit.
            assert!(matches!(
                refused(read(Path::new("/proc/self/maps"), 9)),
                Refused::TooLarge { found_bytes: 10, .. }
            ));
        }
    }

    #[test]
    fn names_do_not_lead_out_of_the_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let (scenes, receivers) = (folder.path().join("scenes"), folder.path().join("receivers"));
        fs::create_dir_all(scenes.join("meshes")).expect("made");
        fs::create_dir_all(&receivers).expect("made");
        for path in [
            scenes.join("meshes/a.obj"),
            receivers.join("a.toml"),
            receivers.join("a.obj"),
            folder.path().join("b.obj"),
        ] {
            fs::write(path, "x").expect("written");
        }
        assert!(beside(&scenes, "meshes/a.obj").is_ok() && beside(&scenes, "./meshes/a.obj").is_ok());
        let absolute = scenes.join("meshes/a.obj").display().to_string();
        for name in ["../b.obj", "meshes/../meshes/a.obj", "/etc/hostname", "/dev/zero", "..", absolute.as_str()] {
            assert!(matches!(refused(beside(&scenes, name)), Refused::Outside { .. }), "{name}");
        }
        assert_eq!(beside(&scenes, "none").expect_err("absent").kind(), ErrorKind::NotFound);

        let spec = |name: &str| named_by_spec(&scenes, Path::new(name));
        assert!(spec("meshes/a.obj").is_ok() && spec(&absolute).is_ok() && spec("../receivers/a.toml").is_ok());
        for name in ["../receivers/a.obj", "../b.obj", "/dev/zero", "../../../../../../../../etc/hostname"] {
            match spec(name) {
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                other => assert!(matches!(refused(other), Refused::Outside { .. }), "{name}"),
            }
        }
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(folder.path().join("b.obj"), scenes.join("link.obj")).expect("linked");
            std::os::unix::fs::symlink(folder.path(), scenes.join("up")).expect("linked");
            for name in ["link.obj", "up/b.obj"] {
                assert!(matches!(refused(beside(&scenes, name)), Refused::Outside { .. }), "{name}");
                assert!(matches!(refused(spec(name)), Refused::Outside { .. }), "{name}");
            }
        }
    }

    #[test]
    fn a_suffix_follows_the_whole_name() {
        for (path, expected) in [("a/set", "a/set.parts"), ("set.old", "set.old.parts"), ("a/set/", "a/set.parts")] {
            assert_eq!(with_suffix(Path::new(path), ".parts"), Path::new(expected));
        }
    }

    #[test]
    fn the_folder_of_a_name_alone_is_the_working_directory() {
        for (path, expected) in [("a/set", "a"), ("/set", "/"), ("set", "."), ("a/set/", "a"), ("", ".")] {
            assert_eq!(parent_folder(Path::new(path)), Path::new(expected));
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
