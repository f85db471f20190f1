//! Classifiers of frames wherever a model is taken: a trained network, or the classical detector as `--model cfar`.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use anyhow::Context;
use radome_driver::Judge as NamedJudge;
use radome_driver::recording::mcap::RESULTS_VERSION;
use radome_dsp::detect::CfarCounter;
use radome_dsp::rdm::{AxesCoverage, PhysicalAxes, SlowTime};
use radome_dsp::{Frame, MapStatus, Rdm, RdmProcessor, ReceiverFault, Waveform};
use radome_models::bounded_file::read;
use radome_models::occupancy_filter::Smoothing;
use radome_models::{Classifier, MODEL_LIMIT_BYTES};
use sha2::{Digest, Sha256};

/// The name that takes the place of a model file.
pub const CFAR: &str = "cfar";

/// The model that judges where none is named: it is part of the program, and takes nearly any waveform.
pub const BUILT_IN: &str = "room-hqnn";

/// Velocity resolution beyond which the shipped models mostly count two people as one, m/s. Of frames of simulated rooms (seeds 731033
/// to 731038) with two people `room-hqnn` called 67 % `two` at 0.10 m/s, 16 % at 0.26 m/s and none at 0.52 m/s.
const COUNTING_RESOLUTION_M_PER_S: f64 = 0.25;

static BUILT_IN_FILE: &[u8] = include_bytes!("../../fixtures/models/room-hqnn.safetensors");

/// Probabilities of the number of people who are seen, by the number that a detector counts, `[counted][seen]`: people who are hidden or
/// turned away are missed more often than somebody is made of noise. Chosen on simulated corridors (seeds 90001 to 90006) and
/// halls (200001 to 200006).
const COUNTED_TO_SEEN: [[f32; 3]; 3] = [[0.70, 0.20, 0.10], [0.05, 0.60, 0.35], [0.01, 0.10, 0.89]];

/// A network of our own by its file, or the built-in one by its name.
///
/// # Errors
/// The file cannot be read or is no model.
pub fn network(name: &Path) -> anyhow::Result<radome_models::Model> {
    Ok(if is_built_in(name) {
        radome_models::Model::from_bytes(name, BUILT_IN_FILE)?
    } else {
        radome_models::Model::load(name)?
    })
}

/// Whether a name is that of the built-in model, and of no file.
pub fn is_built_in(name: &Path) -> bool {
    name == Path::new(BUILT_IN) && !name.exists()
}

/// Delays of the number of people against flicker.
#[derive(Debug, Clone, Copy)]
pub struct Delays {
    /// Time of agreement before a greater number counts, s.
    pub on_s: f64,
    /// Time of agreement before a smaller number counts, s.
    pub off_s: f64,
}

impl Default for Delays {
    fn default() -> Self {
        Delays { on_s: 0.5, off_s: 3.0 }
    }
}

/// A model, before it is known which frames it will see.
pub enum Model {
    /// A trained network, native or ONNX.
    Network(Box<Classifier>),
    /// The classical detector: no training, any waveform.
    Cfar,
}

/// A model at work on frames of one waveform.
pub struct Judge(Kind);

// There is one in a program: its size does not matter.
#[allow(clippy::large_enum_variant)]
enum Kind {
    Network { classifier: Box<Classifier>, processor: RdmProcessor, map: Rdm },
    Cfar(Box<CfarCounter>),
}

/// Prediction for one frame.
pub enum Prediction {
    /// Its window over frames is not full yet: so many of so many.
    WarmingUp { have: usize, need: usize },
    /// Probabilities of empty, one and two by this frame.
    Probabilities([f32; 3]),
    /// No receiver gives a signal: the frame says nothing of the room.
    NoSignal,
}

/// Fault of a receiver, as it is said to the user.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct FaultyReceiver {
    /// Index in the frame, 0-based.
    rx: usize,
    /// Receivers of a frame.
    receivers: usize,
    fault: ReceiverFault,
}

impl std::fmt::Display for FaultyReceiver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let FaultyReceiver { rx, receivers, fault } = *self;
        write!(f, "receiver {} of {receivers}: {fault}", rx + 1)?;
        if fault.is_dead() {
            f.write_str("; frames in which no receiver gives a signal get no answer")?;
        }
        f.write_str(match fault {
            ReceiverFault::Constant => "\n\nhint: see whether the board programs this receiver, or capture without it",
            ReceiverFault::Saturated | ReceiverFault::Clipped => {
                "\n\nhint: capture with a lower if_gain_db, or move the radar away from what reflects strongly"
            }
        })
    }
}

/// Writes the fault of a receiver to stderr, the same one once in a run of the program.
fn say_fault(faulty: FaultyReceiver) {
    static SAID: Mutex<BTreeSet<FaultyReceiver>> = Mutex::new(BTreeSet::new());
    if SAID.lock().unwrap_or_else(PoisonError::into_inner).insert(faulty) {
        eprintln!("warning: {faulty}");
    }
}

impl Model {
    /// `cfar`, the built-in model by its name, or a model file.
    ///
    /// # Errors
    /// The file cannot be read or is no model.
    pub fn open(name: &Path) -> anyhow::Result<Self> {
        if name == Path::new(CFAR) && !name.exists() {
            return Ok(Model::Cfar);
        }
        if is_built_in(name) {
            return Ok(Model::Network(Box::new(Classifier::new(network(name)?))));
        }
        Ok(Model::Network(Box::new(Classifier::load(name)?)))
    }

    /// The waveform that a board is programmed with; the detector takes any.
    pub fn waveform(&self) -> Option<&Waveform> {
        match self {
            Model::Network(classifier) => Some(classifier.waveform()),
            Model::Cfar => None,
        }
    }

    /// Name and hash of the model, as recordings store them.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn named(&self, path: &Path, delays: Delays) -> anyhow::Result<NamedJudge> {
        let model = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let model_hash = match self {
            // It is this program's own.
            Model::Cfar => format!("radome {}", env!("CARGO_PKG_VERSION")),
            Model::Network(_) => {
                let bytes = if is_built_in(path) {
                    BUILT_IN_FILE.to_vec()
                } else {
                    read(path, MODEL_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?
                };
                format!("{:x}", Sha256::digest(&bytes))
            }
        };
        let Delays { on_s: on_delay_s, off_s: off_delay_s } = delays;
        Ok(NamedJudge { version: RESULTS_VERSION, model, model_hash, on_delay_s, off_delay_s })
    }

    /// Settings of the filter over predictions.
    pub fn smoothing(&self) -> Smoothing {
        match self {
            Model::Network(classifier) => classifier.card().smoothing,
            Model::Cfar => Smoothing::default(),
        }
    }

    /// Frames that a map is made of.
    pub fn frames(&self) -> usize {
        match self {
            Model::Network(classifier) => match classifier.rdm_spec().slow_time {
                SlowTime::Chirps => 1,
                SlowTime::Frames { frames } => frames,
            },
            Model::Cfar => 1,
        }
    }

    /// Checks whether frames of a waveform can be judged.
    ///
    /// # Errors
    /// The quantity in which the waveform differs from the model's own; of a model on physical axes, the limit that it exceeds.
    pub fn check_waveform(&self, waveform: &Waveform) -> anyhow::Result<()> {
        match self {
            Model::Network(classifier) => {
                Ok(classifier.rdm_spec().check_compatible(waveform, classifier.waveform())?)
            }
            Model::Cfar => Ok(()),
        }
    }

    /// Puts it to work on frames of a waveform, and says on stderr what is lost where these are not the model's own.
    ///
    /// # Errors
    /// If the model cannot judge frames of the waveform.
    pub fn judge(self, waveform: &Waveform) -> anyhow::Result<Judge> {
        self.check_waveform(waveform)?;
        Ok(Judge(match self {
            Model::Network(classifier) => {
                if let Some(axes) = classifier.rdm_spec().physical_axes {
                    say_losses(&losses(&axes, waveform, classifier.waveform()));
                }
                let processor = RdmProcessor::new(classifier.rdm_spec(), waveform)?;
                let map = processor.empty_map();
                Kind::Network { classifier, processor, map }
            }
            Model::Cfar => {
                Kind::Cfar(Box::new(CfarCounter::new(waveform).context("the detector cannot look at these frames")?))
            }
        }))
    }
}

/// Losses of a map of frames of this waveform against one of the model's own waveform, in words; empty if there are none.
fn losses(axes: &PhysicalAxes, waveform: &Waveform, nominal: &Waveform) -> Vec<String> {
    let (given, own) = (axes.coverage(waveform), axes.coverage(nominal));
    let mut losses = Vec::new();
    if given.range_bins < own.range_bins {
        losses.push(format!(
            "range ends at {:.2} m, not at {:.2} m",
            given.range_bins as f64 * axes.range_step_m,
            own.range_bins as f64 * axes.range_step_m
        ));
    }
    if given.velocity_bins.len() < own.velocity_bins.len() {
        losses.push(format!(
            "speeds above {:.2} m/s are not told from others, with the model's own waveform above {:.2} m/s",
            waveform.max_velocity_m_per_s(),
            nominal.max_velocity_m_per_s()
        ));
    }
    // A tenth is not worth a word.
    let is_coarser = |given: f64, own: f64| given > 1.1 * own;
    if is_coarser(given.range_resolution_m, own.range_resolution_m) {
        losses.push(format!(
            "range resolution is {:.2} m, not {:.2} m",
            given.range_resolution_m, own.range_resolution_m
        ));
    }
    if is_coarser(given.velocity_resolution_m_per_s, own.velocity_resolution_m_per_s) {
        losses.push(format!(
            "velocity resolution is {:.2} m/s, not {:.2} m/s",
            given.velocity_resolution_m_per_s, own.velocity_resolution_m_per_s
        ));
        if given.velocity_resolution_m_per_s > COUNTING_RESOLUTION_M_PER_S {
            losses.push("two people are mostly counted as one".to_owned());
        }
    }
    let samples = |of: &AxesCoverage| (of.samples.len() * of.chirps.len()) as f64;
    let gain_db = 10.0 * (samples(&given) / samples(&own)).log10();
    if gain_db < -1.0 {
        losses.push(format!("echoes are {:.0} dB lower over noise, by fewer samples or chirps", -gain_db));
    }
    losses
}

/// Writes losses to stderr, the same ones once in a run of the program.
fn say_losses(losses: &[String]) {
    static SAID: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    if losses.is_empty() {
        return;
    }
    let text = losses.join("; ");
    if SAID.lock().unwrap_or_else(PoisonError::into_inner).insert(text.clone()) {
        eprintln!("note: frames of another waveform than the model's own are brought onto its axes: {text}");
    }
}

impl Judge {
    /// The newest map: the network's input, or what the detector sees move.
    pub fn map(&self) -> &Rdm {
        match &self.0 {
            Kind::Network { map, .. } => map,
            Kind::Cfar(counter) => counter.map(),
        }
    }

    /// The network at work, to be asked about changed maps; the detector looks at frames and has none.
    pub fn classifier(&mut self) -> Option<&mut Classifier> {
        match &mut self.0 {
            Kind::Network { classifier, .. } => Some(classifier.as_mut()),
            Kind::Cfar(_) => None,
        }
    }

    /// Forgets what must not reach across missing frames.
    pub fn reset(&mut self) {
        match &mut self.0 {
            Kind::Network { processor, .. } => processor.reset(),
            Kind::Cfar(counter) => counter.reset(),
        }
    }

    /// Judges the next frame. Says on stderr which receivers have faults, each fault once in a run of the program.
    ///
    /// # Errors
    /// The frame is of another shape than the waveform says, or the model fails.
    pub fn frame(&mut self, frame: &Frame) -> anyhow::Result<Prediction> {
        let receivers = frame.shape.rx;
        let mut dead = 0;
        for rx in 0..receivers {
            if let Some(fault) = frame.receiver_fault(rx) {
                say_fault(FaultyReceiver { rx, receivers, fault });
                dead += usize::from(fault.is_dead());
            }
        }
        // A map is made of any frame: what shows maps has the newest.
        let prediction = self.judge(frame)?;
        if dead < receivers {
            return Ok(prediction);
        }
        // The frames behind it are not held against it.
        self.reset();
        Ok(Prediction::NoSignal)
    }

    fn judge(&mut self, frame: &Frame) -> anyhow::Result<Prediction> {
        match &mut self.0 {
            Kind::Network { classifier, processor, map } => match processor.process(frame, map)? {
                MapStatus::WarmingUp { have, need } => Ok(Prediction::WarmingUp { have, need }),
                MapStatus::Ready => Ok(Prediction::Probabilities(classifier.classify(map)?)),
            },
            Kind::Cfar(counter) => {
                let seen = counter.observe(frame)?;
                Ok(Prediction::Probabilities(COUNTED_TO_SEEN[counter.people(seen)]))
            }
        }
    }

    /// The model back, for frames of another source.
    pub fn into_model(self) -> Model {
        match self.0 {
            Kind::Network { classifier, .. } => Model::Network(classifier),
            Kind::Cfar(_) => Model::Cfar,
        }
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::{RxMask, WaveformRequest};

    use super::*;

    fn waveform(change: impl FnOnce(&mut WaveformRequest)) -> Waveform {
        let mut request = WaveformRequest {
            start_frequency_hz: 60.5e9,
            end_frequency_hz: 61.5e9,
            samples_per_chirp: 128,
            chirps_per_frame: 64,
            sample_rate_hz: 2e6,
            chirp_interval_s: 391.55e-6,
            ..WaveformRequest::paper()
        };
        change(&mut request);
        Waveform::realise(request).expect("a valid waveform")
    }

    #[test]
    fn what_another_waveform_loses_is_said_by_quantity() {
        let axes = PhysicalAxes { range_step_m: 0.15, range_bins: 64, velocity_step_m_per_s: 0.098, velocity_bins: 64 };
        let own = waveform(|_| ());
        let lost = |given: Waveform| losses(&axes, &given, &own).join("; ");
        assert_eq!(lost(own.clone()), "");
        // Other receivers, gain and frame rate lose nothing.
        let one = RxMask::from_antennas(&[1]).expect("a receiver");
        assert_eq!(lost(waveform(|w| (w.rx_antennas, w.if_gain_db, w.frame_interval_s) = (one, 33.0, 0.05))), "");
        assert_eq!(lost(waveform(|w| (w.chirps_per_frame, w.frame_interval_s) = (512, 0.25))), "");
        let short = lost(waveform(|w| (w.samples_per_chirp, w.chirps_per_frame) = (64, 16)));
        assert!(short.contains("range ends at 5.40 m, not at 9.60 m"), "{short}");
        assert!(short.contains("velocity resolution is 0.39 m/s, not 0.10 m/s"), "{short}");
        assert!(short.contains("9 dB lower") && short.contains("mostly counted as one"), "{short}");
        let narrow = lost(waveform(|w| w.end_frequency_hz = w.start_frequency_hz + 0.33e9));
        assert_eq!(narrow, "range resolution is 0.47 m, not 0.16 m");
        let slow = lost(waveform(|w| w.chirp_interval_s = 780e-6));
        assert!(slow.contains("speeds above 1.57 m/s"), "{slow}");
    }

    #[test]
    fn a_frame_without_a_signal_has_no_answer() {
        let of = waveform(|_| ());
        let length = of.request.samples_per_chirp * of.request.chirps_per_frame;
        for name in [CFAR, BUILT_IN] {
            let mut judge = Model::open(Path::new(name)).expect("a model").judge(&of).expect("its waveform");
            let mut frame = Frame::zeroed(of.shape());
            assert!(matches!(judge.frame(&frame).expect("judged"), Prediction::NoSignal), "{name}");
            frame.sequence = 1;
            frame.codes.iter_mut().enumerate().for_each(|(index, code)| *code = 2000 + (index % 97) as u16);
            assert!(matches!(judge.frame(&frame).expect("judged"), Prediction::Probabilities(_)), "{name}");
            frame.sequence = 2;
            frame.codes[..length].fill(2048);
            assert!(matches!(judge.frame(&frame).expect("judged"), Prediction::Probabilities(_)), "{name}");
        }
    }

    #[test]
    fn a_fault_names_the_receiver_and_what_to_do() {
        for (fault, hint) in [
            (ReceiverFault::Constant, "programs"),
            (ReceiverFault::Saturated, "if_gain_db"),
            (ReceiverFault::Clipped, "if_gain_db"),
        ] {
            let said = FaultyReceiver { rx: 0, receivers: 3, fault }.to_string();
            assert!(said.contains("receiver 1 of 3") && said.contains("\n\nhint: ") && said.contains(hint), "{said}");
        }
    }
}
