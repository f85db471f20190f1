//! Former names of commands do what the present ones do.

use radome_tests::{help, long_options, radome};

/// Table of former and present names, which the program reads too.
const TABLE: &str = include_str!("../../cli/src/command/former_names.txt");

/// Options of each command when it had its former name, without those of all commands. Former options that are hidden now are
/// tested one by one below.
const OPTIONS: [(&str, &str); 23] = [
    ("devices", "--json --probe --udev-rules --watch"),
    ("config", "--json --registers"),
    ("emulate", "--faults --from --json --latency-ms --link --loop --on --probe --protocol --seed --speed"),
    ("convert", "--json --overwrite --to"),
    ("repair", "--json --output --overwrite"),
    ("results", "--changes --csv --json --overwrite"),
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
        "--corrections --frames --height-m --json --labels --map --name --output --people --seated --seed --subject --waypoints",
    ),
    ("paths", "--json --margin-db --people --person --preview --seed --time"),
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

fn table() -> Vec<(&'static str, &'static str)> {
    let lines = TABLE.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.split_once(" -> ").unwrap_or_else(|| panic!("no pair: {line}"))).collect()
}

#[test]
fn every_former_name_takes_what_the_present_one_takes_and_what_it_took() {
    let table = table();
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

#[test]
fn former_names_stand_in_no_help() {
    let lists = |help: String, name: &str| help.lines().any(|line| line.starts_with(&format!("  {name} ")));
    for (former, _) in table() {
        let (group, name) = former.split_once(' ').unwrap_or(("", former));
        assert!(!lists(help(group), name), "{former}");
    }
    for group in ["demo", "live", "record", "doctor", "board", "recording", "scene", "dataset", "model", "bench"] {
        assert!(lists(help(""), group), "{}", help(""));
    }
}

#[test]
fn completions_know_the_groups_and_their_commands() {
    let output = radome().args(["completions", "bash"]).output().expect("runs");
    let script = String::from_utf8(output.stdout).expect("text");
    for (_, present) in table() {
        let (group, name) = present.split_once(' ').unwrap_or_else(|| panic!("{present} has no group"));
        // The hidden ones are not completed.
        let is_listed = script.contains(&format!("radome__subcmd__{group},{name})"));
        assert!(is_listed || present == "recording labels", "{present}");
    }
}
