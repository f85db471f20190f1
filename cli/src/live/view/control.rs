//! Requests of a page: one JSON object per message, all of them checked here.

use anyhow::{Context, bail, ensure};
use radome_driver::{LabelSpan, Transport};
use radome_dsp::Occupancy;
use serde::Deserialize;

use super::feed::PageId;
use super::label_set::LabelSet;
use super::picture::Selection;
use super::shared::Shared;

/// Longest name of the person who labels, characters.
const MOST_WHO: usize = 60;
/// Largest lag of a page that may label, s.
const MOST_LAG_S: f64 = 3.0;
/// Fastest replay, as a multiple of real time.
const MOST_SPEED: f64 = 1000.0;

/// Message of a page.
#[derive(Debug, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// The page has received a picture and is ready for the next.
    Seen,
    /// Selects the content of this page.
    Look(Selection),
    /// Continues the playback.
    Play,
    /// Pauses the playback.
    Pause,
    /// Sets the speed as a multiple of real time; 0 is as fast as possible.
    Speed { times: f64 },
    /// Seeks the first frame at or after a time.
    Seek { time_s: f64 },
    /// Seeks a frame by its number.
    SeekFrame { sequence: u64 },
    /// Steps forwards, or backwards if negative.
    Step { frames: i64 },
    /// Starts a label at the frame that the page shows; at the newest frame if the page does not say.
    Label { occupancy: Occupancy, who: Option<String>, shown_s: Option<f64> },
    /// Ends the label at the frame that the page shows; at the newest frame if the page does not say.
    Stop { shown_s: Option<f64> },
    /// Changes the start and end of a label.
    Move { id: u64, start_s: f64, end_s: f64 },
    /// Changes the class of a label.
    Relabel { id: u64, occupancy: Occupancy },
    /// Creates a label.
    Add { start_s: f64, end_s: f64, occupancy: Occupancy, who: Option<String> },
    /// Deletes a label.
    Delete { id: u64 },
    /// Undoes the last change of a label.
    Undo,
    /// Redoes the change that was undone.
    Redo,
}

/// Executes the request of a page.
///
/// # Errors
/// The message is malformed, or the request cannot be fulfilled.
pub fn handle(shared: &Shared, page: PageId, text: &str) -> anyhow::Result<()> {
    let command: Command = serde_json::from_str(text).context("this is no message of the page")?;
    match command {
        Command::Seen => shared.feed.acknowledge(page),
        Command::Look(selection) => shared.feed.select(page, selection)?,
        Command::Play => play(shared)?,
        Command::Pause => transport(shared)?.pause(),
        Command::Speed { times } => {
            ensure!((0.0..=MOST_SPEED).contains(&times), "a speed of {times} times, expected 0 to {MOST_SPEED}");
            transport(shared)?.set_speed(times);
        }
        Command::Seek { time_s } => {
            let transport = transport(shared)?;
            ensure!(time_s.is_finite(), "a time must be finite");
            shared.labels.end_before_jump();
            transport.seek_time_s(time_s);
        }
        Command::SeekFrame { sequence } => {
            let transport = transport(shared)?;
            shared.labels.end_before_jump();
            transport.seek_frame(sequence);
        }
        Command::Step { frames } => step(shared, frames)?,
        Command::Label { occupancy, who, shown_s } => {
            let who = labeller(who)?;
            edit_at_shown(shared, shown_s, |labels, time_s| labels.toggle(occupancy, time_s, who))?;
        }
        Command::Stop { shown_s } => edit_at_shown(shared, shown_s, |labels, time_s| {
            labels.stop(time_s);
            Ok(())
        })?,
        Command::Move { id, start_s, end_s } => {
            edit(shared, |labels, _| labels.change(id, |label| (label.start_s, label.end_s) = (start_s, end_s)))?;
        }
        Command::Relabel { id, occupancy } => {
            edit(shared, |labels, _| labels.change(id, |label| label.label = occupancy.name().to_owned()))?;
        }
        Command::Add { start_s, end_s, occupancy, who } => {
            let label = LabelSpan { who: labeller(who)?, ..LabelSpan::new(start_s, end_s, occupancy.name()) };
            edit(shared, |labels, _| labels.add(label))?;
        }
        Command::Delete { id } => edit(shared, |labels, _| labels.delete(id))?,
        Command::Undo => edit(shared, |labels, _| labels.undo())?,
        Command::Redo => edit(shared, |labels, _| labels.redo())?,
    }
    Ok(())
}

/// Returns the controls of the playback; fails if the source is not a recording that is played.
fn transport(shared: &Shared) -> anyhow::Result<&Transport> {
    let playback = shared.about.playback.as_ref();
    Ok(&playback.context("only recordings can be sought, paused and stepped through")?.transport)
}

/// Continues the playback. At the end of the recording, it starts again.
fn play(shared: &Shared) -> anyhow::Result<()> {
    let transport = transport(shared)?;
    if transport.playback().at_end {
        shared.labels.end_before_jump();
    }
    transport.play();
    Ok(())
}

/// Steps forwards, or backwards if negative.
fn step(shared: &Shared, frames: i64) -> anyhow::Result<()> {
    ensure!((-100..=100).contains(&frames), "a step of {frames} frames, expected -100 to 100");
    let transport = transport(shared)?;
    if frames < 0 {
        shared.labels.end_before_jump();
    }
    transport.step(frames);
    Ok(())
}

/// Fails during a seek in a recording: a label would begin or end at the frame that was shown before.
fn check_no_seek(shared: &Shared) -> anyhow::Result<()> {
    let Some(playback) = &shared.about.playback else { return Ok(()) };
    let transport = &playback.transport;
    let is_shown = |time_s| shared.labels.is_near(time_s);
    let is_position_shown = transport.playback().position.is_none_or(|position| is_shown(position.time_s()));
    ensure!(
        !transport.is_seeking() && is_position_shown,
        "the recording is still being sought: press again when its frame is shown"
    );
    Ok(())
}

/// Time at which a label begins or ends: that of the frame that the page shows. A page whose connection stalled shows an old
/// frame, and its request may come seconds after the key was pressed.
fn label_time(shared: &Shared, shown_s: Option<f64>, newest_s: f64) -> anyhow::Result<f64> {
    let Some(shown_s) = shown_s else { return Ok(newest_s) };
    let speed = shared.about.playback.as_ref().map_or(1.0, |playback| playback.transport.playback().speed);
    // At full speed, any number of frames comes between two pictures.
    let most_lag_s = if speed > 0.0 { MOST_LAG_S * speed.max(1.0) } else { f64::INFINITY };
    ensure!(
        (newest_s - shown_s).abs() <= most_lag_s,
        "the page shows the frame at {shown_s:.1} s, and the newest one is at {newest_s:.1} s: press again when the page is up to date"
    );
    Ok(shown_s.min(newest_s))
}

/// Begins or ends a label, by `change`, at the time of [`label_time`].
fn edit_at_shown(
    shared: &Shared,
    shown_s: Option<f64>,
    change: impl FnOnce(&mut LabelSet, f64) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    check_no_seek(shared)?;
    edit(shared, |labels, newest_s| change(labels, label_time(shared, shown_s, newest_s)?))
}

/// Changes the labels, unless they are read-only.
fn edit(shared: &Shared, change: impl FnOnce(&mut LabelSet, f64) -> anyhow::Result<()>) -> anyhow::Result<()> {
    ensure!(
        !shared.about.read_only_labels,
        "labels are read-only here: the program was started with --read-only-labels"
    );
    shared.labels.edit(change)
}

/// Checks and trims the name of the person who labels.
fn labeller(who: Option<String>) -> anyhow::Result<Option<String>> {
    let Some(who) = who else { return Ok(None) };
    if who.chars().count() > MOST_WHO || who.chars().any(char::is_control) {
        bail!("a name of at most {MOST_WHO} characters is expected");
    }
    Ok(Some(who.trim().to_owned()).filter(|who| !who.is_empty()))
}
