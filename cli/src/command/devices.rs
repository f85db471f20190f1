use radome_driver::discover;

use crate::output;

/// `radome devices`
#[derive(clap::Args)]
pub struct Arguments {
    /// One object a candidate
    #[arg(long)]
    json: bool,
}

/// Lists what might be a board or its debug probe, and what to do about those that cannot be used.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let candidates = discover::candidates();
    for candidate in &candidates {
        if arguments.json {
            output::json_line(candidate)?;
        } else {
            output::text_line(&candidate.to_string())?;
        }
    }
    if candidates.is_empty() && !arguments.json {
        eprintln!("nothing found\n\nhint: radome demo needs no board; radome emulate makes one");
    }
    Ok(())
}
