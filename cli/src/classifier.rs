//! Classifiers of frames for all commands that take a model: a trained network, or the classical detector as `--model
//! cfar`.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Mutex;

use anyhow::{Context, ensure};
use radome_driver::Judge;
use radome_driver::recording::mcap::RESULTS_VERSION;
use radome_dsp::detect::CfarCounter;
use radome_dsp::rdm::{AxesCoverage, PhysicalAxes, SlowTime};
use radome_dsp::{Frame, MapStatus, Rdm, RdmProcessor, RdmSpec, ReceiverFault, Waveform};
use radome_models::Classifier;
use radome_models::evidence_mean::EvidenceMean;
use radome_models::model::{BUILT_IN, is_built_in, read};
use radome_models::occupancy_filter::Smoothing;
use sha2::{Digest, Sha256};

use crate::panics::lock;

/// Name that selects the classical detector instead of a model file.
pub const CFAR: &str = "cfar";

/// Velocity resolution beyond which the shipped models mostly count two people who walk as one, m/s. It was chosen with an earlier
/// `room-hqnn`, on frames of simulated rooms with two people (seeds 731033 to 731038): this model called 67 % of them `two` at 0.10 m/s,
/// 16 % at 0.26 m/s and none at 0.52 m/s.
const COUNTING_RESOLUTION_M_PER_S: f64 = 0.25;

/// Probabilities of the classes empty, one and two for each number of people that the detector counts, `[counted][class]`.
/// Missing a person who is hidden or turned away is more likely than counting noise as a person. Chosen on simulated
/// corridors (seeds 90001 to 90006) and halls (200001 to 200006).
const COUNT_TO_PROBABILITIES: [[f32; 3]; 3] = [[0.70, 0.20, 0.10], [0.05, 0.60, 0.35], [0.01, 0.10, 0.89]];

/// Opens a native network by its file, or the built-in one by its name.
///
/// # Errors
/// The file cannot be read or is no model, or is an ONNX file.
pub fn network(name: &Path) -> anyhow::Result<radome_models::Model> {
    check_exists(name)?;
    ensure!(
        !name.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("onnx")),
        "{}: an ONNX file can only judge\n\nhint: name the .safetensors file that it was exported from",
        name.display()
    );
    Ok(radome_models::Model::load(name)?)
}

fn check_exists(name: &Path) -> anyhow::Result<()> {
    ensure!(
        is_built_in(name) || name.exists(),
        "{}: there is no such model\n\nhint: name a model's file, such as fixtures/models/room-linear.safetensors, or {BUILT_IN}, which is built in; \
         live, model evaluate and model background also take {CFAR}",
        name.display()
    );
    Ok(())
}

fn is_cfar(name: &Path) -> bool {
    name == Path::new(CFAR) && !name.exists()
}

/// Returns whether a name is that of a model without a file: the built-in one or the classical detector.
pub fn is_without_file(name: &Path) -> bool {
    is_built_in(name) || is_cfar(name)
}

/// Delays of the number of people, which suppress flicker.
#[derive(Debug, Clone, Copy)]
pub struct Delays {
    /// Time for which a greater number must persist before it counts, s.
    pub on_s: f64,
    /// Time for which a smaller number must persist before it counts, s.
    pub off_s: f64,
}

impl Default for Delays {
    fn default() -> Self {
        Delays { on_s: 0.5, off_s: 3.0 }
    }
}

/// Model whose waveform is not chosen yet.
pub enum Model {
    /// Trained network, native or ONNX.
    Network(Box<Classifier>),
    /// Classical detector, which needs no training and accepts nearly any waveform.
    Cfar,
}

/// Model prepared for frames of one waveform. Receives frames in order.
pub struct FrameClassifier<'m>(Kind<'m>);

// A program holds one instance, so its size does not matter.
#[allow(clippy::large_enum_variant)]
enum Kind<'m> {
    Network { classifier: &'m mut Classifier, processor: RdmProcessor, map: Rdm, mean: EvidenceMean },
    Cfar(Box<CfarCounter>),
}

pub enum Prediction {
    /// The window over frames holds `have` of the `need` frames.
    WarmingUp { have: usize, need: usize },
    /// Probabilities of empty, one and two from this frame and those that the model remembers.
    Probabilities([f32; 3]),
    /// No receiver that the model needs gives a signal, so the frame contains no information about the room.
    NoSignal,
}

/// Error of a receiver, as reported to the user.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct FaultyReceiver {
    /// Index in the frame, 0-based.
    rx: usize,
    receivers: usize,
    fault: ReceiverFault,
}

impl std::fmt::Display for FaultyReceiver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let FaultyReceiver { rx, receivers, fault } = *self;
        write!(f, "receiver {} of {receivers}: {fault}", rx + 1)?;
        if fault.is_dead() {
            f.write_str(
                "; frames get no answer if no receiver gives a signal, or if the model needs this one, as those of one waveform do",
            )?;
        }
        f.write_str(match fault {
            ReceiverFault::Constant => "\n\nhint: see whether the board programs this receiver, or capture without it",
            ReceiverFault::Saturated | ReceiverFault::Clipped => {
                "\n\nhint: capture with a lower if_gain_db, or move the radar away from what reflects strongly"
            }
        })
    }
}

/// Prints the error of a receiver on stderr, each one once per run of the program.
fn warn_once(faulty: FaultyReceiver) {
    static REPORTED: Mutex<BTreeSet<FaultyReceiver>> = Mutex::new(BTreeSet::new());
    if lock(&REPORTED).insert(faulty) {
        message!("warning: {faulty}");
    }
}

impl Model {
    /// Opens a model: `cfar`, the built-in model by its name, or a model file.
    ///
    /// # Errors
    /// The file cannot be read or is no model.
    pub fn open(name: &Path) -> anyhow::Result<Self> {
        if is_cfar(name) {
            return Ok(Model::Cfar);
        }
        check_exists(name)?;
        Ok(Model::Network(Box::new(Classifier::load(name)?)))
    }

    fn network(&self) -> Option<&Classifier> {
        match self {
            Model::Network(classifier) => Some(classifier),
            Model::Cfar => None,
        }
    }

    /// Returns the waveform to program a board with; `None` for the detector, which accepts any.
    pub fn waveform(&self) -> Option<&Waveform> {
        self.network().map(Classifier::waveform)
    }

    /// Describes the model with its settings, as recordings store it.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn description(&self, path: &Path, delays: Delays, max_range_m: Option<f64>) -> anyhow::Result<Judge> {
        let model = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let model_hash = match self {
            // The detector is identified by the program's version.
            Model::Cfar => format!("radome {}", env!("CARGO_PKG_VERSION")),
            Model::Network(_) => format!("{:x}", Sha256::digest(read(path)?)),
        };
        let Delays { on_s: on_delay_s, off_s: off_delay_s } = delays;
        Ok(Judge { version: RESULTS_VERSION, model, model_hash, on_delay_s, off_delay_s, max_range_m })
    }

    /// Returns the time over which the model averages the evidence of frames, s.
    pub fn memory_s(&self) -> f64 {
        self.network().map_or(0.0, |network| network.card().memory_s)
    }

    /// Returns the settings of the filter over predictions.
    pub fn smoothing(&self) -> Smoothing {
        self.network().map(|network| network.card().smoothing).unwrap_or_default()
    }

    /// Number of frames that form a map.
    pub fn frames(&self) -> usize {
        match self.network().map(|network| network.rdm_spec().slow_time) {
            Some(SlowTime::Frames { frames }) => frames,
            Some(SlowTime::Chirps) | None => 1,
        }
    }

    /// Checks whether frames of a waveform can be classified.
    ///
    /// # Errors
    /// The waveform differs from the model's own. For a model on physical axes: the waveform exceeds one of its limits.
    pub fn check_waveform(&self, waveform: &Waveform) -> anyhow::Result<()> {
        let Some(network) = self.network() else { return Ok(()) };
        Ok(network.rdm_spec().check_compatible(waveform, network.waveform())?)
    }

    /// Range below which echoes come from the radar itself and not from people, m.
    fn nearest_m(&self) -> f64 {
        let Some(card) = self.network().map(Classifier::card) else { return CfarCounter::NEAREST_M };
        let skipped = card.standardisation.reference.skipped_range_bins().unwrap_or(0);
        skipped as f64 * card.rdm_spec.steps(&card.waveform).0
    }

    /// Prepares the model for frames of a waveform. People farther away than `max_range_m`, if given, do not count. Prints on stderr
    /// what is lost relative to the model's own waveform.
    ///
    /// # Errors
    /// The model cannot classify frames of the waveform, or its maps cannot be limited to this range.
    pub fn for_waveform(
        &mut self,
        waveform: &Waveform,
        max_range_m: Option<f64>,
    ) -> anyhow::Result<FrameClassifier<'_>> {
        self.check_waveform(waveform)?;
        if let Some(range_m) = max_range_m {
            let takes_any_waveform = self.network().is_none_or(|network| network.rdm_spec().physical_axes.is_some());
            ensure!(
                takes_any_waveform,
                "--max-range-m is for models of any waveform, and this model takes only its own\n\nhint: leave it out, or use {BUILT_IN} \
                 or {CFAR}"
            );
            let nearest_m = self.nearest_m();
            ensure!(
                range_m >= nearest_m,
                "--max-range-m {range_m}: the model sees nobody nearer than {nearest_m:.2} m\n\nhint: give a greater distance"
            );
        }
        Ok(FrameClassifier(match self {
            Model::Network(classifier) => {
                let spec = classifier.rdm_spec();
                if let Some(axes) = spec.physical_axes {
                    note_once(&losses(&axes, waveform, classifier.waveform()));
                }
                let processor = RdmProcessor::new(&RdmSpec { max_range_m, ..*spec }, waveform)?;
                let map = processor.empty_map();
                let mean = EvidenceMean::new(classifier.card().memory_s);
                Kind::Network { classifier, processor, map, mean }
            }
            Model::Cfar => {
                let counter = CfarCounter::new(waveform).context("the detector cannot look at these frames")?;
                Kind::Cfar(Box::new(counter.up_to(max_range_m.unwrap_or(f64::INFINITY))))
            }
        }))
    }
}

/// Describes the losses of a map with this waveform relative to the model's own waveform; empty if there are none.
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
            "speeds above {:.2} m/s look like lower ones ({:.2} m/s with the model's own waveform)",
            waveform.max_velocity_m_per_s(),
            nominal.max_velocity_m_per_s()
        ));
    }
    // Differences of a tenth are not reported.
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
            losses.push("two people who walk are mostly counted as one".to_owned());
        }
    }
    let samples = |coverage: &AxesCoverage| (coverage.samples.len() * coverage.chirps.len()) as f64;
    let gain_db = 10.0 * (samples(&given) / samples(&own)).log10();
    if gain_db < -1.0 {
        losses.push(format!("echoes are {:.0} dB lower over noise, by fewer samples or chirps", -gain_db));
    }
    losses
}

/// Prints losses on stderr, the same ones once per run of the program.
fn note_once(losses: &[String]) {
    static REPORTED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    if losses.is_empty() {
        return;
    }
    let text = losses.join("; ");
    if lock(&REPORTED).insert(text.clone()) {
        message!("note: frames of another waveform than the model's own are brought onto its axes: {text}");
    }
}

impl FrameClassifier<'_> {
    /// Newest map: the network's input, or the moving echoes that the detector sees.
    pub fn map(&self) -> &Rdm {
        match &self.0 {
            Kind::Network { map, .. } => map,
            Kind::Cfar(counter) => counter.map(),
        }
    }

    /// Returns the network, for predictions on modified maps; `None` for the detector, which uses frames.
    pub fn network(&mut self) -> Option<&mut Classifier> {
        match &mut self.0 {
            Kind::Network { classifier, .. } => Some(classifier),
            Kind::Cfar(_) => None,
        }
    }

    /// Resets state that must not persist across missing frames. The mean of earlier evidence and the motion of echoes persist: their
    /// weights decay with time.
    pub fn reset_at_gap(&mut self) {
        match &mut self.0 {
            Kind::Network { processor, .. } => processor.reset_at_gap(),
            Kind::Cfar(counter) => counter.reset(),
        }
    }

    /// Resets the state of maps, as before frames of another scene. The mean of earlier evidence persists: its weight decays with time.
    pub fn reset(&mut self) {
        match &mut self.0 {
            Kind::Network { processor, .. } => processor.reset(),
            Kind::Cfar(counter) => counter.reset(),
        }
    }

    /// Classifies the next frame. Reports receivers with errors on stderr, each error once per run of the program.
    ///
    /// # Errors
    /// The frame does not have the shape of the waveform, or the model fails.
    pub fn classify(&mut self, frame: &Frame) -> anyhow::Result<Prediction> {
        self.classify_changed(frame, frame)
    }

    /// Classifies the next frame with `changed` codes, such as added noise. Receiver errors are found in the frame as it was
    /// `received`, since noise that fills the range of the ADC is no error.
    ///
    /// # Errors
    /// Those of [`FrameClassifier::classify`].
    pub fn classify_changed(&mut self, received: &Frame, changed: &Frame) -> anyhow::Result<Prediction> {
        let receivers = received.shape.rx;
        for rx in 0..receivers {
            if let Some(fault) = received.receiver_fault(rx) {
                warn_once(FaultyReceiver { rx, receivers, fault });
            }
        }
        // Every frame gives a map, so that displays of maps have the newest one.
        let prediction = self.predict(received, changed)?;
        if self.has_signal(received) {
            return Ok(match (prediction, &mut self.0) {
                (Prediction::Probabilities(frame), Kind::Network { mean, .. }) => {
                    Prediction::Probabilities(mean.update(received.time_s(), frame))
                }
                (prediction, _) => prediction,
            });
        }
        // The reset keeps a frame without a signal from affecting later frames.
        self.reset();
        Ok(Prediction::NoSignal)
    }

    /// Returns whether the receivers that the model needs give a signal.
    fn has_signal(&self, frame: &Frame) -> bool {
        match &self.0 {
            Kind::Network { processor, .. } => processor.spec().has_signal(frame),
            Kind::Cfar(_) => (0..frame.shape.rx).any(|rx| !frame.is_receiver_dead(rx)),
        }
    }

    fn predict(&mut self, received: &Frame, changed: &Frame) -> anyhow::Result<Prediction> {
        match &mut self.0 {
            Kind::Network { classifier, processor, map, .. } => {
                match processor.process_changed(received, changed, map)? {
                    MapStatus::WarmingUp { have, need } => Ok(Prediction::WarmingUp { have, need }),
                    MapStatus::Ready => Ok(Prediction::Probabilities(classifier.classify(map)?)),
                }
            }
            Kind::Cfar(counter) => {
                let observation = counter.observe(changed)?;
                Ok(Prediction::Probabilities(COUNT_TO_PROBABILITIES[counter.people(observation)]))
            }
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
    fn losses_by_another_waveform_are_reported_by_quantity() {
        let axes = PhysicalAxes { range_step_m: 0.15, range_bins: 64, velocity_step_m_per_s: 0.098, velocity_bins: 64 };
        let own = waveform(|_| ());
        let lost = |given: Waveform| losses(&axes, &given, &own).join("; ");
        assert_eq!(lost(own.clone()), "");
        // Other receivers, gain and frame rate cause no loss.
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
            let mut model = Model::open(Path::new(name)).expect("a model");
            let mut classifier = model.for_waveform(&of, None).expect("its waveform");
            let mut frame = Frame::zeroed(of.shape());
            assert!(matches!(classifier.classify(&frame).expect("classified"), Prediction::NoSignal), "{name}");
            frame.sequence = 1;
            frame.codes.iter_mut().enumerate().for_each(|(index, code)| *code = 2000 + (index % 97) as u16);
            assert!(matches!(classifier.classify(&frame).expect("classified"), Prediction::Probabilities(_)), "{name}");
            frame.sequence = 2;
            frame.codes[..length].fill(2048);
            assert!(matches!(classifier.classify(&frame).expect("classified"), Prediction::Probabilities(_)), "{name}");
        }
    }

    #[test]
    fn a_fault_names_the_receiver_and_a_remedy() {
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
