//! Tests that former names of commands behave like the present names.

use radome_tests::{help, long_options, outcome, radome, subcommand, success};

/// Page with the table of former and present names. A test of the program compares the program's own list with it.
const PAGE: &str = include_str!("../../docs/commands.md");

/// Options of each command under its former name, without the options that all commands have. [`FORMER_OPTIONS`] lists
/// the former options that are hidden now.
const OPTIONS: [(&str, &str); 23] = [
    ("devices", "--json --probe --udev-rules --watch"),
    ("config", "--json --registers"),
    ("emulate", "--faults --from --json --latency-ms --link --loop --on --probe --protocol --seed --speed"),
    ("convert", "--json --overwrite --to"),
    ("repair", "--json --output --overwrite"),
    ("results", "--changes --json --overwrite"),
    ("labels", "--export --import --json --overwrite --who"),
    (
        "rdm",
        "--across-frames --frame --frames --incoherent --json --output --overwrite --png --preset --remove-static --rx --seed",
    ),
    ("echoes", "--angles --frames --json --output --overwrite --people --reflector --seed"),
    ("dataset label", "--from --json --output --overwrite --propose --span --who"),
    ("simulate", "--frames --json --output --overwrite --people --seed --shard --tolerance-db"),
    ("calibrate", "--base --copies --json --name --output --overwrite --part --people --scene --seed"),
    (
        "dataset pair",
        "--corrections --frames --height-m --json --labels --name --output --people --seated --seed --subject --waypoints",
    ),
    ("paths", "--json --margin-db --people --person --seed --time"),
    ("train", "--checkpoint --epochs --hold-out --json --network --output --overwrite --seed --spec --weights"),
    ("adapt", "--curve --empty --force --json --output --overwrite --simulated"),
    ("background", "--json --model --output --overwrite --seconds --seed"),
    (
        "evaluate",
        "--ablate --empty-hours --fit-smoothing --json --keep --ladder --model --no-smoothing --skip-refused --split \
         --thermal-snr-db",
    ),
    ("study", "--dataset --json --output --report-only --shard"),
    ("export", "--json --output --overwrite"),
    ("models", "--json"),
    (
        "circuit",
        "--depolarising-one-qubit --depolarising-two-qubit --depth --encoding --gradient --json --qubits --readout-flip \
         --repetitions --seed --shots --theta --x",
    ),
    (
        "rcs",
        "--angle-deg --axes-m --azimuth-deg --edge-m --elevation-deg --faces --frequency-hz --height-m --json --material \
         --mesh-edge-m --method --polarisation --radius-m --range-m --rounds --thickness-m --tolerance-db --width-m",
    ),
];

/// Options that were renamed: command, former name and present name.
const FORMER_OPTIONS: [(&str, &str, &str); 3] =
    [("results", "--csv", "--output"), ("paths", "--preview", "--output"), ("dataset pair", "--map", "--preset")];

/// Commands that end at once, by their former names.
const CHEAP: [&str; 5] = [
    "devices --udev-rules",
    "config paper --registers --json",
    "models --json",
    "circuit --x 0.8,2.1 --theta 0.4,-1.2,2,0.7 --json",
    "paths fixtures/scenes/corridor.toml --time 3 --json",
];

fn former_names() -> Vec<(&'static str, &'static str)> {
    let (_, section) = PAGE.split_once("\n## Former names\n").expect("a section");
    let rows = section.lines().filter_map(|line| line.strip_prefix("| `")?.strip_suffix("` |"));
    rows.map(|row| row.split_once("` | `").unwrap_or_else(|| panic!("no pair: {row}"))).collect()
}

/// Status, stdout and stderr of a command line.
fn outcome_of(line: &str) -> (Option<i32>, String, String) {
    outcome(radome().args(line.split(' ')))
}

#[test]
fn every_former_name_takes_what_the_present_one_takes_and_what_it_took() {
    let table = former_names();
    assert_eq!(table.len(), OPTIONS.len());
    for (former, present) in table {
        let (by_former, by_present) = (help(former), help(present));
        assert_eq!(by_former, by_present, "{former} -> {present}");
        assert!(by_present.contains(&format!("radome {present}")), "{by_present}");
        let taken = long_options(&by_present);
        let (_, before) = OPTIONS.iter().find(|(name, _)| *name == former).unwrap_or_else(|| panic!("{former}"));
        for option in before.split_whitespace() {
            assert!(taken.contains(&option), "{former} took {option}; {present} takes {taken:?}");
        }
    }
}

/// Asserts that both names receive their arguments: they refuse the same ones with the same message, and cheap commands
/// print the same.
#[test]
fn former_and_present_names_do_the_same() {
    let table = former_names();
    for (former, present) in &table {
        let refused = outcome_of(&format!("{former} --no-such-option"));
        assert_eq!(refused, outcome_of(&format!("{present} --no-such-option")), "{former}");
        assert!(refused.0 == Some(2) && refused.2.contains("'--no-such-option'"), "{former}: {refused:?}");
    }
    for line in CHEAP {
        let name = line.split(' ').next().unwrap_or_default();
        let (_, present) = table.iter().find(|(former, _)| *former == name).unwrap_or_else(|| panic!("{name}"));
        let told = outcome_of(line);
        assert_eq!(told, outcome_of(&line.replacen(name, present, 1)), "{line}");
        assert!(told.0 == Some(0) && !told.1.is_empty(), "{line}: {told:?}");
    }
}

#[test]
fn former_options_are_taken_for_the_present_ones() {
    for (command, former, present) in FORMER_OPTIONS {
        let known = help(command);
        assert!(!long_options(&known).contains(&former) && long_options(&known).contains(&present), "{known}");
        let (status, _, said) = outcome_of(&format!("{command} {former}"));
        assert!(status == Some(2) && said.contains("a value is required") && said.contains(present), "{said}");
    }
}

#[test]
fn former_names_stand_in_no_help() {
    let lists = |help: String, name: &str| help.lines().any(|line| line.starts_with(&format!("  {name} ")));
    for (former, _) in former_names() {
        let (group, name) = former.split_once(' ').unwrap_or(("", former));
        assert!(!lists(help(group), name), "{former}");
    }
    for group in ["demo", "live", "record", "doctor", "board", "recording", "scene", "dataset", "model", "bench"] {
        assert!(lists(help(""), group), "{}", help(""));
    }
}

#[test]
fn completions_know_the_groups_and_their_commands() {
    let (script, _) = success(subcommand("completions bash"));
    for (_, present) in former_names() {
        let (group, name) = present.split_once(' ').unwrap_or_else(|| panic!("{present} has no group"));
        // Hidden commands are not completed.
        let is_listed = script.contains(&format!("radome__subcmd__{group},{name})"));
        assert!(is_listed || present == "recording labels", "{present}");
    }
}

/// Asserts that file names complete sources, recordings, scenes, models and waveforms.
#[test]
fn completions_offer_files_wherever_one_can_be_named() {
    let (script, _) = success(subcommand("completions zsh"));
    for named in [":source -- ", ":recording -- ", ":recordings -- ", ":inputs -- ", ":scene -- ", ":waveform -- "] {
        let lines: Vec<&str> = script.lines().filter(|line| line.contains(named)).collect();
        assert!(!lines.is_empty(), "{named}");
        assert!(lines.iter().all(|line| line.contains(":_files'")), "{lines:?}");
    }
    for option in ["--model=", "--scene=", "--waveform=", "--from=", "--output="] {
        let lines: Vec<&str> = script.lines().filter(|line| line.contains(option)).collect();
        assert!(!lines.is_empty(), "{option}");
        assert!(lines.iter().all(|line| line.contains(":_files'")), "{lines:?}");
    }
}
