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
/// Length of slow time for people who sit still, s. The rate of a breath of four seconds is then two cells from zero, outside of
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
    /// Processor of maps over the chirps of a frame.
    chirp_processor: RdmProcessor,
    /// Processor of maps over the frames of slow time.
    slow_processor: RdmProcessor,
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
        let chirp_spec = RdmSpec {
            channels: Channels::IncoherentSum,
            chirp_mean_removal: true,
            static_removal: StaticRemoval::SlowTimeMean,
            ..RdmSpec::default()
        };
        let slow_frames = (BREATH_S / waveform.frame_interval_s()).round().clamp(8.0, 256.0) as usize;
        let slow_spec = RdmSpec {
            slow_time: SlowTime::Frames { frames: slow_frames },
            static_removal: StaticRemoval::None,
            ..chirp_spec
        };
        let looks = waveform.shape().rx;
        let chirp_processor = RdmProcessor::new(&chirp_spec, waveform)?;
        let slow_processor = RdmProcessor::new(&slow_spec, waveform)?;
        let shape = chirp_processor.shape();
        let cfar = Cfar::new(cfar_spec(looks, shape.doppler, shape.range), shape.doppler, shape.range)?;
        // The sum over slow time has as many looks as there are frames: far more than a threshold needs, and not independent.
        let energy_spec = CfarSpec {
            guard: reach(0, 2),
            training: reach(0, 8),
            false_alarm_rate: SLOW_FALSE_ALARM_RATE,
            ..cfar_spec(looks, 1, shape.range)
        };
        let energy_cfar = Cfar::new(energy_spec, 1, shape.range)?;
        let (map, slow_map) = (chirp_processor.empty_map(), slow_processor.empty_map());
        let walked = VecDeque::with_capacity(slow_frames);
        Ok(CfarCounter {
            chirp_processor,
            slow_processor,
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
        self.chirp_processor.reset();
        self.slow_processor.reset();
        self.walked.clear();
    }

    /// Observes the next frame.
    ///
    /// # Errors
    /// [`CounterError::Frame`] if the frame's shape is not the waveform's, or if the number of its codes is not that of its
    /// shape.
    pub fn observe(&mut self, frame: &Frame) -> Result<Observation, CounterError> {
        let is_map = self.chirp_processor.process(frame, &mut self.map)? == MapStatus::Ready;
        let walking =
            if is_map { count_people(&self.cfar.detect(&self.map, 0), &self.map, self.max_range_m) } else { 0 };
        let is_slow_map = self.slow_processor.process(frame, &mut self.slow_map)? == MapStatus::Ready;
        let breathes = is_slow_map && has_breathing(&self.energy_cfar, &self.slow_map, self.max_range_m);
        if self.walked.len() == self.slow_frames {
            self.walked.pop_front();
        }
        self.walked.push_back(walking > 0);
        Ok(Observation { walking, breathes })
    }

    /// Number of people in the room, at most 2, from this observation and the previous frames. A person who breathes
    /// counts as one if nobody walks and few of the previous frames contained a walker.
    pub fn people(&self, observation: Observation) -> usize {
        let frames_walked = self.walked.iter().filter(|walked| **walked).count();
        let few_walked = frames_walked as f64 <= MOST_WALKED_SHARE * self.walked.len() as f64;
        observation.walking.max(usize::from(observation.breathes && few_walked)).min(2)
    }
}

fn reach(doppler: usize, range: usize) -> CellReach {
    CellReach { doppler, range }
}

fn cfar_spec(looks: usize, doppler: usize, range: usize) -> CfarSpec {
    // The window fits small maps too.
    let (doppler_reach, range_reach) = ((doppler.saturating_sub(1) / 2).min(6), (range / 4).min(8));
    let guard = reach(doppler_reach / 3, range_reach / 4);
    CfarSpec {
        rank: RANK,
        guard,
        training: reach(doppler_reach - guard.doppler, range_reach.max(1) - guard.range.min(range_reach.max(1) - 1)),
        false_alarm_rate: FALSE_ALARM_RATE,
        looks: looks.clamp(1, 16),
    }
}

/// Detections that are close in range, as of one person.
struct Group {
    /// Range of the farthest cell, m.
    last_range_m: f64,
    /// Level of the strongest cell, corrected for range, dB.
    level_db: f64,
    /// Number of cells.
    cells: usize,
}

/// Counts people among the detections of a frame, up to a range.
fn count_people(detections: &[CellDetection], map: &Rdm, max_range_m: f64) -> usize {
    let zero = map.shape.doppler / 2;
    let is_in_range = |range: usize| (CfarCounter::NEAREST_M..=max_range_m).contains(&map.range_m(range));
    let moves = |d: &&CellDetection| d.doppler.abs_diff(zero) > RESIDUE_CELLS && is_in_range(d.range);
    // Groups of one cell each, with the level corrected for range.
    let mut cells: Vec<Group> = detections
        .iter()
        .filter(moves)
        .map(|d| {
            let range_m = map.range_m(d.range);
            Group { last_range_m: range_m, level_db: f64::from(d.power_db) + 40.0 * range_m.log10(), cells: 1 }
        })
        .collect();
    if cells.len() < LEAST_CELLS {
        return 0;
    }
    cells.sort_by(|a, b| a.last_range_m.total_cmp(&b.last_range_m));
    let mut groups: Vec<Group> = Vec::new();
    for cell in cells {
        match groups.last_mut().filter(|group| cell.last_range_m - group.last_range_m <= APART_M) {
            Some(group) => {
                group.last_range_m = cell.last_range_m;
                group.level_db = group.level_db.max(cell.level_db);
                group.cells += 1;
            }
            None => groups.push(cell),
        }
    }
    groups.retain(|group| group.cells >= LEAST_CELLS);
    let strongest_db = groups.iter().map(|group| group.level_db).fold(f64::NEG_INFINITY, f64::max);
    groups.iter().filter(|group| group.level_db >= strongest_db - GHOST_DB).count()
}

/// Returns whether the energy over slow time, without static echoes, exceeds its threshold and its least share at some range up to
/// the greatest one.
fn has_breathing(cfar: &Cfar, map: &Rdm, max_range_m: f64) -> bool {
    let (range, zero) = (map.shape.range, map.shape.doppler / 2);
    let (mut energy, mut static_energy) = (vec![0.0; range], vec![0.0; range]);
    for (doppler, row) in map.db.chunks_exact(range.max(1)).enumerate() {
        let sums = if doppler.abs_diff(zero) > 1 { &mut energy } else { &mut static_energy };
        sums.iter_mut().zip(row).for_each(|(sum, db)| *sum += 10f64.powf(f64::from(*db) / 10.0));
    }
    let Some(thresholds) = cfar.thresholds(&energy) else { return false };
    let mut cells = energy.iter().zip(&thresholds).zip(&static_energy).enumerate();
    cells.any(|(index, ((energy, threshold), static_energy))| {
        energy > threshold
            && *energy > LEAST_MOVING_SHARE * (energy + static_energy)
            && (CfarCounter::NEAREST_M..=max_range_m).contains(&map.range_m(index))
    })
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::{SPEED_OF_LIGHT_M_PER_S, WaveformRequest};

    /// Frame of bodies `(range_m, speed_m_per_s, amplitude_lsb)` over seeded noise of 1 LSB.
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
                .map(|(range_m, speed_m_per_s, amplitude_lsb)| {
                    let delay_s = 2.0 * (range_m + speed_m_per_s * slow_s) / SPEED_OF_LIGHT_M_PER_S;
                    let phase = waveform.centre_frequency_hz() * delay_s + waveform.slope_hz_per_s * delay_s * t;
                    amplitude_lsb * (TAU * phase.fract()).cos()
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
            let counts = (0..frames).map(|number| {
                let observation = counter.observe(&frame(&waveform, number, bodies)).expect("a frame");
                counter.people(observation)
            });
            counts.last().expect("frames")
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
        fn frames_too_small_for_a_window_are_refused_with_the_least_size() {
            let sizes = (8..40).flat_map(|samples| (1..12).map(move |chirps| (samples, chirps)));
            for (samples_per_chirp, chirps_per_frame) in sizes {
                let request = WaveformRequest { samples_per_chirp, chirps_per_frame, ..WaveformRequest::paper() };
                let waveform = Waveform::realise(request).expect("valid");
                match CfarCounter::new(&waveform) {
                    Ok(_) => assert!(samples_per_chirp >= 20 && chirps_per_frame >= 2, "{}", waveform.shape()),
                    // Frames of one chirp have no map.
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
