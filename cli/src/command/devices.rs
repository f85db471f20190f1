use radome_driver::Candidate;
use radome_driver::discover::{self, Accessibility, Belief};

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
            output::text_line(&describe(candidate))?;
        }
    }
    if candidates.is_empty() && !arguments.json {
        eprintln!("nothing found\n\nhint: radome demo needs no board; radome emulate makes one");
    }
    Ok(())
}

fn describe(candidate: &Candidate) -> String {
    let belief = match candidate.belief {
        Belief::Mcu7Serial => "Radar Baseboard MCU7",
        Belief::Mcu7Bulk => "Radar Baseboard MCU7 (bulk transfers)",
        Belief::Deepcraft => "PSoC 6 kit with streaming firmware",
        Belief::KitProg3 => "KitProg3 debug probe",
        Belief::SerialPort => "serial port",
    };
    let state = match &candidate.accessibility {
        Accessibility::Ready => "ready".to_owned(),
        Accessibility::Busy => "busy: another program has it".to_owned(),
        Accessibility::Unknown => "state unknown: try it".to_owned(),
        Accessibility::PermissionDenied { udev_rule } => {
            format!("permission denied\n    hint: put this into /etc/udev/rules.d/70-radome.rules: {udev_rule}")
        }
    };
    let name = candidate.name.as_deref().map(|n| format!(" \"{n}\"")).unwrap_or_default();
    format!("{:20} {belief}{name}: {state}", candidate.path.display())
}
