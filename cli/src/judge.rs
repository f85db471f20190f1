//! What judges frames wherever a model is taken: a trained network, or the classical detector as `--model cfar`.

use std::path::Path;

use anyhow::Context;
use radome_driver::Judge as NamedJudge;
use radome_driver::recording::mcap::RESULTS_VERSION;
use radome_dsp::people::PeopleCounter;
use radome_dsp::rdm::SlowTime;
use radome_dsp::{Frame, MapStatus, Rdm, RdmProcessor, Waveform};
use radome_models::bounded_file::read;
use radome_models::occupancy_filter::Smoothing;
use radome_models::{Classifier, MODEL_LIMIT_BYTES};
use sha2::{Digest, Sha256};

use crate::live::classify::Delays;

/// The name that takes the place of a model file.
pub const CFAR: &str = "cfar";

/// What a detector's count says of how many people are seen, `[counted][seen]`: who is hidden or turned away is missed more often
/// than somebody is made of noise. This and the filter's settings were chosen on simulated corridors (seeds 90001 to 90006) and halls
/// (200001 to 200006).
const COUNTED_TO_SEEN: [[f32; 3]; 3] = [[0.70, 0.20, 0.10], [0.05, 0.60, 0.35], [0.01, 0.10, 0.89]];

const CFAR_SMOOTHING: Smoothing =
    Smoothing { dwell_s: 8.0, unseen_share: 0.15, unseen_s: 3.0, weight: Some(1.0), independent_s: None };

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
    Cfar(Box<PeopleCounter>),
}

/// What a judge says of a frame.
pub enum Verdict {
    /// Its window over frames is not full yet: so many of so many.
    WarmingUp { have: usize, need: usize },
    /// Probabilities of empty, one and two by this frame.
    Probabilities([f32; 3]),
}

impl Model {
    /// `cfar`, or a model file.
    pub fn open(name: &Path) -> anyhow::Result<Self> {
        if name == Path::new(CFAR) && !name.exists() {
            return Ok(Model::Cfar);
        }
        Ok(Model::Network(Box::new(Classifier::load(name)?)))
    }

    /// The waveform that a board has to be programmed with; the detector takes any.
    pub fn waveform(&self) -> Option<&Waveform> {
        match self {
            Model::Network(classifier) => Some(classifier.waveform()),
            Model::Cfar => None,
        }
    }

    /// Who judges, as recordings name it.
    pub fn named(&self, path: &Path, delays: Delays) -> anyhow::Result<NamedJudge> {
        let model = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let model_hash = match self {
            // It is this program's own.
            Model::Cfar => format!("radome {}", env!("CARGO_PKG_VERSION")),
            Model::Network(_) => {
                let bytes = read(path, MODEL_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
                Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect()
            }
        };
        let Delays { on_s: on_delay_s, off_s: off_delay_s } = delays;
        Ok(NamedJudge { version: RESULTS_VERSION, model, model_hash, on_delay_s, off_delay_s })
    }

    /// How answers to frames are put together.
    pub fn smoothing(&self) -> Smoothing {
        match self {
            Model::Network(classifier) => classifier.card().smoothing,
            Model::Cfar => CFAR_SMOOTHING,
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

    /// Puts it to work on frames of a waveform; refuses those that the model was not made for.
    pub fn judge(self, waveform: &Waveform) -> anyhow::Result<Judge> {
        Ok(Judge(match self {
            Model::Network(classifier) => {
                waveform.check_compatible(classifier.waveform())?;
                let processor = RdmProcessor::new(classifier.rdm_spec(), waveform)?;
                let map = processor.empty_map();
                Kind::Network { classifier, processor, map }
            }
            Model::Cfar => {
                Kind::Cfar(Box::new(PeopleCounter::new(waveform).context("the detector cannot look at these frames")?))
            }
        }))
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

    /// Judges the next frame.
    pub fn frame(&mut self, frame: &Frame) -> anyhow::Result<Verdict> {
        match &mut self.0 {
            Kind::Network { classifier, processor, map } => match processor.process(frame, map)? {
                MapStatus::WarmingUp { have, need } => Ok(Verdict::WarmingUp { have, need }),
                MapStatus::Ready => Ok(Verdict::Probabilities(classifier.classify(map)?)),
            },
            Kind::Cfar(counter) => {
                let seen = counter.look(frame)?;
                Ok(Verdict::Probabilities(COUNTED_TO_SEEN[counter.people(seen)]))
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
