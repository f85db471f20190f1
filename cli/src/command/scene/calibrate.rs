//! `calibrate`: fits a receiver to recordings, and compares simulations with and without it with unseen parts of the
//! recordings.

mod arguments;
mod copies;
mod difference;
mod line;
mod measured;
mod recordings;
mod report;
mod sample;
mod still;

use radome_sim::receiver::Receiver;

pub use self::arguments::Arguments;
use self::copies::Copies;
use self::measured::measure;
use self::recordings::Recordings;
use crate::exit::wrong_use;

/// Fits a receiver to the first part of recordings, and compares simulations with and without it with the rest.
///
/// # Errors
/// A recording, the scene or the base receiver cannot be read, too few frames can be fitted, or the output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(output) = &arguments.output {
        let inputs = arguments.recordings.iter().chain(&arguments.scene).chain(&arguments.base);
        arguments.overwrite.check(output, &inputs.map(std::path::PathBuf::as_path).collect::<Vec<_>>())?;
    }
    if arguments.people.is_some() && arguments.scene.is_none() {
        wrong_use!(
            "--people needs --scene: without one nobody is simulated\n\nhint: name the scene that the recordings show"
        );
    }
    if !(arguments.part > 0.0 && arguments.part < 1.0) {
        wrong_use!("--part is {}, expected a number between 0 and 1", arguments.part);
    }
    if !(1..=10_000).contains(&arguments.copies) {
        wrong_use!("--copies is {}, expected 1 to 10000", arguments.copies);
    }
    let base = match &arguments.base {
        Some(path) => radome_sim::scene::load_receiver(path)?,
        None => Receiver::typical(),
    };
    let recordings = Recordings::open(&arguments.recordings, arguments.part)?;
    let copies = Copies::new(arguments, &recordings.waveform)?;
    let mut measured = measure(arguments, &recordings, &base)?;
    let clutter = still::fit_clutter(&recordings.waveform, &mut measured);
    let gain = match copies.has_scene {
        true => Some(still::fit_level(&recordings.waveform, &copies, &mut measured)?),
        false => None,
    };
    report::round(&mut measured.fit.receiver);
    let line = measured.slow_time.line();
    let real =
        difference::HeldOutMaps::new(&recordings, measured.held_out.channels.clone(), line.map(|line| line.bin))?;
    let before = copies.sample(&base, &real.regions)?;
    let after = copies.sample(&measured.fit.receiver, &real.regions)?;
    if let Some(output) = &arguments.output {
        report::write_receiver(output, &measured.fit.receiver, arguments)?;
    }
    let answer = report::Answer {
        receiver: arguments.output.as_deref(),
        frames_fitted: recordings.frames_fitted(),
        frames_judged: recordings.frames_held_out(),
        copies: arguments.copies,
        fit_residual_lsb: measured.fit.channels.iter().map(|channel| channel.residual_lsb).collect(),
        clutter,
        gain,
        resampled: real.resampled,
        between_real: real.differences_between_recordings(),
        before: real.compare(&before),
        after: real.compare(&after),
        line: copies.has_scene.then(|| line::Lines::new(line, &before.lines, &after.lines)),
    };
    report::print(&answer, arguments.json)
}
