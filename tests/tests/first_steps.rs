//! The README's way from nothing to a model of one's own: its very commands.

use std::process::Command;

use radome_tests::{radome, root};

/// Runs the block of the README that begins with this comment, in the source tree, with its folder moved to a temporary one.
#[test]
fn the_readmes_commands_lead_to_a_labelled_recording_and_a_model() {
    let readme = std::fs::read_to_string(root().join("README.md")).expect("a README");
    let start = readme.find("```\n# From nothing to a model").expect("the block") + 4;
    let block = &readme[start..start + readme[start..].find("```").expect("its end")];
    let folder = tempfile::tempdir().expect("a folder");
    let program = radome();
    let commands = block
        .replace("out/first", &folder.path().display().to_string())
        .replace("radome=target/release/radome", &format!("radome={}", program.get_program().to_string_lossy()));
    let output =
        Command::new("sh").arg("-euc").arg(&commands).current_dir(root()).output().expect("a shell that can be run");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{commands}\n{said}\n{}", String::from_utf8_lossy(&output.stderr));
    assert!(folder.path().join("model.safetensors").exists());
    // What `evaluate` and `live` say last.
    assert!(said.contains("balanced accuracy") && said.contains("latency"), "{said}");
}
