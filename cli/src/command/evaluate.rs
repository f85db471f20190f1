mod ablation;
mod thermal;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_dsp::{Frame, FrameSource, Occupancy, SourceEvent};
use radome_models::Classifier;
use radome_models::dataset::{self, Dataset, SplitSpec};
use radome_models::evaluate::{Metrics, evaluate, most_probable};
use radome_models::occupancy_filter::OccupancyFilter;
use serde::Serialize;
use serde_json::json;

use self::thermal::ThermalNoise;
use crate::judge::{CFAR, Model, Verdict};
use crate::output;

/// `radome evaluate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Model file, or cfar for the classical detector; the first of what follows if not given here
    #[arg(long)]
    model: Option<PathBuf>,
    /// A dataset folder, or recordings each with what it shows: RECORDING=empty, RECORDING=one, RECORDING=two
    #[arg(required = true, value_name = "DATASET|RECORDING=LABEL")]
    inputs: Vec<String>,
    /// Each frame of a recording by itself, as a dataset's maps are, rather than as `live` answers: through the causal filter
    /// over the frames before it
    #[arg(long)]
    no_smoothing: bool,
    /// Which split of a dataset
    #[arg(long, value_enum, default_value_t = Split::Test)]
    split: Split,
    /// Of recordings, also with thermal noise on the raw samples at these ratios of the signal's variance to the noise's, dB
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true, value_name = "DB,...")]
    thermal_snr_db: Vec<f64>,
    /// Also with parts of the maps replaced by noise of the same level, and with echoes moved and weakened: shows what the model
    /// goes by
    #[arg(long)]
    ablate: bool,
    /// One object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Split {
    Train,
    Validation,
    Test,
    All,
}

/// Metrics of a model on one split of a dataset, or on recordings of which each shows one thing.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (model, inputs) = match (&arguments.model, arguments.inputs.split_first()) {
        (Some(model), _) => (model.clone(), arguments.inputs.as_slice()),
        (None, Some((model, inputs))) => (PathBuf::from(model), inputs),
        (None, None) => bail!("nothing to evaluate"),
    };
    let judging = Model::open(&model)?;
    if arguments.ablate && matches!(judging, Model::Cfar) {
        bail!("{CFAR} looks at raw frames, and --ablate changes maps\n\nhint: name a model file with --model");
    }
    match inputs {
        [] => bail!("nothing to evaluate {} on\n\nhint: name a dataset folder, or RECORDING=LABEL", model.display()),
        [folder] if labelled(folder).is_err() && Path::new(folder).is_dir() => {
            let Model::Network(mut classifier) = judging else {
                bail!("{CFAR} looks at raw frames, and a dataset holds maps\n\nhint: name recordings, RECORDING=LABEL");
            };
            on_dataset(&mut classifier, Path::new(folder), arguments)
        }
        recordings => on_recordings(judging, recordings, arguments),
    }
}

/// A recording and what it shows.
fn labelled(input: &str) -> anyhow::Result<(&Path, Occupancy)> {
    let (path, label) = input.rsplit_once('=').with_context(|| {
        format!(
            "{input}: no label\n\nhint: RECORDING=empty, RECORDING=one or RECORDING=two, or one dataset folder alone"
        )
    })?;
    let label = Occupancy::from_name(label).with_context(|| format!("{input}: {label} is not empty, one or two"))?;
    Ok((Path::new(path), label))
}

/// How a recording was judged.
#[derive(Serialize)]
struct Judged {
    path: PathBuf,
    label: Occupancy,
    /// What most of its frames were called, and the share of them.
    majority: Occupancy,
    share: f64,
    frames: u64,
    /// Share of its frames that were called what the label says.
    right: f64,
}

/// How often each class was what frames were called.
type Counts = [u64; Occupancy::ALL.len()];

fn on_recordings(mut model: Model, inputs: &[String], arguments: &Arguments) -> anyhow::Result<()> {
    let all = inputs.iter().map(|input| labelled(input)).collect::<anyhow::Result<Vec<_>>>()?;
    let (mut confusion, mut confusion_alone) = ([Counts::default(); 3], [Counts::default(); 3]);
    let mut recordings = Vec::new();
    for &(path, label) in &all {
        let (back, [filtered, alone]) = judge(model, path, None)?;
        model = back;
        let counts = if arguments.no_smoothing { alone } else { filtered };
        for (sum, count) in confusion_alone[label.index()].iter_mut().zip(alone) {
            *sum += count;
        }
        let frames: u64 = counts.iter().sum();
        if frames == 0 {
            bail!(
                "{}: no frame of it makes a map\n\nhint: it is shorter than the slow time of the model's maps",
                path.display()
            );
        }
        for (sum, count) in confusion[label.index()].iter_mut().zip(counts) {
            *sum += count;
        }
        // The first of equals, as for a map.
        let most = counts.iter().copied().max().unwrap_or_default();
        let majority = Occupancy::ALL.into_iter().find(|o| counts[o.index()] == most).unwrap_or(Occupancy::Empty);
        let share = |count: u64| count as f64 / frames as f64;
        let (share, right) = (share(most), share(counts[label.index()]));
        recordings.push(Judged { path: path.to_owned(), label, majority, share, frames, right });
    }
    let (metrics, alone) = (Metrics::from_confusion(confusion), Metrics::from_confusion(confusion_alone));
    let mut ablated = Vec::new();
    if arguments.ablate {
        (model, ablated) = ablation::on_recordings(model, &all)?;
    }
    let thermal = under_thermal_noise(model, inputs, arguments)?;
    if arguments.json {
        let mut answer = json!({
            "balanced_accuracy": metrics.balanced_accuracy, "confusion": metrics.confusion,
            "balanced_accuracy_by_single_frames": alone.balanced_accuracy, "recordings": recordings,
            "thermal": thermal,
        });
        if arguments.ablate {
            answer["ablation"] = json!(ablated);
        }
        return output::json_line(&answer);
    }
    for of in &thermal {
        eprintln!("thermal noise, SNR {:+} dB: balanced accuracy {:.4}", of.snr_db, of.balanced_accuracy);
    }
    for of in &recordings {
        let mark = if of.majority == of.label { ' ' } else { '!' };
        output::text_line(&format!(
            "{mark} {}: {} frames, {:.0} % {} (is {})",
            of.path.display(),
            of.frames,
            100.0 * of.share,
            of.majority,
            of.label
        ))?;
    }
    if !arguments.no_smoothing {
        eprintln!("by single frames: balanced accuracy {:.4}", alone.balanced_accuracy);
    }
    print(&metrics)?;
    ablation::print(&ablated)
}

/// Scores with thermal noise on the raw samples.
#[derive(Serialize)]
struct Thermal {
    snr_db: f64,
    balanced_accuracy: f64,
    confusion: [Counts; Occupancy::ALL.len()],
}

fn under_thermal_noise(mut model: Model, inputs: &[String], arguments: &Arguments) -> anyhow::Result<Vec<Thermal>> {
    let mut all = Vec::new();
    for &snr_db in &arguments.thermal_snr_db {
        if !snr_db.is_finite() {
            bail!("--thermal-snr-db is {snr_db}, expected a finite number");
        }
        let mut confusion = [Counts::default(); Occupancy::ALL.len()];
        for input in inputs {
            let (path, label) = labelled(input)?;
            let noise = ThermalNoise::of(path, snr_db)?;
            let (back, [filtered, alone]) = judge(model, path, Some(&noise))?;
            model = back;
            let counts = if arguments.no_smoothing { alone } else { filtered };
            confusion[label.index()].iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
        }
        let balanced_accuracy = Metrics::from_confusion(confusion).balanced_accuracy;
        all.push(Thermal { snr_db, balanced_accuracy, confusion });
    }
    Ok(all)
}

/// How often frames of a recording were called each class, through the filter and by themselves; and the model again.
fn judge(model: Model, path: &Path, noise: Option<&ThermalNoise>) -> anyhow::Result<(Model, [Counts; 2])> {
    let mut source = radome_driver::recording::open(path)?;
    let mut frame = Frame::zeroed(source.waveform().shape());
    let mut filter = OccupancyFilter::new(model.smoothing(), source.waveform().frame_interval_s());
    let mut counts = [Counts::default(); 2];
    let mut judge = model.judge(source.waveform()).with_context(|| path.display().to_string())?;
    loop {
        match source.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::End => return Ok((judge.into_model(), counts)),
            SourceEvent::Gap(_) => judge.reset(),
            SourceEvent::Frame => {
                if let Some(noise) = noise {
                    noise.add(&mut frame);
                }
                if let Verdict::Probabilities(alone) = judge.frame(&frame)? {
                    let filtered = filter.update(frame.time_s(), alone);
                    for (counts, probabilities) in counts.iter_mut().zip([filtered, alone]) {
                        counts[most_probable(&probabilities).index()] += 1;
                    }
                }
            }
        }
    }
}

fn on_dataset(classifier: &mut Classifier, folder: &Path, arguments: &Arguments) -> anyhow::Result<()> {
    let dataset = Dataset::open(folder)?;
    let wanted = match arguments.split {
        Split::Train => Some(dataset::Split::Train),
        Split::Validation => Some(dataset::Split::Validation),
        Split::Test => Some(dataset::Split::Test),
        Split::All => None,
    };
    let splits = dataset.splits(&SplitSpec::default())?;
    let indices: Vec<usize> =
        (0..dataset.len()).filter(|i| wanted.is_none_or(|w| splits.get(*i) == Some(&w))).collect();
    let metrics = evaluate(classifier, &dataset, &indices)?;
    let ablated = if arguments.ablate { Some(ablation::on_dataset(classifier, &dataset, &indices)?) } else { None };
    if classifier.card().standardisation.needs_labels() {
        eprintln!("the labels of these maps were told to the model: it standardises by scene and class");
    }
    if arguments.json {
        return output::json_line(&OfDataset { metrics: &metrics, ablation: ablated });
    }
    print(&metrics)?;
    ablation::print(&ablated.unwrap_or_default())
}

/// Scores on a dataset's maps.
#[derive(Serialize)]
struct OfDataset<'a> {
    #[serde(flatten)]
    metrics: &'a Metrics,
    #[serde(skip_serializing_if = "Option::is_none")]
    ablation: Option<Vec<ablation::Row>>,
}

fn print(metrics: &Metrics) -> anyhow::Result<()> {
    output::text_line(&format!(
        "{} maps: balanced accuracy {:.4}, macro-F1 {:.4}, accuracy {:.4}, populated recall {}",
        metrics.samples,
        metrics.balanced_accuracy,
        metrics.macro_f1,
        metrics.accuracy,
        metrics.populated_recall.map_or("-".to_owned(), |r| format!("{r:.4}"))
    ))?;
    output::text_line(&format!("{:>14} {:>7} {:>7} {:>7}", "truth \\ label", "empty", "one", "two"))?;
    for (class, row) in Occupancy::ALL.iter().zip(&metrics.confusion) {
        output::text_line(&format!("{:>14} {:>7} {:>7} {:>7}", class.name(), row[0], row[1], row[2]))?;
    }
    for class in &metrics.absent {
        eprintln!("no map is labelled {class}: the balanced accuracy is over the other classes");
    }
    Ok(())
}
