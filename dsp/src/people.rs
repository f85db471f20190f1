//! How many people a frame shows, by a classical detector: what networks are held against.
//!
//! Two looks at every frame, each with what stands still taken out: the chirps of the frame, for who walks, by 2-D CFAR in
//! range and Doppler; and the mean chirp of the last seconds, for who sits and breathes, whose slow-time energy over range
//! goes through a CFAR of its own and must be more than what the echo of a wall drifts by. Detections that hang together in range
//! are one person; a weaker group behind another is taken for its echo off the walls.

use std::collections::VecDeque;

use thiserror::Error;

use crate::cfar::{CellReach, Cfar, CfarError, CfarMethod, CfarSpec, Detection};
use crate::rdm::{Channels, SlowTime, SpecError, StaticRemoval};
use crate::{Frame, MapError, MapStatus, Rdm, RdmProcessor, RdmSpec, Waveform};

/// Chance that noise alone is somebody, in a cell.
const FALSE_ALARM_RATE: f64 = 1e-6;
/// The same in a range of the slow look.
const SLOW_FALSE_ALARM_RATE: f64 = 1e-4;
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
/// Length of slow time for who sits still, s: a breath of four seconds is then two cells from zero, clear of the window's
/// main lobe.
const BREATH_S: f64 = 8.0;
/// What breathes returns at least so much of its energy in motion: walls and furniture, whose echo only drifts and jitters,
/// return less.
const LEAST_MOVING_SHARE: f64 = 0.05;
/// Who has just left still fills the window of who breathes: it counts where at most this share of its frames held a walker.
const MOST_WALKED_SHARE: f64 = 0.25;

/// Frames that no counter can be made for, or that it cannot take.
#[derive(Debug, Error)]
pub enum PeopleError {
    /// No map can be made of such frames.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// No map can be made of this frame.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The detector's window does not fit the maps.
    #[error("{source}\n\nhint: frames of at least 8 chirps and 16 samples can be counted in")]
    Cfar {
        /// Why.
        #[from]
        source: CfarError,
    },
}

/// What a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// People who move within it.
    pub walking: usize,
    /// Whether, in the seconds that end with it, somebody breathes; `false` until there are so many seconds.
    pub breathes: bool,
}

/// Counts people in one frame after the other. Owns its plans, maps and windows.
pub struct PeopleCounter {
    moving: RdmProcessor,
    still: RdmProcessor,
    cfar: Cfar,
    energy_cfar: Cfar,
    map: Rdm,
    slow_map: Rdm,
    /// Of the frames of slow time, whether somebody walked.
    walked: VecDeque<bool>,
    slow_frames: usize,
}

impl PeopleCounter {
    /// For frames of a waveform.
    ///
    /// # Errors
    /// Frames so small that no window of training cells fits their maps.
    pub fn new(waveform: &Waveform) -> Result<Self, PeopleError> {
        let moving_spec = RdmSpec {
            channels: Channels::IncoherentSum,
            chirp_mean_removal: true,
            static_removal: StaticRemoval::SlowTimeMean,
            ..RdmSpec::default()
        };
        let slow_frames = (BREATH_S / waveform.frame_interval_s()).round().clamp(8.0, 256.0) as usize;
        let still_spec = RdmSpec {
            slow_time: SlowTime::Frames { frames: slow_frames },
            static_removal: StaticRemoval::None,
            ..moving_spec
        };
        let looks = waveform.shape().rx;
        let moving = RdmProcessor::new(&moving_spec, waveform)?;
        let still = RdmProcessor::new(&still_spec, waveform)?;
        let shape = moving.shape();
        let cfar = Cfar::new(cfar_spec(looks, shape.doppler, shape.range), shape.doppler, shape.range)?;
        // The sum over slow time is of as many looks as there are frames: far more than a threshold needs, and not independent.
        let energy_spec = CfarSpec {
            guard: reach(0, 2),
            training: reach(0, 8),
            false_alarm_rate: SLOW_FALSE_ALARM_RATE,
            ..cfar_spec(looks, 1, shape.range)
        };
        let energy_cfar = Cfar::new(energy_spec, 1, shape.range)?;
        let (map, slow_map) = (moving.empty_map(), still.empty_map());
        let walked = VecDeque::with_capacity(slow_frames);
        Ok(PeopleCounter { moving, still, cfar, energy_cfar, map, slow_map, walked, slow_frames })
    }

    /// Frames of slow time in which somebody who breathes is looked for.
    pub fn slow_frames(&self) -> usize {
        self.slow_frames
    }

    /// The newest map of who moves: all receivers together, less what stands still.
    pub fn map(&self) -> &Rdm {
        &self.map
    }

    /// Forgets what must not reach across missing frames.
    pub fn reset(&mut self) {
        self.moving.reset();
        self.still.reset();
        self.walked.clear();
    }

    /// Looks at the next frame.
    ///
    /// # Errors
    /// A frame of another shape than the waveform's.
    pub fn look(&mut self, frame: &Frame) -> Result<Seen, PeopleError> {
        let is_map = self.moving.process(frame, &mut self.map)? == MapStatus::Ready;
        let walking = if is_map { count(&self.cfar.detect(&self.map, 0), &self.map) } else { 0 };
        let is_slow_map = self.still.process(frame, &mut self.slow_map)? == MapStatus::Ready;
        let breathes = is_slow_map && breathes(&self.energy_cfar, &self.slow_map);
        if self.walked.len() == self.slow_frames {
            self.walked.pop_front();
        }
        self.walked.push_back(walking > 0);
        Ok(Seen { walking, breathes })
    }

    /// People in the room by what has been seen so far: who walks, or somebody who breathes where nobody has walked for long.
    pub fn people(&self, seen: Seen) -> usize {
        let walked = self.walked.iter().filter(|walked| **walked).count();
        let is_calm = walked as f64 <= MOST_WALKED_SHARE * self.walked.len() as f64;
        seen.walking.max(usize::from(seen.breathes && is_calm)).min(2)
    }
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

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::{SPEED_OF_LIGHT_M_PER_S, WaveformRequest};

    /// Codes of bodies, each a range, a speed and an amplitude in codes, over seeded noise of one code.
    fn frame(waveform: &Waveform, number: u64, bodies: &[(f64, f64, f64)]) -> Frame {
        let shape = waveform.shape();
        let mut frame = Frame::zeroed(shape);
        frame.sequence = number;
        let start_s = number as f64 * waveform.frame_interval_s();
        frame.time_ns = (start_s * 1e9) as u64;
        let mut state = 0x9e37_79b9_7f4a_7c15 ^ (number + 1).wrapping_mul(0xd134_2543_de82_ef95);
        let mut uniform = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state as f64 / u64::MAX as f64
        };
        let samples = shape.samples;
        for (index, code) in frame.codes.iter_mut().enumerate() {
            let (chirp, sample) = (index / samples % shape.chirps, index % samples);
            let t = sample as f64 / waveform.request.sample_rate_hz;
            let slow_s = start_s + chirp as f64 * waveform.chirp_interval_s;
            // Two uniform numbers make one of a normal distribution: Box and Muller.
            let noise = (-2.0 * uniform().max(1e-12).ln()).sqrt() * (TAU * uniform()).cos();
            let echo: f64 = bodies
                .iter()
                .map(|(range_m, speed_m_per_s, codes)| {
                    let delay_s = 2.0 * (range_m + speed_m_per_s * slow_s) / SPEED_OF_LIGHT_M_PER_S;
                    let phase = waveform.centre_frequency_hz() * delay_s + waveform.slope_hz_per_s * delay_s * t;
                    codes * (TAU * phase.fract()).cos()
                })
                .sum();
            *code = (2048.0 + noise + echo).round() as u16;
        }
        frame
    }

    fn counts(bodies: &[(f64, f64, f64)], frames: u64) -> Vec<usize> {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        let mut counter = PeopleCounter::new(&waveform).expect("fits");
        (0..frames)
            .map(|number| {
                let seen = counter.look(&frame(&waveform, number, bodies)).expect("a frame");
                counter.people(seen)
            })
            .collect()
    }

    /// Noise alone is nobody; bodies apart, as strong as their range lets them be, are counted.
    #[test]
    fn bodies_apart_in_range_are_counted() {
        assert!(counts(&[], 40).iter().all(|people| *people == 0));
        assert!(counts(&[(3.0, 0.8, 8.0)], 5).iter().all(|people| *people == 1));
        assert!(counts(&[(2.0, 0.8, 20.0), (4.5, -0.6, 4.0)], 5).iter().all(|people| *people == 2));
    }

    mod hard_cases {
        use super::*;

        /// What stands still is nobody, however strong it is.
        #[test]
        fn walls_are_nobody() {
            assert!(counts(&[(3.0, 0.0, 400.0)], 100).iter().all(|people| *people == 0));
        }

        /// A weak second body far behind the first is its echo off a wall.
        #[test]
        fn an_echo_by_the_wall_is_nobody() {
            assert!(counts(&[(2.0, 0.8, 200.0), (4.0, 0.8, 2.0)], 5).iter().all(|people| *people == 1));
        }

        #[test]
        fn frames_too_small_for_a_window_are_refused() {
            let request = WaveformRequest { samples_per_chirp: 8, chirps_per_frame: 2, ..WaveformRequest::paper() };
            let waveform = Waveform::realise(request).expect("valid");
            if let Err(error) = PeopleCounter::new(&waveform) {
                assert!(error.to_string().contains("hint:"), "{error}");
            }
        }
    }
}
