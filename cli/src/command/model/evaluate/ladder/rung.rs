//! Rungs of a ladder, and the recordings that are simulated for them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_files::named_by_spec;
use radome_sim::Scene;

use crate::dataset::rung::{MOST_FRAMES, RungFile};
use crate::exit::wrong_use;

/// Longest recording of an empty room, s. Hours of empty rooms are spread over several rooms.
const EMPTY_RECORDING_S: f64 = 360.0;

/// Rung, ready to be simulated.
pub(super) struct Rung {
    pub(super) name: String,
    /// One sentence that describes the difference from training.
    pub(super) about: String,
    pub(super) simulations: Vec<Simulation>,
}

/// Recording to be simulated.
pub(super) struct Simulation {
    pub(super) name: String,
    /// Name of the scene file.
    stem: String,
    /// The scene before its seed draws from it.
    pub(super) scene: Scene,
    pub(super) seed: u64,
    /// Maximum number of people; the scene's own number if absent.
    pub(super) people: Option<usize>,
    pub(super) frames: u64,
}

/// Loads the rungs of a folder, ordered by file name, or the one rung of a file.
pub(super) fn load(path: &Path) -> anyhow::Result<Vec<Rung>> {
    let mut files = Vec::new();
    if path.is_dir() {
        let cannot = || format!("cannot list {}", path.display());
        for entry in std::fs::read_dir(path).with_context(cannot)? {
            let file = entry.with_context(cannot)?.path();
            if file.is_file() && file.extension().is_some_and(|extension| extension == "toml") {
                files.push(file);
            }
        }
        files.sort();
        if files.is_empty() {
            bail!("{}: no rung in it\n\nhint: a rung is a .toml file; fixtures/ladder has some", path.display());
        }
    } else {
        files.push(path.to_owned());
    }
    // Each scene is read once, because reading prints its warnings.
    let mut scenes = BTreeMap::new();
    let rungs = files.iter().map(|file| Rung::load(file, &mut scenes)).collect::<anyhow::Result<Vec<_>>>()?;
    let mut names = BTreeSet::new();
    if let Some(duplicate) = rungs.iter().find(|rung| !names.insert(rung.name.as_str())) {
        bail!("{}: two rungs are called {}", path.display(), duplicate.name);
    }
    Ok(rungs)
}

impl Rung {
    fn load(path: &Path, scenes: &mut BTreeMap<PathBuf, Scene>) -> anyhow::Result<Self> {
        let file = RungFile::load(path)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut simulations = Vec::new();
        for entry in &file.scene {
            let scene_path = named_by_spec(folder, &entry.path)
                .with_context(|| format!("{}: cannot read {}", path.display(), entry.path.display()))?;
            let mut scene = match scenes.get(&scene_path) {
                Some(scene) => scene.clone(),
                None => {
                    let scene = Scene::load(&scene_path).with_context(|| path.display().to_string())?;
                    scenes.insert(scene_path.clone(), scene.clone());
                    scene
                }
            };
            if let Some(body) = entry.body {
                scene = scene.with_body(body);
            }
            let stem = scene_path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let people = entry.people.map_or(String::new(), |people| format!("-people{people}"));
            for seed in entry.seeds.0..=entry.seeds.1 {
                simulations.push(Simulation {
                    name: format!("{}-{stem}-seed{seed}{people}", file.name),
                    stem: stem.clone(),
                    scene: scene.clone(),
                    seed,
                    people: entry.people,
                    frames: entry.frames,
                });
            }
        }
        Ok(Rung { name: file.name, about: file.about, simulations })
    }

    /// Replaces the recordings by the same scenes without people, for this many hours in total. Each recording lasts
    /// six minutes at most. The seeds follow those that the rung uses for the scene.
    pub(super) fn without_people(self, hours: f64) -> anyhow::Result<Self> {
        // Grouped by scene name, because skins and ellipsoids of one scene are in different rungs.
        let mut last_of_scene: BTreeMap<&str, &Simulation> = BTreeMap::new();
        for simulation in &self.simulations {
            let last = last_of_scene.entry(simulation.stem.as_str()).or_insert(simulation);
            if simulation.seed > last.seed {
                *last = simulation;
            }
        }
        let time_s = hours * 3600.0 / last_of_scene.len().max(1) as f64;
        let mut simulations = Vec::new();
        for (stem, last) in &last_of_scene {
            let recordings = (time_s / EMPTY_RECORDING_S).ceil();
            let frames = (time_s / recordings / last.scene.waveform().frame_interval_s()).ceil();
            let total_frames = recordings * frames;
            if !(1.0..=MOST_FRAMES as f64).contains(&total_frames) {
                let count = if total_frames.is_finite() { total_frames.to_string() } else { "no number of".to_owned() };
                wrong_use!(
                    "--empty-hours {hours}: {count} frames of {stem}, expected 1 to {MOST_FRAMES}\n\nhint: a day is enough for any rate \
                     that can be told"
                );
            }
            simulations.extend((1..=recordings as u64).map(|after| {
                let seed = last.seed.saturating_add(after);
                Simulation {
                    name: format!("{}-{stem}-seed{seed}-empty", self.name),
                    stem: (*stem).to_owned(),
                    scene: last.scene.clone(),
                    seed,
                    people: Some(0),
                    frames: frames as u64,
                }
            }));
        }
        Ok(Rung { name: self.name.clone(), about: self.about.clone(), simulations })
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::ladder;
    use super::*;
    use crate::output;

    /// An hour of each rung is simulated in rooms that the rung itself does not contain.
    #[test]
    fn hours_of_empty_rooms_are_of_other_seeds() {
        for rung in load(&ladder()).expect("rungs") {
            let of_rung: Vec<(String, u64)> = rung.simulations.iter().map(|of| (of.stem.clone(), of.seed)).collect();
            let scenes: BTreeSet<String> = of_rung.iter().map(|(stem, _)| stem.clone()).collect();
            let name = rung.name.clone();
            let empty = rung.without_people(1.0).expect("an hour").simulations;
            let mut time_s = 0.0;
            for simulation in &empty {
                assert_eq!(simulation.people, Some(0));
                assert!(!of_rung.contains(&(simulation.stem.clone(), simulation.seed)), "{}", simulation.name);
                let of_it_s = simulation.frames as f64 * simulation.scene.waveform().frame_interval_s();
                assert!(of_it_s < EMPTY_RECORDING_S + 1.0, "{}", simulation.name);
                time_s += of_it_s;
            }
            assert!((3600.0..3610.0).contains(&time_s), "{name}: {time_s} s");
            assert_eq!(empty.iter().map(|of| of.stem.clone()).collect::<BTreeSet<_>>(), scenes);
            assert_eq!(empty.iter().map(|of| &of.name).collect::<BTreeSet<_>>().len(), empty.len(), "{name}");
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn hours_that_cannot_be_simulated_are_refused() {
            for hours in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9, 25.0] {
                let rung = load(&ladder().join("rooms.toml")).expect("a rung").remove(0);
                let error = output::chain(&rung.without_people(hours).err().expect("refused"));
                assert!(error.contains("--empty-hours") && error.contains("864000"), "{error}");
            }
            let rung = load(&ladder().join("rooms.toml")).expect("a rung").remove(0);
            let few = rung.without_people(1e-9).expect("a frame").simulations;
            assert_eq!(few.iter().map(|of| of.frames).collect::<Vec<_>>(), [1]);
        }

        #[test]
        fn a_wrong_rung_is_refused_with_its_reason() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("rung.toml");
            let good = "format = 1\nname = \"a\"\nabout = \"b\"\n[[scene]]\npath = \"hall.toml\"\nseeds = [1, 2]\nframes = 3\n";
            for (from, to, expected) in [
                ("format = 1", "format = 2", "format is 2"),
                ("\"a\"", "\"../a\"", "expected letters"),
                ("[1, 2]", "[2, 1]", "first one first"),
                ("frames = 3", "frames = 0", "expected 1 or more"),
                ("frames = 3", "frames = 864001", "at most"),
                ("seeds", "seed", "seed"),
                ("", "", "hall.toml"),
            ] {
                std::fs::write(&path, good.replacen(from, to, 1)).expect("writable");
                let error = output::chain(&load(&path).err().expect("refused"));
                assert!(error.contains("rung.toml") && error.contains(expected), "{to}: {error}");
            }
            std::fs::remove_file(&path).expect("removed");
            let error = output::chain(&load(folder.path()).err().expect("refused"));
            assert!(error.contains("no rung") && error.contains("hint:"), "{error}");
        }
    }
}
