//! Differences between a mirror and its recording.

use std::fmt::Write;
use std::path::Path;

use anyhow::Context;
use radome_dsp::detect::Detection;
use serde::Serialize;
use serde_json::json;

use super::detections::Detections;
use super::script::PersonTrack;
use super::smooth::{PersonState, Sensor};
use crate::output;

/// Tolerances within which an echo of the mirror belongs to an expected person, m and m/s.
const NEAR_M: f64 = 0.5;
const NEAR_M_PER_S: f64 = 0.6;

/// Statistics of differences.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Spread {
    pub mean: f64,
    pub rms: f64,
    pub p90: f64,
    pub worst: f64,
}

impl Spread {
    fn of(differences: &[f64]) -> Option<Self> {
        let mut sizes: Vec<f64> = differences.iter().map(|d| d.abs()).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        let count = differences.len() as f64;
        Some(Spread {
            mean: differences.iter().sum::<f64>() / count,
            rms: (differences.iter().map(|d| d * d).sum::<f64>() / count).sqrt(),
            p90: sizes.get((0.9 * (count - 1.0)).round() as usize).copied()?,
            worst: sizes.last().copied()?,
        })
    }
}

#[derive(Debug, Clone, Serialize)]
struct Person {
    /// Number of frames whose echo is not merged with a ghost off a wall.
    visible: usize,
    /// Number of frames in which the person was tracked, including bridged ones.
    followed: usize,
    /// Differences of the mirror's echoes from those of the recording, in frames that have both.
    compared: usize,
    range_m: Option<Spread>,
    velocity_m_per_s: Option<Spread>,
    angle_deg: Option<Spread>,
    /// Largest standard deviation of a position, as estimated by the smoother, m.
    sigma_m: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct Report {
    frames: usize,
    people: Vec<Person>,
    /// Number of frames of the mirror in which as many people are in the room as the recording's labels state. Maps of the others
    /// are left out.
    labels_agree: usize,
    tells_direction: bool,
}

impl Report {
    pub fn new(
        tracks: &[PersonTrack],
        real: &[Detections],
        mirror: &[Detections],
        sensor: &Sensor,
        labels_agree: usize,
    ) -> Self {
        let people =
            tracks.iter().filter(|track| !track.path.is_empty()).map(|track| person(track, real, mirror, sensor));
        Report {
            frames: real.len(),
            people: people.collect(),
            labels_agree,
            tells_direction: sensor.measures_direction(),
        }
    }

    /// Prints the report.
    ///
    /// # Errors
    /// Standard output cannot be written.
    pub fn print(&self, folder: &Path, pair: &str, maps: usize, json: bool) -> anyhow::Result<()> {
        if json {
            return output::json_line(&json!({
                "dataset": folder, "pair": pair, "maps": maps, "frames": self.frames,
                "labels_agree": self.labels_agree, "tells_direction": self.tells_direction, "people": self.people,
            }));
        }
        let left_out = if self.labels_agree < self.frames { "; the other frames are left out" } else { "" };
        output::text_line(&format!(
            "{}: {maps} maps of {} frames and their mirror, which has as many people as the labels say in {}{left_out}",
            folder.display(),
            self.frames,
            self.labels_agree
        ))?;
        if self.people.is_empty() {
            return output::text_line("nobody is there");
        }
        output::text_line(&format!(
            "{:>6} {:>8} {:>9} {:>9}  mirror less recording: {:>20} {:>20} {:>20}",
            "person", "visible", "followed", "compared", "range rms/p90/worst", "speed", "angle"
        ))?;
        for (i, person) in self.people.iter().enumerate() {
            let spread = |spread: Option<Spread>, unit: &str| {
                spread.map_or("-".into(), |s| format!("{:.2}/{:.2}/{:.2} {unit}", s.rms, s.p90, s.worst))
            };
            output::text_line(&format!(
                "{:>6} {:>8} {:>9} {:>9}  {:>43} {:>20} {:>20}",
                i + 1,
                person.visible,
                person.followed,
                person.compared,
                spread(person.range_m, "m"),
                spread(person.velocity_m_per_s, "m/s"),
                spread(person.angle_deg, "deg")
            ))?;
        }
        Ok(())
    }
}

/// Compares the echoes of a person in the recording and in the mirror.
fn person(track: &PersonTrack, real: &[Detections], mirror: &[Detections], sensor: &Sensor) -> Person {
    let (mut range, mut speed, mut angle) = (Vec::new(), Vec::new(), Vec::new());
    let (mut visible, mut followed, mut sigma_m) = (0, 0, 0f64);
    for tracklet in &track.tracklets {
        followed += tracklet.states.len();
        for state in &tracklet.states {
            sigma_m = sigma_m.max(state.sigma_m);
            let index = tracklet.echoes.iter().find(|index| index.frame == state.frame);
            let Some(echo) = index.and_then(|index| real.get(index.frame)?.echoes.get(index.echo)) else { continue };
            visible += usize::from(state.is_visible);
            let Some(other) = mirror.get(state.frame).and_then(|detected| echo_near(detected, state, sensor)) else {
                continue;
            };
            range.push(other.range_m - echo.range_m);
            speed.push(sensor.wrap_speed(other.velocity_m_per_s - echo.velocity_m_per_s));
            if let (Some(Some(a)), Some(Some(b))) = (echo.cosines.first(), other.cosines.first()) {
                angle.push((b.asin() - a.asin()).to_degrees());
            }
        }
    }
    Person {
        visible,
        followed,
        compared: range.len(),
        range_m: Spread::of(&range),
        velocity_m_per_s: Spread::of(&speed),
        angle_deg: Spread::of(&angle),
        sigma_m,
    }
}

/// Finds the strongest echo of the mirror near a person's expected one.
fn echo_near<'a>(detected: &'a Detections, state: &PersonState, sensor: &Sensor) -> Option<&'a Detection> {
    let expected = sensor.expected(state);
    let is_near = |echo: &&Detection| {
        (echo.range_m - expected.range_m).abs() < NEAR_M
            && sensor.wrap_speed(echo.velocity_m_per_s - expected.velocity_m_per_s).abs() < NEAR_M_PER_S
    };
    detected.echoes.iter().filter(is_near).max_by(|a, b| a.snr_db.total_cmp(&b.snr_db))
}

/// Formats a line of JSON for each frame in which a person was tracked.
///
/// # Errors
/// A line cannot be formatted.
pub fn track_lines(tracks: &[PersonTrack], frames: &[(u64, f64)]) -> anyhow::Result<String> {
    let mut text = String::new();
    for (i, track) in tracks.iter().enumerate() {
        for state in track.tracklets.iter().flat_map(|s| &s.states) {
            let Some((frame, begin_s)) = frames.get(state.frame) else { continue };
            let line = json!({
                "person": i + 1, "frame": frame, "frame_begins_s": begin_s, "position_m": [state.x, state.y],
                "velocity_m_per_s": [state.vx, state.vy], "sigma_m": state.sigma_m, "snr_db": state.snr_db,
                "visible": state.is_visible,
            });
            writeln!(text, "{line}").context("writing the track")?;
        }
    }
    Ok(text)
}
