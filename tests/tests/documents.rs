//! Checks the documentation against the tree and the program: links, paths, commands and their options.
//!
//! Fenced blocks marked `sh` are run. Blocks marked `console` need a board, a network or more than seconds. The test
//! compares their commands and options, and those in the text, with the help.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use radome_tests::{help, long_options, radome, root, subcommands, success};

/// Folders to whose files pages refer by paths from the root.
const FOLDERS: [&str; 11] =
    ["cli", "docs", "driver", "dsp", "files", "fixtures", "fuzz", "models", "packaging", "sim", "tests"];
/// Path segments that stand for any name.
const PLACEHOLDERS: [&str; 2] = ["GROUP", "NAME"];
/// Commands with subcommands.
const GROUPS: [&str; 6] = ["bench", "board", "dataset", "model", "recording", "scene"];
/// Page that leads a new user from the first command to a model.
const FIRST_STEPS: &str = "docs/label-and-adapt.md";
/// Other pages with commands that are run.
const RUN: [&str; 6] =
    ["docs/board.md", "docs/datasets.md", "docs/live.md", "docs/recordings.md", "docs/simulate.md", "docs/train.md"];

/// Markdown file of the tree.
struct Page {
    /// Path from the root.
    path: String,
    /// Text outside of fenced blocks.
    prose: String,
    /// Fenced blocks: language and content.
    blocks: Vec<(String, String)>,
}

impl Page {
    fn parse(path: String, text: &str) -> Self {
        let mut page = Page { path, prose: String::new(), blocks: Vec::new() };
        let mut open: Option<(String, String)> = None;
        for line in text.lines() {
            match (line.strip_prefix("```"), open.take()) {
                (Some(_), Some(block)) => page.blocks.push(block),
                (Some(language), None) => open = Some((language.trim().to_owned(), String::new())),
                (None, Some((language, content))) => open = Some((language, content + line + "\n")),
                (None, None) => {
                    page.prose.push_str(line);
                    page.prose.push('\n');
                }
            }
        }
        assert!(open.is_none(), "{}: a block has no end", page.path);
        assert!(page.prose.matches('`').count().is_multiple_of(2), "{}: a code span has no end", page.path);
        page
    }

    fn folder(&self) -> &Path {
        Path::new(&self.path).parent().unwrap_or(Path::new(""))
    }

    /// Code within the text, each span on one line.
    fn spans(&self) -> Vec<String> {
        let spans = self.prose.split('`').skip(1).step_by(2);
        spans.map(|span| span.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
    }

    /// Link and picture targets within the tree.
    fn links(&self) -> Vec<&str> {
        let targets = |opening: &'static str, closing: char| {
            let rests = self.prose.split(opening).skip(1);
            rests.filter_map(move |rest| rest.split_once(closing)).map(|(target, _)| target)
        };
        let all = targets("](", ')').chain(targets("src=\"", '"'));
        all.filter(|target| !target.contains("://")).collect()
    }

    /// Arguments of the program's commands in text and blocks.
    fn commands(&self) -> Vec<Vec<String>> {
        let mut lines = self.spans();
        for (language, content) in &self.blocks {
            let of_block: Vec<String> = content.replace("\\\n", " ").lines().map(str::to_owned).collect();
            let is_command = language == "sh" || language == "console";
            let is_stray = |line: &String| !is_command && command(line).is_some();
            assert!(!of_block.iter().any(is_stray), "{}: mark this block sh or console:\n{content}", self.path);
            lines.extend(of_block);
        }
        lines.iter().filter_map(|line| command(line)).collect()
    }

    /// Content of the blocks that are run.
    fn script(&self) -> String {
        self.blocks.iter().filter(|(language, _)| language == "sh").map(|(_, content)| content.as_str()).collect()
    }
}

/// Words of a command line after the name of the program; `None` for other lines.
fn command(line: &str) -> Option<Vec<String>> {
    let line = line.trim();
    let line = line.strip_prefix("$ ").unwrap_or(line);
    let starts = ["radome ", "$radome ", "cargo run --release -- "];
    let rest = starts.iter().find_map(|start| line.strip_prefix(start))?;
    let words = rest.split_whitespace().take_while(|word| !["&&", "|", ">", "#"].contains(word));
    Some(words.map(|word| word.trim_end_matches(';').to_owned()).collect())
}

/// Anchors of the headings of a page, as GitHub makes them.
fn anchors(text: &str) -> BTreeSet<String> {
    let anchor = |heading: &str| -> String {
        let heading = heading.trim_start_matches('#').trim().to_lowercase();
        let kept = heading.chars().filter(|c| c.is_alphanumeric() || [' ', '-', '_'].contains(c));
        kept.map(|c| if c == ' ' { '-' } else { c }).collect()
    };
    text.lines().filter(|line| line.starts_with('#')).map(anchor).collect()
}

fn find_pages(folder: &str, pages: &mut Vec<Page>) {
    for entry in fs::read_dir(root().join(folder)).expect("a folder") {
        let entry = entry.expect("an entry");
        let name = entry.file_name().to_string_lossy().into_owned();
        let path = if folder.is_empty() { name.clone() } else { format!("{folder}/{name}") };
        if entry.file_type().expect("a kind").is_dir() {
            // Hidden folders and those in .gitignore are not part of the tree.
            if !name.starts_with('.') && !["target", "out", "corpus", "artifacts", "log"].contains(&name.as_str()) {
                find_pages(&path, pages);
            }
        } else if name.ends_with(".md") {
            let text = fs::read_to_string(entry.path()).expect("a page");
            pages.push(Page::parse(path, &text));
        }
    }
}

/// All pages of the tree, ordered by path.
fn pages() -> Vec<Page> {
    let mut pages = Vec::new();
    find_pages("", &mut pages);
    pages.sort_by(|a, b| a.path.cmp(&b.path));
    assert!(pages.iter().any(|page| page.path == FIRST_STEPS) && pages.iter().any(|page| page.path == "README.md"));
    pages
}

fn page(path: &str) -> Page {
    pages().into_iter().find(|page| page.path == path).unwrap_or_else(|| panic!("no {path}"))
}

/// Runs the blocks of a page that are marked `sh` in the source tree, with `out/` redirected to `folder`. Returns
/// stdout.
fn run_blocks(page: &Page, folder: &Path) -> String {
    let program = PathBuf::from(radome().get_program());
    let commands = page
        .script()
        .replace("out/", &format!("{}/", folder.display()))
        .replace("radome=target/release/radome", &format!("radome={}", program.display()));
    let mut paths = vec![program.parent().expect("a folder").to_owned()];
    paths.extend(std::env::split_paths(&std::env::var_os("PATH").unwrap_or_default()));
    let output = Command::new("sh")
        .arg("-euc")
        .arg(&commands)
        .current_dir(root())
        .env("PATH", std::env::join_paths(paths).expect("folders"))
        .output()
        .expect("a shell that can be run");
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let path = &page.path;
    assert!(output.status.success(), "{path}:\n{commands}\n{said}\n{}", String::from_utf8_lossy(&output.stderr));
    said
}

#[test]
fn links_lead_to_files_and_headings() {
    let (mut count, mut wrong) = (0, Vec::new());
    for page in pages() {
        for link in page.links() {
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() { root().join(&page.path) } else { root().join(page.folder()).join(file) };
            let has_anchor =
                anchor.is_empty() || fs::read_to_string(&target).is_ok_and(|text| anchors(&text).contains(anchor));
            if !target.exists() || !has_anchor {
                wrong.push(format!("{}: {link}", page.path));
            }
            count += 1;
        }
    }
    assert!(wrong.is_empty(), "links to no file or heading:\n{}", wrong.join("\n"));
    assert!(count > 40, "{count} links found");
}

#[test]
fn the_readme_links_every_page_of_docs() {
    let readme = page("README.md");
    let linked: BTreeSet<&str> = readme.links().into_iter().collect();
    for page in pages().iter().filter(|page| page.folder() == Path::new("docs")) {
        assert!(linked.contains(page.path.as_str()), "README.md does not link {}", page.path);
    }
}

#[test]
fn paths_in_the_text_exist() {
    let (mut count, mut wrong) = (0, Vec::new());
    for page in pages() {
        for span in page.spans() {
            let (folder, _) = span.split_once('/').unwrap_or_default();
            let is_plain = span.chars().all(|c| c.is_ascii_alphanumeric() || "./_-".contains(c));
            let is_placeholder = PLACEHOLDERS.iter().any(|placeholder| span.contains(placeholder));
            if !FOLDERS.contains(&folder) || !is_plain || is_placeholder {
                continue;
            }
            if !root().join(&span).exists() && !root().join(page.folder()).join(&span).exists() {
                wrong.push(format!("{}: {span}", page.path));
            }
            count += 1;
        }
    }
    assert!(wrong.is_empty(), "paths that do not exist:\n{}", wrong.join("\n"));
    assert!(count > 100, "{count} paths found");
}

/// Asserts that a command and its options appear in the help, which excludes former names.
fn check_command(place: &str, words: &[String], helps: &mut BTreeMap<String, String>) {
    let is_name = |word: &str| word.chars().all(|c| c.is_ascii_lowercase());
    let Some(first) = words.first().filter(|word| is_name(word)) else { return };
    let second = words.get(1).filter(|word| GROUPS.contains(&first.as_str()) && is_name(word));
    let name = second.map_or_else(|| first.clone(), |second| format!("{first} {second}"));
    let help = helps.entry(name.clone()).or_insert_with(|| help(&name));
    assert!(help.contains(&format!("radome {name}")), "{place}: {name} is a former name");
    let known = long_options(help);
    for option in words.iter().filter(|word| word.starts_with("--")) {
        let option = option.split('=').next().unwrap_or_default();
        assert!(known.contains(&option), "{place}: {name} has no {option}: {known:?}");
    }
}

#[test]
fn commands_and_options_are_those_of_the_program() {
    let mut helps: BTreeMap<String, String> = BTreeMap::new();
    for page in pages() {
        for words in page.commands() {
            check_command(&page.path, &words, &mut helps);
        }
    }
    assert!(helps.len() > 25, "{:?}", helps.keys());
}

#[test]
fn examples_in_helps_are_commands_of_the_program() {
    let mut helps: BTreeMap<String, String> = BTreeMap::new();
    for name in ["", "live", "record", "recording label", "model adapt"] {
        let text = help(name);
        let examples: Vec<_> = text.lines().filter(|line| line.starts_with("  ")).filter_map(command).collect();
        assert!(examples.len() >= 2, "{name}: {text}");
        for words in examples {
            check_command(&format!("help of {name:?}"), &words, &mut helps);
        }
    }
}

/// Names of commands as the program takes them, without groups.
fn all_commands() -> BTreeSet<String> {
    let mut known = BTreeSet::from(["bench".to_owned()]);
    for command in subcommands(&help("")) {
        let below = if GROUPS.contains(&command) { help(command) } else { String::new() };
        match subcommands(&below).as_slice() {
            [] => known.extend([command.to_owned()]),
            names => known.extend(names.iter().map(|name| format!("{command} {name}"))),
        }
    }
    known
}

/// Values of options were called by the option, by a unit, OUTPUT or a kind of file.
#[test]
fn values_of_options_are_named_by_unit_or_kind_of_file() {
    let units = [("-s", "SECONDS"), ("-ms", "MS"), ("-db", "DB"), ("-m", "METRES"), ("-deg", "DEGREES"), ("-hz", "HZ")];
    for command in all_commands() {
        let text = help(&command);
        for line in text.lines().filter(|line| line.trim_start().starts_with('-')) {
            let Some((option, value)) = line.split_once(" <").and_then(|(o, v)| Some((o, v.split_once('>')?.0))) else {
                continue;
            };
            let place = format!("{command}: {}<{value}>", option.trim_start());
            for (_, unit) in units.iter().filter(|(ending, _)| option.ends_with(*ending)) {
                assert!(value.split(',').next() == Some(*unit), "{place}");
            }
            let is_output = option.ends_with("--output");
            assert!(!is_output || value.starts_with("FILE") || value.starts_with("DIR"), "{place}");
            assert!(!["FOLDER", "PNG", "SCENE", "SPEC"].contains(&value), "{place}");
        }
    }
}

#[test]
fn the_table_of_commands_is_that_of_the_program() {
    let page = page("docs/commands.md");
    // The tables of later sections list other things.
    let listed: BTreeSet<String> = page
        .prose
        .lines()
        .take_while(|line| !line.starts_with("## "))
        .filter_map(|line| line.strip_prefix("| `")?.split(" | ").next())
        .flat_map(|cell| cell.split('`').step_by(2))
        .filter(|name| !name.is_empty())
        .map(str::to_owned)
        .collect();
    assert_eq!(listed, all_commands());
}

#[test]
fn the_first_steps_lead_to_a_labelled_recording_and_a_model() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = page(FIRST_STEPS);
    assert!(page.script().contains("# From nothing to a model"), "{}", page.script());
    let said = run_blocks(&page, folder.path());
    assert!(folder.path().join("first/model.safetensors").exists());
    // `evaluate` and `live` end with these lines.
    assert!(said.contains("balanced accuracy") && said.contains("latency"), "{said}");
}

#[test]
fn the_commands_of_all_other_pages_succeed() {
    let folder = tempfile::tempdir().expect("a folder");
    let with_scripts: Vec<Page> = pages().into_iter().filter(|page| !page.script().is_empty()).collect();
    let run: Vec<&Page> = with_scripts.iter().filter(|page| page.path != FIRST_STEPS).collect();
    assert_eq!(run.iter().map(|page| page.path.as_str()).collect::<Vec<_>>(), RUN);
    for page in run {
        run_blocks(page, folder.path());
    }
    let made =
        "live/night.csv recordings/map.png simulate/bedroom.png datasets/array.sh train/array.sh train/paper-hqnn.onnx";
    for made in made.split(' ') {
        assert!(folder.path().join(made).exists(), "{made}");
    }
}

/// Asserts that the program reads the blocks of `docs/rooms.md`: a scene, an absent file, a box in place of the scene's
/// plan, and a material.
#[test]
fn the_toml_files_on_pages_are_read_by_the_program() {
    let toml = |path: &str| -> Vec<String> {
        page(path).blocks.into_iter().filter(|(language, _)| language == "toml").map(|(_, content)| content).collect()
    };
    let folder = tempfile::tempdir().expect("a folder");
    let run = |command: &str, name: &str, text: &str, options: &[&str]| {
        fs::write(folder.path().join(name), text).expect("a file");
        let arguments = command.split(' ').chain([name]).chain(options.iter().copied());
        success(radome().current_dir(folder.path()).args(arguments));
    };
    let board = toml("docs/board.md");
    run("board config", "waveform.toml", board.first().expect("a waveform"), &[]);
    let rooms = toml("docs/rooms.md");
    let [office, _, cuboid, oak] = &rooms[..] else { panic!("{} blocks in docs/rooms.md", rooms.len()) };
    let (head, rest) = office.split_once("[room]\n").expect("a room");
    let (_, tail) = rest.split_once("[[furniture]]").expect("furniture");
    let cuboid = format!("{head}{cuboid}{oak}[[furniture]]{tail}").replace("concrete", "oak");
    for (name, text) in [("office.toml", office), ("box.toml", &cuboid)] {
        run("scene simulate", name, text, &["--frames", "2", "-o", &format!("{name}.mcap")]);
    }
}

#[test]
fn blocks_spans_links_and_commands_are_found() {
    let text = "# A *page*, of two parts\n`radome live\nSOURCE --json` and [a link](x.md#y), <img src=\"p.png\">\n\
                ```console\n$ radome board list \\\n  --watch && ls\n```\n";
    let page = Page::parse("docs/page.md".to_owned(), text);
    assert_eq!(page.links(), ["x.md#y", "p.png"]);
    assert_eq!(page.commands(), [vec!["live", "SOURCE", "--json"], vec!["board", "list", "--watch"]]);
    assert_eq!(anchors(text), BTreeSet::from(["a-page-of-two-parts".to_owned()]));
    assert_eq!((page.folder(), page.script()), (Path::new("docs"), String::new()));
}
