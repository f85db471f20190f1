//! Imports point one way: there is no cycle among the folders of the crate, nor among the files of a folder.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Modules, each with those that it imports.
type Graph = BTreeMap<String, BTreeSet<String>>;

/// Finds the source files below a folder, without those of tests.
fn find_sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for path in fs::read_dir(folder).expect("a folder").filter_map(Result::ok).map(|entry| entry.path()) {
        if path.file_stem().is_some_and(|name| name == "tests") {
            continue;
        }
        if path.is_dir() {
            find_sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// Code of a file without comments and without the unit tests at its end.
fn code_of(path: &Path) -> String {
    let text = fs::read_to_string(path).expect("a source file");
    let mut code = String::new();
    let mut lines = text.lines().peekable();
    while let Some(line) = lines.next() {
        let next_is_module = lines.peek().is_some_and(|next| next.starts_with("mod ") && next.ends_with('{'));
        if line.starts_with("#[cfg(") && line.contains("test") && next_is_module {
            break;
        }
        if !line.trim_start().starts_with("//") {
            code.push_str(line);
            code.push('\n');
        }
    }
    code
}

/// First names of the paths behind `crate::` or `super::`: `a` and `b` of `{a, b::c};`.
fn first_names(import: &str) -> Vec<String> {
    let first = |path: &str| path.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let import = import.split(';').next().unwrap_or_default().trim();
    let Some(list) = import.strip_prefix('{') else { return vec![first(import)] };
    let mut depth = 0;
    let paths = list.split(|c: char| {
        depth += i32::from(c == '{') - i32::from(c == '}');
        c == ',' && depth == 0
    });
    paths.map(first).filter(|name| !name.is_empty()).collect()
}

/// Modules that lie on a cycle, or that import such modules.
fn on_cycles(graph: &Graph) -> BTreeSet<&String> {
    let mut left: BTreeSet<&String> = graph.keys().collect();
    loop {
        let is_free = |node: &String| graph[node].iter().all(|to| to == node || !left.contains(&to));
        let free: Vec<&String> = left.iter().copied().filter(|node| is_free(node)).collect();
        if free.is_empty() {
            return left;
        }
        for node in free {
            left.remove(node);
        }
    }
}

#[test]
fn imports_point_one_way() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    find_sources(&source, &mut files);
    let (mut folders, mut within_folders) = (Graph::new(), Graph::new());
    for path in &files {
        let relative = path.strip_prefix(&source).expect("a path below the sources").with_extension("");
        let module = relative.to_string_lossy().replace('\\', "/");
        let (folder, file) = module.rsplit_once('/').unwrap_or(("", module.as_str()));
        let top = module.split('/').next().unwrap_or_default().to_owned();
        if top == "lib" {
            continue;
        }
        let code = code_of(path);
        let imported = code.split("crate::").skip(1).flat_map(first_names).filter(|name| *name != top);
        folders.entry(top.clone()).or_default().extend(imported);
        // A `mod.rs` re-exports the files of its folder.
        if file != "mod" {
            let imported = code.split("use super::").skip(1).flat_map(first_names);
            let imported = imported.map(|name| if folder.is_empty() { name } else { format!("{folder}/{name}") });
            within_folders.entry(module.clone()).or_default().extend(imported);
        }
    }
    assert!(folders.len() > 10 && within_folders.len() > 80, "{} and {}", folders.len(), within_folders.len());
    assert!(folders["train"].contains("network"), "{:?}", folders["train"]);
    assert_eq!(on_cycles(&folders), BTreeSet::new());
    assert_eq!(on_cycles(&within_folders), BTreeSet::new());
}

#[test]
fn a_cycle_is_found() {
    let graph = |edges: &[(&str, &str)]| {
        let mut graph = Graph::new();
        for (from, to) in edges {
            graph.entry((*from).to_owned()).or_default().insert((*to).to_owned());
        }
        graph
    };
    assert!(on_cycles(&graph(&[("a", "b"), ("b", "c"), ("a", "c")])).is_empty());
    assert_eq!(on_cycles(&graph(&[("a", "b"), ("b", "c"), ("c", "b"), ("d", "e")])).len(), 3);
    assert_eq!(first_names("{a, b::{c, d}, e};"), ["a", "b", "e"]);
}
