use num_complex::Complex64;
use radome_dsp::KernelLevel;

use super::super::held::tests::{CHIRP, INTERVAL_S, SAMPLES, echoes, held, place, tone};
use super::super::tests::{bits, error_db, samples_of_chirp};
use super::super::{ChirpPositions, HeldEcho, Tone, exact_chirp};
use super::*;
use crate::lanes::tests::assert_same_at_every_level;

/// Returns every receiver's blocks of a run from a chirp on, and the rejected echoes.
fn spread(level: KernelLevel, held: &HeldEchoes, begin: usize, chirps: usize) -> (Vec<Vec<Grids>>, HeldEchoes) {
    let synthesiser = Synthesiser { level, ..Synthesiser::new(SAMPLES) };
    let mut blocks = vec![vec![synthesiser.grids(); RUN / CHIRPS]; RECEIVERS];
    let mut rates = synthesiser.rate_grids(RECEIVERS);
    let run = Run { first: place(begin), step: place(1) - place(0), chirps };
    synthesiser.spread_rates(&CHIRP, held, &run, &mut rates, &mut blocks);
    (blocks, rates.rejected().clone())
}

/// Returns the error of a run's chirps relative to the sum of tones, over all receivers, dB.
fn error_of_run_db(echoes: &[HeldEcho], blocks: &[Vec<Grids>], begin: usize, chirps: usize) -> f64 {
    let synthesiser = Synthesiser::new(SAMPLES);
    let (mut exact, mut fast) = (Vec::new(), Vec::new());
    for (receiver, blocks) in blocks.iter().enumerate() {
        for n in 0..chirps {
            let tones: Vec<Tone> = echoes.iter().map(|echo| tone(echo, receiver, begin + n)).collect();
            exact.extend(exact_chirp(&tones, SAMPLES));
            fast.extend(samples_of_chirp(&synthesiser, &blocks[n / CHIRPS], n % CHIRPS));
        }
    }
    error_db(&exact, &fast)
}

/// Returns an echo at 3 m with this path rate, m/s, and path acceleration, m/s^2.
fn echo(rate_m_per_s: f64, bend_m_per_s2: f64) -> HeldEcho {
    let c = radome_dsp::SPEED_OF_LIGHT_M_PER_S;
    let end = rate_m_per_s + INTERVAL_S * bend_m_per_s2;
    let grown = INTERVAL_S * 0.5 * (rate_m_per_s + end);
    let delay = [[6.0, rate_m_per_s, bend_m_per_s2], [6.0 + grown, end, bend_m_per_s2]].map(|d| d.map(|m| m / c));
    let amplitudes = [(0.6, -0.8), (0.1, 0.9), (-1.0, 0.4)].map(|(re, im)| [Complex64::new(re, im); 2]);
    HeldEcho { delay, amplitudes }
}

/// With the rejected echoes added as held ones, the error is below -26 dB of the sum of separate tones, as for held
/// echoes.
#[test]
fn a_field_of_echoes_is_within_minus_26_db_of_the_sum() {
    let echoes = echoes(120);
    let held = held(&echoes);
    let synthesiser = Synthesiser::new(SAMPLES);
    let mut accepted = 0;
    for (begin, chirps) in [(0, 32), (32, 32), (8, 16), (40, 20), (3, 9)] {
        let (mut blocks, rejected) = spread(synthesiser.level, &held, begin, chirps);
        accepted += echoes.len() - rejected.len();
        for block in 0..chirps.div_ceil(CHIRPS) {
            let mut grids: Vec<Grids> = blocks.iter().map(|blocks| blocks[block].clone()).collect();
            let positions = ChirpPositions::new(0..CHIRPS, |lane| place(begin + CHIRPS * block + lane));
            synthesiser.spread_held(&CHIRP, &rejected, &positions, &mut grids);
            for (blocks, grids) in blocks.iter_mut().zip(grids) {
                blocks[block] = grids;
            }
        }
        let error_db = error_of_run_db(&echoes, &blocks, begin, chirps);
        assert!(error_db < -26.0, "{chirps} chirps from {begin}: {error_db} dB");
    }
    assert!(accepted > 3 * echoes.len(), "{accepted} of {}", 5 * echoes.len());
}

/// Echoes that change little are nearly exact. The worst accepted echo is within -26 dB.
#[test]
fn echoes_that_change_more_are_less_exact_and_then_left_out() {
    let level = KernelLevel::detect();
    let error_db = |echo: HeldEcho| {
        let (blocks, rejected) = spread(level, &held(&[echo]), 0, RUN);
        rejected.is_empty().then(|| error_of_run_db(&[echo], &blocks, 0, RUN))
    };
    for rate in [0.0, 0.01, -0.02] {
        assert!(
            error_db(echo(rate, 0.0)).is_some_and(|db| db < -36.0),
            "{rate} m/s: {:?} dB",
            error_db(echo(rate, 0.0))
        );
    }
    let (mut accepted, mut rejected) = (0, 0);
    for rate in -40..=40 {
        for bend in [-80.0, -40.0, -20.0, -10.0, -3.0, 0.0, 5.0, 15.0, 25.0, 100.0] {
            match error_db(echo(0.25 * f64::from(rate), bend)) {
                Some(db) => {
                    accepted += 1;
                    assert!(db < -26.0, "{} m/s, {bend} m/s^2: {db} dB", 0.25 * f64::from(rate));
                }
                None => rejected += 1,
            }
        }
    }
    assert!(accepted > 200 && rejected > 200, "{accepted} {rejected}");
}

/// Echoes whose amplitudes change, in phase or in magnitude, are as exact as others. One whose phase also bends, or
/// that moves much, is rejected if the amplitude changes much.
#[test]
fn changing_amplitudes_are_followed() {
    let level = KernelLevel::detect();
    let changing = |of: HeldEcho, factor: Complex64| {
        let [first, second, third] = of.amplitudes;
        HeldEcho { amplitudes: [first, second.map(|a| 1.2 * a), third].map(|[a, _]| [a, a * factor]), ..of }
    };
    let factors = [Complex64::ONE, Complex64::from_polar(1.0, 0.35), Complex64::new(0.3, 0.0)];
    for factor in factors {
        let echo = changing(echo(1.0, 2.0), factor);
        let (blocks, rejected) = spread(level, &held(&[echo]), 0, RUN);
        let error_db = error_of_run_db(&[echo], &blocks, 0, RUN);
        assert!(rejected.is_empty() && error_db < -32.0, "{factor}: {error_db} dB");
    }
    let bent = echo(1.0, 20.0);
    let rejected = |echoes: &[HeldEcho]| spread(level, &held(echoes), 0, RUN).1.len();
    assert_eq!(factors.map(|factor| rejected(&[changing(bent, factor)])), [0, 0, 1]);
    // At 6 m/s an echo moves by 0.28 cells until the run's ends.
    let steps = [1.0, 0.0].map(|end| changing(echo(6.0, 0.0), Complex64::new(end, 0.0)));
    assert_eq!(steps.map(|echo| rejected(&[echo])), [0, 0]);
    let fading = changing(echo(6.0, 0.0), Complex64::new(-1.0, 0.0));
    assert_eq!(rejected(&[fading]), 1);
}

#[test]
fn every_level_gives_the_same_bits() {
    let held = held(&echoes(21));
    assert_same_at_every_level(|level| bits(spread(level, &held, 16, RUN).0.iter().flatten()));
}
