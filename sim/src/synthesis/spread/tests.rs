//! Tests of vectorised chirps against tones added one by one.

use super::super::tests::{error_db, samples_of, samples_of_chirp};
use super::*;
use crate::lanes::tests::assert_same_at_every_level;
use crate::path_segment::{PathDerivatives, PathSample};
use crate::random::{Purpose, generator};
use crate::synthesis::{Tone, exact_chirp};
use num_complex::Complex64;
use radome_dsp::KernelLevel;
use rand::Rng;

const SAMPLES: usize = 128;
const CHIRP: Chirp =
    Chirp { start_hz: 60e9, slope_hz_per_s: 40e12, sample_rate_hz: 2e6, middle_s: SAMPLES as f64 / 4e6 };
const POSITIONS: [f64; CHIRPS] = [0.0, 0.07, 0.19, 0.31, 0.5, 0.62, 0.83, 1.01];

/// Returns paths that rest, that cross into the next cell, that cross many cells, and that lie around frequency zero.
fn paths() -> Vec<PathSegment> {
    let mut rng = generator(3, Purpose::Noise, [0, 0]);
    let mut paths = Vec::new();
    for i in 0..300 {
        let mut number = |limit: f64| rng.random_range(-limit..limit);
        let (delay_s, speed) = match i % 4 {
            0 => (40e-9 + number(30e-9), 1e-11),
            1 => (40e-9 + number(30e-9), 4e-10),
            2 => (40e-9 + number(30e-9), 3e-9),
            _ => (number(1e-10), 1e-10),
        };
        let mut key = || {
            let delay_s = delay_s + number(speed);
            let delay_rate = number(speed) / 4e-3;
            let bend = PathDerivatives {
                delay: [number(speed) / 4e-3f64.powi(2), number(speed) / 4e-3f64.powi(3)],
                amplitude: [
                    Complex64::new(number(1.0), number(1.0)) / 4e-3,
                    Complex64::new(number(1.0), number(1.0)) / 4e-3f64.powi(2),
                ],
            };
            (PathSample { delay_s, delay_rate, amplitude: Complex64::new(number(1.0), number(1.0)) }, bend)
        };
        paths.push(PathSegment::between(&key(), &key(), 4e-3));
    }
    paths
}

fn tones(paths: &[PathSegment], place: f64) -> Vec<Tone> {
    let tone = |path: &PathSegment| {
        let (delay_s, rate) = path.delay(place);
        Tone {
            phase_cycles: CHIRP.phase_cycles(delay_s),
            cycles_per_sample: CHIRP.beat_hz(delay_s, rate) / CHIRP.sample_rate_hz,
            amplitude: path.amplitude(place),
        }
    };
    paths.iter().map(tone).collect()
}

/// Returns every chirp's grid at the only receiver, computed with an instruction set.
fn spread_at(level: KernelLevel, paths: &[PathSegment]) -> Vec<Grid> {
    let tracks: Vec<Track> = paths.iter().map(|&first| Track { first, others: Default::default() }).collect();
    let grids = spread_tracks_at(level, &tracks, 1, &[0, CHIRPS]);
    let extract = |chirp| {
        let mut grid = Grid::default();
        grids[0].extract(chirp, &mut grid);
        grid
    };
    (0..CHIRPS).map(extract).collect()
}

#[test]
fn every_level_gives_the_bits_of_one_tone_after_another() {
    let paths = paths();
    let synthesiser = Synthesiser::new(SAMPLES);
    for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
        for (chirp, (spread, place)) in spread_at(level, &paths).iter().zip(POSITIONS).enumerate() {
            let mut grid = synthesiser.grid();
            for tone in tones(&paths, place) {
                synthesiser.add(&tone, &mut grid);
            }
            // The two spare taps of a tone may turn -0 to 0.
            let bits = |grid: &Grid| -> Vec<[u32; 2]> {
                grid.cells.iter().map(|c| [(c.re + 0.0).to_bits(), (c.im + 0.0).to_bits()]).collect()
            };
            assert_eq!(bits(spread), bits(&grid), "{level}, chirp {chirp}");
        }
    }
}

#[test]
fn chirps_side_by_side_are_within_minus_90_dbc_of_the_sum() {
    let paths = paths();
    let synthesiser = Synthesiser::new(SAMPLES);
    for (chirp, (grid, place)) in spread_at(synthesiser.level, &paths).iter().zip(POSITIONS).enumerate() {
        let error_db = error_db(&exact_chirp(&tones(&paths, place), SAMPLES), &samples_of(&synthesiser, grid));
        assert!(error_db < -90.0, "chirp {chirp}: {error_db} dBc");
    }
}

/// Returns tracks for antennas up to 5 mm apart.
fn tracks() -> Vec<Track> {
    let mut rng = generator(4, Purpose::Noise, [0, 0]);
    let mut tracks = Vec::new();
    for first in paths() {
        let mut offset = || {
            let mut number = |limit: f32| rng.random_range(-limit..limit);
            ReceiverOffset {
                delay_s: [number(1.6e-11), number(1e-12), number(2e-13), number(1e-13)],
                ratio: [Complex::new(0.9, number(0.1)), Complex::new(number(0.01), number(0.01))],
            }
        };
        tracks.push(Track { first, others: [offset(), offset()] });
    }
    tracks
}

/// Returns every receiver's grids: `[receiver]`.
fn spread_tracks_at(level: KernelLevel, tracks: &[Track], receivers: usize, cuts: &[usize]) -> Vec<Grids> {
    let synthesiser = Synthesiser { level, ..Synthesiser::new(SAMPLES) };
    let mut grids = vec![synthesiser.grids(); receivers];
    for ends in cuts.windows(2) {
        let positions = ChirpPositions::new(ends[0]..ends[1], |chirp| POSITIONS[chirp]);
        synthesiser.spread_tracks(&CHIRP, tracks, &positions, &mut grids);
    }
    grids
}

fn bits(grids: &Grids) -> Vec<[[u32; CHIRPS]; 2]> {
    grids.cells.iter().map(|c| [c.re.map(|x| (x + 0.0).to_bits()), c.im.map(|x| (x + 0.0).to_bits())]).collect()
}

/// Receivers' grids do not depend on the number of further receivers, nor those of the first on the split of the block.
/// Every instruction set gives the same bits.
#[test]
fn receivers_do_not_depend_on_those_behind_them() {
    let tracks = tracks();
    assert_same_at_every_level(|level| {
        let all = spread_tracks_at(level, &tracks, 3, &[0, CHIRPS]);
        let fewer = spread_tracks_at(level, &tracks, 2, &[0, CHIRPS]);
        let cut = spread_tracks_at(level, &tracks, 1, &[0, 3, 4, CHIRPS]);
        assert!(bits(&cut[0]) == bits(&all[0]), "{level}");
        assert!(all.iter().zip(&fewer).all(|(all, fewer)| bits(all) == bits(fewer)), "{level}");
        all.iter().map(bits).collect::<Vec<_>>()
    });
}

#[test]
fn receivers_hear_their_own_delays_within_minus_50_dbc() {
    let tracks = tracks();
    let synthesiser = Synthesiser::new(SAMPLES);
    let grids = spread_tracks_at(synthesiser.level, &tracks, 3, &[0, CHIRPS]);
    for (chirp, place) in POSITIONS.into_iter().enumerate() {
        for (receiver, grids) in grids.iter().enumerate().skip(1) {
            let tone = |track: &Track| {
                let ((delay_s, rate), offset) = (track.first.delay(place), &track.others[receiver - 1]);
                let [_, b, c, d] = offset.delay_s.map(f64::from);
                let delay_s = delay_s + f64::from(offset.delay(place as f32));
                let rate = rate + (b + place * (2.0 * c + place * 3.0 * d)) / track.first.interval_s();
                Tone {
                    phase_cycles: CHIRP.phase_cycles(delay_s),
                    cycles_per_sample: CHIRP.beat_hz(delay_s, rate) / CHIRP.sample_rate_hz,
                    amplitude: track.first.amplitude(place) * offset.ratio(place as f32),
                }
            };
            let exact = exact_chirp(&tracks.iter().map(tone).collect::<Vec<Tone>>(), SAMPLES);
            let error_db = error_db(&exact, &samples_of_chirp(&synthesiser, grids, chirp));
            assert!(error_db < -50.0, "receiver {receiver}, chirp {chirp}: {error_db} dBc");
        }
    }
}
