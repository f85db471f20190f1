//! Tests from a dataset to models and reports: killed trainings, interrupted studies and renamed models.

use std::path::{Path, PathBuf};
use std::time::Duration;

use radome_models::dataset::{Dataset, Split, SplitSpec};
use radome_models::model::Adapted;
use radome_tests::running::Running;
use radome_tests::{
    command, fails_with, failure, fixture, fixture_text, json_lines, outcome, simulate, subcommand, success,
    write_file, wrong_use_with,
};

/// Small dataset of halls, made once for all tests. Its rows have the splits of its spec, which no training changes.
pub fn hall_dataset() -> &'static Path {
    static MAPS: std::sync::OnceLock<(tempfile::TempDir, PathBuf)> = std::sync::OnceLock::new();
    let (_, path) = MAPS.get_or_init(|| {
        build_dataset(&fixture_text("datasets/quick.toml").replace("seeds = [1, 24]", "seeds = [1, 8]"))
    });
    path
}

/// Builds a dataset in a folder of its own.
fn build_dataset(spec_text: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = write_file(folder.path(), "maps.toml", spec_text);
    let path = folder.path().join("maps");
    json_lines(command!("dataset build --json", &spec, "-o", &path));
    (folder, path)
}

/// Copies a dataset, with other seeds in some rows: another dataset with the same sequences.
fn copy_as_another_dataset(from: &Path, to: &Path) {
    std::fs::create_dir(to).expect("created");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        std::fs::copy(entry.path(), to.join(entry.file_name())).expect("copied");
    }
    let manifest = std::fs::read_to_string(to.join("manifest.jsonl")).expect("rows");
    write_file(to, "manifest.jsonl", manifest.replace("\"seed\":1,", "\"seed\":100,"));
}

const TRAINING: &str = "epochs = 6\nstarts = 2\nstart_epochs = 2\npooled = [4, 4]\nsplit = { by = \"seed\" }\n";

#[test]
fn a_training_that_is_killed_ends_with_the_same_weights() {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = write_file(folder.path(), "training.toml", TRAINING);
    let train_command =
        |name: &str| command!("model train --json", hall_dataset(), "--spec", &spec, "-o", folder.path().join(name));
    let told = json_lines(train_command("whole.safetensors"));
    // Two starts of two epochs, four more epochs, and the summary.
    assert_eq!(told.len(), 2 + 6 + 1);
    // Three runs are killed after their first output; the fourth runs to its end.
    for _ in 0..3 {
        let killed = Running::start(train_command("killed.safetensors"));
        killed.stdout.find(0, "a line", |_| Some(()));
        std::thread::sleep(Duration::from_millis(100));
    }
    json_lines(train_command("killed.safetensors"));
    let bytes = |name: &str| std::fs::read(folder.path().join(name)).expect("a model");
    assert_eq!(bytes("whole.safetensors"), bytes("killed.safetensors"));
    assert!(!folder.path().join("killed.safetensors.checkpoint").exists());
}

#[test]
fn every_network_can_be_trained_by_name_and_says_what_it_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = write_file(
        folder.path(),
        "training.toml",
        "epochs = 1\nstarts = 1\nmost_training_maps = 40\nsplit = { by = \"seed\" }\n\
         reference = { over_noise = { skip_range_bins = 3 } }\n",
    );
    let networks = json_lines(subcommand("model list --json")).remove(0);
    for network in networks.as_array().expect("a list") {
        let name = network["name"].as_str().expect("a name");
        let model = folder.path().join(format!("{name}.safetensors"));
        json_lines(command!("model train --json", hall_dataset(), "--spec", &spec, "--network", name, "-o", &model));
        let metrics = json_lines(command!("model evaluate --json", &model, hall_dataset())).remove(0);
        let score = metrics["balanced_accuracy"].as_f64().expect("a score");
        assert!((0.0..=1.0).contains(&score), "{name}: {metrics}");
    }
    fails_with(command!("model train", hall_dataset(), "--network hqmm -o x"), &["no network 'hqmm'", "doppler_net"]);
    // Descriptors need levels over noise, but the default reference is absolute.
    let said = failure(command!("model train", hall_dataset(), "--network descriptor_linear -o x"));
    assert!(said.contains("reference is absolute") && said.contains("hint: "), "{said}");
}

#[test]
fn one_recording_can_be_held_out() {
    let folder = tempfile::tempdir().expect("a folder");
    let manifest = std::fs::read_to_string(hall_dataset().join("manifest.jsonl")).expect("a manifest");
    let row: serde_json::Value = serde_json::from_str(manifest.lines().next().expect("a row")).expect("JSON");
    let sequence = row["sequence"].as_str().expect("a sequence");
    let maps_of = manifest.lines().filter(|line| line.contains(&format!("\"{sequence}\""))).count() as u64;
    let spec = write_file(folder.path(), "training.toml", "epochs = 1\nstarts = 1\n");
    let model = folder.path().join("model.safetensors");
    let train_command = |sequence: &str| {
        command!(
            "model train --json",
            hall_dataset(),
            "--spec",
            &spec,
            "--hold-out",
            sequence,
            "--overwrite -o",
            &model
        )
    };
    let told = json_lines(train_command(sequence));
    let test = &told.last().expect("an answer")["training"]["test"];
    assert_eq!(test["samples"].as_u64(), Some(maps_of), "{test}");
    assert_eq!(
        &json_lines(command!("model evaluate --json", &model, hall_dataset())).remove(0),
        test,
        "evaluate divides the dataset as the training did"
    );
    fails_with(train_command("nobody"), &["no sequence 'nobody'", "hint: the dataset has '", " and others"]);
}

#[test]
fn a_study_that_is_stopped_carries_on_and_reports_what_there_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = "title = \"Small\"\ndataset = \"none.toml\"\nseeds = [1, 2]\nlearning_rates = [1e-3, 1e-2]\n\
                label_fractions = [1.0, 0.5]\nsnr_db = [20.0]\n\
                variants = [{ name = \"hqnn\" }, { name = \"linear\", head = { kind = \"linear\" } }]\n\
                [train]\nepochs = 2\nstarts = 1\nmost_training_maps = 60\npooled = [4, 4]\nsplit = { by = \"seed\" }\n";
    let spec = write_file(folder.path(), "study.toml", text);
    let output = folder.path().join("study");
    let study = || command!("model study --json", &spec, "--dataset", hall_dataset(), "-o", &output);
    let killed = Running::start(study());
    killed.stdout.find(0, "a training", |_| Some(()));
    drop(killed);
    let partial = json_lines(study().arg("--report-only")).remove(0);
    assert!(partial["done"].as_u64() < Some(8), "{partial}");

    let report = json_lines(study()).pop().expect("a report");
    assert_eq!((report["done"].as_u64(), report["planned"].as_u64()), (Some(8), Some(8)));
    let cells = report["cells"].as_array().expect("cells");
    assert_eq!(cells.len(), 4);
    for cell in cells {
        let test = cell["test"]["mean"].as_f64().expect("a score");
        assert!((0.0..=1.0).contains(&test) && cell["done"].as_u64() == Some(2), "{cell}");
        assert!([1e-3, 1e-2].contains(&cell["learning_rate"].as_f64().expect("a rate")));
        assert_eq!(cell["noisy"].as_array().map(Vec::len), Some(if cell["label_fraction"] == 1.0 { 1 } else { 0 }));
    }
    let plots = ["noise", "labels", "curves", "cost"].into_iter().flat_map(|name| {
        ["", "-dark"]
            .into_iter()
            .flat_map(move |end| ["png", "svg"].map(|extension| format!("{name}{end}.{extension}")))
    });
    for name in ["report.md", "report.json"].map(str::to_owned).into_iter().chain(plots) {
        assert!(output.join(&name).exists(), "{name}");
    }
    // No training is repeated, and another study cannot use the folder.
    assert_eq!(json_lines(study()).len(), 1);
    std::fs::write(&spec, text.replace("seeds = [1, 2]", "seeds = [1, 3]")).expect("writable");
    assert!(failure(study()).contains("another study"));
}

/// Asserts that augmentation, limit and filter settings reach the model file. Also asserts that ablation replaces parts
/// of maps by noise and reports the recalls again, for maps of a dataset and for recordings.
#[test]
fn ablation_replaces_parts_of_maps_and_reports_recalls_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = "epochs = 1\nstarts = 1\nmost_training_maps = 60\npooled = [4, 4]\nsplit = { by = \"seed\" }\n\
                [reference.over_noise]\nskip_range_bins = 3\nmost_db = 50.0\n\
                [smoothing]\ndwell_s = 60.0\nindependent_s = 1.0\n\
                [augmentation]\nnoise_db = 1.0\ndoppler_flip = true\necho_gain_db = [-7, 7]\nrange_shift_bins = 6\n\
                range_stretch = 0.1\nvelocity_stretch = 0.1\nsuperpose = { probability = 0.2 }\nsway = { probability = 0.7 }\n";
    let spec = write_file(folder.path(), "training.toml", text);
    let model = folder.path().join("model.safetensors");
    json_lines(command!("model train --json", hall_dataset(), "--spec", &spec, "-o", &model));

    let on_maps = || command!("model evaluate", &model, hall_dataset());
    let answer = json_lines(on_maps().args(["--ablate", "--json"])).remove(0);
    let rows = answer["ablation"].as_array().expect("rows");
    assert_eq!((&rows[0]["replaced"], &rows[0]["confusion"]), (&"nothing".into(), &answer["confusion"]), "{answer}");
    for part in ["speeds up to 0.15 m/s", "speeds above 0.35 m/s", "near ranges", "echoes 8 range bins", "12 dB weaker"]
    {
        let has = |row: &&serde_json::Value| row["replaced"].as_str().is_some_and(|name| name.contains(part));
        let row = rows.iter().find(has).unwrap_or_else(|| panic!("{part}: {answer}"));
        let recalls = row["recall"].as_array().expect("three recalls");
        assert_eq!(recalls.len(), 3);
        assert!(
            recalls.iter().filter_map(serde_json::Value::as_f64).all(|recall| (0.0..=1.0).contains(&recall)),
            "{row}"
        );
    }
    // The noise is reproducible; without the option the answer does not contain it.
    assert_eq!(json_lines(on_maps().args(["--ablate", "--json"])).remove(0), answer);
    let plain = json_lines(on_maps().arg("--json")).remove(0);
    assert!(plain.get("ablation").is_none(), "{plain}");
    assert_eq!(plain["balanced_accuracy"], answer["balanced_accuracy"]);
    let (table, _) = success(on_maps().arg("--ablate"));
    assert!(table.contains("replaced by noise") && table.contains("far ranges"), "{table}");

    let recording = folder.path().join("one.mcap");
    simulate(&fixture("scenes/hall.toml"), "--people 1 --seed 9 --frames 6", &recording);
    let labelled = format!("{}=one", recording.display());
    let on_recording = |name: &Path| command!("model evaluate --model", name, &labelled, "--ablate");
    let answer = json_lines(on_recording(&model).arg("--json")).remove(0);
    let nothing = &answer["ablation"][0];
    assert_eq!(nothing["balanced_accuracy"], answer["balanced_accuracy_by_single_frames"], "{answer}");
    let frames: u64 = nothing["confusion"][1].as_array().expect("a row").iter().filter_map(|n| n.as_u64()).sum();
    assert_eq!((frames, &answer["recordings"][0]["label"]), (6, &"one".into()), "{answer}");
    wrong_use_with(on_recording(Path::new("cfar")), &["raw frames", "hint:"]);
}

#[test]
fn shipped_settings_train_a_model() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, network) in [
        ("room-hqnn", "descriptor_hqnn"),
        ("room-linear", "descriptor_linear"),
        ("room-cnn", "estimator_matched"),
        ("desk-hqnn", "hqnn"),
        ("paper-hqnn", "hqnn"),
    ] {
        let spec = fixture("datasets").join(format!("{name}-training.toml"));
        let model = folder.path().join(format!("{name}.safetensors"));
        let train = command!(
            "model train --json --epochs 1",
            hall_dataset(),
            "--spec",
            spec,
            "--network",
            network,
            "-o",
            &model
        );
        let told = json_lines(train);
        assert!(told.last().is_some_and(|last| last["training"]["epochs"] == 1), "{name}: {told:?}");
    }
}

mod hard_cases {
    use super::*;

    /// Twelve short sequences whose rows have no split, so that each training divides them by its own rule.
    fn undivided_dataset() -> &'static Path {
        static MAPS: std::sync::OnceLock<(tempfile::TempDir, PathBuf)> = std::sync::OnceLock::new();
        let (_, path) = MAPS.get_or_init(|| {
            let whole = fixture_text("datasets/quick.toml");
            let few = whole.replace("seeds = [1, 24]", "seeds = [1, 4]").replace("frames = 110", "frames = 30");
            let kept: Vec<&str> = few.lines().filter(|line| !line.starts_with("split")).collect();
            build_dataset(&kept.join("\n"))
        });
        path
    }

    /// The test split was that of the default rule, so that maps that were trained on counted.
    #[test]
    fn a_model_is_evaluated_on_the_test_split_of_its_own_training() {
        let folder = tempfile::tempdir().expect("a folder");
        let spec =
            write_file(folder.path(), "training.toml", "epochs = 1\nstarts = 1\n[split]\nseed = 2\ntest = 0.4\n");
        let model = folder.path().join("model.safetensors");
        let trained = json_lines(command!("model train --json", undivided_dataset(), "--spec", &spec, "-o", &model))
            .pop()
            .expect("an answer")["training"]["test"]
            .take();
        let evaluate = |model: &Path| command!("model evaluate --json", model, undivided_dataset());
        let (told, said) = success(evaluate(&model));
        assert_eq!(serde_json::from_str::<serde_json::Value>(&told).expect("JSON"), trained);
        assert!(!said.contains("default rule"), "{said}");

        // A file of an older program does not say by which rule it was trained.
        let mut older = radome_models::Model::load(&model).expect("a model");
        older.card.split = None;
        let older_file = folder.path().join("older.safetensors");
        older.save(&older_file).expect("writable");
        let (told, said) = success(evaluate(&older_file));
        assert_ne!(serde_json::from_str::<serde_json::Value>(&told).expect("JSON")["samples"], trained["samples"]);
        assert!(said.contains("does not say how its training divided this dataset"), "{said}");
    }

    /// Maps that were trained on counted as test maps of a dataset that had grown.
    #[test]
    fn maps_of_training_sequences_are_no_test_maps_of_another_dataset() {
        let folder = tempfile::tempdir().expect("a folder");
        let own = Dataset::open(undivided_dataset()).expect("a dataset");
        let splits = own.splits(&SplitSpec::default()).expect("splits");
        let test: Vec<&str> = own
            .rows()
            .iter()
            .zip(splits)
            .filter(|(_, split)| *split == Split::Test)
            .map(|(row, _)| row.sequence.as_str())
            .collect();
        // All sequences but this one are trained or chosen on.
        let unseen = test.first().expect("a test map");
        let count = |sequence: &str| test.iter().filter(|other| **other == sequence).count();
        assert!(count(unseen) < test.len());
        let spec = write_file(folder.path(), "training.toml", "epochs = 1\nstarts = 1\n");
        let model = folder.path().join("model.safetensors");
        json_lines(command!(
            "model train --json",
            undivided_dataset(),
            "--spec",
            &spec,
            "--hold-out",
            unseen,
            "-o",
            &model
        ));

        let other = folder.path().join("other");
        copy_as_another_dataset(undivided_dataset(), &other);
        let evaluated = |model: &Path| {
            let (told, said) = success(command!("model evaluate --json", model, &other));
            let metrics: serde_json::Value = serde_json::from_str(&told).expect("JSON");
            (metrics["samples"].as_u64().expect("a number") as usize, said)
        };
        let (samples, said) = evaluated(&model);
        assert_eq!(samples, count(unseen), "{said}");
        assert!(said.contains("maps are left out: the model was trained or chosen on their sequences"), "{said}");

        // A file of an older program does not list the sequences of its training.
        let mut older = radome_models::Model::load(&model).expect("a model");
        older.card.training.seen_sequences.clear();
        let older_file = folder.path().join("older.safetensors");
        older.save(&older_file).expect("writable");
        let (samples, said) = evaluated(&older_file);
        assert_eq!(samples, test.len(), "{said}");
        assert!(said.contains("warning: ") && said.contains("may be among those evaluated"), "{said}");
    }

    /// Regression test: another dataset had the held-out sequence in another split, so it was not evaluated, without a word.
    #[test]
    fn what_a_training_held_out_is_evaluated_on_another_dataset() {
        let folder = tempfile::tempdir().expect("a folder");
        let own = Dataset::open(hall_dataset()).expect("a dataset");
        let row = own.rows().iter().find(|row| row.split == Some(Split::Train)).expect("a training map");
        let maps = own.rows().iter().filter(|other| other.sequence == row.sequence).count();
        let spec = write_file(folder.path(), "training.toml", "epochs = 1\nstarts = 1\n");
        let model = folder.path().join("model.safetensors");
        json_lines(command!(
            "model train --json",
            hall_dataset(),
            "--spec",
            &spec,
            "--hold-out",
            &row.sequence,
            "-o",
            &model
        ));
        let other = folder.path().join("other");
        copy_as_another_dataset(hall_dataset(), &other);
        let (told, said) = success(command!("model evaluate --json", &model, &other));
        let metrics: serde_json::Value = serde_json::from_str(&told).expect("JSON");
        // The training has seen all other sequences.
        assert_eq!(metrics["samples"].as_u64(), Some(maps as u64), "{said}");
        assert!(said.contains(&format!("{maps} maps of other splits count as test, too")), "{said}");
        assert!(said.contains(&row.sequence), "{said}");
    }

    /// Maps of the dataset of the training counted, even if the model was adapted to them afterwards.
    #[test]
    fn a_model_is_not_evaluated_on_recordings_of_its_adaptation() {
        let folder = tempfile::tempdir().expect("a folder");
        let trained = |name: &str, test: f64| {
            let text = format!("epochs = 1\nstarts = 1\nsplit = {{ test = {test:.1} }}\n");
            let spec = write_file(folder.path(), "training.toml", text);
            let path = folder.path().join(name);
            json_lines(command!("model train --json", undivided_dataset(), "--spec", &spec, "-o", &path));
            radome_models::Model::load(&path).expect("a model")
        };
        let (mut model, of_all) = (trained("model.safetensors", 0.2), trained("of-all.safetensors", 0.0));
        // The list of a model that was adapted to the sequences of its test split.
        model.card.training.seen_sequences = of_all.card.training.seen_sequences;
        let path = folder.path().join("adapted.safetensors");
        let evaluate = || command!("model evaluate --json", &path, undivided_dataset());
        model.save(&path).expect("writable");
        success(evaluate());
        model.card.adapted =
            Some(Adapted { seconds: [9.0; 3], recordings: 3, strength: 1000.0, simulated_maps: 0, held_out: None });
        model.save(&path).expect("writable");
        fails_with(evaluate(), &["of sequences that the model was trained or chosen on or adapted to", "hint: "]);
    }

    /// Two of the scores went to stderr, so that a file of the output lacked them.
    #[test]
    fn all_scores_on_recordings_go_to_stdout() {
        let folder = tempfile::tempdir().expect("a folder");
        let recording = folder.path().join("one.mcap");
        simulate(&fixture("scenes/hall.toml"), "--people 1 --seed 9 --frames 6", &recording);
        let labelled = format!("{}=one", recording.display());
        let model = fixture("models/room-cnn.safetensors");
        let (told, said) = success(command!("model evaluate --thermal-snr-db 20 --model", &model, &labelled));
        for score in ["thermal noise, SNR +20 dB: balanced accuracy ", "without the filter: balanced accuracy "] {
            assert!(told.contains(score) && !said.contains(score), "{told}{said}");
        }
    }

    /// Sequences were divided by seed, and then none of the seeds was in two splits.
    #[test]
    fn verify_finds_the_leak_that_a_training_makes() {
        let verify = command!("dataset verify --by seed", undivided_dataset());
        fails_with(verify, &["leaks between splits", "hint: split = { by = \"seed\" } keeps each seed in one split"]);
        success(command!("dataset verify --by seed", hall_dataset()));
    }

    /// No map is no score.
    #[test]
    fn an_empty_split_has_no_score() {
        let folder = tempfile::tempdir().expect("a folder");
        let spec = write_file(folder.path(), "training.toml", "epochs = 1\nstarts = 1\nsplit = { test = 0.0 }\n");
        let model = folder.path().join("model.safetensors");
        json_lines(command!("model train --json", undivided_dataset(), "--spec", &spec, "-o", &model));
        fails_with(
            command!("model evaluate", &model, undivided_dataset()),
            &["the test split is empty", "12 sequences", "hint: "],
        );
    }

    /// A dataset was taken for a model, and a folder of recordings for a dataset.
    #[test]
    fn inputs_of_another_kind_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let model = fixture("models/room-cnn.safetensors");
        let evaluate = |inputs: &[&Path]| command!("model evaluate", ..inputs);
        fails_with(evaluate(&[hall_dataset()]), &["a folder is no model", "MODEL DATASET"]);
        fails_with(
            &mut evaluate(&[&model, folder.path()]),
            &["neither a dataset nor a recording", "name each recording"],
        );
        let mut mixed = evaluate(&[&model, hall_dataset()]);
        fails_with(mixed.arg("run.mcap=one"), &["a dataset is evaluated by itself", "hint: "]);
        // A name that stands for another format is refused, before any work.
        let named = |name: &str| folder.path().join(name);
        wrong_use_with(
            command!("model train", hall_dataset(), "-o", named("a.onnx")),
            &["a.onnx", "radome model export writes ONNX"],
        );
        wrong_use_with(command!("model export", &model, "-o", named("a.safetensors")), &["end its name in .onnx"]);
        std::fs::write(named("a.onnx"), "x").expect("writable");
        fails_with(command!("model export", named("a.onnx"), "-o", named("b.onnx")), &["an ONNX file can only judge"]);
        std::fs::remove_file(named("a.onnx")).expect("removed");
        // The built-in model is found by its name, and has no ONNX form.
        fails_with(command!("model export room-hqnn -o", named("a.onnx")), &["no ONNX form", "hint: "]);
        assert!(!named("a.onnx").exists());
    }

    /// Command `radome model train` with options, into `model.safetensors` of a folder.
    fn train_command(folder: &Path, options: &[&str]) -> std::process::Command {
        command!("model train", hall_dataset(), "--epochs 1", ..options, "-o", folder.join("model.safetensors"))
    }

    /// A checkpoint beside the output stood for `--overwrite`, and two trainings into one file joined in one checkpoint.
    #[test]
    fn a_training_changes_only_its_own_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let (model, checkpoint) = ("model.safetensors", "model.safetensors.checkpoint");
        let of_other = write_file(folder.path(), model, "another model");
        write_file(folder.path(), checkpoint, "another checkpoint");
        fails_with(train_command(folder.path(), &[]), &["exists already", "--overwrite"]);
        assert_eq!(std::fs::read_to_string(&of_other).expect("reads"), "another model");
        let lock = folder.path().join(format!("{checkpoint}.lock"));
        let held = radome_models::dataset::lock_file(&lock).expect("free");
        fails_with(train_command(folder.path(), &["--overwrite"]), &["another process is at work here"]);
        drop(held);
    }

    /// The model was removed at the end where the checkpoint had its name, and the exit status was 0.
    #[test]
    fn a_checkpoint_is_no_other_file_of_the_training() {
        let folder = tempfile::tempdir().expect("a folder");
        let named = |name: &str| folder.path().join(name).display().to_string();
        let spec = write_file(folder.path(), "training.toml", "starts = 1\n").display().to_string();
        write_file(folder.path(), "weights.safetensors", "weights");
        let manifest = hall_dataset().join("manifest.jsonl").display().to_string();
        for (checkpoint, expected) in [
            (named("model.safetensors"), "are one file"),
            (named("./model.safetensors"), "are one file"),
            (spec.clone(), "input and output at once"),
            (named("weights.safetensors"), "input and output at once"),
            (manifest, "input and output at once"),
        ] {
            let weights = named("weights.safetensors");
            let options = ["--checkpoint", &checkpoint, "--spec", &spec, "--weights", &weights];
            wrong_use_with(train_command(folder.path(), &options), &[expected, "hint: "]);
        }
        let (model, checkpoint) = (folder.path().join("a.lock"), folder.path().join("a"));
        let command = command!("model train", hall_dataset(), "--epochs 1 -o", &model, "--checkpoint", &checkpoint);
        wrong_use_with(command, &["are one file"]);
    }

    /// The model of a training replaced a file that had appeared meanwhile, without `--overwrite`.
    #[test]
    fn a_file_that_appears_during_a_training_stays() {
        let folder = tempfile::tempdir().expect("a folder");
        let (model, checkpoint) = ("model.safetensors", folder.path().join("model.safetensors.checkpoint"));
        let path = folder.path().join(model);
        let command = || command!("model train --json", hall_dataset(), "--epochs 6 -o", &path);
        let mut training = Running::start(command());
        training.stdout.find(0, "an epoch", |_| Some(()));
        write_file(folder.path(), model, "another model");
        assert_eq!(training.wait().code(), Some(1));
        let said = training.stderr.all().join("\n");
        assert!(said.contains("exists already") && said.contains("the training is kept in"), "{said}");
        assert_eq!(std::fs::read_to_string(&path).expect("reads"), "another model");
        assert!(checkpoint.exists());
        std::fs::remove_file(&path).expect("removed");
        // Only the last epoch is trained once more.
        assert!(json_lines(command()).len() <= 2);
        assert!(path.exists() && !checkpoint.exists());
    }

    /// Hints named a file to remove that was no checkpoint, and a command to repeat that failed again.
    #[test]
    fn hints_about_checkpoints_fit() {
        let folder = tempfile::tempdir().expect("a folder");
        let recording = write_file(folder.path(), "a.mcap", "a recording");
        let named = recording.display().to_string();
        let said = failure(train_command(folder.path(), &["--checkpoint", &named]));
        assert!(said.contains("name another file for the checkpoint"), "{said}");
        assert!(!said.contains("carries on") && !said.contains("carrying on"), "{said}");
        assert_eq!(std::fs::read_to_string(&recording).expect("reads"), "a recording");
        let nowhere = folder.path().join("no/folder.checkpoint").display().to_string();
        let (_, told, said) = outcome(train_command(folder.path(), &["--checkpoint", &nowhere]));
        assert!(told.is_empty() && said.contains("does not exist") && said.contains("mkdir"), "{told}{said}");
    }

    /// Options that have no effect, or values beyond any use, were taken without a word.
    #[test]
    fn options_and_values_without_use_are_refused() {
        let model = fixture("models/room-cnn.safetensors");
        let set = hall_dataset().display().to_string();
        let ladder = fixture("ladder/rooms.toml").display().to_string();
        for (arguments, expected) in [
            (vec![set.as_str(), "--no-smoothing"], "each map of a dataset is judged by itself"),
            (vec![set.as_str(), "--skip-refused"], "each map of a dataset is judged by itself"),
            (vec![set.as_str(), "--max-range-m", "2"], "each map of a dataset is judged by itself"),
            (vec!["--ladder", ladder.as_str(), "--max-range-m", "2"], "cannot be used with"),
            (vec!["none.mcap=one", "--split", "test"], "--split names a split of a dataset"),
            (vec!["none.mcap=one", "--thermal-snr-db=-4000"], "expected -100 to 100"),
            (vec!["none.mcap=one", "--thermal-snr-db", "nan"], "expected -100 to 100"),
            (vec!["--ladder", ladder.as_str(), "--split", "test"], "cannot be used with"),
            (vec!["--ladder", ladder.as_str(), "--empty-hours", "0"], "no number of frames"),
        ] {
            let (status, told, said) = outcome(command!("model evaluate --model", &model, ..&arguments));
            assert!(status != Some(0) && told.is_empty() && said.contains(expected), "{arguments:?}: {said}");
        }
        let (status, _, said) = outcome(subcommand("model background none.mcap -o none.json --seconds nan"));
        assert!(status == Some(2) && said.contains("expected a finite number"), "{said}");
    }

    /// `--network` set the head of the file back to two qubits, and nothing was said.
    #[test]
    fn the_head_of_a_file_is_used_with_the_named_network() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = "epochs = 1\nstarts = 1\nmost_training_maps = 40\npooled = [4, 4]\nsplit = { by = \"seed\" }\n\
                    head = { kind = \"circuit\", circuit = { qubits = 4 } }\n";
        let spec = write_file(folder.path(), "training.toml", text).display().to_string();
        json_lines(train_command(folder.path(), &["--json", "--spec", &spec, "--network", "hqnn", "--overwrite"]));
        let model = radome_models::Model::load(&folder.path().join("model.safetensors")).expect("a model");
        assert_eq!(model.card.head.width(), 4);
        let other =
            |network: &str| train_command(folder.path(), &["--spec", &spec, "--overwrite", "--network", network]);
        wrong_use_with(other("estimator_matched"), &["head is set beside the name", "expected none"]);
        // A head without a use was in the card of the model.
        fails_with(other("resnet18"), &["head is set for network resnet18", "expected none"]);
        // In a file, the name of a network is that of its kind.
        write_file(folder.path(), "training.toml", "network = \"frozen_angles\"\n");
        let expected = "network = \"hqnn\" and head = { kind = \"circuit\", frozen = true }";
        fails_with(other("hqnn"), &["`frozen_angles` is a network with a head", expected]);
    }

    /// A file was checked by itself, and refused for epochs that the options replace.
    #[test]
    fn a_file_is_checked_together_with_the_options() {
        let folder = tempfile::tempdir().expect("a folder");
        let text =
            "linear_epochs = 16\nstarts = 1\nmost_training_maps = 40\npooled = [4, 4]\nsplit = { by = \"seed\" }\n";
        let spec = write_file(folder.path(), "training.toml", text);
        let output = folder.path().join("model.safetensors");
        // Without the option there are 15 epochs.
        let alone = command!("model train", hall_dataset(), "--spec", &spec, "-o", &output);
        fails_with(alone, &["training.toml", "linear_epochs is 16"]);
        success(train_command(folder.path(), &["--spec", &spec.display().to_string()]));
    }

    #[test]
    fn impossible_settings_of_augmentation_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        for (augmentation, expected) in [
            ("echo_gain_db = [-7, 7]", "[reference.over_noise]"),
            ("sway = { probability = 2.0 }", "sway.probability"),
            ("echo_gain = [-7, 7]", "echo_gain"),
        ] {
            let spec = write_file(folder.path(), "training.toml", format!("[augmentation]\n{augmentation}\n"));
            let output = folder.path().join("model.safetensors");
            fails_with(command!("model train", hall_dataset(), "--spec", &spec, "-o", &output), &[expected]);
            assert!(!output.exists());
        }
    }

    #[test]
    fn studies_that_cannot_be_run_are_refused_by_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let output = folder.path().join("study");
        let say = |text: &str| {
            let spec = write_file(folder.path(), "study.toml", text);
            failure(command!("model study", &spec, "--dataset", hall_dataset(), "-o", &output))
        };
        let good = "title = \"T\"\ndataset = \"x.toml\"\nseeds = [1]\nvariants = [{ name = \"hqnn\" }]\n";
        for (from, to, expected) in [
            ("\"hqnn\"", "\"hqmm\"", "hqmm"),
            ("seeds = [1]", "seeds = []", "at least one"),
            ("seeds = [1]", "seeds = [2, 1, 2]", "seeds is 2 twice"),
            ("seeds = [1]", "seeds = [1]\nlabel_fractions = [1.0, 0.5, 0.5]", "label_fractions is 0.5 twice"),
            ("seeds = [1]", "seeds = [1]\nsnr_db = [inf]", "snr_db"),
            ("seeds = [1]", "seeds = [1]\nlabel_fractions = [0.0]", "label_fractions"),
            ("seeds = [1]", "seeds = [1]\nlearning_rates = [-1.0]", "learning_rates"),
            ("seeds = [1]", "sedes = [1]", "no study"),
            ("seeds = [1]", "seeds = [1]\ntarget = 2.0", "target is 2"),
            ("\"hqnn\" }]", "\"hqnn\" }]\n[train]\nlabel_fraction = 0.5", "train.label_fraction is 0.5"),
            ("{ name = \"hqnn\" }", "{ name = \"hqnn\" }, { name = \"hqnn\" }", "twice"),
            ("\"hqnn\" }]", "\"resnet18\", head = { kind = \"linear\" } }]", "head of variant resnet18 is set"),
            ("{ name = \"hqnn\" }", "{ name = \"../x\", network = \"hqnn\" }", "letters"),
            (
                "{ name = \"hqnn\" }",
                "{ name = \"q\", head = { kind = \"circuit\", circuit = { qubits = 13 } } }",
                "qubits is 13",
            ),
        ] {
            let said = say(&good.replace(from, to));
            assert!(said.contains(expected), "{to}: {said}");
        }
    }
}
