//! Checks imports within and between the crates: no cycle of modules, and no import against the order of the crates.
//!
//! Sources are read as text, without test modules and comments. An import counts for the deepest module that it names.
//! A name that a module re-exports counts as its original module. Two modules of one folder form a cycle if files in or
//! below each import from the other.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use radome_tests::root;

/// Crates, each with the crates that it may import.
const CRATES: [(&str, &[&str]); 6] = [
    ("dsp", &[]),
    ("files", &[]),
    ("driver", &["dsp", "files"]),
    ("sim", &["dsp", "files"]),
    ("models", &["dsp", "files"]),
    ("cli", &["dsp", "files", "driver", "sim", "models"]),
];

/// Segments of a module's path below the crate's root; empty for the root.
type ModulePath = Vec<String>;

/// Sources of a crate without comments and test modules, by module.
struct Sources(BTreeMap<ModulePath, String>);

/// Path in a `use`, and its name in the importing module.
struct Import {
    path: Vec<String>,
    name: String,
}

impl Sources {
    fn read(crate_name: &str) -> Self {
        let (mut found, mut tests) = (BTreeMap::new(), BTreeSet::new());
        read_folder(&root().join(crate_name).join("src"), &[], &mut found, &mut tests);
        found.retain(|path, _| !(0..=path.len()).any(|length| tests.contains(&path[..length])));
        Sources(found)
    }

    /// Path from the root of the crate; `None` for a path into another crate.
    fn absolute(&self, module: &[String], path: &[String]) -> Option<ModulePath> {
        let supers = path.iter().take_while(|segment| *segment == "super").count();
        let crate_root: &[String] = &[];
        let (base, rest) = match path.first()?.as_str() {
            "crate" => (crate_root, &path[1..]),
            "self" => (module, &path[1..]),
            "super" => (&module[..module.len().checked_sub(supers)?], &path[supers..]),
            child if self.0.contains_key(&below(module, child)) => (module, path),
            _ => return None,
        };
        Some([base, rest].concat())
    }

    /// Module that an absolute path names, or the original module of the item at its end.
    fn resolve(&self, target: &[String], exports: &BTreeMap<ModulePath, ModulePath>, depth: usize) -> ModulePath {
        for length in 1..=target.len() {
            if self.0.contains_key(&target[..length]) {
                continue;
            }
            return match exports.get(&target[..length]) {
                Some(source) if depth < 8 => {
                    self.resolve(&[&source[..], &target[length..]].concat(), exports, depth + 1)
                }
                _ => target[..length - 1].to_vec(),
            };
        }
        target.to_vec()
    }

    /// Imports between the children of each parent module.
    fn edges(&self) -> BTreeMap<ModulePath, BTreeMap<String, BTreeSet<String>>> {
        let mut exports = BTreeMap::new();
        for (module, code) in &self.0 {
            for import in uses(code) {
                if let Some(source) = self.absolute(module, &import.path) {
                    exports.insert(below(module, &import.name), source);
                }
            }
        }
        let mut edges: BTreeMap<ModulePath, BTreeMap<String, BTreeSet<String>>> = BTreeMap::new();
        for (module, code) in &self.0 {
            let paths = uses(code).into_iter().map(|import| import.path).chain(inline_paths(code));
            for target in paths.filter_map(|path| self.absolute(module, &path)) {
                let target = self.resolve(&target, &exports, 0);
                let shared = module.iter().zip(&target).take_while(|(a, b)| a == b).count();
                if let (Some(from), Some(to)) = (module.get(shared), target.get(shared)) {
                    let siblings = edges.entry(module[..shared].to_vec()).or_default();
                    siblings.entry(from.clone()).or_default().insert(to.clone());
                }
            }
        }
        edges
    }
}

/// Path of a child of a module.
fn below(parent: &[String], child: &str) -> ModulePath {
    parent.iter().cloned().chain([child.to_owned()]).collect()
}

/// Reads the sources of a folder into `found`, and the paths of test modules into `tests`.
fn read_folder(
    folder: &Path,
    parent: &[String],
    found: &mut BTreeMap<ModulePath, String>,
    tests: &mut BTreeSet<ModulePath>,
) {
    for entry in fs::read_dir(folder).expect("a folder of sources") {
        let path = entry.expect("an entry").path();
        let stem = path.file_stem().expect("a name").to_string_lossy().into_owned();
        if path.is_dir() {
            read_folder(&path, &below(parent, &stem), found, tests);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let is_parent = ["mod", "lib", "main"].contains(&stem.as_str());
            let module = if is_parent { parent.to_vec() } else { below(parent, &stem) };
            let (code, test_modules) = without_tests(&fs::read_to_string(&path).expect("a source"));
            tests.extend(test_modules.into_iter().map(|name| below(&module, &name)));
            found.insert(module, code);
        }
    }
}

/// Removes comments and test modules from a source that rustfmt has formatted. Also returns the names of test modules
/// in separate files.
fn without_tests(text: &str) -> (String, Vec<String>) {
    let (mut code, mut test_modules) = (String::new(), Vec::new());
    let mut lines = text.lines();
    let mut is_test = false;
    while let Some(line) = lines.next() {
        let line = line.split("//").next().unwrap_or_default();
        let item = without_visibility(line);
        if item.starts_with("#[") || item.is_empty() {
            is_test |= item.starts_with("#[cfg(test)]") || item.starts_with("#[cfg(all(test");
            continue;
        }
        match item.strip_prefix("mod ").filter(|_| is_test) {
            Some(name) if name.ends_with(';') => test_modules.push(name.trim_end_matches(';').to_owned()),
            Some(_) => {
                let indent = &line[..line.len() - line.trim_start().len()];
                let end = format!("{indent}}}");
                for line in lines.by_ref() {
                    if line == end {
                        break;
                    }
                }
            }
            None => {
                code.push_str(line);
                code.push('\n');
            }
        }
        is_test = false;
    }
    (code, test_modules)
}

/// Line without `pub`, `pub(crate)` and similar prefixes.
fn without_visibility(line: &str) -> &str {
    let line = line.trim();
    let Some(rest) = line.strip_prefix("pub") else { return line };
    if let Some((_, item)) = rest.strip_prefix('(').and_then(|rest| rest.split_once(") ")) {
        return item;
    }
    rest.strip_prefix(' ').unwrap_or(line)
}

/// All imports by `use`.
fn uses(code: &str) -> Vec<Import> {
    let mut imports = Vec::new();
    let mut lines = code.lines().map(without_visibility);
    while let Some(line) = lines.next() {
        let Some(first) = line.strip_prefix("use ") else { continue };
        let mut tree = first.to_owned();
        while !tree.ends_with(';') {
            let Some(line) = lines.next() else { break };
            tree.push_str(line);
        }
        expand(tree.trim_end_matches(';'), &[], &mut imports);
    }
    imports
}

/// Splits a tree such as `a::{b, c::d as e}` into its paths.
fn expand(tree: &str, prefix: &[String], imports: &mut Vec<Import>) {
    let tree = tree.trim();
    if let Some(inner) = tree.strip_prefix('{').and_then(|tree| tree.strip_suffix('}')) {
        let (mut depth, mut start) = (0, 0);
        for (index, character) in inner.char_indices() {
            match character {
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    expand(&inner[start..index], prefix, imports);
                    start = index + 1;
                }
                _ => {}
            }
        }
        expand(&inner[start..], prefix, imports);
    } else if let Some((head, tail)) = tree.split_once("::").filter(|(head, _)| !head.contains('{')) {
        expand(tail, &below(prefix, head), imports);
    } else if tree == "self" || tree == "*" {
        let name = prefix.last().cloned().unwrap_or_default();
        imports.push(Import { path: prefix.to_vec(), name });
    } else if !tree.is_empty() {
        let (item, name) = tree.split_once(" as ").unwrap_or((tree, tree));
        imports.push(Import { path: below(prefix, item), name: name.to_owned() });
    }
}

/// Paths that begin with `crate` or `super` anywhere in the code, except in `use` items, which [`uses`] reads.
fn inline_paths(code: &str) -> Vec<Vec<String>> {
    let is_part = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
    let mut paths = Vec::new();
    for (start, _) in code.match_indices("crate::").chain(code.match_indices("super::")) {
        let end = code[start..].find(|c: char| !is_part(c)).map_or(code.len(), |length| start + length);
        let path = &code[start..end];
        if !code[..start].ends_with(is_part) && !path.ends_with("::") {
            paths.push(path.split("::").map(str::to_owned).collect());
        }
    }
    paths
}

/// Largest sets of modules that reach each other.
fn cycles(edges: &BTreeMap<String, BTreeSet<String>>) -> Vec<Vec<&str>> {
    let reached = |from: &str| {
        let (mut seen, mut next) = (BTreeSet::new(), vec![from]);
        while let Some(module) = next.pop() {
            for target in edges.get(module).into_iter().flatten() {
                if seen.insert(target.as_str()) {
                    next.push(target);
                }
            }
        }
        seen
    };
    let all: BTreeMap<&str, BTreeSet<&str>> = edges.keys().map(|module| (module.as_str(), reached(module))).collect();
    let mut cycles: Vec<Vec<&str>> = Vec::new();
    for (module, targets) in &all {
        let is_known = cycles.iter().any(|cycle| cycle.contains(module));
        if targets.contains(module) && !is_known {
            cycles.push(
                targets.iter().copied().filter(|target| all.get(target).is_some_and(|t| t.contains(module))).collect(),
            );
        }
    }
    cycles
}

#[test]
fn no_modules_import_each_other() {
    let mut found = Vec::new();
    for (name, _) in CRATES {
        for (parent, edges) in Sources::read(name).edges() {
            for cycle in cycles(&edges) {
                let parent =
                    std::iter::once(name).chain(parent.iter().map(String::as_str)).collect::<Vec<_>>().join("::");
                found.push(format!("{parent}: {}", cycle.join(", ")));
            }
        }
    }
    assert!(found.is_empty(), "modules that import each other:\n    {}", found.join("\n    "));
}

#[test]
fn crates_import_only_those_below_them() {
    for (name, allowed) in CRATES {
        for (module, code) in Sources::read(name).0 {
            for (other, _) in CRATES.iter().filter(|(other, _)| *other != name && !allowed.contains(other)) {
                let path = format!("radome_{other}::");
                assert!(!code.contains(&path), "{name}: {} imports {path}", module.join("::"));
            }
        }
    }
}

/// Asserts that the import reader handles trees, re-exports and test modules.
#[test]
fn a_cycle_by_a_reexport_is_found_and_one_by_tests_is_not() {
    let module = |path: &str, text: &str| {
        let path: ModulePath = path.split("::").filter(|part| !part.is_empty()).map(str::to_owned).collect();
        (path, without_tests(text).0)
    };
    let sources = Sources(BTreeMap::from([
        module("", "mod a;\nmod b;\nmod c;\npub use b::{Item, inner::Other as Renamed};\n"),
        module("a", "use crate::{\n    Renamed, // use crate::c::Comment;\n    c::{self},\n};\n"),
        module("b", "use super::a::Thing;\npub mod inner;\n"),
        module("b::inner", "use super::super::b::Item;\n"),
        module("c", "#[cfg(test)]\nmod tests {\n    use crate::a::Thing;\n}\n"),
    ]));
    let edges = sources.edges();
    let top_level: ModulePath = Vec::new();
    assert_eq!(cycles(&edges[&top_level]), [["a", "b"]]);
    assert!(edges[&top_level]["a"].contains("c"));
}
