//! Static echoes: weights of static paths in a frame, with jitter, drift and obstruction by people, and their grids.

use glam::DVec3;
use num_complex::{Complex, Complex64};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::FrameSimulator;
use super::paths::FramePaths;
use crate::diffraction::{self, Column};
use crate::echo::Snapshot;
use crate::math::neighbours;
use crate::prepared_scene::{StaticPath, StaticTone, drift};
use crate::random::{Purpose, generator};
use crate::scene_file::ShadowFile;
use crate::synthesis::{Grid, Tone};

/// Weights of static paths in a frame.
pub(super) struct Clutter {
    /// Indices and weights of paths that nobody comes near; they are constant in the frame.
    steady: Vec<(usize, Complex64)>,
    /// Indices of the other paths.
    changing: Vec<usize>,
    /// Weights of the other paths: `[time][changing path]`.
    weights: Vec<Vec<Complex64>>,
    /// Whether the times are the middles of all chirps; otherwise they are the ends of the frame's intervals.
    pub(super) is_per_chirp: bool,
}

/// Grids of static paths at the times of their weights.
pub(super) struct StaticGrids {
    /// Grids: `[rx][time]`.
    pub(super) grids: Vec<Vec<Grid>>,
    pub(super) is_per_chirp: bool,
}

pub(super) const NO_STATIC: StaticGrids = StaticGrids { grids: Vec::new(), is_per_chirp: false };

impl FrameSimulator {
    /// Computes the weights of all static paths in a frame: in every chirp where people diffract them, otherwise at the
    /// ends of intervals.
    pub(super) fn clutter(&self, index: u64, start_s: f64, frame_paths: &FramePaths) -> Clutter {
        let is_strip = self.scene.file().people.shadow == ShadowFile::Strip;
        let has_people = frame_paths.snapshots.iter().any(|people| !people.is_empty());
        if !(is_strip && has_people) {
            let ends_s = self.ends_s(start_s, frame_paths.halvings);
            let weights = self.clutter_weights(index, &ends_s, &frame_paths.snapshots);
            let changing = (0..self.prepared.static_paths.len()).collect();
            return Clutter { steady: Vec::new(), changing, weights, is_per_chirp: false };
        }
        let without_people = self.clutter_weights(index, &[start_s], &[Vec::new()]);
        let without_people = without_people.first().map(Vec::as_slice).unwrap_or_default();
        let (columns, active_s) = (frame_paths.columns(), self.active_s());
        let paths = self.prepared.static_paths.iter().zip(without_people).enumerate();
        let (changing, steady): (Vec<_>, Vec<_>) =
            paths.partition(|(_, (path, _))| may_obstruct(&path.polyline, &columns));
        let weights: Vec<Vec<Complex64>> = (0..self.waveform().shape().chirps)
            .map(|chirp| {
                let people = columns_between(&columns, self.middle_s(chirp) / active_s);
                // Amplitudes at the ADC are conjugated.
                let weight = |(_, (path, weight)): &(usize, (&StaticPath, &Complex64))| {
                    *weight * diffraction::past_strips(&path.polyline, &people, self.prepared.wavelength_m).conj()
                };
                changing.iter().map(weight).collect()
            })
            .collect();
        Clutter {
            steady: steady.into_iter().map(|(number, (_, weight))| (number, *weight)).collect(),
            changing: changing.into_iter().map(|(number, _)| number).collect(),
            weights,
            is_per_chirp: true,
        }
    }

    /// Computes the complex weight of every static path at the ends of intervals: `[end][path]`.
    fn clutter_weights(&self, index: u64, ends_s: &[f64], snapshots: &[Vec<Snapshot>]) -> Vec<Vec<Complex64>> {
        let constants = &self.scene.receiver().clutter;
        let mut rng = generator(self.options.seed, Purpose::FrameJitter, [index, 0]);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let steps = self.clutter_steps(ends_s.first().copied().unwrap_or_default());
        // Half of the power of jitter and drift is common to all echoes, half is independent.
        let half = constants.phase_jitter_rad * 0.5f64.sqrt();
        let half_drift = constants.phase_drift_rad_per_10s * 0.5f64.sqrt();
        let common_rad = half * normal();
        let jitter: Vec<Complex64> = self
            .prepared
            .static_paths
            .iter()
            .map(|_| {
                let phase_rad = common_rad + half * normal();
                Complex64::from_polar((1.0 + constants.amplitude_jitter * normal()).max(0.0), phase_rad)
            })
            .collect();
        ends_s
            .iter()
            .zip(snapshots)
            .map(|(&t, people)| {
                let columns: Vec<_> = people.iter().map(|p| p.column).collect();
                let common_drift = drift(t, &self.prepared.common_drift);
                let paths = self.prepared.static_paths.iter().zip(&jitter);
                paths
                    .enumerate()
                    .map(|(i, (path, jitter))| {
                        let factor = diffraction::past_columns(&path.polyline, &columns, self.prepared.wavelength_m);
                        let step = steps.get(i).copied().unwrap_or_default();
                        let phase_rad = half_drift * (common_drift + drift(t, &path.drift)) + step;
                        jitter * Complex64::from_polar(factor, phase_rad)
                    })
                    .collect()
            })
            .collect()
    }

    /// Computes the phase of every static path due to the steps before a frame, rad; empty if there are none. Time is
    /// divided into intervals with one step each, at a random time. Between two steps the phases are constant, and
    /// their differences are the steps.
    fn clutter_steps(&self, start_s: f64) -> Vec<f64> {
        let constants = &self.scene.receiver().clutter;
        if constants.phase_step_rad == 0.0 {
            return Vec::new();
        }
        let intervals = start_s / constants.phase_step_interval_s;
        let interval = intervals as u64;
        let step = generator(self.options.seed, Purpose::ClutterStep, [interval, 0]).random::<f64>();
        let level = interval + u64::from(intervals - interval as f64 >= step);
        let mut rng = generator(self.options.seed, Purpose::ClutterStep, [level, 1]);
        let sigma_rad = constants.phase_step_rad * 0.5f64.sqrt();
        let phase = |_| {
            let normal: f64 = StandardNormal.sample(&mut rng);
            sigma_rad * normal
        };
        self.prepared.static_paths.iter().map(phase).collect()
    }

    /// Builds grids of static paths at the times of their weights. If `is_by_delay`, every tone is multiplied by `j`
    /// and its delay.
    pub(super) fn static_grids(&self, clutter: &Clutter, is_by_delay: bool) -> StaticGrids {
        let of_receiver = |rx: usize| {
            let mut steady = self.synthesiser.grid();
            self.add_static(rx, clutter.steady.iter().copied(), is_by_delay, &mut steady);
            let at_time = |weights: &Vec<Complex64>| {
                let mut grid = steady.clone();
                let changing = clutter.changing.iter().copied().zip(weights.iter().copied());
                self.add_static(rx, changing, is_by_delay, &mut grid);
                grid
            };
            clutter.weights.iter().map(at_time).collect()
        };
        StaticGrids {
            grids: (0..self.waveform().shape().rx).map(of_receiver).collect(),
            is_per_chirp: clutter.is_per_chirp,
        }
    }

    /// Adds static paths to a grid, each by its index and with a weight. If `is_by_delay`, every tone is multiplied by
    /// `j` and its delay.
    fn add_static(
        &self,
        rx: usize,
        paths: impl Iterator<Item = (usize, Complex64)>,
        is_by_delay: bool,
        grid: &mut Grid,
    ) {
        // Delay of a tone of one cycle a sample; static paths have no Doppler shift.
        let delay_s = self.prepared.chirp.sample_rate_hz / self.prepared.chirp.slope_hz_per_s;
        for (number, weight) in paths {
            let tone = self.prepared.static_paths.get(number).and_then(|path| path.tones.get(rx));
            if let Some(&StaticTone { phase_cycles, cycles_per_sample, amplitude }) = tone {
                let mut amplitude = amplitude * weight;
                if is_by_delay {
                    amplitude *= Complex64::new(0.0, cycles_per_sample * delay_s);
                }
                let amplitude = Complex::new(amplitude.re as f32, amplitude.im as f32);
                self.synthesiser.add(&Tone { phase_cycles, cycles_per_sample, amplitude }, grid);
            }
        }
    }
}

/// Returns whether a person may come near a path between evenly spaced times. The test assumes that a person moves no
/// farther from both neighbouring times than their distance.
fn may_obstruct(polyline: &[DVec3], columns: &[Vec<Column>]) -> bool {
    columns.iter().enumerate().any(|(time, people)| {
        people.iter().enumerate().any(|(i, column)| {
            let next = columns.get(time + 1).and_then(|people| people.get(i)).unwrap_or(column);
            let moved_m = (next.x - column.x).hypot(next.y - column.y) + (next.radius_m - column.radius_m).abs();
            diffraction::may_affect(polyline, column, moved_m)
        })
    })
}

/// Interpolates the columns of people, given at evenly spaced times, at a fraction of the whole time.
fn columns_between(columns: &[Vec<Column>], at: f64) -> Vec<Column> {
    let Some((before, next, fraction)) = neighbours(columns, at) else { return Vec::new() };
    let between = |a: f64, b: f64| a + (b - a) * fraction;
    before
        .iter()
        .zip(next)
        .map(|(a, b)| Column {
            x: between(a.x, b.x),
            y: between(a.y, b.y),
            radius_m: between(a.radius_m, b.radius_m),
            height_m: between(a.height_m, b.height_m),
        })
        .collect()
}
