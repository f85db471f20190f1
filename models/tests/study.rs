//! Studies on made-up maps: shards, interruptions, failures.

use std::path::Path;

use radome_models::dataset::{DatasetError, lock_folder};
use radome_models::study::{Outcome, Progress, Report, Study, StudyError, StudySpec, Variant};
use radome_models::{Dataset, TrainSpec};

use crate::support::{Maps, dataset};

/// Few small maps with strong targets.
fn maps() -> Dataset {
    dataset(Maps { size: 32, sequences: [6, 2, 2], length: 3, snr_db: (20.0, 30.0), ..Maps::default() })
}

fn variant(name: &str) -> Variant {
    Variant { name: name.to_owned(), network: None, head: None, transposed: None }
}

/// Two heads, a grid of two rates, two seeds, two shares of the maps: 8 trainings that are compared and 2 that only choose.
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

fn report(spec: &StudySpec, maps: &Dataset, folder: &Path) -> Report {
    Study::open(spec, maps, folder, (0, 1)).expect("opens").report().expect("a report")
}

/// Everything that is written of a report.
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

    // The last shard begins alone and tries the rates that it needs of the others.
    let counts = [2, 0, 1].map(|index| run(&spec, &maps, &at("apart"), (index, 3)).len());
    assert_eq!(counts.iter().sum::<usize>(), 10, "{counts:?}");
    assert_eq!(bytes(&report(&spec, &maps, &at("apart"))), bytes(&whole));

    // All at once.
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
fn a_plan_counts_what_is_done_and_times_the_rest() {
    let (maps, spec) = (maps(), spec());
    let folder = tempfile::tempdir().expect("a folder");
    let plan = || {
        let study = Study::open(&spec, &maps, folder.path(), (0, 1)).expect("opens");
        let mut timed = Vec::new();
        let plan = study.plan(&mut |variant: &str| timed.push(variant.to_owned())).expect("a plan");
        (plan, timed)
    };
    let (before, timed) = plan();
    assert_eq!((before.trainings, before.done, timed.len()), (10, 0, 2));
    // 54 maps in batches of 16: 4 steps an epoch, 2 for the half. Two epochs; of each network two trainings at half of the maps.
    let steps: Vec<usize> = before.networks.iter().map(|network| network.steps).collect();
    assert_eq!(steps, [3 * 2 * 4 + 2 * 2 * 2; 2]);
    assert!(before.networks.iter().all(|network| network.step_seconds.is_some_and(|seconds| seconds > 0.0)));
    assert!(before.hours > 0.0 && before.cpu_hours >= before.hours, "{before:?}");

    run(&spec, &maps, folder.path(), (0, 1));
    let (after, timed) = plan();
    assert_eq!((after.trainings, after.done, timed.len()), (10, 10, 0));
    assert!(after.hours == 0.0 && after.networks.iter().all(|network| network.step_seconds.is_none()), "{after:?}");
}

/// Shares of the maps and noise on them cost no training twice: there is one file a training, and each is trained once.
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

    /// Three maps are less than a batch; a network with batch normalisation learns from them, too.
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

    #[test]
    fn a_seed_that_diverges_is_counted_with_its_reason() {
        let maps = maps();
        let mut spec = StudySpec { learning_rates: vec![1e30], label_fractions: vec![1.0], ..spec() };
        spec.train.warm_up_steps = 1;
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        outcomes(&spec, &maps, &at("one"));
        let all = report(&spec, &maps, &at("one"));
        assert_eq!((all.done, all.planned, all.failures.len()), (4, 4, 4));
        for cell in &all.cells {
            let test = cell.test.expect("chance");
            assert_eq!((cell.failed, test.count), (2, 2));
            assert!((test.mean - 1.0 / 3.0).abs() < 1e-12, "{test:?}");
        }
        for failure in &all.failures {
            assert!(failure.reason.contains("not finite at start"), "{failure:?}");
            assert!(all.markdown().contains(&failure.reason), "{}", all.markdown());
        }
        // Of two rates, the one that diverges is not chosen, and is not lost.
        spec.learning_rates = vec![1e30, 1e-3];
        outcomes(&spec, &maps, &at("two"));
        let all = report(&spec, &maps, &at("two"));
        assert!(all.cells.iter().all(|cell| cell.learning_rate == 1e-3 && cell.done == 2), "{all:?}");
        let lost = all.failures.iter().filter(|failure| failure.job.learning_rate == 1e30);
        assert_eq!(lost.filter(|failure| failure.reason.contains("not finite")).count(), 2, "{all:?}");
    }

    /// A whole run keeps all others out; shards keep whole runs out.
    #[test]
    fn a_folder_in_use_is_said_to_be() {
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
        // One result is enough.
        let results = folder.path().join("results");
        let is_first = || std::fs::read_dir(&results).expect("a folder").count() == 0;
        let ran = study((0, 2)).run(&is_first, &mut |progress| {
            if let Progress::Job(..) = progress {
                error = study((0, 1)).run(&|| true, &mut |_| {}).err();
            }
        });
        ran.expect("runs");
        assert!(matches!(error, Some(StudyError::Dataset(DatasetError::Busy { .. }))), "{error:?}");
    }

    /// A checkpoint of another machine, or a damaged one: the training begins again and the report is the same.
    #[test]
    fn a_checkpoint_that_cannot_be_continued_is_left() {
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
