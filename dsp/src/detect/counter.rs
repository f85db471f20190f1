//! Classical counter of people, the baseline of networks.
//!
//! Each frame has two maps, both without static echoes. The map over the chirps of the frame shows people who walk, by
//! 2-D CFAR in range and Doppler. The map over the mean chirps of the last seconds shows people who sit and breathe.
//! Its slow-time energy must exceed a CFAR threshold along range, and the drift of a wall's echo. Detections that are
//! close in range count as one person. A weaker group behind a stronger one counts as an echo of the stronger one off
//! the walls.

use std::collections::VecDeque;

use thiserror::Error;

use super::cfar::{CellDetection, CellReach, Cfar, CfarError, CfarSpec};
use crate::rdm::{Channels, SlowTime, SpecError, StaticRemoval};
use crate::{Frame, FrameMismatch, MapStatus, Rdm, RdmProcessor, RdmSpec, Waveform};

/// False-alarm rate in a cell of the map over chirps.
const FALSE_ALARM_RATE: f64 = 1e-6;
/// False-alarm rate in a range bin of the energy over slow time.
const SLOW_FALSE_ALARM_RATE: f64 = 1e-4;
/// Rank of the training cell that is the level; targets may fill a quarter of the window.
const RANK: f64 = 0.75;
/// Velocity cells on either side of zero that hold the residue of static removal.
const RESIDUE_CELLS: usize = 1;
/// Least number of cells of a person: a single cell is a false alarm every few thousand frames.
const LEAST_CELLS: usize = 3;
/// Distance above which groups of detections are different people, m.
const APART_M: f64 = 0.8;
/// Difference of level, corrected for range, above which a weaker group is a multipath ghost of the strongest, dB.
const GHOST_DB: f64 = 12.0;
/// Length of slow time for people who sit still, s. A breath of four seconds is then two cells from zero, outside of
/// the window's main lobe.
const BREATH_S: f64 = 8.0;
/// Least share of energy in motion in the echo of a person who breathes. Walls and furniture, whose echo only drifts and jitters,
/// return less.
const LEAST_MOVING_SHARE: f64 = 0.05;
/// Largest share of frames with a walker in the window in which breathing counts: a person who has just left still fills it.
const MOST_WALKED_SHARE: f64 = 0.25;

/// Error of a counter.
#[derive(Debug, Error)]
pub enum CounterError {
    /// Frames of the waveform have no map.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The frame does not fit the waveform.
    #[error(transparent)]
    Frame(#[from] FrameMismatch),
    /// The detector's window does not fit the maps.
    #[error("{0}\n\nhint: people can be counted in frames of at least 20 samples and 2 chirps")]
    Cfar(#[from] CfarError),
}

/// Observation of people in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Observation {
    /// Number of people who move within the frame.
    pub walking: usize,
    /// Whether a person breathes in the seconds that end with the frame; `false` until that time has passed.
    pub breathes: bool,
}

/// Counter of people by CFAR detection, frame by frame. Owns its plans, maps and windows.
///
/// ```
/// use radome_dsp::detect::CfarCounter;
/// use radome_dsp::{Frame, Waveform, WaveformRequest};
///
/// let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
/// let mut counter = CfarCounter::new(&waveform)?;
/// let observation = counter.observe(&Frame::zeroed(waveform.shape()))?;
/// assert_eq!(counter.people(observation), 0);
/// # Ok::<(), radome_dsp::detect::CounterError>(())
/// ```
pub struct CfarCounter {
    moving: RdmProcessor,
    still: RdmProcessor,
    cfar: Cfar,
    energy_cfar: Cfar,
    map: Rdm,
    slow_map: Rdm,
    /// Whether a person walked, for each of the frames of slow time.
    walked: VecDeque<bool>,
    slow_frames: usize,
    max_range_m: f64,
}

impl CfarCounter {
    /// Range below which echoes come from the package itself, m. People nearer than this are not counted.
    pub const NEAREST_M: f64 = 0.25;

    /// Creates the counter for frames of a waveform.
    ///
    /// # Errors
    /// [`CounterError::Spec`] if frames of the waveform have no map, as those of one chirp, and [`CounterError::Cfar`] if the
    /// window of training cells does not fit their maps, as with fewer than 20 samples.
    pub fn new(waveform: &Waveform) -> Result<Self, CounterError> {
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
        // The sum over slow time has as many looks as there are frames: far more than a threshold needs, and not independent.
        let energy_spec = CfarSpec {
            guard: reach(0, 2),
            training: reach(0, 8),
            false_alarm_rate: SLOW_FALSE_ALARM_RATE,
            ..cfar_spec(looks, 1, shape.range)
        };
        let energy_cfar = Cfar::new(energy_spec, 1, shape.range)?;
        let (map, slow_map) = (moving.empty_map(), still.empty_map());
        let walked = VecDeque::with_capacity(slow_frames);
        Ok(CfarCounter {
            moving,
            still,
            cfar,
            energy_cfar,
            map,
            slow_map,
            walked,
            slow_frames,
            max_range_m: f64::INFINITY,
        })
    }

    /// Counts only people whose echoes are nearer than this or at it, m.
    pub fn up_to(self, max_range_m: f64) -> Self {
        CfarCounter { max_range_m, ..self }
    }

    /// Number of frames of slow time in which breathing is detected.
    pub fn slow_frames(&self) -> usize {
        self.slow_frames
    }

    /// Newest map over chirps: mean power of all receivers, without static echoes.
    pub fn map(&self) -> &Rdm {
        &self.map
    }

    /// Resets the state between frames. Call it where frames are missing.
    pub fn reset(&mut self) {
        self.moving.reset();
        self.still.reset();
        self.walked.clear();
    }

    /// Observes the next frame.
    ///
    /// # Errors
    /// [`CounterError::Frame`] if the frame's shape is not the waveform's, or if the number of its codes is not that of its
    /// shape.
    pub fn observe(&mut self, frame: &Frame) -> Result<Observation, CounterError> {
        let is_map = self.moving.process(frame, &mut self.map)? == MapStatus::Ready;
        let walking = if is_map { count(&self.cfar.detect(&self.map, 0), &self.map, self.max_range_m) } else { 0 };
        let is_slow_map = self.still.process(frame, &mut self.slow_map)? == MapStatus::Ready;
        let breathes = is_slow_map && breathes(&self.energy_cfar, &self.slow_map, self.max_range_m);
        if self.walked.len() == self.slow_frames {
            self.walked.pop_front();
        }
        self.walked.push_back(walking > 0);
        Ok(Observation { walking, breathes })
    }

    /// Number of people in the room, at most 2, from this observation and the previous frames. A person who breathes
    /// counts as one if nobody walks and few of the previous frames contained a walker.
    pub fn people(&self, observation: Observation) -> usize {
        let walked = self.walked.iter().filter(|walked| **walked).count();
        let is_calm = walked as f64 <= MOST_WALKED_SHARE * self.walked.len() as f64;
        observation.walking.max(usize::from(observation.breathes && is_calm)).min(2)
    }
}

fn reach(doppler: usize, range: usize) -> CellReach {
    CellReach { doppler, range }
}

fn cfar_spec(looks: usize, doppler: usize, range: usize) -> CfarSpec {
    // The window fits small maps too.
    let (across, along) = ((doppler.saturating_sub(1) / 2).min(6), (range / 4).min(8));
    let guard = reach(across / 3, along / 4);
    CfarSpec {
        rank: RANK,
        guard,
        training: reach(across - guard.doppler, along.max(1) - guard.range.min(along.max(1) - 1)),
        false_alarm_rate: FALSE_ALARM_RATE,
        looks: looks.clamp(1, 16),
    }
}

/// Counts people among the detections of a frame, up to a range.
fn count(detections: &[CellDetection], map: &Rdm, max_range_m: f64) -> usize {
    let zero = map.shape.doppler / 2;
    let is_in_range = |range: usize| (CfarCounter::NEAREST_M..=max_range_m).contains(&map.range_m(range));
    let moves = |d: &&CellDetection| d.doppler.abs_diff(zero) > RESIDUE_CELLS && is_in_range(d.range);
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
    groups.iter().filter(|group| group.1 >= strongest_db - GHOST_DB).count()
}

/// Returns whether the energy over slow time, without static echoes, exceeds its threshold and its least share at some range up to
/// the greatest one.
fn breathes(cfar: &Cfar, map: &Rdm, max_range_m: f64) -> bool {
    let (range, zero) = (map.shape.range, map.shape.doppler / 2);
    let (mut energy, mut still) = (vec![0.0; range], vec![0.0; range]);
    for (doppler, row) in map.db.chunks_exact(range.max(1)).enumerate() {
        let sums = if doppler.abs_diff(zero) > 1 { &mut energy } else { &mut still };
        sums.iter_mut().zip(row).for_each(|(sum, db)| *sum += 10f64.powf(f64::from(*db) / 10.0));
    }
    let Some(thresholds) = cfar.thresholds(&energy) else { return false };
    let mut cells = energy.iter().zip(&thresholds).zip(&still).enumerate();
    cells.any(|(index, ((energy, threshold), still))| {
        energy > threshold
            && *energy > LEAST_MOVING_SHARE * (energy + still)
            && (CfarCounter::NEAREST_M..=max_range_m).contains(&map.range_m(index))
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
        let mut counter = CfarCounter::new(&waveform).expect("fits");
        (0..frames)
            .map(|number| {
                let observation = counter.observe(&frame(&waveform, number, bodies)).expect("a frame");
                counter.people(observation)
            })
            .collect()
    }

    /// Noise alone is no person. Bodies at different ranges, with levels that fall with range, are counted.
    #[test]
    fn bodies_apart_in_range_are_counted() {
        assert!(counts(&[], 40).iter().all(|people| *people == 0));
        assert!(counts(&[(3.0, 0.8, 8.0)], 5).iter().all(|people| *people == 1));
        assert!(counts(&[(2.0, 0.8, 20.0), (4.5, -0.6, 4.0)], 5).iter().all(|people| *people == 2));
    }

    #[test]
    fn bodies_beyond_the_greatest_range_are_not_counted() {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        let count = |max_range_m: f64, bodies: &[(f64, f64, f64)], frames: u64| {
            let mut counter = CfarCounter::new(&waveform).expect("fits").up_to(max_range_m);
            let seen = (0..frames).map(|number| {
                let observation = counter.observe(&frame(&waveform, number, bodies)).expect("a frame");
                counter.people(observation)
            });
            seen.last().expect("frames")
        };
        let two = [(2.0, 0.8, 20.0), (4.5, -0.6, 4.0)];
        assert_eq!([6.0, 3.5, 1.0].map(|max_range_m| count(max_range_m, &two, 5)), [2, 1, 0]);
        // Half a millimetre a second turns the phase as breathing does.
        let sits = [(3.0, 0.0005, 20.0)];
        assert_eq!([6.0, 2.0].map(|max_range_m| count(max_range_m, &sits, 100)), [1, 0]);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn walls_are_not_people() {
            assert!(counts(&[(3.0, 0.0, 400.0)], 100).iter().all(|people| *people == 0));
        }

        /// A weak second body far behind the first is the ghost of the first.
        #[test]
        fn a_multipath_ghost_is_not_a_person() {
            assert!(counts(&[(2.0, 0.8, 200.0), (4.0, 0.8, 2.0)], 5).iter().all(|people| *people == 1));
        }

        #[test]
        fn frames_too_small_for_a_window_are_refused_and_the_least_is_said() {
            let sizes = (8..40).flat_map(|samples| (1..12).map(move |chirps| (samples, chirps)));
            for (samples_per_chirp, chirps_per_frame) in sizes {
                let request = WaveformRequest { samples_per_chirp, chirps_per_frame, ..WaveformRequest::paper() };
                let waveform = Waveform::realise(request).expect("valid");
                match CfarCounter::new(&waveform) {
                    Ok(_) => assert!(samples_per_chirp >= 20 && chirps_per_frame >= 2, "{}", waveform.shape()),
                    // Of one chirp there is no map.
                    Err(CounterError::Spec(_)) => assert_eq!(chirps_per_frame, 1),
                    Err(error) => {
                        assert!(samples_per_chirp < 20, "{}: {error}", waveform.shape());
                        assert!(error.to_string().contains("hint: people can be counted in frames of at least 20"));
                    }
                }
            }
        }
    }
}
