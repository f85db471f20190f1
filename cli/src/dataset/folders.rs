//! Recordings in a folder, and the labels in their names.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::recording::infineon::radar_folders;
use radome_driver::recording::{Format, RecordingError};
use regex_lite::Regex;

use super::spec::{FolderLabel, Recorded};
use crate::source;

/// Largest nesting depth of folders that are searched.
const MOST_DEPTH: usize = 12;

/// Recording that a search found.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct FoundRecording {
    pub path: PathBuf,
    /// Path of the session, relative to the folder. Several radars may have recorded it.
    pub session: String,
    /// Name of the recording: the session, and the radar if there are several.
    pub name: String,
}

/// Finds all recordings in a folder, ordered by name.
///
/// # Errors
/// A folder cannot be listed or a file cannot be read, or there is no recording.
pub fn find(folder: &Path) -> anyhow::Result<Vec<FoundRecording>> {
    let mut found = Vec::new();
    search(folder, "", &mut found, 0)?;
    found.sort();
    ensure!(
        !found.is_empty(),
        "{}: no recording here\n\nhint: expected folders with RadarIfxAvian_00 or radar.npy in them, .mcap files, or text \
         recordings with their _config.json",
        folder.display()
    );
    // A folder that is itself a recording uses its own name.
    for found in found.iter_mut().filter(|f| f.session.is_empty()) {
        let absolute = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        found.session = absolute.file_name().unwrap_or_default().to_string_lossy().into_owned();
        found.name = format!("{}{}", found.session, found.name);
    }
    Ok(found)
}

fn search(folder: &Path, name: &str, found: &mut Vec<FoundRecording>, depth: usize) -> anyhow::Result<()> {
    let file_name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    match Format::of_content(folder)? {
        // Each radar of a session has a recording of its own.
        Some(Format::Infineon) => {
            let radars = radar_folders(folder)?;
            let is_one = radars.len() == 1;
            for path in radars {
                let radar_name = if is_one { name.to_owned() } else { format!("{name}/{}", file_name(&path)) };
                found.push(FoundRecording { path, session: name.to_owned(), name: radar_name });
            }
            return Ok(());
        }
        Some(Format::Mcap | Format::Text) | None => {}
    }
    let cannot = || format!("{}: cannot be listed", folder.display());
    let mut entries: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(cannot)? {
        entries.push(entry.with_context(cannot)?.path());
    }
    entries.sort();
    if depth == MOST_DEPTH {
        bail!("{}: folders within folders {MOST_DEPTH} deep; do they contain each other?", folder.display());
    }
    for path in entries {
        let own_name = file_name(&path);
        let with_parent = |own: &str| if name.is_empty() { own.to_owned() } else { format!("{name}/{own}") };
        if own_name.starts_with('.') {
            continue;
        } else if path.is_dir() {
            search(&path, &with_parent(&own_name), found, depth + 1)?;
        } else if is_recording(&path)? {
            let name = with_parent(&source::name_of(&path).to_string_lossy());
            found.push(FoundRecording { path, session: name.clone(), name });
        }
    }
    Ok(())
}

/// Returns whether a file is a recording. A file with the name of an MCAP file counts, since opening it reports damage.
fn is_recording(path: &Path) -> anyhow::Result<bool> {
    if path.extension().is_some_and(|ending| ending == "mcap") {
        return Ok(true);
    }
    match Format::of_content(path) {
        // A pipe, a device, or a link that leads nowhere.
        Err(RecordingError::NotRegular { .. } | RecordingError::Missing { .. }) => Ok(false),
        format => Ok(format?.is_some()),
    }
}

/// Label and names that a pattern takes from the name of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParsedName {
    pub label: FolderLabel,
    pub scene: Option<String>,
    pub subject: Option<String>,
    pub sequence: Option<String>,
}

/// Pattern of names, with the label of the recordings that match it.
#[derive(Debug)]
struct NamePattern {
    text: String,
    regex: Regex,
    label: FolderLabel,
}

impl NamePattern {
    fn new(text: &str, label: FolderLabel) -> anyhow::Result<Self> {
        Ok(NamePattern { text: text.to_owned(), regex: compile(text)?, label })
    }
}

/// Patterns of a source.
#[derive(Debug)]
pub struct NamePatterns(Vec<NamePattern>);

impl NamePatterns {
    /// Compiles the patterns of the spec.
    ///
    /// # Errors
    /// A pattern is not valid.
    pub fn new(source: &Recorded) -> anyhow::Result<Self> {
        let patterns = source.labels.iter().map(|(text, label)| NamePattern::new(text, *label));
        Ok(NamePatterns(patterns.collect::<anyhow::Result<_>>()?))
    }

    /// Returns the label of a name, by the single pattern that matches.
    ///
    /// # Errors
    /// No pattern fits the name, or more than one does.
    pub fn parse(&self, name: &str) -> anyhow::Result<ParsedName> {
        let last = name.rsplit('/').next().unwrap_or(name);
        let match_name = |NamePattern { text, regex, label }: &NamePattern| {
            let captures = regex.captures(if text.contains('/') { name } else { last })?;
            let get = |what: &str| captures.name(what).map(|m| m.as_str().to_owned());
            let parsed =
                ParsedName { label: *label, scene: get("scene"), subject: get("subject"), sequence: get("sequence") };
            Some((text.clone(), parsed))
        };
        let mut matches: Vec<(String, ParsedName)> = self.0.iter().filter_map(match_name).collect();
        match (matches.pop(), matches.first()) {
            (Some((_, parsed)), None) => Ok(parsed),
            (None, _) => {
                let patterns: Vec<String> = self.0.iter().map(|pattern| format!("\"{}\"", pattern.text)).collect();
                bail!(
                    "'{name}' fits none of the patterns {}\n\nhint: add one to `labels`; \"skip\" leaves a recording out",
                    patterns.join(", ")
                )
            }
            (Some((second, _)), Some((first, _))) => {
                bail!("'{name}' fits two patterns, \"{first}\" and \"{second}\"\n\nhint: make one of them narrower")
            }
        }
    }
}

/// Compiles a pattern to a regular expression.
fn compile(pattern: &str) -> anyhow::Result<Regex> {
    let mut text = String::from("^");
    let mut rest = pattern;
    while let Some(character) = rest.chars().next() {
        rest = &rest[character.len_utf8()..];
        match character {
            '*' => text += "[^/]*",
            '?' => text += "[^/]",
            '{' => {
                let Some((name, after)) = rest.split_once('}') else {
                    bail!("pattern \"{pattern}\": a brace is never closed")
                };
                ensure!(
                    ["scene", "subject", "sequence"].contains(&name),
                    "pattern \"{pattern}\": {{{name}}} means nothing; there are {{scene}}, {{subject}} and {{sequence}}"
                );
                text += &format!("(?P<{name}>[^/]+?)");
                rest = after;
            }
            other => text += &regex_lite::escape(other.encode_utf8(&mut [0; 4])),
        }
    }
    text.push('$');
    Regex::new(&text).with_context(|| format!("pattern \"{pattern}\" cannot be used"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rules(patterns: &[(&str, FolderLabel)]) -> anyhow::Result<NamePatterns> {
        patterns
            .iter()
            .map(|(text, label)| NamePattern::new(text, *label))
            .collect::<anyhow::Result<_>>()
            .map(NamePatterns)
    }

    #[test]
    fn names_are_read_by_the_one_pattern_that_fits() {
        use FolderLabel::{Empty, One, Two};
        let rules =
            rules(&[("empty*", Empty), ("{scene}/{subject}/one_*", One), ("{subject}+*_two.?", Two)]).expect("rules");
        let read = |name: &str| {
            let r = rules.parse(name).expect("one fits");
            (r.label, r.scene, r.subject)
        };
        assert_eq!(read("kitchen/empty-20240528"), (Empty, None, None));
        assert_eq!(read("kitchen/ann/one_3"), (One, Some("kitchen".into()), Some("ann".into())));
        assert_eq!(read("x/ann+bob_two.1"), (Two, None, Some("ann".into())));
    }

    mod hard_cases {
        use super::*;

        /// Regression test: datasets did not find text recordings with other endings than `.txt`. All other commands took a
        /// folder with a config.json of another program for a recording.
        #[test]
        fn recordings_are_found_and_nothing_else() {
            let folder = tempfile::tempdir().expect("a folder");
            let values = "0.512332\n0.512332\n\n";
            for (name, content) in [
                ("cut.mcap", ""),
                ("notes.txt", "no recording"),
                ("project/config.json", "{}"),
                ("project/one/RadarIfxAvian_00/format.version", "1.0.0\n"),
                ("walk.dat", values),
                ("walk.label", "Time(Seconds),Length(Seconds),Label(string)\n"),
                ("walk_config.json", "{}"),
            ] {
                let path = folder.path().join(name);
                std::fs::create_dir_all(path.parent().expect("a folder")).expect("creates");
                std::fs::write(path, content).expect("writes");
            }
            let found = find(folder.path()).expect("recordings");
            let names: Vec<&str> = found.iter().map(|found| found.name.as_str()).collect();
            assert_eq!(names, ["cut", "project/one", "walk.dat"]);
        }

        #[test]
        fn no_pattern_or_two_is_an_error_with_the_name() {
            use FolderLabel::{Empty, One};
            let rules = rules(&[("empty*", Empty), ("*one*", One)]).expect("rules");
            let said = |name: &str| rules.parse(name).expect_err("no").to_string();
            assert!(
                said("day1/nobody").contains("'day1/nobody' fits none of the patterns \"*one*\", \"empty*\"")
                    || said("day1/nobody").contains("'day1/nobody' fits none of the patterns \"empty*\", \"*one*\"")
            );
            assert!(said("empty_or_one").contains("fits two patterns"));
            // Dots and brackets are literal; a star does not match across folders.
            let strict = super::rules(&[("a.[b]*", One), ("x/*", Empty)]).expect("rules");
            assert!(strict.parse("a.[b]c").is_ok() && strict.parse("ab").is_err() && strict.parse("x/y/z").is_err());
            assert!(compile("{who}_*").expect_err("unknown").to_string().contains("{who}"));
            assert!(compile("{subject").expect_err("open").to_string().contains("never closed"));
        }
    }
}
