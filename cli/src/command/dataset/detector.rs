//! What a classical detector believes of a recording: something to correct by hand, not to train on as it is.
//!
//! Two looks at every frame, each with what stands still taken out: the chirps of the frame, for who walks, by 2-D CFAR in
//! range and Doppler; and the mean chirp of the last seconds, for who sits and breathes, whose slow-time energy over range
//! goes through a CFAR of its own and must be more than what the echo of a wall drifts by. Detections that hang together in range are one person; a weaker group behind another is
//! taken for its echo off the walls.

use std::path::Path;

use anyhow::bail;
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_dsp::cfar::{CellReach, Cfar, CfarMethod, CfarSpec, Detection};
use radome_dsp::rdm::{Channels, SlowTime, StaticRemoval};
use radome_dsp::{Frame, FrameSource, MapStatus, Occupancy, Rdm, RdmProcessor, RdmSpec, SourceEvent};

use super::label::spans_of;

/// Chance that noise alone is somebody, in a cell.
const FALSE_ALARM_RATE: f64 = 1e-6;
/// Rank of the training cell that is the level: targets may fill a quarter of the window.
const RANK: f64 = 0.75;
/// Velocity cells at either side of zero that hold what static removal leaves.
const LEFT_OVERS: usize = 1;
/// Ranges nearer than this are the package's own echo, m.
const NEAREST_M: f64 = 0.25;
/// Cells that make somebody: one alone is a false alarm every few thousand frames.
const LEAST_CELLS: usize = 3;
/// Groups of detections that are farther apart than this are different people, m.
const APART_M: f64 = 0.8;
/// A second group that is weaker than the first by more than this, with the way there and back made good, is its echo, dB.
const ECHO_DB: f64 = 12.0;
/// Time over which frames are asked to agree, s.
const AGREEMENT_S: f64 = 1.5;
/// Length of slow time for who sits still, s: a breath of four seconds is then two cells from zero, clear of the window's
/// main lobe.
const BREATH_S: f64 = 8.0;
/// What breathes returns at least so much of its energy in motion: walls and furniture, whose echo only drifts and jitters,
/// return less.
const LEAST_MOVING_SHARE: f64 = 0.05;

/// Labels for a recording: each with the share of its frames that agreed.
pub fn propose(path: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let mut recording = Recording::open(path)?;
    let waveform = recording.waveform().clone();
    let moving_spec = RdmSpec {
        channels: Channels::IncoherentSum,
        chirp_mean_removal: true,
        static_removal: StaticRemoval::SlowTimeMean,
        ..RdmSpec::default()
    };
    let frames = (BREATH_S / waveform.frame_interval_s()).round().clamp(8.0, 256.0) as usize;
    let still_spec =
        RdmSpec { slow_time: SlowTime::Frames { frames }, static_removal: StaticRemoval::None, ..moving_spec };
    let looks = waveform.shape().rx;
    let mut moving = RdmProcessor::new(&moving_spec, &waveform)?;
    let mut still = RdmProcessor::new(&still_spec, &waveform)?;
    let shape = moving.shape();
    let cfar = Cfar::new(cfar_spec(looks, shape.doppler, shape.range), shape.doppler, shape.range)?;
    // The sum over slow time is of as many looks as there are frames: far more than a threshold needs, and not independent.
    let energy_cfar = Cfar::new(
        CfarSpec {
            guard: reach(0, 2),
            training: reach(0, 8),
            false_alarm_rate: 1e-4,
            ..cfar_spec(looks, 1, shape.range)
        },
        1,
        shape.range,
    )?;

    let (mut map, mut slow_map) = (moving.empty_map(), still.empty_map());
    let mut frame = Frame::zeroed(waveform.shape());
    // Of each frame: when, how many walk, and whether somebody breathes in the window that ends with it.
    let mut looked: Vec<(f64, usize, bool)> = Vec::new();
    loop {
        match recording.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::End => break,
            SourceEvent::Gap(_) => {
                moving.reset();
                still.reset();
            }
            SourceEvent::Frame => {
                let is_map = moving.process(&frame, &mut map)? == MapStatus::Ready;
                let people = if is_map { count(&cfar.detect(&map, 0), &map) } else { 0 };
                let is_slow_map = still.process(&frame, &mut slow_map)? == MapStatus::Ready;
                looked.push((frame.time_s(), people, is_slow_map && breathes(&energy_cfar, &slow_map)));
            }
        }
    }
    if looked.is_empty() {
        bail!("{}: no frame", path.display());
    }
    let believe = |index: usize, (time_s, moving, _): &(f64, usize, bool)| {
        // Who has just left still fills the window of who breathes: it counts where few of its frames held a walker.
        let half = frames / 2;
        let window = looked.get(index.saturating_sub(half)..(index + half).min(looked.len())).unwrap_or(&[]);
        let walked = window.iter().filter(|(_, people, _)| *people > 0).count();
        // At either end of the recording the first and the last whole window answer.
        let slow = (index + half).max(frames - 1).min(looked.len() - 1);
        let breathes = looked.get(slow).is_some_and(|(.., breathes)| *breathes) && 4 * walked <= window.len();
        let people = (*moving).max(usize::from(breathes)).min(2);
        (*time_s, Occupancy::from_index(people).unwrap_or(Occupancy::Two))
    };
    let believed: Vec<(f64, Occupancy)> = looked.iter().enumerate().map(|(index, of)| believe(index, of)).collect();
    let agreed = agree(&believed);
    let mut spans = spans_of(&agreed, waveform.frame_interval_s());
    for span in &mut spans {
        let within = believed.iter().filter(|(time_s, _)| (span.start_s..span.end_s).contains(time_s));
        let (all, same) =
            within.fold((0, 0), |(all, same), (_, class)| (all + 1, same + u32::from(class.name() == span.label)));
        span.who = Some("detector".into());
        span.confidence = Some(f64::from(same) / f64::from(all.max(1)));
    }
    Ok(spans)
}

fn reach(doppler: usize, range: usize) -> CellReach {
    CellReach { doppler, range }
}

fn cfar_spec(looks: usize, doppler: usize, range: usize) -> CfarSpec {
    // A window that fits small maps too.
    let (across, along) = ((doppler.saturating_sub(1) / 2).min(6), (range / 4).min(8));
    let guard = reach(across / 3, along / 4);
    CfarSpec {
        method: CfarMethod::OrderedStatistic { rank: RANK },
        guard,
        training: reach(across - guard.doppler, along.max(1) - guard.range.min(along.max(1) - 1)),
        false_alarm_rate: FALSE_ALARM_RATE,
        looks: looks.clamp(1, 16),
    }
}

/// People among the detections of a frame.
fn count(detections: &[Detection], map: &Rdm) -> usize {
    let zero = map.shape.doppler / 2;
    let moves = |d: &&Detection| d.doppler.abs_diff(zero) > LEFT_OVERS && map.range_m(d.range) >= NEAREST_M;
    let mut cells: Vec<(f64, f64)> = detections
        .iter()
        .filter(moves)
        .map(|d| {
            let range_m = map.range_m(d.range);
            (range_m, f64::from(d.power_db) + 40.0 * range_m.log10())
        })
        .collect();
    if cells.len() < LEAST_CELLS {
        return 0;
    }
    cells.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Groups by range: last range, strongest cell, cells.
    let mut groups: Vec<(f64, f64, usize)> = Vec::new();
    for (range_m, level_db) in cells {
        match groups.last_mut().filter(|(last_m, ..)| range_m - *last_m <= APART_M) {
            Some(group) => *group = (range_m, group.1.max(level_db), group.2 + 1),
            None => groups.push((range_m, level_db, 1)),
        }
    }
    groups.retain(|group| group.2 >= LEAST_CELLS);
    let strongest_db = groups.iter().map(|group| group.1).fold(f64::NEG_INFINITY, f64::max);
    groups.iter().filter(|group| group.1 >= strongest_db - ECHO_DB).count()
}

/// Whether the energy over slow time, less what stands still, stands out at some range and is much of what is there.
fn breathes(cfar: &Cfar, map: &Rdm) -> bool {
    let (range, zero) = (map.shape.range, map.shape.doppler / 2);
    let (mut energy, mut still) = (vec![0.0; range], vec![0.0; range]);
    for (doppler, row) in map.db.chunks_exact(range.max(1)).enumerate() {
        let sums = if doppler.abs_diff(zero) > 1 { &mut energy } else { &mut still };
        sums.iter_mut().zip(row).for_each(|(sum, db)| *sum += 10f64.powf(f64::from(*db) / 10.0));
    }
    let Some(thresholds) = cfar.thresholds(&energy) else { return false };
    let mut cells = energy.iter().zip(&thresholds).zip(&still).enumerate();
    cells.any(|(index, ((energy, threshold), still))| {
        energy > threshold && *energy > LEAST_MOVING_SHARE * (energy + still) && map.range_m(index) >= NEAREST_M
    })
}

/// What most frames within [`AGREEMENT_S`] about each believe.
fn agree(believed: &[(f64, Occupancy)]) -> Vec<(f64, Occupancy)> {
    let half_s = 0.5 * AGREEMENT_S;
    let (mut from, mut to) = (0, 0);
    let mut votes = [0usize; 3];
    let vote = |frame: Option<&(f64, Occupancy)>, votes: &mut [usize; 3], add: bool| {
        if let Some((_, class)) = frame {
            let votes = &mut votes[class.index()];
            *votes = if add { *votes + 1 } else { votes.saturating_sub(1) };
        }
    };
    believed
        .iter()
        .map(|(time_s, own)| {
            while believed.get(to).is_some_and(|(t, _)| *t <= time_s + half_s) {
                vote(believed.get(to), &mut votes, true);
                to += 1;
            }
            while believed.get(from).is_some_and(|(t, _)| *t < time_s - half_s) {
                vote(believed.get(from), &mut votes, false);
                from += 1;
            }
            let most = votes.iter().copied().max().unwrap_or(0);
            // Among equals, what the frame itself says.
            let class = if votes[own.index()] == most {
                Some(*own)
            } else {
                Occupancy::ALL.into_iter().find(|o| votes[o.index()] == most)
            };
            (*time_s, class.unwrap_or(*own))
        })
        .collect()
}
