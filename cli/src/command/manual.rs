use std::path::PathBuf;

use anyhow::Context;
use clap_complete::Shell;

use crate::output;

/// `radome completions`
#[derive(clap::Args)]
pub struct CompletionArguments {
    /// Name of the shell
    shell: Shell,
}

/// `radome man`
#[derive(clap::Args)]
pub struct ManArguments {
    /// Folder for radome.1 and a page for each command. Existing pages are replaced
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

/// Prints a script that completes commands and options.
///
/// # Errors
/// Standard output cannot be written.
pub fn completions(arguments: &CompletionArguments, mut program: clap::Command) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut program, "radome", &mut script);
    output::text_line(String::from_utf8_lossy(&script).trim_end())
}

/// Writes manual pages with the text of `--help`, for `man`.
///
/// # Errors
/// The folder cannot be made, or a page cannot be written.
pub fn man(arguments: &ManArguments, program: clap::Command) -> anyhow::Result<()> {
    let folder = &arguments.output;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    clap_mangen::generate_to(program, folder)
        .with_context(|| format!("cannot write manual pages to {}", folder.display()))?;
    message!("manual pages in {}; read one with man -l {}", folder.display(), folder.join("radome.1").display());
    Ok(())
}
