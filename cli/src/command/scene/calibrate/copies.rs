//! Simulated copies of recordings, each with another seed.

use anyhow::bail;
use radome_dsp::statistics::{MotionLine, Regions, SlowTimeStatistics};
use radome_dsp::{Frame, Waveform, WaveformMismatch};
use radome_sim::receiver::Receiver;
use radome_sim::receiver::calibration::{Calibration, ChannelFit, LEAST_FRAMES};
use radome_sim::{Scene, SimulateOptions, Simulator};

use super::arguments::{Arguments, WINDOW_S};
use super::sample::{Sample, Sampler};
use crate::{output, source};

/// Scene that is simulated with one receiver after the other.
pub struct Copies {
    scene: Scene,
    /// Whether the copies contain anything but the receiver.
    pub has_scene: bool,
    people: Option<usize>,
    seeds: std::ops::Range<u64>,
    frames: u64,
}

/// Samples of copies simulated with one receiver.
pub struct Simulated {
    pub samples: Vec<Sample>,
    /// Fit of each receiver over all copies.
    pub channels: Vec<ChannelFit>,
    /// Slow-time line of the moving person in each copy.
    pub lines: Vec<Option<MotionLine>>,
}

impl Copies {
    /// Prepares copies of the requested scene, or none.
    ///
    /// # Errors
    /// The scene cannot be read, or its waveform is not that of the recordings.
    pub fn new(arguments: &Arguments, waveform: &Waveform) -> anyhow::Result<Self> {
        let scene = match &arguments.scene {
            Some(path) => {
                let scene = Scene::load(path)?;
                if let Err(WaveformMismatch { what, expected, got }) = scene.waveform().check_compatible(waveform) {
                    bail!(
                        "{}: the scene's waveform is not the recordings': they differ in {what}: {expected} is needed, {got} was \
                         given\n\nhint: write the recordings' waveform into [waveform] of the scene; radome recording info shows it",
                        path.display()
                    );
                }
                scene
            }
            None => Scene::empty_space(waveform)?,
        };
        let frames = (WINDOW_S / waveform.frame_interval_s()).round().max(LEAST_FRAMES as f64) as u64;
        Ok(Copies {
            has_scene: arguments.scene.is_some(),
            people: arguments.people,
            seeds: arguments.seed..arguments.seed.saturating_add(arguments.copies),
            scene,
            frames,
        })
    }

    /// Simulates all copies with a receiver.
    ///
    /// # Errors
    /// The receiver does not fit the scene, or the simulation fails.
    pub fn sample(&self, receiver: &Receiver, regions: &Regions) -> anyhow::Result<Simulated> {
        let copies = (self.seeds.end - self.seeds.start) as usize;
        let waveform = self.scene.waveform();
        let mut calibration = Calibration::new(waveform, copies * self.frames as usize)?;
        let mut sampler = Sampler::new(waveform, regions)?;
        let (mut samples, mut lines) = (Vec::new(), Vec::new());
        let bar = output::progress(copies as u64, "simulating");
        for seed in self.seeds.clone() {
            let (mut sample, mut slow_time) = (Sample::default(), SlowTimeStatistics::new(waveform, WINDOW_S));
            calibration.begin_recording();
            self.for_each_frame(receiver, seed, self.people, |frame| {
                calibration.push(frame)?;
                slow_time.push(frame);
                sampler.add(frame, &mut sample)
            })?;
            slow_time.end();
            samples.push(sample);
            lines.push(slow_time.line());
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(Simulated { samples, channels: calibration.fit(receiver, "", "")?.channels, lines })
    }

    /// Simulates the static echoes of the scene, without people and without leakage.
    ///
    /// # Errors
    /// The simulation fails.
    pub fn clutter(&self, receiver: &Receiver) -> anyhow::Result<SlowTimeStatistics> {
        let mut quiet = receiver.clone();
        for rx in &mut quiet.rx {
            rx.leakage.clear();
            rx.transient.clear();
        }
        let mut slow_time = SlowTimeStatistics::new(self.scene.waveform(), WINDOW_S);
        self.for_each_frame(&quiet, self.seeds.start, Some(0), |frame| {
            slow_time.push(frame);
            Ok(())
        })?;
        slow_time.end();
        Ok(slow_time)
    }

    fn for_each_frame(
        &self,
        receiver: &Receiver,
        seed: u64,
        people: Option<usize>,
        mut visit: impl FnMut(&Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let options = SimulateOptions { seed, people, frames: Some(self.frames), ..SimulateOptions::default() };
        let mut simulator = Simulator::new(&self.scene.clone().with_receiver(receiver.clone()), options)?;
        let mut frame = Frame::zeroed(self.scene.waveform().shape());
        while source::next_frame(&mut simulator, &mut frame)? {
            visit(&frame)?;
        }
        Ok(())
    }
}
