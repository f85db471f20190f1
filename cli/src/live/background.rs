//! Background levels of an empty room with fans, curtains, pipes or machines. A map that exceeds them by less than a threshold
//! counts as empty, whatever the network predicts.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use radome_driver::Judge;
use radome_driver::recording::Existing;
use radome_dsp::{Rdm, Waveform};
use radome_files::read;
use serde::{Deserialize, Serialize};

use crate::files;

const FORMAT: u32 = 1;
/// Length limit of captures, bytes: the largest maps have millions of cells.
const LIMIT_BYTES: u64 = 64 << 20;
/// Least number of frames of a capture: about ten seconds at ten per second.
pub const LEAST_FRAMES: usize = 90;
/// Factor on the largest excess in the part of the capture that was not used for the level. It gives the threshold
/// above which a map shows more than the empty room. The second constant is the least threshold, dB over all cells.
const MARGIN: f32 = 3.0;
const LEAST_THRESHOLD_DB: f32 = 60.0;
/// Largest threshold. A room that exceeds it was not empty, or its background does not repeat. Walkers have 300 to 3000
/// dB.
const MOST_THRESHOLD_DB: f32 = 300.0;
/// Largest magnitude of a level, dB: no map has more.
const MOST_LEVEL_DB: f32 = 500.0;
/// Probabilities of empty, one and two for a frame that shows no more than the empty room, since people are sometimes
/// missed.
pub const NOBODY_SEEN: [f32; 3] = [0.96, 0.02, 0.02];

/// Level of an empty room in each cell, as shown by the maps of one model.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Background {
    format: u32,
    /// SHA-256 of the model that the maps are made for.
    model_hash: String,
    /// Waveform of the frames that the maps were made of; older captures have none.
    #[serde(default)]
    waveform: Option<Waveform>,
    /// Greatest range at which people count, m; `None` for the whole room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    max_range_m: Option<f64>,
    doppler: usize,
    range: usize,
    pub frames: usize,
    /// Sum of the excesses over the level above which somebody may be present, dB.
    pub threshold_db: f32,
    /// Highest level of each cell and its neighbours, `[doppler][range]` of the first channel, dB.
    level_db: Vec<f32>,
}

#[derive(Default)]
pub struct Capture {
    maps: Vec<Vec<f32>>,
    doppler: usize,
    range: usize,
}

fn first_channel(map: &Rdm) -> &[f32] {
    map.db.get(..map.shape.doppler * map.shape.range).unwrap_or(&map.db)
}

impl Capture {
    pub fn add(&mut self, map: &Rdm) {
        (self.doppler, self.range) = (map.shape.doppler, map.shape.range);
        self.maps.push(first_channel(map).to_vec());
    }

    /// Computes the level from the first two thirds, and the threshold from the excess in the last third.
    ///
    /// # Errors
    /// Too few maps were captured.
    pub fn finish(self, judge: &Judge, waveform: &Waveform) -> anyhow::Result<Background> {
        let Capture { maps, doppler, range } = self;
        ensure!(
            maps.len() >= LEAST_FRAMES,
            "{} maps of the empty room, expected {LEAST_FRAMES} at least\n\nhint: capture for longer",
            maps.len()
        );
        let (first, last) = maps.split_at(2 * maps.len() / 3);
        let mut highest = vec![f32::MIN; doppler * range];
        for map in first {
            highest.iter_mut().zip(map).for_each(|(highest, cell)| *highest = highest.max(*cell));
        }
        let level_db = with_neighbours(&highest, doppler, range);
        let most_db = last.iter().map(|map| excess_db(map, &level_db)).fold(0.0, f32::max);
        let threshold_db = (MARGIN * most_db).max(LEAST_THRESHOLD_DB);
        if threshold_db > MOST_THRESHOLD_DB {
            bail!(
                "the end of the capture exceeds its beginning by {most_db:.0} dB, summed over the cells of a map, expected at most \
                 {:.0} dB: the room was not empty, or something moves in it that never does so twice in the same way\n\nhint: leave the \
                 room, or capture for longer",
                MOST_THRESHOLD_DB / MARGIN
            );
        }
        let (frames, model_hash, max_range_m) = (maps.len(), judge.model_hash.clone(), judge.max_range_m);
        let waveform = Some(waveform.clone());
        Ok(Background {
            format: FORMAT,
            model_hash,
            waveform,
            max_range_m,
            doppler,
            range,
            frames,
            threshold_db,
            level_db,
        })
    }
}

/// Maximum of each cell and its eight neighbours; velocities wrap around, ranges do not.
fn with_neighbours(cells: &[f32], doppler: usize, range: usize) -> Vec<f32> {
    let neighbourhood_maximum = |d: usize, r: usize| {
        let rows = [(d + doppler - 1) % doppler, d, (d + 1) % doppler];
        let columns = r.saturating_sub(1)..(r + 2).min(range);
        let near = rows.into_iter().flat_map(|row| columns.clone().map(move |column| row * range + column));
        near.filter_map(|i| cells.get(i)).copied().fold(f32::MIN, f32::max)
    };
    (0..doppler * range).map(|i| neighbourhood_maximum(i / range, i % range)).collect()
}

/// Sum of the excesses of cells over the level, dB.
fn excess_db(cells: &[f32], level_db: &[f32]) -> f32 {
    cells.iter().zip(level_db).map(|(cell, level)| (cell - level).max(0.0)).sum()
}

impl Background {
    /// Reads a capture; refuses one of another model or another greatest range.
    ///
    /// # Errors
    /// The file cannot be read, or it was captured with another model or another `--max-range-m`.
    pub fn load(path: &Path, judge: &Judge) -> anyhow::Result<Self> {
        let context = || format!("{} is no capture of an empty room", path.display());
        let text = read(path, LIMIT_BYTES).with_context(|| {
            format!(
                "cannot read {}\n\nhint: radome model background SOURCE -o FILE.json captures an empty room",
                path.display()
            )
        })?;
        let background: Background = serde_json::from_slice(&text).with_context(context)?;
        if background.format != FORMAT {
            bail!("{}: format {}, this program reads {FORMAT}", path.display(), background.format);
        }
        let cells = background.level_db.len();
        if background.doppler.checked_mul(background.range) != Some(cells) || cells == 0 {
            bail!("{}: {cells} cells, expected {} x {}", path.display(), background.doppler, background.range);
        }
        let is_threshold_valid = (LEAST_THRESHOLD_DB..=MOST_THRESHOLD_DB).contains(&background.threshold_db);
        let is_level_valid = |level_db: &f32| level_db.abs() <= MOST_LEVEL_DB;
        if !is_threshold_valid || !background.level_db.iter().all(is_level_valid) {
            bail!(
                "{}: its threshold of {} dB is not {LEAST_THRESHOLD_DB} to {MOST_THRESHOLD_DB} dB, or a level is beyond {MOST_LEVEL_DB} dB: \
                 the file is damaged\n\nhint: radome model background SOURCE -o FILE.json captures the empty room anew",
                path.display(),
                background.threshold_db
            );
        }
        if background.model_hash != judge.model_hash {
            bail!(
                "{} was captured with another model than {}, whose maps are others\n\nhint: radome model background SOURCE --model {} -o \
                 FILE.json captures the empty room anew",
                path.display(),
                judge.model,
                judge.model
            );
        }
        if background.max_range_m != judge.max_range_m {
            let option = |range_m: Option<f64>| {
                range_m.map_or_else(|| "no --max-range-m".to_owned(), |m| format!("--max-range-m {m}"))
            };
            bail!(
                "{} was captured with {}, and {} is given: cells beyond the range hold other noise\n\nhint: capture the empty room anew \
                 with radome model background and the --max-range-m of live, or leave it out of both",
                path.display(),
                option(background.max_range_m),
                option(judge.max_range_m)
            );
        }
        Ok(background)
    }

    /// Checks that the capture is of frames like those of a waveform: the same shape, and ranges and velocities within a
    /// hundredth.
    ///
    /// # Errors
    /// The capture is of another waveform.
    pub fn check_waveform(&self, path: &Path, waveform: &Waveform) -> anyhow::Result<()> {
        let Some(captured) = &self.waveform else { return Ok(()) };
        let is_close = |of: fn(&Waveform) -> f64| (of(captured) / of(waveform) - 1.0).abs() < 0.01;
        let is_alike = captured.shape() == waveform.shape()
            && is_close(Waveform::max_range_m)
            && is_close(Waveform::max_velocity_m_per_s);
        ensure!(
            is_alike,
            "{} was captured with another waveform\n\nhint: radome model background captures the empty room anew",
            path.display()
        );
        Ok(())
    }

    /// Writes the capture atomically.
    ///
    /// # Errors
    /// The file exists and is not to be replaced, or cannot be written.
    pub fn save(&self, path: &Path, existing: Existing) -> anyhow::Result<()> {
        let rounded = Background {
            level_db: self.level_db.iter().map(|level| (level * 100.0).round() / 100.0).collect(),
            ..self.clone()
        };
        files::write_output(path, existing, |file| {
            serde_json::to_writer(file, &rounded).context("cannot write the capture")
        })
    }

    /// Returns whether a map exceeds the level of the empty room by no more than the threshold.
    pub fn explains(&self, map: &Rdm) -> bool {
        (map.shape.doppler, map.shape.range) == (self.doppler, self.range)
            && excess_db(first_channel(map), &self.level_db) <= self.threshold_db
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_wrap_around_in_velocity_and_end_in_range() {
        let mut cells = vec![0.0; 4 * 3];
        cells[0] = 5.0;
        let level = with_neighbours(&cells, 4, 3);
        // Rows 3, 0 and 1; columns 0 and 1.
        assert_eq!(level, [5.0, 5.0, 0.0, 5.0, 5.0, 0.0, 0.0, 0.0, 0.0, 5.0, 5.0, 0.0]);
        assert_eq!(excess_db(&[7.0; 12], &level), 6.0 * 2.0 + 6.0 * 7.0);
    }
}
