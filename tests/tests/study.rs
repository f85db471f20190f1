//! Tests of studies in several processes: shards, kills, folders in use, plans and scripts for clusters.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, SystemTime};

use radome_models::Dataset;
use radome_tests::running::{Running, wait_up_to};
use radome_tests::{
    command, fails_with, failure, fixture_text, json_lines, radome, success, success_at_once, wrong_use_with,
};

use super::learning::hall_dataset;

/// Spec of a study with 24 trainings of a second or less, and three more that only select a rate.
pub const STUDY: &str = "title = \"Small\"\ndataset = \"none.toml\"\nseeds = [1, 2, 3, 4]\nlearning_rates = [1e-3, 1e-2]\n\
    label_fractions = [1.0, 0.5]\nsnr_db = [20.0]\n\
    variants = [{ name = \"hqnn\" }, { name = \"estimator_matched\" }, { name = \"dequantization\" }]\n\
    [train]\nepochs = 3\nstarts = 1\nmost_training_maps = 60\npooled = [4, 4]\nsplit = { by = \"seed\" }\n";
/// Number of trainings of [`STUDY`].
pub const TRAININGS: usize = 24 + 3;

/// Folder with the study's file.
struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new(study: &str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("study.toml"), study).expect("writable");
        Place { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Command of the study in the folder `name`.
    fn study(&self, name: &str) -> Command {
        command!("model study --json", self.path("study.toml"), "--dataset", hall_dataset(), "-o", self.path(name))
    }

    fn shard(&self, name: &str, shard: &str) -> Command {
        let mut command = self.study(name);
        command.args(["--shard", shard]);
        command
    }

    fn report(&self, name: &str) -> (String, String) {
        report(&self.path(name))
    }

    /// Rewrites the study's file with conditions, and writes the spec of their maps beside it.
    fn add_conditions(&self, study: &str, conditions: &str) {
        let text = study.replace("[train]", &format!("conditions = [{conditions}]\n[train]"));
        std::fs::write(self.path("study.toml"), text).expect("writable");
        std::fs::copy(hall_dataset().with_file_name("maps.toml"), self.path("maps.toml")).expect("copied");
    }

    /// Contents and modification times of the results and models of trainings.
    fn trainings(&self, name: &str) -> BTreeMap<PathBuf, (Vec<u8>, SystemTime)> {
        let folders = ["results", "models"].map(|part| self.path(name).join(part));
        let entries = folders.iter().flat_map(|folder| std::fs::read_dir(folder).expect("a folder"));
        let content = |path: PathBuf| {
            let changed = path.metadata().and_then(|metadata| metadata.modified()).expect("a time");
            (path.clone(), (std::fs::read(&path).expect("a file"), changed))
        };
        entries.map(|entry| content(entry.expect("an entry").path())).collect()
    }
}

/// Spec of a study with six trainings: three networks with two shares of the labels.
fn small_spec() -> String {
    STUDY.replace("seeds = [1, 2, 3, 4]", "seeds = [1]").replace("learning_rates = [1e-3, 1e-2]\n", "")
}

/// Condition with thermal noise on the raw samples, of the same power as the signal.
const NOISE: &str = "{ name = \"noise +0 dB\", group = \"Noise\", dataset = \"maps.toml\", raw_snr_db = 0.0 }";

/// The written report of a study.
pub fn report(folder: &Path) -> (String, String) {
    let read = |name: &str| std::fs::read_to_string(folder.join(name)).expect("a report");
    (read("report.md"), read("report.json"))
}

/// Number of results and of checkpoints in the folder of a study.
pub fn progress(folder: &Path) -> [usize; 2] {
    ["results/json", "checkpoints/safetensors"].map(|what| {
        let (name, extension) = what.split_once('/').expect("two words");
        let entries = std::fs::read_dir(folder.join(name)).into_iter().flatten().flatten();
        entries.filter(|entry| entry.path().extension().is_some_and(|found| found == extension)).count()
    })
}

/// Waits up to five minutes until `done` returns true.
pub fn wait(what: &str, mut done: impl FnMut() -> bool) {
    wait_up_to(Duration::from_secs(300), what, || done().then_some(()));
}

/// Asserts that four parallel shards give the report of one run, byte for byte. One shard is killed within a training
/// and restarted; no training runs twice.
#[test]
fn shards_with_one_killed_report_the_bytes_of_one_run() {
    let place = Place::new(STUDY);
    let told = json_lines(place.study("whole"));
    assert_eq!(told.len(), TRAININGS + 1);

    let first = Running::start(place.shard("shards", "0/4"));
    // No other shard runs yet, so that the checkpoint belongs to this one.
    wait("a training to be at work", || progress(&place.path("shards"))[1] > 0);
    drop(first);
    let [done, begun] = progress(&place.path("shards"));
    assert!(done < TRAININGS, "{done} done, {begun} begun");

    success_at_once(["0/4", "1/4", "2/4", "3/4"].map(|shard| place.shard("shards", shard)));
    assert_eq!(progress(&place.path("shards")), [TRAININGS, 0]);
    assert!(!place.path("shards/report.md").exists(), "shards leave the report to the last command");
    let merged = json_lines(place.study("shards").arg("--report-only"));
    assert_eq!(merged.last(), told.last());
    assert_eq!(place.report("shards"), place.report("whole"));
    assert!(place.path("shards/times.md").exists());
}

/// Asserts that conditions can be added to a complete study without new trainings, and that shards give the same
/// report.
#[test]
fn conditions_are_added_without_training_again() {
    let place = Place::new(&small_spec());
    json_lines(place.study("whole"));
    let before = place.trainings("whole");
    // Six results, and the models of the three trainings on all labels.
    assert_eq!(before.len(), 6 + 3);

    place.add_conditions(&small_spec(), NOISE);
    let same = format!("same={}", hall_dataset().display());
    let judge = |name: &str| {
        let mut command = place.study(name);
        command.args(["--condition", &same]);
        command
    };
    let told = json_lines(judge("whole"));
    // Three networks under two conditions, and the report.
    assert_eq!(told.len(), 3 * 2 + 1);
    assert!(place.trainings("whole") == before, "trainings were done or written again");
    let report = told.last().expect("a report");
    let [noise, same] = [0usize, 1].map(|index| &report["conditions"][index]);
    assert_eq!((noise["group"].as_str(), same["group"].as_str()), (Some("Noise"), None));
    for cell in same["cells"].as_array().expect("cells") {
        let is_same =
            |clean: &&serde_json::Value| clean["variant"] == cell["variant"] && clean["label_fraction"] == 1.0;
        let clean = report["cells"].as_array().expect("cells").iter().find(is_same).expect("the clean one");
        assert_eq!((&cell["balanced_accuracy"], &cell["confusion"]), (&clean["test"], &clean["confusion"]));
    }
    assert_eq!(noise["maps"], same["maps"]);
    let markdown = place.report("whole").0;
    assert!(
        markdown.contains("## Noise\n") && markdown.contains("| network | test split | noise +0 dB |"),
        "{markdown}"
    );

    // Noise changes only the maps.
    let open = |path: &Path| Dataset::open(path).expect("a dataset");
    let (clean, noisy) = (open(hall_dataset()), open(&place.path("whole/conditions/noise_+0_dB")));
    let known = |dataset: &Dataset| {
        let row = |row: &radome_models::dataset::ManifestRow| (row.sequence.clone(), row.frame, row.label, row.split);
        dataset.rows().iter().map(row).collect::<Vec<_>>()
    };
    assert_eq!(known(&clean), known(&noisy));
    assert!(clean.rows().iter().zip(noisy.rows()).all(|(clean, noisy)| clean.hash != noisy.hash));

    // No work is left; shards give the same result.
    assert_eq!(json_lines(judge("whole")).len(), 1);
    success_at_once(["0/2", "1/2"].map(|shard| {
        let mut command = judge("shards");
        command.args(["--shard", shard]);
        command
    }));
    json_lines(judge("shards").arg("--report-only"));
    assert_eq!(place.report("shards"), place.report("whole"));
}

#[test]
fn a_plan_says_what_is_left() {
    let place = Place::new(&STUDY.replace("seeds = [1, 2, 3, 4]", "seeds = [1]"));
    let plan = || json_lines(place.study("study").arg("--plan")).remove(0);
    let before = plan();
    // Three networks at two rates with all labels, and at one rate with half of them.
    assert_eq!((before["trainings"].as_u64(), before["done"].as_u64()), (Some(9), Some(0)), "{before}");
    assert!(before["cpu_hours"].as_f64() > Some(0.0), "{before}");
    for network in before["networks"].as_array().expect("networks") {
        assert!(network["step_seconds"].as_f64() > Some(0.0) && network["steps"].as_u64() > Some(0), "{network}");
    }
    json_lines(place.study("study"));
    let after = plan();
    assert_eq!((after["done"].as_u64(), after["hours"].as_f64()), (Some(9), Some(0.0)), "{after}");
    let mut command = place.study("study");
    command.arg("--plan");
    let arguments: Vec<_> =
        command.get_args().filter(|argument| *argument != "--json").map(ToOwned::to_owned).collect();
    let (table, _) = success(radome().args(arguments));
    assert!(
        table.contains("s a step") && table.contains("estimator_matched") && table.contains("CPU-hours"),
        "{table}"
    );
}

/// Asserts that a plan counts the scores under a condition without building its dataset.
#[test]
fn a_plan_counts_scores_under_conditions() {
    let place = Place::new(&small_spec());
    place.add_conditions(&small_spec(), NOISE);
    let left =
        |more: &[&str]| json_lines(place.study("study").arg("--plan").args(more)).remove(0)["judgings_left"].as_u64();
    let same = format!("same={}", hall_dataset().display());
    // Three models, trained on all labels.
    assert_eq!([left(&[]), left(&["--condition", &same])], [Some(3), Some(6)]);
    assert!(!place.path("study/conditions").exists());
    json_lines(place.study("study"));
    assert_eq!([left(&[]), left(&["--condition", &same])], [Some(0), Some(3)]);
}

/// Asserts that the script names the study, its shards and the report after them, and that a shell accepts it.
#[test]
fn the_script_of_an_array_runs_the_study_in_shards() {
    let place = Place::new(STUDY);
    let script = |arguments: &[&str]| {
        command!("model slurm", place.path("study.toml"), "-o", place.path("out put"), ..arguments)
    };
    let (text, _) = success(script(&["--tasks", "6", "--cpus", "2", "--dataset", "maps"]));
    for part in ["--array=0-5", "--cpus-per-task=2", "model study", "--shard auto/6", "--report-only", "out put'"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let given = place.path("real rooms");
    let given = format!("it's abroad={}", given.display());
    let (with_condition, _) = success(script(&["--dataset", "maps", "--condition", &given]));
    // The shards and the final report have the option.
    let word = format!("--condition '{}'", given.replace('\'', "'\\''"));
    assert_eq!(with_condition.matches(&word).count(), 2, "{with_condition}");
    let twice = ["--dataset", "maps", "--condition", &given, "--condition", &given];
    wrong_use_with(script(&twice), &["given twice"]);
    let path = place.path("array.sh");
    std::fs::write(&path, &text).expect("writable");
    assert!(Command::new("sh").arg("-n").arg(&path).status().expect("runs").success());
    // Without a dataset the study needs the spec of one.
    assert!(failure(script(&[])).contains("none.toml"));
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_study_killed_within_a_training_repeats_no_other() {
        let place = Place::new(&STUDY.replace("seeds = [1, 2, 3, 4]", "seeds = [1]"));
        json_lines(place.study("whole"));
        let killed = Running::start(place.study("killed"));
        wait("a second training", || progress(&place.path("killed")).iter().all(|count| *count > 0));
        drop(killed);
        let [done, _] = progress(&place.path("killed"));
        let told = json_lines(place.study("killed"));
        assert_eq!(told.len(), 9 - done + 1, "{done} were done");
        assert_eq!(place.report("killed"), place.report("whole"));
    }

    #[test]
    fn conditions_that_cannot_be_evaluated_are_named() {
        let place = Place::new(&small_spec());
        let wide = std::fs::read_to_string(hall_dataset().with_file_name("maps.toml")).expect("a spec");
        let wide = wide.replace("[map]", "[map]\nrange_fft_length = 256").replace("seeds = [1, 8]", "seeds = [1, 1]");
        std::fs::write(place.path("wide.toml"), wide.replace("every = 5", "every = 55")).expect("writable");
        json_lines(command!("dataset build --json", place.path("wide.toml"), "-o", place.path("wide")));
        let given = format!("office={}", place.path("wide").display());
        let said = failure(place.study("study").args(["--condition", &given]));
        assert!(said.contains("condition 'office': its maps are") && said.contains("hint: "), "{said}");
        assert_eq!(progress(&place.path("study")), [0, 0], "said before the first training");

        for (conditions, expected) in [
            ("{ name = \"a\" }", "condition 'a': expected one of `dataset` and `ladder`"),
            ("{ name = \"a\", dataset = \"none.toml\" }", "condition 'a'"),
            ("{ name = \"a\", dataset = \"maps.toml\", raw_snr_db = inf }", "raw_snr_db is inf"),
            ("{ name = \"a\", dataset = \"maps.toml\", snr = 3 }", "snr"),
        ] {
            place.add_conditions(&small_spec(), conditions);
            fails_with(place.study("study"), &[expected]);
        }
        // The report leaves out a condition without a dataset.
        place.add_conditions(&small_spec(), NOISE);
        let report = json_lines(place.study("study").arg("--report-only")).remove(0);
        assert_eq!(report["conditions"].as_array().map(Vec::len), Some(0), "{report}");
    }

    /// Asserts that a built dataset keeps the condition's definition: a change under the same name is refused.
    #[test]
    fn another_ratio_under_the_same_name_is_refused() {
        let place = Place::new(&small_spec());
        let few = small_spec().replace(", { name = \"estimator_matched\" }, { name = \"dequantization\" }", "");
        place.add_conditions(&few, NOISE);
        json_lines(place.study("study"));
        place.add_conditions(&few, &NOISE.replace("raw_snr_db = 0.0", "raw_snr_db = 3.0"));
        fails_with(place.study("study"), &["noise_+0_dB", "made from another spec", "hint: "]);
    }

    /// Asserts that a second run in a folder fails with a message, while reports are still possible.
    #[test]
    fn a_second_run_reports_that_the_folder_is_in_use() {
        // The first run must outlast the test, which kills it at the end.
        let place = Place::new(&STUDY.replace("epochs = 3", "epochs = 10000"));
        let _first = Running::start(place.study("study"));
        wait("a training", || progress(&place.path("study"))[1] > 0);
        for shard in ["0/1", "1/3"] {
            fails_with(place.study("study").args(["--shard", shard]), &["another process is at work here", "hint: "]);
        }
        let report = json_lines(place.study("study").arg("--report-only")).remove(0);
        assert_eq!(report["done"].as_u64(), Some(0), "{report}");
    }

    #[test]
    fn shards_build_one_dataset() {
        let place = Place::new(&STUDY.replace("none.toml", "maps.toml").replace("seeds = [1, 2, 3, 4]", "seeds = [1]"));
        let few = fixture_text("datasets/quick.toml").replace("seeds = [1, 24]", "seeds = [1, 8]");
        std::fs::write(place.path("maps.toml"), few).expect("writable");
        success_at_once(["0/3", "1/3", "2/3"].map(|shard| {
            command!("model study --json", place.path("study.toml"), "-o", place.path("study"), "--shard", shard)
        }));
        assert_eq!(progress(&place.path("study")), [9, 0]);
    }

    /// A study took the dataset that it had built, whatever its spec had become.
    #[test]
    fn a_dataset_whose_spec_was_edited_is_refused() {
        let place = Place::new(&small_spec().replace("none.toml", "maps.toml"));
        let spec = fixture_text("datasets/quick.toml").replace("seeds = [1, 24]", "seeds = [1, 8]");
        std::fs::write(place.path("maps.toml"), &spec).expect("writable");
        let study = || command!("model study --json", place.path("study.toml"), "-o", place.path("study"));
        let told = json_lines(study());
        std::fs::write(place.path("maps.toml"), spec.replace("seeds = [1, 8]", "seeds = [1, 9]")).expect("writable");
        fails_with(study(), &["study/dataset was made from another spec", "hint: undo the change"]);
        // The report on what was done is still to be had.
        assert_eq!(json_lines(study().arg("--report-only")).last(), told.last());
        std::fs::write(place.path("maps.toml"), spec).expect("writable");
        assert_eq!(json_lines(study()).last(), told.last());
        // Where the sources are not at hand, the dataset is named.
        std::fs::remove_file(place.path("maps.toml")).expect("removable");
        fails_with(study(), &["study/dataset cannot be compared with its sources", "maps.toml"]);
        assert!(json_lines(study().arg("--dataset").arg(place.path("study/dataset"))).last().is_some());
    }
}
