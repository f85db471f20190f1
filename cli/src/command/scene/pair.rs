//! `radome scene pair`.

use crate::dataset::pairing::{Settings, pair};
use crate::output;

/// `radome scene pair`
#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    settings: Settings,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Mirrors a recording and prints the remaining differences.
///
/// # Errors
/// Those of [`pair`].
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let paired = pair(&arguments.settings)?;
    paired.report.print(&arguments.settings.output, &paired.name, paired.maps, arguments.json)
}
