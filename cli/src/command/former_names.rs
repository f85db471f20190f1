//! Former names of commands, which work for one version: arguments that begin with one are read as if they had the present name.

use std::ffi::OsString;

/// Former and present names, one pair a line: `FORMER -> PRESENT`.
const TABLE: &str = include_str!("former_names.txt");

/// Pairs of a former and a present name, each as words.
fn pairs() -> impl Iterator<Item = (Vec<&'static str>, Vec<&'static str>)> {
    let lines = TABLE.lines().filter(|line| !line.starts_with('#'));
    lines
        .filter_map(|line| line.split_once(" -> "))
        .map(|(former, present)| (former.split(' ').collect(), present.split(' ').collect()))
}

/// Arguments of the program, the program's name first, with a former name of a command replaced by the present one. Flags before and
/// within the name stay; `help` may stand before it.
pub fn with_present_names(arguments: Vec<OsString>) -> Vec<OsString> {
    let words = arguments.iter().enumerate().skip(1).filter_map(|(index, argument)| {
        let argument = argument.to_str().filter(|argument| !argument.starts_with('-'))?;
        Some((index, argument))
    });
    // A name is one word or two.
    let given: Vec<(usize, &str)> = words.skip_while(|(_, word)| *word == "help").take(2).collect();
    let is_former = |former: &[&str]| {
        former.len() <= given.len() && former.iter().zip(&given).all(|(word, (_, given))| word == given)
    };
    let Some((former, present)) = pairs().find(|(former, _)| is_former(former)) else { return arguments };
    let replaced: Vec<usize> = given.iter().take(former.len()).map(|(index, _)| *index).collect();
    let mut renamed = Vec::with_capacity(arguments.len() + 1);
    for (index, argument) in arguments.iter().enumerate() {
        if replaced.first() == Some(&index) {
            renamed.extend(present.iter().map(OsString::from));
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
    fn every_line_of_the_table_is_a_pair_and_no_name_is_both_former_and_present() {
        let lines = TABLE.lines().filter(|line| !line.starts_with('#')).count();
        let all: Vec<_> = pairs().collect();
        assert_eq!(all.len(), lines);
        for (former, present) in &all {
            assert!(!all.iter().any(|(other, _)| other == present), "{present:?}");
            assert_eq!(all.iter().filter(|(other, _)| other == former).count(), 1, "{former:?}");
        }
    }
}
