//! Tests of studies on made-up maps: shards, interruptions and failures.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::SystemTime;

use radome_dsp::Occupancy;
use radome_models::dataset::{DatasetError, SplitBy, SplitSpec, lock_folder};
use radome_models::study::{
    Condition, Job, Outcome, Progress, Report, Study, StudyError, StudySpec, Variant, paired_difference,
};
use radome_models::{Dataset, Metrics, TrainSpec};

use crate::support::{Maps, dataset};

/// Settings of few small maps with strong targets.
const FEW: Maps = Maps { seed: 1, size: 32, sequences: [6, 2, 2], length: 3, snr_db: (20.0, 30.0) };

fn maps() -> Dataset {
    dataset(FEW)
}

fn condition(name: &str, dataset: Dataset) -> Condition {
    Condition::new(name, Some("Group"), dataset).expect("a condition")
}

/// Condition with the same sequences, frames and labels, and targets of another strength.
fn at_other_snr(snr_db: f64) -> Condition {
    condition("weaker", dataset(Maps { snr_db: (snr_db, snr_db + 10.0), ..FEW }))
}

/// Condition with maps of sequences that are in no training.
fn unseen_sequences() -> Condition {
    let maps = dataset(Maps { seed: 2, ..FEW });
    let header = maps.header().clone();
    let renamed = |index: usize| {
        let mut row = maps.rows()[index].clone();
        row.sequence = format!("stranger {}", row.sequence);
        (header.rdm(maps.map(index).expect("a map"), row.frame), row)
    };
    let all = (0..maps.len()).map(renamed).collect();
    condition("strangers", Dataset::from_maps(header.clone(), all).expect("dataset"))
}

fn variant(name: &str) -> Variant {
    Variant { name: name.to_owned(), network: None, head: None, transposed: None }
}

/// Spec of two heads, two learning rates, two seeds and two shares of the maps: 8 trainings to compare and 2 that only
/// select the rate.
fn spec() -> StudySpec {
    StudySpec {
        title: "Small".to_owned(),
        remarks: Vec::new(),
        variants: vec![variant("hqnn"), variant("estimator_matched")],
        seeds: vec![1, 2],
        label_fractions: vec![1.0, 0.5],
        learning_rates: vec![1e-3, 5e-3],
        snr_db: vec![20.0],
        target: 0.5,
        leave_one_recording_out: false,
        train: TrainSpec {
            epochs: 2,
            linear_epochs: Some(1),
            starts: 1,
            batch_size: 16,
            pooled: [4, 4],
            ..TrainSpec::default()
        },
    }
}

/// Runs a shard; returns the names of the networks that it trained.
fn run(spec: &StudySpec, maps: &Dataset, folder: &Path, shard: (usize, usize)) -> Vec<String> {
    let mut trained = Vec::new();
    let study = Study::open(spec, maps, folder, shard).expect("opens");
    let ran = study.run(&|| true, &mut |progress| {
        if let Progress::Done(outcome) = progress {
            trained.push(outcome.job.variant.clone());
        }
    });
    ran.expect("runs");
    trained
}

/// Runs a shard with conditions; returns the numbers of trainings and of evaluated models, and the report.
fn run_with_conditions(
    spec: &StudySpec,
    maps: &Dataset,
    folder: &Path,
    shard: (usize, usize),
    conditions: &[Condition],
) -> ([usize; 2], Report) {
    let mut counts = [0, 0];
    let study = Study::open(spec, maps, folder, shard).expect("opens").with_conditions(conditions).expect("like maps");
    let ran = study.run(&|| true, &mut |progress| match progress {
        Progress::Done(_) => counts[0] += 1,
        Progress::Evaluated(_) => counts[1] += 1,
        _ => {}
    });
    ran.expect("runs");
    (counts, study.report().expect("a report"))
}

/// Bytes and times of the files in a folder, by name.
fn files(folder: &Path) -> BTreeMap<String, (Vec<u8>, SystemTime)> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry"));
    let content = |entry: std::fs::DirEntry| {
        let changed = entry.metadata().and_then(|metadata| metadata.modified()).expect("a time");
        let bytes = std::fs::read(entry.path()).expect("a file");
        (entry.file_name().to_string_lossy().into_owned(), (bytes, changed))
    };
    entries.map(content).collect()
}

fn report(spec: &StudySpec, maps: &Dataset, folder: &Path) -> Report {
    Study::open(spec, maps, folder, (0, 1)).expect("opens").report().expect("a report")
}

/// Report as Markdown and as JSON.
fn bytes(report: &Report) -> (String, String) {
    (report.markdown(), serde_json::to_string_pretty(report).expect("JSON"))
}

#[test]
fn shards_in_any_order_make_the_report_of_one_run() {
    let (maps, spec) = (maps(), spec());
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    assert_eq!(run(&spec, &maps, &at("whole"), (0, 1)).len(), 10);
    let whole = report(&spec, &maps, &at("whole"));
    assert_eq!((whole.done, whole.planned), (8, 8));

    // The last shard runs first and trains at the rates that it needs from the others.
    let counts = [2, 0, 1].map(|index| run(&spec, &maps, &at("apart"), (index, 3)).len());
    assert_eq!(counts.iter().sum::<usize>(), 10, "{counts:?}");
    assert_eq!(bytes(&report(&spec, &maps, &at("apart"))), bytes(&whole));

    // All shards run in parallel.
    let together = at("together");
    let (maps, spec, together) = (&maps, &spec, together.as_path());
    let counts: Vec<usize> = std::thread::scope(|scope| {
        let start = |index| scope.spawn(move || run(spec, maps, together, (index, 3)).len());
        let threads: Vec<_> = (0..3).map(start).collect();
        threads.into_iter().map(|thread| thread.join().expect("ends")).collect()
    });
    assert_eq!(counts.iter().sum::<usize>(), 10, "{counts:?}");
    assert_eq!(bytes(&report(spec, maps, together)), bytes(&whole));
}

#[test]
fn models_of_all_labels_and_curves_of_all_epochs_are_kept() {
    let (maps, spec) = (maps(), spec());
    let folder = tempfile::tempdir().expect("a folder");
    run(&spec, &maps, folder.path(), (0, 1));
    let [results, models] = ["results", "models"].map(|part| files(&folder.path().join(part)));
    assert_eq!((results.len(), models.len()), (10, 6));
    for (name, (text, _)) in results {
        let outcome: Outcome = serde_json::from_slice(&text).expect("an outcome");
        let model = name.replace(".json", ".safetensors");
        assert_eq!(models.contains_key(&model), outcome.job.label_fraction == 1.0, "{name}");
        assert_eq!(outcome.curve.len(), spec.train.epochs, "{name}");
    }
    for cell in report(&spec, &maps, folder.path()).cells {
        let epochs: Vec<usize> = cell.curve.iter().map(|point| point.epoch).collect();
        assert_eq!(epochs, [1, 2], "{}", cell.variant);
        assert!(cell.curve.iter().all(|point| point.validation.is_some_and(|of| of.count == 2)), "{cell:?}");
    }
}

/// Asserts that an interrupted study has the scores of each finished training under every condition.
#[test]
fn conditions_are_evaluated_as_soon_as_a_training_is_done() {
    let (maps, spec) = (maps(), spec());
    let folder = tempfile::tempdir().expect("a folder");
    let conditions = [condition("same", dataset(FEW)), unseen_sequences()];
    let study = Study::open(&spec, &maps, folder.path(), (0, 1)).expect("opens").with_conditions(&conditions);
    let study = study.expect("like maps");
    let [compared, evaluated] = [const { Cell::new(0) }; 2];
    let ran = study.run(&|| compared.get() < 1, &mut |progress| match progress {
        Progress::Done(outcome) => {
            let rates = study.chosen_rates().expect("rates");
            let is_compared = rates.get(&outcome.job.variant) == Some(&outcome.job.learning_rate);
            compared.set(compared.get() + usize::from(is_compared && outcome.job.label_fraction == 1.0));
        }
        Progress::Evaluated(_) => evaluated.set(evaluated.get() + 1),
        _ => {}
    });
    ran.expect("runs");
    let report = study.report().expect("a report");
    assert!(report.done < report.planned, "it was not stopped");
    let with_models: usize =
        report.cells.iter().filter(|cell| cell.label_fraction == 1.0).map(|cell| cell.scores.len()).sum();
    assert!(with_models > 0);
    for condition in &report.conditions {
        assert_eq!(condition.done, with_models, "{}", condition.name);
    }
    assert_eq!(evaluated.get(), with_models * conditions.len());
}

/// Asserts that conditions of a complete study change no file of a training, and that only changed datasets are
/// evaluated again.
#[test]
fn conditions_are_evaluated_without_training_again() {
    let (maps, spec) = (maps(), spec());
    let folder = tempfile::tempdir().expect("a folder");
    run(&spec, &maps, folder.path(), (0, 1));
    let training_files = || ["results", "models"].map(|part| files(&folder.path().join(part)));
    let before = training_files();
    let mut conditions = vec![condition("same", dataset(FEW)), at_other_snr(0.0), unseen_sequences()];
    let (counts, report) = run_with_conditions(&spec, &maps, folder.path(), (0, 1), &conditions);
    // Two networks, two seeds, three conditions.
    assert_eq!(counts, [0, 12]);
    assert!(training_files() == before, "files of trainings were written again");
    // Numbers of maps: the test splits of the same sequences, and all maps of unseen sequences.
    let map_counts: Vec<usize> = report.conditions.iter().map(|condition| condition.maps).collect();
    assert_eq!(map_counts, [18, 18, 90]);
    assert!(report.conditions.iter().all(|condition| (condition.done, condition.planned) == (4, 4)), "{report:?}");
    for cell in report.cells.iter().filter(|cell| cell.label_fraction == 1.0) {
        let same = report.conditions[0].cells.iter().find(|other| other.variant == cell.variant).expect("a cell");
        assert_eq!((same.balanced_accuracy, same.confusion), (cell.test, cell.confusion));
        // The same models on the same maps have no difference, for each seed.
        assert_eq!(same.scores.iter().map(|score| score.seed).collect::<Vec<_>>(), [1, 2]);
        let difference = paired_difference(&same.scores, &cell.scores).expect("pairs");
        assert_eq!((difference.count, difference.least, difference.most), (2, 0.0, 0.0));
    }
    assert!(report.markdown().contains("## Group\n") && report.markdown().contains("| same | weaker | strangers |"));

    conditions[1] = at_other_snr(-10.0);
    let (counts, again) = run_with_conditions(&spec, &maps, folder.path(), (0, 1), &conditions);
    assert_eq!(counts, [0, 4]);
    assert_ne!(again.conditions[1].dataset_hash, report.conditions[1].dataset_hash);
    assert_eq!([&again.conditions[0], &again.conditions[2]], [&report.conditions[0], &report.conditions[2]]);
    assert_eq!(run_with_conditions(&spec, &maps, folder.path(), (0, 1), &conditions), ([0, 0], again));
}

#[test]
fn shards_with_conditions_make_the_report_of_one_run() {
    let (maps, spec, conditions) = (maps(), spec(), [at_other_snr(0.0), unseen_sequences()]);
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let (counts, whole) = run_with_conditions(&spec, &maps, &at("whole"), (0, 1), &conditions);
    assert_eq!(counts, [10, 8]);
    let apart = [2, 0, 1].map(|index| run_with_conditions(&spec, &maps, &at("apart"), (index, 3), &conditions));
    let sum = |kind: usize| apart.iter().map(|(counts, _)| counts[kind]).sum::<usize>();
    assert_eq!([sum(0), sum(1)], [10, 8]);
    assert_eq!(bytes(&apart[2].1), bytes(&whole));
    // Conditions are added afterwards, by shards.
    run(&spec, &maps, &at("after"), (0, 1));
    let after = [1, 0].map(|index| run_with_conditions(&spec, &maps, &at("after"), (index, 2), &conditions));
    assert_eq!(after.iter().map(|(counts, _)| counts[1]).sum::<usize>(), 8);
    assert_eq!(bytes(&after[1].1), bytes(&whole));
}

#[test]
fn a_plan_counts_done_trainings_and_times_the_others() {
    let (maps, spec) = (maps(), spec());
    let folder = tempfile::tempdir().expect("a folder");
    let plan = || {
        let study = Study::open(&spec, &maps, folder.path(), (0, 1)).expect("opens");
        let mut timed = Vec::new();
        let plan = study.plan(3, &mut |variant: &str| timed.push(variant.to_owned())).expect("a plan");
        (plan, timed)
    };
    let (before, timed) = plan();
    assert_eq!((before.trainings, before.done, timed.len()), (10, 0, 2));
    // 54 maps in batches of 16 give 4 steps an epoch, 2 for half of them. There are two epochs; two trainings of each
    // network use half of the maps.
    let steps: Vec<usize> = before.networks.iter().map(|network| network.steps).collect();
    assert_eq!(steps, [3 * 2 * 4 + 2 * 2 * 2; 2]);
    assert!(before.networks.iter().all(|network| network.step_seconds.is_some_and(|seconds| seconds > 0.0)));
    assert!(before.hours > 0.0 && before.cpu_hours >= before.hours, "{before:?}");
    // Four models of all labels under each of three conditions, none of which has a dataset yet.
    assert_eq!(before.judgings_left, 4 * 3);

    run(&spec, &maps, folder.path(), (0, 1));
    let (after, timed) = plan();
    assert_eq!((after.trainings, after.done, timed.len()), (10, 10, 0));
    assert!(after.hours == 0.0 && after.networks.iter().all(|network| network.step_seconds.is_none()), "{after:?}");
}

/// Regression test: the recall of a recording with one class was called its balanced accuracy, and each recording counted as a seed.
#[test]
fn recordings_that_are_held_out_in_turn_are_scored_together() {
    use Occupancy::{Empty, One, Two};
    let maps = dataset(Maps { sequences: [1, 0, 0], ..FEW });
    let spec = StudySpec {
        variants: vec![variant("hqnn")],
        seeds: vec![1, 2, 3, 4],
        label_fractions: vec![1.0],
        leave_one_recording_out: true,
        ..spec()
    };
    let outcome = |seed: u64, recording: usize, predictions: [(Occupancy, Occupancy); 2]| {
        let job = Job {
            variant: "hqnn".to_owned(),
            label_fraction: 1.0,
            learning_rate: 1e-3,
            seed,
            held_out: Some(format!("s{recording}")),
        };
        Outcome { job, training: 0.9, test: Some(Metrics::from_predictions(predictions)), ..Outcome::default() }
    };
    let broken = Outcome { test: None, error: Some("not finite".to_owned()), ..outcome(4, 1, [(Empty, Empty); 2]) };
    let outcomes = [
        outcome(1, 1, [(Empty, Empty); 2]),
        outcome(1, 2, [(One, One); 2]),
        outcome(1, 3, [(Two, Two); 2]),
        outcome(2, 1, [(Empty, Empty); 2]),
        outcome(2, 2, [(One, One), (One, Two)]),
        outcome(2, 3, [(Two, One); 2]),
        // Two recordings of this seed are left.
        outcome(3, 1, [(Empty, Empty); 2]),
        broken,
        outcome(4, 2, [(One, One); 2]),
        outcome(4, 3, [(Two, Two); 2]),
    ];
    let rates = BTreeMap::from([("hqnn".to_owned(), 1e-3)]);
    let report = radome_models::study::report(&spec, &maps, &rates, &outcomes);
    let cell = &report.cells[0];
    let scores: Vec<(u64, f64)> = cell.scores.iter().map(|score| (score.seed, score.balanced_accuracy)).collect();
    assert_eq!(scores, [(1, 1.0), (2, 0.5), (4, 1.0 / 3.0)]);
    let [test, training] = [cell.test, cell.training].map(|interval| interval.expect("scores"));
    assert_eq!((test.count, test.most, training.count), (3, 1.0, 4));
    assert_eq!((report.done, report.planned), (10, 12));
    let text = report.markdown();
    assert!(
        text.contains("Each recording in turn is the test split") && text.contains("| hqnn | 0.001 | 3 |"),
        "{text}"
    );
}

/// Regression test: each sequence was held out with its whole group, so every map counted as often as its group has sequences.
#[test]
fn groups_that_are_held_out_in_turn_count_each_map_once() {
    let ungrouped = dataset(Maps { sequences: [6, 0, 0], ..FEW });
    let header = ungrouped.header().clone();
    // Six subjects, each with a sequence of each class.
    let with_subject = |index: usize| {
        let mut row = ungrouped.rows()[index].clone();
        row.subject = Some(format!("subject {}", index / FEW.length % 6));
        (header.rdm(ungrouped.map(index).expect("a map"), row.frame), row)
    };
    let all = (0..ungrouped.len()).map(with_subject).collect();
    let maps = Dataset::from_maps(header.clone(), all).expect("dataset");
    let by = |by: SplitBy| StudySpec {
        variants: vec![variant("hqnn")],
        seeds: vec![1],
        label_fractions: vec![1.0],
        learning_rates: Vec::new(),
        snr_db: Vec::new(),
        leave_one_recording_out: true,
        train: TrainSpec { split: SplitSpec { by, ..SplitSpec::default() }, ..spec().train },
        ..spec()
    };
    let spec = by(SplitBy::Subject);
    let folder = tempfile::tempdir().expect("a folder");
    assert_eq!(run(&spec, &maps, &folder.path().join("subjects"), (0, 1)).len(), 6);
    let by_subject = report(&spec, &maps, &folder.path().join("subjects"));
    assert_eq!((by_subject.done, by_subject.planned, by_subject.cells[0].scores.len()), (6, 6, 1));
    assert_eq!(by_subject.cells[0].confusion.iter().flatten().sum::<u64>(), maps.len() as u64);
    let text = by_subject.markdown();
    assert!(text.contains("Each group of recordings of one subject in turn"), "{text}");

    // A folder of an earlier version has results of all sequences.
    let earlier = folder.path().join("earlier");
    assert_eq!(run(&by(SplitBy::Sequence), &maps, &earlier, (0, 1)).len(), 18);
    std::fs::remove_file(earlier.join("study.json")).expect("removed");
    let found = report(&spec, &maps, &earlier);
    assert_eq!((found.done, found.planned, found.cells[0].scores.len()), (6, 6, 1));
}

/// Asserts that shares of the maps and noise levels repeat no training: each has one file.
#[test]
fn noise_levels_are_evaluated_on_the_same_trainings() {
    let (maps, few) = (maps(), spec());
    let many = StudySpec { snr_db: vec![-20.0, -10.0, 0.0, 10.0, 20.0], ..few.clone() };
    let folder = tempfile::tempdir().expect("a folder");
    let trained =
        [&few, &many].map(|spec| run(spec, &maps, &folder.path().join(spec.snr_db.len().to_string()), (0, 1)));
    assert_eq!(trained[0], trained[1]);
    let report = report(&many, &maps, &folder.path().join("5"));
    let cells: Vec<usize> = report.cells.iter().map(|cell| cell.noisy.len()).collect();
    assert_eq!(cells, [5, 0, 5, 0]);
}

mod hard_cases {
    use super::*;

    fn outcomes(spec: &StudySpec, maps: &Dataset, folder: &Path) -> Vec<Outcome> {
        Study::open(spec, maps, folder, (0, 1)).expect("opens").run(&|| true, &mut |_| {}).expect("runs")
    }

    /// Asserts that a network with batch normalisation can be trained on three maps, which are less than a batch.
    #[test]
    fn a_share_of_one_map_a_class_is_trained_on() {
        let maps = maps();
        let spec = StudySpec {
            variants: vec![variant("hqnn"), variant("estimator_matched"), variant("doppler_net")],
            seeds: vec![1],
            label_fractions: vec![1e-6],
            learning_rates: Vec::new(),
            ..spec()
        };
        let folder = tempfile::tempdir().expect("a folder");
        let outcomes = outcomes(&spec, &maps, folder.path());
        assert_eq!(outcomes.len(), 3);
        for outcome in outcomes {
            assert!(outcome.error.is_none(), "{outcome:?}");
            let test = outcome.test.expect("a test split");
            assert!((0.0..=1.0).contains(&test.balanced_accuracy) && test.samples == 18, "{test:?}");
        }
    }

    /// Asserts that a training that diverged, and therefore has no model, counts as chance, under every condition too.
    #[test]
    fn a_seed_that_diverges_is_counted_with_its_reason() {
        let maps = maps();
        let mut spec = StudySpec { learning_rates: vec![1e30], label_fractions: vec![1.0], ..spec() };
        spec.train.warm_up_steps = 1;
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        // Regression test: a plan timed steps at the study's learning rate, and failed if that diverges.
        let study = Study::open(&spec, &maps, &at("one"), (0, 1)).expect("opens");
        let plan = study.plan(0, &mut |_| {}).expect("a plan");
        assert_eq!((plan.trainings, plan.done), (4, 0));
        let mut steps = plan.networks.iter().map(|network| network.step_seconds);
        assert!(steps.all(|step| step.is_some_and(|seconds| seconds > 0.0)), "{plan:?}");

        let (counts, all) = run_with_conditions(&spec, &maps, &at("one"), (0, 1), &[unseen_sequences()]);
        assert_eq!(counts, [4, 4]);
        assert_eq!((all.done, all.planned, all.failures.len()), (4, 4, 4));
        for cell in &all.cells {
            let test = cell.test.expect("chance");
            assert_eq!((cell.failed, test.count), (2, 2));
            assert!((test.mean - 1.0 / 3.0).abs() < 1e-12, "{test:?}");
        }
        for cell in &all.conditions[0].cells {
            let accuracy = cell.balanced_accuracy.expect("chance");
            assert!(cell.done == 2 && (accuracy.mean - 1.0 / 3.0).abs() < 1e-12, "{cell:?}");
            assert_eq!(cell.confusion.iter().flatten().sum::<u64>(), 0);
            assert!(cell.scores.len() == 2 && cell.scores.iter().all(|score| score.balanced_accuracy == accuracy.mean));
        }
        for failure in &all.failures {
            assert!(failure.reason.contains("not finite at start"), "{failure:?}");
            assert!(all.markdown().contains(&failure.reason), "{}", all.markdown());
        }
        // The rate that diverges is not selected, but its result is kept.
        spec.learning_rates = vec![1e30, 1e-3];
        outcomes(&spec, &maps, &at("two"));
        let all = report(&spec, &maps, &at("two"));
        assert!(all.cells.iter().all(|cell| cell.learning_rate == 1e-3 && cell.done == 2), "{all:?}");
        let lost = all.failures.iter().filter(|failure| failure.job.learning_rate == 1e30);
        assert_eq!(lost.filter(|failure| failure.reason.contains("not finite")).count(), 2, "{all:?}");
    }

    fn open<'a>(
        spec: &'a StudySpec,
        maps: &'a Dataset,
        folder: &Path,
        conditions: &'a [Condition],
    ) -> Result<Study<'a>, StudyError> {
        Study::open(spec, maps, folder, (0, 1))?.with_conditions(conditions)
    }

    /// Error of a run under conditions that the study accepts.
    fn run_error(spec: &StudySpec, maps: &Dataset, folder: &Path, conditions: &[Condition]) -> StudyError {
        open(spec, maps, folder, conditions).expect("opens").run(&|| true, &mut |_| {}).expect_err("refused")
    }

    #[test]
    fn errors_name_conditions_that_do_not_fit() {
        let (maps, spec) = (maps(), StudySpec { seeds: vec![1], learning_rates: Vec::new(), ..spec() });
        let folder = tempfile::tempdir().expect("a folder");
        let larger = [condition("larger", dataset(Maps { size: 64, ..FEW }))];
        let error = open(&spec, &maps, folder.path(), &larger).err().expect("another shape");
        assert!(matches!(&error, StudyError::Maps { condition, .. } if condition == "larger"), "{error}");
        assert!(error.to_string().contains("condition 'larger': its maps are "), "{error}");
        let twice = [condition("a b", dataset(FEW)), condition("A_b", dataset(FEW))];
        let error = open(&spec, &maps, folder.path(), &twice).err().expect("one name in files").to_string();
        assert!(error.contains("'A_b'"), "{error}");

        // A set that contains only training sequences is refused.
        let seen = [condition("seen", dataset(Maps { sequences: [6, 2, 0], ..FEW }))];
        let error = run_error(&spec, &maps, folder.path(), &seen);
        assert!(matches!(&error, StudyError::NothingUnseen { condition } if condition == "seen"), "{error}");

        // A study from before models were kept lacks this file.
        let unseen = [unseen_sequences()];
        std::fs::remove_file(folder.path().join("models/hqnn-1-0.001-1.safetensors")).expect("removed");
        let error = run_error(&spec, &maps, folder.path(), &unseen);
        assert!(matches!(&error, StudyError::NoModel { .. }), "{error}");
        assert!(error.to_string().contains("remove ") && error.to_string().contains("hqnn-1-0.001-1.json"), "{error}");

        let half = StudySpec { label_fractions: vec![0.5], ..spec.clone() };
        let other = tempfile::tempdir().expect("a folder");
        let study = Study::open(&half, &maps, other.path(), (0, 1)).expect("opens");
        let error = study.with_conditions(&unseen).err().expect("no model of all labels").to_string();
        assert!(error.contains("label_fractions"), "{error}");
    }

    /// Regression test: the error of a truncated result was "EOF while parsing", and a result in the place of another counted under the
    /// wrong seed.
    #[test]
    fn errors_name_damaged_and_misplaced_files_with_the_remedy() {
        let (maps, spec) = (maps(), StudySpec { learning_rates: Vec::new(), label_fractions: vec![1.0], ..spec() });
        let folder = tempfile::tempdir().expect("a folder");
        outcomes(&spec, &maps, folder.path());
        let at = |name: &str| folder.path().join(name);
        let unseen = [unseen_sequences()];
        let error = || run_error(&spec, &maps, folder.path(), &unseen).to_string();
        let (model, result) = ("models/hqnn-1-0.001-1.safetensors", "results/hqnn-1-0.001-1.json");
        let whole = [model, result].map(|name| std::fs::read(at(name)).expect("reads"));
        std::fs::write(at(model), &whole[0][..whole[0].len() / 2]).expect("writes");
        let of_model = error();
        let is_named = of_model.contains("truncated") && of_model.contains("remove ") && of_model.contains(result);
        assert!(is_named, "{of_model}");
        std::fs::write(at(model), &whole[0]).expect("writes");

        std::fs::write(at(result), &whole[1][..whole[1].len() / 2]).expect("writes");
        let of_result = error();
        assert!(of_result.contains("it is no result") && of_result.contains("hint: remove it"), "{of_result}");
        std::fs::copy(at("results/hqnn-1-0.001-2.json"), at(result)).expect("copies");
        let of_copy = error();
        assert!(
            of_copy.contains("another training, hqnn-1-0.001-2") && of_copy.contains("hint: remove it"),
            "{of_copy}"
        );
    }

    /// Regression test: results of more than three thousand epochs could not be read back, so the study did not continue.
    #[test]
    fn results_of_many_epochs_are_read_back() {
        let (maps, spec) = (maps(), StudySpec { seeds: vec![1], learning_rates: Vec::new(), ..spec() });
        let folder = tempfile::tempdir().expect("a folder");
        run(&spec, &maps, folder.path(), (0, 1));
        let path = folder.path().join("results/hqnn-1-0.001-1.json");
        let mut outcome: Outcome = serde_json::from_slice(&std::fs::read(&path).expect("reads")).expect("an outcome");
        outcome.curve = outcome.curve.iter().cycle().take(5000).cloned().collect();
        let text = serde_json::to_string_pretty(&outcome).expect("JSON");
        assert!(text.len() > 1 << 20, "{} bytes", text.len());
        std::fs::write(&path, text).expect("writes");
        let study = Study::open(&spec, &maps, folder.path(), (0, 1)).expect("opens");
        assert!(study.outcomes().expect("read").contains(&outcome));
    }

    /// Asserts that a whole run excludes all other runs, and that shards exclude whole runs.
    #[test]
    fn a_folder_in_use_is_an_error() {
        let (maps, spec) = (maps(), spec());
        let folder = tempfile::tempdir().expect("a folder");
        let study = |shard| Study::open(&spec, &maps, folder.path(), shard).expect("opens");
        let lock = lock_folder(folder.path()).expect("free");
        for shard in [(0, 1), (0, 2)] {
            let error = study(shard).run(&|| true, &mut |_| {}).expect_err("in use");
            assert!(matches!(error, StudyError::Dataset(DatasetError::Busy { .. })), "{error}");
            assert!(error.to_string().contains("another process is at work here"), "{error}");
        }
        drop(lock);
        let mut error = None;
        // The run stops after the first result.
        let results = folder.path().join("results");
        let has_no_result = || std::fs::read_dir(&results).expect("a folder").count() == 0;
        let ran = study((0, 2)).run(&has_no_result, &mut |progress| {
            if let Progress::Job(..) = progress {
                error = study((0, 1)).run(&|| true, &mut |_| {}).err();
            }
        });
        ran.expect("runs");
        assert!(matches!(error, Some(StudyError::Dataset(DatasetError::Busy { .. }))), "{error:?}");
    }

    /// Asserts that with a damaged checkpoint, or one of another machine, training restarts and the report is the same.
    #[test]
    fn a_checkpoint_that_cannot_be_continued_is_replaced() {
        let maps = maps();
        let spec = StudySpec { seeds: vec![1], label_fractions: vec![1.0], learning_rates: Vec::new(), ..spec() };
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        run(&spec, &maps, &at("whole"), (0, 1));
        std::fs::create_dir_all(at("other").join("checkpoints")).expect("made");
        std::fs::write(at("other").join("checkpoints/hqnn-1-0.001-1.safetensors"), "no checkpoint").expect("written");
        assert_eq!(run(&spec, &maps, &at("other"), (0, 1)), ["hqnn", "estimator_matched"]);
        assert_eq!(bytes(&report(&spec, &maps, &at("other"))), bytes(&report(&spec, &maps, &at("whole"))));
        assert_eq!(std::fs::read_dir(at("other").join("checkpoints")).expect("a folder").count(), 0);
    }
}
