mod ablation;
mod candidate;
mod labelled;
mod ladder;
mod thermal;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{bail, ensure};
use radome_driver::recording::{Format, Recording};
use radome_dsp::{Frame, FrameSource, Occupancy};
use radome_models::calibration::ReliabilitySums;
use radome_models::dataset::{self, Dataset, SplitSpec};
use radome_models::evaluate::{Confusion, FalseAlarms, Metrics, RecordingScores, Stretch, add_confusion, evaluate};
use radome_models::{Classifier, ModelCard};
use serde::Serialize;
use serde_json::json;

use self::candidate::{Candidate, Predictions, Refusal, add_reliability};
pub use self::labelled::LabelledRecording;
use self::thermal::ThermalNoise;
use crate::classifier::{CFAR, Model};
use crate::exit::wrong_use;
use crate::{output, source};

/// `radome model evaluate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Model file, or cfar for the classical detector; the first input if this option is absent. With --ladder it may be given
    /// several times
    #[arg(long)]
    model: Vec<PathBuf>,
    /// Dataset folder, or recordings with their labels: RECORDING=empty, RECORDING=one, RECORDING=two (two people or more),
    /// RECORDING=LABELS.txt (an Audacity label track), .label (DEEPCRAFT) or .json, or RECORDING alone if it contains labels. Frames
    /// without a label are left out; those without an answer are counted and not scored. With --ladder: further models
    #[arg(value_name = "DATASET|RECORDING[=LABEL]", value_hint = clap::ValueHint::AnyPath, required_unless_present = "ladder")]
    inputs: Vec<String>,
    /// Evaluate each frame of a recording by itself, as for the maps of a dataset. By default the causal filter over earlier
    /// frames is applied, as in `live`
    #[arg(long)]
    no_smoothing: bool,
    /// Count only people up to this distance from the radar, m, as in `live`. The labels must be of these people
    #[arg(long, value_name = "METRES", value_parser = source::positive)]
    max_range_m: Option<f64>,
    /// End with exit status 0 instead of 1 if the model refuses some recordings. They are listed and left out in either case
    #[arg(long)]
    skip_refused: bool,
    /// Split of a dataset; the test split if absent
    #[arg(long, value_enum)]
    split: Option<Split>,
    /// Also evaluate recordings with thermal noise on the raw samples, at these signal-to-noise ratios, dB. Signal power is the
    /// variance over the whole recording. Samples with noise are rounded and clipped to the ADC's range, as by a board: at the
    /// ends of the range there is less noise than with the `raw_snr_db` of a dataset
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true, value_name = "DB,...", value_parser = thermal::snr_db)]
    thermal_snr_db: Vec<f64>,
    /// Also evaluate with parts of the maps replaced by noise of the same level, and with echoes moved and weakened. This shows
    /// which parts of a map the model relies on
    #[arg(long)]
    ablate: bool,
    /// Folder of rungs, or one rung. A rung is a set of recordings that are simulated and evaluated with all models; it differs
    /// from the training data in one way. Frames in which someone enters or leaves are left out
    #[arg(long, value_name = "DIR|FILE.toml", conflicts_with_all = ["ablate", "thermal_snr_db", "no_smoothing", "skip_refused", "split", "max_range_m"])]
    ladder: Option<PathBuf>,
    /// Folder that stores the recordings of the ladder for later runs. A recording is simulated again if its last frame has changed
    #[arg(long, value_name = "DIR", requires = "ladder")]
    keep: Option<PathBuf>,
    /// Evaluate each rung's rooms without people for this number of hours instead of its recordings, to count false alarms an
    /// hour. These recordings of six minutes have seeds other than the rung's
    #[arg(long, value_name = "HOURS", requires = "ladder")]
    empty_hours: Option<f64>,
    /// Also fit the settings of the causal filter to the answers of all models on the ladder; they go under [smoothing] in a
    /// training's file
    #[arg(long, requires = "ladder", conflicts_with = "empty_hours")]
    fit_smoothing: bool,
    /// Print one JSON object
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

/// Computes metrics of a model on one split of a dataset or on labelled recordings, or of several models on a ladder.
///
/// # Errors
/// A model or an input cannot be read, or the model refuses a recording.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(path) = &arguments.ladder {
        let models: Vec<PathBuf> =
            arguments.model.iter().cloned().chain(arguments.inputs.iter().map(PathBuf::from)).collect();
        let (hours, keep) = (arguments.empty_hours, arguments.keep.as_deref());
        return ladder::run(&models, path, hours, keep, arguments.fit_smoothing, arguments.json);
    }
    let (model_path, inputs) = match (arguments.model.as_slice(), arguments.inputs.split_first()) {
        ([model], _) => (model.clone(), arguments.inputs.as_slice()),
        ([], Some((model, inputs))) => (PathBuf::from(model), inputs),
        ([], None) => wrong_use!("nothing to evaluate"),
        (models, _) => wrong_use!(
            "{} models were given\n\nhint: --ladder compares several; on datasets and recordings evaluate them one by one",
            models.len()
        ),
    };
    ensure!(
        !model_path.is_dir(),
        "{}: a folder is no model\n\nhint: name the model first: radome model evaluate MODEL DATASET",
        model_path.display()
    );
    let model = Model::open(&model_path)?;
    if arguments.ablate && matches!(model, Model::Cfar) {
        wrong_use!("{CFAR} looks at raw frames, and --ablate changes maps\n\nhint: name a model file with --model");
    }
    match inputs {
        [] => wrong_use!(
            "nothing to evaluate {} on\n\nhint: name a dataset folder, RECORDING=LABEL, or a ladder with --ladder",
            model_path.display()
        ),
        [folder] if is_dataset(Path::new(folder)) => {
            let Model::Network(mut classifier) = model else {
                wrong_use!(
                    "{CFAR} looks at raw frames, and a dataset holds maps\n\nhint: name recordings, RECORDING=LABEL"
                );
            };
            if !arguments.thermal_snr_db.is_empty() {
                wrong_use!(
                    "--thermal-snr-db puts noise on raw samples, and a dataset holds maps\n\nhint: name recordings, RECORDING=LABEL, or \
                     build a dataset with raw_snr_db"
                );
            }
            if arguments.no_smoothing || arguments.skip_refused || arguments.max_range_m.is_some() {
                wrong_use!(
                    "--no-smoothing, --skip-refused and --max-range-m are for recordings; each map of a dataset is judged by itself\n\n\
                     hint: leave them out"
                );
            }
            evaluate_dataset(&mut classifier, Path::new(folder), arguments)
        }
        _ if arguments.split.is_some() => {
            wrong_use!("--split names a split of a dataset, and recordings have none\n\nhint: leave it out")
        }
        recordings => {
            evaluate_recordings(Candidate::new(model_path, model, arguments.max_range_m), recordings, arguments)
        }
    }
}

/// Fails if a folder without a recording is no dataset either.
fn check_is_dataset(folder: &Path) -> anyhow::Result<()> {
    ensure!(
        folder.join("dataset.json").exists(),
        "{}: this folder is neither a dataset nor a recording\n\nhint: name each recording in it, RECORDING=LABEL, or build a \
         dataset of them: radome dataset build SPEC.toml -o DIR",
        folder.display()
    );
    Ok(())
}

/// Returns whether a path is a folder that holds no recording, and is therefore taken for a dataset.
fn is_dataset(path: &Path) -> bool {
    path.is_dir() && matches!(Format::of_content(path), Ok(None))
}

/// Predictions for one recording.
#[derive(Serialize)]
struct RecordingResult {
    path: PathBuf,
    /// Its label, or "mixed" where it has several.
    label: &'static str,
    /// Most frequent predicted class of its labelled frames with a prediction, and the share of these frames.
    majority: Occupancy,
    share: f64,
    /// Number of labelled frames with a prediction.
    frames: u64,
    /// Number of labelled frames without one. They do not count in any score.
    unanswered: u64,
    /// Fraction of `frames` that were predicted correctly.
    right: f64,
    by_label: Vec<LabelResult>,
    /// Intervals of one label, each with the time in seconds until its first correct frame.
    stretches: Vec<Stretch>,
    #[serde(skip)]
    is_right: bool,
}

/// Predictions for the frames of one label.
#[derive(Serialize)]
struct LabelResult {
    label: Occupancy,
    frames: u64,
    /// Number of frames that were predicted empty, one and two.
    called: [u64; Occupancy::ALL.len()],
    /// Fraction of the frames that were predicted correctly.
    right: f64,
}

impl RecordingResult {
    fn new(path: &Path, scores: &RecordingScores, unanswered: u64) -> Self {
        let (frames, majority) = (scores.frames(), scores.majority());
        let share = |count: u64, of: u64| count as f64 / of.max(1) as f64;
        let of_label = |label: Occupancy| {
            let called = scores.confusion[label.index()];
            let frames: u64 = called.iter().sum();
            (frames > 0).then(|| LabelResult { label, frames, called, right: share(called[label.index()], frames) })
        };
        RecordingResult {
            path: path.to_owned(),
            label: scores.label().map_or("mixed", Occupancy::name),
            majority,
            share: share(scores.predicted()[majority.index()], frames),
            frames,
            unanswered,
            right: share(scores.right(), frames),
            by_label: Occupancy::ALL.into_iter().filter_map(of_label).collect(),
            stretches: scores.stretches.clone(),
            is_right: scores.is_right(),
        }
    }

    fn print(&self) -> anyhow::Result<()> {
        let mark = if self.is_right { ' ' } else { '!' };
        output::text_line(&format!(
            "{mark} {}: {} frames, {:.0} % {} (is {})",
            self.path.display(),
            self.frames,
            100.0 * self.share,
            self.majority,
            self.label
        ))?;
        if self.unanswered > 0 {
            output::text_line(&format!(
                "    {} of {} labelled frames have no answer and do not count",
                self.unanswered,
                self.frames + self.unanswered
            ))?;
        }
        if self.stretches.len() < 2 {
            return Ok(());
        }
        for stretch in &self.stretches {
            let found = match stretch.found_within_s {
                Some(seconds) => format!("found within {seconds:.1} s"),
                None => "not found".to_owned(),
            };
            output::text_line(&format!(
                "    {} from {:.1} s for {:.1} s: {found}",
                stretch.label, stretch.start_s, stretch.duration_s
            ))?;
        }
        for result in &self.by_label {
            output::text_line(&format!(
                "    {}: {} frames, {:.0} % right",
                result.label,
                result.frames,
                100.0 * result.right
            ))?;
        }
        Ok(())
    }
}

/// Predictions for all recordings, and their totals.
#[derive(Default)]
struct Evaluation<'a> {
    /// Recordings that the model accepted.
    accepted: Vec<&'a LabelledRecording>,
    results: Vec<RecordingResult>,
    scores: Vec<RecordingScores>,
    confusion: Confusion,
    single_frame_confusion: Confusion,
    reliability: ReliabilitySums,
    refused: Vec<Refusal>,
    first_refusal: Option<anyhow::Error>,
}

impl<'a> Evaluation<'a> {
    fn refuse(&mut self, recording: &LabelledRecording, refusal: anyhow::Error) {
        let path = recording.path.display().to_string();
        self.refused.push(Refusal::new(path.clone(), &refusal));
        self.first_refusal.get_or_insert(refusal.context(path));
    }

    fn add(
        &mut self,
        recording: &'a LabelledRecording,
        predictions: &Predictions,
        no_smoothing: bool,
    ) -> anyhow::Result<()> {
        let (filtered, single_frames) = (predictions.filtered_scores(), predictions.single_frame_scores());
        if predictions.single_frames.is_empty() {
            return Err(recording.without_frames());
        }
        ensure!(
            single_frames.frames() > 0 || predictions.unanswered == 0,
            "{}: the model has no answer to any of its {} labelled frames\n\nhint: receivers give no signal in them, or they are fewer \
             than the slow time of the model's maps needs; label other frames",
            recording.path.display(),
            predictions.unanswered
        );
        ensure!(
            single_frames.frames() > 0,
            "{}: no label says of any of its frames that it is empty, one or two\n\nhint: RECORDING=empty, RECORDING=one or \
             RECORDING=two for all of it, RECORDING=LABELS.txt for labels in a file",
            recording.path.display()
        );
        add_confusion(&mut self.single_frame_confusion, &single_frames.confusion);
        let (scores, counted) =
            if no_smoothing { (single_frames, &predictions.single_frames) } else { (filtered, &predictions.filtered) };
        add_confusion(&mut self.confusion, &scores.confusion);
        add_reliability(counted, &mut self.reliability);
        self.results.push(RecordingResult::new(&recording.path, &scores, predictions.unanswered));
        self.scores.push(scores);
        self.accepted.push(recording);
        Ok(())
    }

    /// Prints the scores, and those of modified recordings where requested.
    fn print_report(&self, candidate: &mut Candidate, arguments: &Arguments) -> anyhow::Result<()> {
        let metrics = Metrics::from_confusion(self.confusion);
        let single_frame_accuracy = Metrics::from_confusion(self.single_frame_confusion).balanced_accuracy;
        let false_alarms = FalseAlarms::of(&self.scores);
        let unanswered: u64 = self.results.iter().map(|result| result.unanswered).sum();
        let mut ablated = Vec::new();
        if arguments.ablate {
            ablated = ablation::ablate_recordings(&mut candidate.model, &self.accepted, arguments.max_range_m)?;
        }
        let thermal = evaluate_under_noise(candidate, &self.accepted, arguments)?;
        if arguments.json {
            let mut answer = json!({
                "balanced_accuracy": metrics.balanced_accuracy, "confusion": metrics.confusion, "unanswered": unanswered,
                "balanced_accuracy_by_single_frames": single_frame_accuracy,
                "false_alarms": false_alarms.false_alarms, "empty_s": false_alarms.empty_s,
                "false_alarms_per_hour": false_alarms.false_alarms_per_hour,
                "false_alarm_share": false_alarms.false_alarm_share, "recordings": self.results,
                "refused": self.refused, "reliability": self.reliability.reliability(), "thermal": thermal,
            });
            if arguments.ablate {
                answer["ablation"] = json!(ablated);
            }
            return output::json_line(&answer);
        }
        for scores in &thermal {
            let (snr_db, score) = (scores.snr_db, scores.balanced_accuracy);
            output::text_line(&format!("thermal noise, SNR {snr_db:+} dB: balanced accuracy {score:.4}"))?;
        }
        self.results.iter().try_for_each(RecordingResult::print)?;
        for refusal in &self.refused {
            output::text_line(&format!("- {}: refused: {}", refusal.recording, refusal.reason))?;
        }
        if !arguments.no_smoothing {
            output::text_line(&format!("without the filter: balanced accuracy {single_frame_accuracy:.4}"))?;
        }
        print_metrics(&metrics)?;
        print_errors(&false_alarms, &metrics)?;
        ablation::print(&ablated)
    }
}

fn evaluate_recordings(mut candidate: Candidate, inputs: &[String], arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(folder) = inputs.iter().map(Path::new).find(|input| is_dataset(input)) {
        check_is_dataset(folder)?;
        bail!(
            "{}: a dataset is evaluated by itself, and there are other inputs\n\nhint: evaluate them one after the other",
            folder.display()
        );
    }
    let all = LabelledRecording::parse_all(inputs.iter().cloned())?;
    if let Model::Network(classifier) = &candidate.model {
        warn_of_seen(classifier.card(), &all);
    }
    let mut evaluation = Evaluation::default();
    for recording in &all {
        match classify_recording(&mut candidate, recording, None)? {
            Ok(predictions) => evaluation.add(recording, &predictions, arguments.no_smoothing)?,
            Err(refusal) => evaluation.refuse(recording, refusal),
        }
    }
    let has_results = !evaluation.results.is_empty();
    if has_results {
        evaluation.print_report(&mut candidate, arguments)?;
    }
    match evaluation.first_refusal {
        Some(refusal) if !has_results => Err(refusal),
        Some(refusal) if !arguments.skip_refused => Err(refusal.context(format!(
            "{} of {} recordings were refused\n\nhint: with --skip-refused that is no failure",
            evaluation.refused.len(),
            all.len()
        ))),
        _ => Ok(()),
    }
}

/// Warns of recordings that the model was trained or chosen on or adapted to, by their names. They are evaluated, since the user
/// named them; maps of datasets are left out.
fn warn_of_seen(card: &ModelCard, recordings: &[LabelledRecording]) {
    if card.training.seen_sequences.is_empty() {
        if card.adapted.is_some() {
            message!(
                "warning: the model was adapted to recordings, and its file does not list them: they may be among those evaluated"
            );
        }
        return;
    }
    let is_seen =
        |recording: &&LabelledRecording| recording.possible_sequence_names().iter().any(|name| card.has_seen(name));
    let seen = recordings.iter().filter(is_seen);
    let paths: Vec<String> = seen.map(|recording| recording.path.display().to_string()).collect();
    if !paths.is_empty() {
        message!(
            "warning: the model was trained or chosen on recordings of these names or adapted to them, and its scores on them say \
             little about others: {}",
            paths.join(", ")
        );
    }
}

/// Prints the false alarm rate of empty rooms, and the share of occupied time in which people were missed.
fn print_errors(false_alarms: &FalseAlarms, metrics: &Metrics) -> anyhow::Result<()> {
    if let (Some(per_hour), Some(share)) = (false_alarms.false_alarms_per_hour, false_alarms.false_alarm_share) {
        output::text_line(&format!(
            "empty for {:.2} h: {} false alarms, {per_hour:.1} an hour; people reported for {:.2} % of that time",
            false_alarms.empty_s / 3600.0,
            false_alarms.false_alarms,
            100.0 * share
        ))?;
    }
    if let Some(recall) = metrics.populated_recall {
        output::text_line(&format!(
            "people there: reported as empty for {:.2} % of that time",
            100.0 * (1.0 - recall)
        ))?;
    }
    Ok(())
}

/// Scores with thermal noise on the raw samples.
#[derive(Serialize)]
struct ThermalScores {
    snr_db: f64,
    balanced_accuracy: f64,
    confusion: Confusion,
}

fn evaluate_under_noise(
    candidate: &mut Candidate,
    recordings: &[&LabelledRecording],
    arguments: &Arguments,
) -> anyhow::Result<Vec<ThermalScores>> {
    let mut all = Vec::new();
    for &snr_db in &arguments.thermal_snr_db {
        let mut confusion = Confusion::default();
        for recording in recordings {
            let noise = ThermalNoise::for_recording(&recording.path, snr_db)?;
            let predictions = classify_recording(candidate, recording, Some(&noise))??;
            let scores =
                if arguments.no_smoothing { predictions.single_frame_scores() } else { predictions.filtered_scores() };
            add_confusion(&mut confusion, &scores.confusion);
        }
        let balanced_accuracy = Metrics::from_confusion(confusion).balanced_accuracy;
        all.push(ThermalScores { snr_db, balanced_accuracy, confusion });
    }
    Ok(all)
}

/// Predicts the frames of a recording. The inner error is the model's refusal of its waveform.
fn classify_recording(
    candidate: &mut Candidate,
    recording: &LabelledRecording,
    noise: Option<&ThermalNoise>,
) -> anyhow::Result<anyhow::Result<Predictions>> {
    let mut source = Recording::open(&recording.path)?;
    let mut frame = Frame::zeroed(source.waveform().shape());
    let mut run = match candidate.start_run(source.waveform()) {
        Ok(run) => run,
        Err(refusal) => return Ok(Err(refusal)),
    };
    while source::next_frame_noting_gaps(&mut source, &mut frame, || run.note_gap())? {
        let truth = recording.truth(&frame, source.waveform());
        match noise {
            Some(noise) => run.predict_changed(&frame, &noise.add_to(&frame), truth)?,
            None => run.predict(&frame, truth)?,
        }
    }
    Ok(Ok(run.predictions))
}

fn evaluate_dataset(classifier: &mut Classifier, folder: &Path, arguments: &Arguments) -> anyhow::Result<()> {
    check_is_dataset(folder)?;
    let dataset = Dataset::open(folder)?;
    let wanted = match arguments.split {
        Some(Split::Train) => Some(dataset::Split::Train),
        Some(Split::Validation) => Some(dataset::Split::Validation),
        None | Some(Split::Test) => Some(dataset::Split::Test),
        Some(Split::All) => None,
    };
    let splits = dataset.splits(&split_rule(classifier.card(), &dataset, wanted.is_some()))?;
    let mut indices: Vec<usize> =
        (0..dataset.len()).filter(|i| wanted.is_none_or(|split| splits.get(*i) == Some(&split))).collect();
    if wanted == Some(dataset::Split::Test) {
        add_held_out(classifier.card(), &dataset, &mut indices)?;
        if !indices.is_empty() {
            leave_out_seen(classifier.card(), &dataset, &mut indices)?;
        }
    }
    if indices.is_empty() {
        let split = wanted.map_or_else(|| "dataset".to_owned(), |split| format!("{split} split"));
        let sequences: BTreeSet<&str> = dataset.rows().iter().map(|row| row.sequence.as_str()).collect();
        bail!(
            "{}: the {split} is empty: {} maps in {} sequences\n\nhint: splits are made of whole sequences; --split names another one, \
             --split all takes all maps",
            folder.display(),
            dataset.len(),
            sequences.len()
        );
    }
    let metrics = evaluate(classifier, &dataset, &indices)?;
    let ablated = if arguments.ablate { Some(ablation::ablate_dataset(classifier, &dataset, &indices)?) } else { None };
    if classifier.card().standardisation.needs_labels() {
        message!("the labels of these maps were told to the model: it standardises by scene and class");
    }
    if arguments.json {
        return output::json_line(&DatasetAnswer { metrics: &metrics, ablation: ablated });
    }
    print_metrics(&metrics)?;
    ablation::print(&ablated.unwrap_or_default())
}

/// Returns the rule that divides a dataset for the model. If a split `is_wanted` that depends on the rule, reports a rule that is not
/// known to be that of the model's training on this dataset.
fn split_rule(card: &ModelCard, dataset: &Dataset, is_wanted: bool) -> SplitSpec {
    let is_known = card.split_of(dataset).is_some();
    if !is_known && is_wanted && dataset.rows().iter().any(|row| row.split.is_none()) {
        let why = match card.dataset_hash == dataset.hash() {
            true => "the model's file does not say how its training divided this dataset",
            false => "the model was trained on another dataset",
        };
        let rule = match card.split {
            Some(_) => "by the rule of its training",
            None => "that of the default rule, by sequence with seed 0",
        };
        message!("{why}: the split is {rule}");
    }
    card.split_rule(dataset)
}

/// Adds the maps that the model's training held out to the test split of another dataset, which may have them in another split. In the
/// training's own dataset, they are the test split.
///
/// # Errors
/// The dataset cannot be divided by the rule of the training.
fn add_held_out(card: &ModelCard, dataset: &Dataset, indices: &mut Vec<usize>) -> anyhow::Result<()> {
    let Some(rule) = card.split.as_ref().filter(|_| card.split_of(dataset).is_none()) else { return Ok(()) };
    let Some(held_out) = &rule.held_out else { return Ok(()) };
    if !dataset.rows().iter().any(|row| row.sequence == *held_out) {
        return Ok(());
    }
    let splits = dataset.splits(rule)?;
    let in_test: BTreeSet<usize> = indices.iter().copied().collect();
    let is_added = |index: &usize| splits.get(*index) == Some(&dataset::Split::Test) && !in_test.contains(index);
    let added: Vec<usize> = (0..dataset.len()).filter(is_added).collect();
    if !added.is_empty() {
        message!(
            "{} maps of other splits count as test, too: those that the model's training held out, with sequence '{held_out}'",
            added.len()
        );
    }
    indices.extend(added);
    indices.sort_unstable();
    Ok(())
}

/// Removes maps of sequences that the model was trained or chosen on or adapted to. The test split of its own training has none, unless
/// the model was adapted to them.
///
/// # Errors
/// No map is left.
fn leave_out_seen(card: &ModelCard, dataset: &Dataset, indices: &mut Vec<usize>) -> anyhow::Result<()> {
    let is_own = card.dataset_hash == dataset.hash();
    if is_own && card.adapted.is_none() {
        return Ok(());
    }
    let Some(seen) = card.seen_in(dataset) else {
        let what = if is_own { "adapted to recordings" } else { "trained on another dataset" };
        message!(
            "warning: the model was {what}, and its file does not list the sequences: maps of its training may be among those \
             evaluated"
        );
        return Ok(());
    };
    let count = indices.len();
    indices.retain(|index| dataset.rows().get(*index).is_some_and(|row| !seen.contains(row.sequence.as_str())));
    let left_out = count - indices.len();
    ensure!(
        !indices.is_empty(),
        "all {count} maps of the test split are of sequences that the model was trained or chosen on or adapted to\n\nhint: name a \
         dataset with other sequences; --split all takes all maps"
    );
    if left_out > 0 {
        message!(
            "{left_out} of {count} maps are left out: the model was trained or chosen on their sequences or adapted to them"
        );
    }
    Ok(())
}

/// Scores on the maps of a dataset.
#[derive(Serialize)]
struct DatasetAnswer<'a> {
    #[serde(flatten)]
    metrics: &'a Metrics,
    #[serde(skip_serializing_if = "Option::is_none")]
    ablation: Option<Vec<ablation::Row>>,
}

fn print_metrics(metrics: &Metrics) -> anyhow::Result<()> {
    output::text_line(&format!(
        "{} maps: balanced accuracy {:.4}, macro-F1 {:.4}, accuracy {:.4}, populated recall {}",
        metrics.samples,
        metrics.balanced_accuracy,
        metrics.macro_f1,
        metrics.accuracy,
        output::or_dash(metrics.populated_recall, 4)
    ))?;
    output::text_line(&format!("{:>14} {:>7} {:>7} {:>7}", "truth \\ label", "empty", "one", "two"))?;
    for (class, row) in Occupancy::ALL.iter().zip(&metrics.confusion) {
        output::text_line(&format!("{:>14} {:>7} {:>7} {:>7}", class.name(), row[0], row[1], row[2]))?;
    }
    for class in &metrics.absent {
        message!("no map is labelled {class}: the balanced accuracy is over the other classes");
    }
    Ok(())
}
