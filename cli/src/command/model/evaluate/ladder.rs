//! `radome model evaluate --ladder`: compares models on simulated recordings that differ from training, in one way per
//! rung.

mod rung;
mod scores;

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use indicatif::ProgressBar;
use radome_driver::recording::mcap::{Recorder, RecorderOptions, RecordingHeader};
use radome_driver::recording::{Existing, Recording};
use radome_dsp::{Frame, FrameSource};
use radome_models::occupancy_filter::Smoothing;
use radome_models::train::{FilterSequence, fit_smoothing};
use radome_sim::{SimulateOptions, Simulator};
use serde_json::json;

use self::rung::{Rung, Simulation, load};
use self::scores::{ModelScores, RungScores, print, print_fit};
use super::candidate::{Candidate, Refusal, Run};
use crate::classifier::Model;
use crate::panics::PanicGuard;
use crate::{output, source, stored_simulation};

/// Evaluates models on the recordings of a ladder and prints their scores. With `fit`, also prints the filter settings
/// that suit all of them best.
///
/// With `empty_hours`, that many hours of each rung's rooms without people replace the rung's recordings.
///
/// # Errors
/// A rung or a model cannot be read, a simulation fails, or nothing can be evaluated.
pub fn run(
    models: &[PathBuf],
    ladder: &Path,
    empty_hours: Option<f64>,
    store: Option<&Path>,
    fit: bool,
    json: bool,
) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    ensure!(!models.is_empty(), "no model to evaluate on {}\n\nhint: name one or more with --model", ladder.display());
    let mut rungs = load(ladder)?;
    if let Some(hours) = empty_hours {
        rungs = rungs.into_iter().map(|rung| rung.without_people(hours)).collect::<anyhow::Result<_>>()?;
    }
    let open = |path: &PathBuf| anyhow::Ok(Candidate::new(path.clone(), Model::open(path)?, None));
    let mut candidates = models.iter().map(open).collect::<anyhow::Result<Vec<_>>>()?;
    if let Some(folder) = store {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    }
    let frames: u64 = rungs.iter().flat_map(|rung| &rung.simulations).map(|simulation| simulation.frames).sum();
    let bar = output::progress(frames, "ladder");
    // [model][rung]
    let mut scores_by_model: Vec<Vec<RungScores>> = candidates.iter().map(|_| Vec::new()).collect();
    for rung in &rungs {
        bar.set_message(rung.name.clone());
        let mut scores: Vec<RungScores> = candidates.iter().map(|_| RungScores::default()).collect();
        for simulation in &rung.simulations {
            simulation
                .evaluate(&mut candidates, &mut scores, store, &bar)
                .with_context(|| format!("rung {}, recording {}", rung.name, simulation.name))?;
        }
        scores_by_model.iter_mut().zip(scores).for_each(|(all, scores)| all.push(scores));
    }
    bar.finish_and_clear();
    let model_scores: Vec<ModelScores> = candidates
        .iter()
        .zip(&scores_by_model)
        .map(|(candidate, scores)| ModelScores::new(candidate.path(), &rungs, scores))
        .collect();
    let fit = fit.then(|| {
        let sequences = |scores: &mut RungScores| std::mem::take(&mut scores.sequences);
        let groups: Vec<Vec<FilterSequence>> = scores_by_model.iter_mut().flatten().map(sequences).collect();
        fit_smoothing(&groups, Smoothing::default())
    });
    let fitted = fit.flatten();
    if json {
        let of_rung = |rung: &Rung| {
            let frames: u64 = rung.simulations.iter().map(|simulation| simulation.frames).sum();
            json!({ "rung": rung.name, "about": rung.about, "recordings": rung.simulations.len(), "frames": frames })
        };
        let ladder: Vec<_> = rungs.iter().map(of_rung).collect();
        let mut answer = json!({ "ladder": ladder, "models": model_scores });
        if let Some(fitted) = &fitted {
            answer["fitted_smoothing"] = serde_json::to_value(fitted)?;
        }
        return output::json_line(&answer);
    }
    print(&model_scores)?;
    fitted.map_or(Ok(()), |fitted| print_fit(&fitted))
}

impl Simulation {
    /// Runs all models on the frames, each of which is simulated once.
    fn evaluate(
        &self,
        candidates: &mut [Candidate],
        scores: &mut [RungScores],
        store: Option<&Path>,
        bar: &ProgressBar,
    ) -> anyhow::Result<()> {
        let (mut source, mut recorder) = self.open(store)?;
        let waveform = source.waveform().clone();
        let mut runs: Vec<Option<Run>> = Vec::new();
        for (candidate, scores) in candidates.iter_mut().zip(scores.iter_mut()) {
            let started = candidate.start_run(&waveform);
            if let Err(refusal) = &started {
                scores.refused.push(Refusal::new(self.name.clone(), refusal));
            }
            runs.push(started.ok());
        }
        if runs.iter().all(Option::is_none) && recorder.is_none() {
            bar.inc(self.frames);
            return Ok(());
        }
        let mut frame = Frame::zeroed(waveform.shape());
        loop {
            ensure!(!output::interrupted(), "interrupted");
            let note_gap = || runs.iter_mut().flatten().for_each(Run::note_gap);
            if !source::next_frame_noting_gaps(source.as_mut(), &mut frame, note_gap)? {
                break;
            }
            if let Some(recorder) = &mut recorder {
                recorder.frame(&frame)?;
            }
            let truth = frame.truth.filter(|truth| !truth.transition).map(|truth| truth.occupancy);
            for run in runs.iter_mut().flatten() {
                run.predict(&frame, truth)?;
            }
            bar.inc(1);
        }
        if let Some(recorder) = recorder {
            recorder.finish()?;
        }
        for (run, scores) in runs.into_iter().zip(scores) {
            if let Some(run) = run {
                scores.add(&self.name, &run.predictions);
            }
        }
        Ok(())
    }

    /// Opens the frames: simulated, or stored by an earlier run. Returns a recorder if they are to be stored.
    fn open(&self, store: Option<&Path>) -> anyhow::Result<(Box<dyn FrameSource>, Option<Recorder>)> {
        let options = SimulateOptions {
            seed: self.seed,
            people: self.people,
            frames: Some(self.frames),
            ..SimulateOptions::default()
        };
        let simulator = Simulator::new(&self.scene, options)?;
        let mut recorder = None;
        if let Some(folder) = store {
            let path = folder.join(format!("{}.mcap", self.name));
            // Any change of the scene or the simulator shows in the last frame.
            if stored_simulation::is_recording_of(&path, &simulator, 0..self.frames, &[self.frames - 1]) {
                return Ok((Box::new(Recording::open(&path)?), None));
            }
            let header = RecordingHeader::new(simulator.waveform().clone());
            let options = RecorderOptions { existing: Existing::Replace, sync: None };
            recorder = Some(Recorder::with_options(&path, &header, &options)?);
        }
        // Models run on this thread. On the shared thread pool they would queue behind the next frames.
        let source: Box<dyn FrameSource> = Box::new(PanicGuard::new(Box::new(simulator.on_own_threads()?)));
        Ok((source, recorder))
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::{Occupancy, SourceEvent};

    use super::*;
    use crate::files;

    pub(super) fn ladder() -> PathBuf {
        files::fixture("ladder").expect("a fixture")
    }

    /// Every rung loads without warnings, and its scenes give frames with a truth. No training uses the seeds.
    #[test]
    fn all_rungs_can_be_simulated() {
        let rungs = load(&ladder()).expect("rungs");
        let mut frames = 0;
        for rung in &rungs {
            assert!(rung.about.ends_with('.') && (3..=16).contains(&rung.simulations.len()), "{}", rung.name);
            frames += rung.simulations.iter().map(|simulation| simulation.frames).sum::<u64>();
            for simulation in &rung.simulations {
                assert!(simulation.seed > 700_000, "{}", simulation.name);
                let (mut source, recorder) = simulation.open(None).expect("a simulation");
                assert!(recorder.is_none());
                let mut frame = Frame::zeroed(source.waveform().shape());
                for _ in 0..3 {
                    assert_eq!(source.next_frame(&mut frame).expect("a frame"), SourceEvent::Frame);
                    assert!(frame.truth.is_some());
                }
            }
        }
        assert!((8_000..16_000).contains(&frames), "{frames} frames");
        let names: Vec<&str> = rungs.iter().map(|rung| rung.name.as_str()).collect();
        let expected = "company furnished gait ghosts receiver rest rooms skins still three wander waveforms";
        assert_eq!(names.join(" "), expected);
    }

    /// Three people are present at a time and are labelled as two.
    #[test]
    fn the_rung_of_three_people_has_three_people() {
        let rung = load(&ladder().join("three.toml")).expect("a rung").remove(0);
        let busiest = rung.simulations.iter().filter(|simulation| simulation.people.is_none()).map(|simulation| {
            let options = SimulateOptions { seed: simulation.seed, ..SimulateOptions::default() };
            let simulator = Simulator::new(&simulation.scene, options).expect("a simulation");
            let people = |index: u64| simulator.people(index).iter().filter(|person| person.in_room).count();
            let most = (0..simulation.frames).map(|index| (people(index), index)).max().expect("frames");
            (most.0, simulator.truth(most.1).occupancy)
        });
        for (people, truth) in busiest {
            assert_eq!((people, truth), (3, Occupancy::Two));
        }
    }

    #[test]
    fn a_stored_recording_is_recognised() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut simulation = load(&ladder().join("rooms.toml")).expect("a rung").remove(0).simulations.remove(0);
        simulation.frames = 4;
        let bar = ProgressBar::hidden();
        let path = folder.path().join(format!("{}.mcap", simulation.name));
        simulation.evaluate(&mut [], &mut [], Some(folder.path()), &bar).expect("simulated");
        assert!(path.exists());
        assert!(simulation.open(Some(folder.path())).expect("kept").1.is_none());
        // A recording with another seed or length is a different one.
        simulation.frames = 3;
        assert!(simulation.open(Some(folder.path())).expect("anew").1.is_some());
        simulation.frames = 4;
        simulation.seed += 1;
        assert!(simulation.open(Some(folder.path())).expect("anew").1.is_some());
    }
}
