//! Former names of commands, supported for one version. Arguments that begin with one are read as if they had the
//! present name.

use std::ffi::OsString;

/// Former and present names. The help lists no former ones. They work in version 0.1 and are removed with 0.2.
const NAMES: [(&str, &str); 23] = [
    ("devices", "board list"),
    ("config", "board config"),
    ("emulate", "board emulate"),
    ("convert", "recording convert"),
    ("repair", "recording repair"),
    ("results", "recording answers"),
    ("labels", "recording labels"),
    ("rdm", "recording maps"),
    ("echoes", "recording echoes"),
    ("dataset label", "recording label"),
    ("simulate", "scene simulate"),
    ("calibrate", "scene calibrate"),
    ("dataset pair", "scene pair"),
    ("paths", "scene paths"),
    ("train", "model train"),
    ("adapt", "model adapt"),
    ("background", "model background"),
    ("evaluate", "model evaluate"),
    ("study", "model study"),
    ("export", "model export"),
    ("models", "model list"),
    ("circuit", "bench circuit"),
    ("rcs", "bench rcs"),
];

/// Replaces a former command name in the arguments, of which the program's name is the first. Flags before and within
/// the name stay; `help` may precede it.
pub fn with_present_names(arguments: Vec<OsString>) -> Vec<OsString> {
    let words = arguments.iter().enumerate().skip(1).filter_map(|(index, argument)| {
        let argument = argument.to_str().filter(|argument| !argument.starts_with('-'))?;
        Some((index, argument))
    });
    // A name is one word or two.
    let given: Vec<(usize, &str)> = words.skip_while(|(_, word)| *word == "help").take(2).collect();
    let is_former = |former: &str| {
        let mut given = given.iter();
        former.split(' ').all(|word| given.next().is_some_and(|(_, given)| *given == word))
    };
    let Some((former, present)) = NAMES.iter().find(|(former, _)| is_former(former)) else { return arguments };
    let replaced: Vec<usize> = given.iter().take(former.split(' ').count()).map(|(index, _)| *index).collect();
    let mut renamed = Vec::with_capacity(arguments.len() + 1);
    for (index, argument) in arguments.iter().enumerate() {
        if replaced.first() == Some(&index) {
            renamed.extend(present.split(' ').map(OsString::from));
        }
        if !replaced.contains(&index) {
            renamed.push(argument.clone());
        }
    }
    renamed
}

#[cfg(test)]
mod tests {
    use super::*;

    fn renamed(line: &str) -> String {
        let arguments = line.split(' ').map(OsString::from).collect();
        let renamed = with_present_names(arguments);
        renamed.iter().map(|argument| argument.to_str().expect("text")).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn a_former_name_becomes_the_present_one_and_the_rest_stays() {
        for (given, expected) in [
            ("radome devices", "radome board list"),
            ("radome -v rdm x.mcap -o rdm", "radome -v recording maps x.mcap -o rdm"),
            ("radome dataset -v label x.mcap", "radome recording label -v x.mcap"),
            ("radome help dataset pair", "radome help scene pair"),
            ("radome board list", "radome board list"),
            ("radome dataset build label", "radome dataset build label"),
            ("radome live devices", "radome live devices"),
            ("devices --help", "devices --help"),
            ("radome", "radome"),
        ] {
            assert_eq!(renamed(given), expected);
        }
    }

    #[test]
    fn no_name_is_both_former_and_present() {
        for (former, present) in NAMES {
            assert!(!NAMES.iter().any(|(other, _)| *other == present), "{present}");
            assert_eq!(NAMES.iter().filter(|(other, _)| *other == former).count(), 1, "{former}");
        }
    }

    /// Every former name is on the page of commands. The end-to-end tests run every row of that table.
    #[test]
    fn the_page_of_commands_lists_all_former_names() {
        let page = include_str!("../../../docs/commands.md");
        let (_, table) = page.split_once("\n## Former names\n").expect("a section");
        let rows: Vec<_> = table.lines().filter(|line| line.starts_with("| `")).collect();
        assert_eq!(rows, NAMES.map(|(former, present)| format!("| `{former}` | `{present}` |")));
    }
}
