//! Clothes, as fields over their bodies: how much of the skin's echo cloth leaves, from place to place, and how rough
//! its folds are. Neither is there unless a scene asks for it.
//!
//! **Cloth.** A millimetre of it over skin, with air between, leaves -4.7 to +1.6 dB of the bare skin's echo, by how thick the air is;
//! that changes over a few centimetres. In decibels the factor on amplitude is a Gaussian field of places on the body (as it
//! stands with limbs apart): a sum of waves in random directions whose lengths give the correlation `exp(-(r/L)^2)`.
//!
//! **Folds.** A surface whose height varies by `s` (rms) keeps `exp(-2 k^2 s^2 cos^2 theta)` of a highlight's field: -6.9 dB at 0.5 mm
//! and 60 GHz. The power that is missing comes from all around the highlight: from places of the cloth whose normal is off the
//! mirror's by up to the folds' slopes. There are a few dozen such places on each segment, which go with the body, each with a
//! phase of its own, so that what they add up to changes as the body turns and moves. Their powers make up for what the highlight
//! has lost, exactly.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::body::{Build, SEGMENTS};
use super::skin;
use crate::field::highlight::Ellipsoid;
use crate::random::{Purpose, generator};
use crate::scene_file::ClothingFile;

/// Waves of which the field is the sum: its values are Gaussian within a percent.
const WAVES: usize = 64;
/// Places of a segment from which folds scatter.
pub const FOLD_PLACES: usize = 40;
/// Places whose share is less than this, as a natural logarithm, are silent.
const LEAST_SHARE: f64 = -12.0;

/// Clothes of a person. Nothing that is modelled, by default.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Clothing {
    cloth: Option<Arc<Cloth>>,
    folds: Option<Arc<Folds>>,
}

/// Share of the skin's echo that cloth leaves, from place to place.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloth {
    level_db: f64,
    spread_db: f64,
    /// Wave vectors, 1/m, and phases.
    waves: Vec<(DVec3, f64)>,
    /// The body on which places are counted.
    rest: [Ellipsoid; SEGMENTS],
}

/// Rough folds.
#[derive(Debug, Clone, PartialEq)]
pub struct Folds {
    /// Height, rms, m.
    pub roughness_m: f64,
    /// Slope, rms.
    pub slope: f64,
    /// By segment, places on the unit sphere of which the segment is the image, and what turns their fields.
    places: Vec<[(DVec3, Complex64); FOLD_PLACES]>,
}

impl Clothing {
    /// Draws what somebody wears from (seed, identity).
    pub fn draw(file: &ClothingFile, seed: u64, identity: [u64; 2], build: &Build) -> Self {
        let cloth = (file.spread_db > 0.0).then(|| Arc::new(Cloth::draw(file, seed, identity, build)));
        let folds = (file.roughness_m > 0.0).then(|| Arc::new(Folds::draw(file, seed, identity, build)));
        Clothing { cloth, folds }
    }

    /// The field of cloth.
    pub fn cloth(&self) -> Option<&Cloth> {
        self.cloth.as_deref()
    }

    /// The folds.
    pub fn folds(&self) -> Option<&Folds> {
        self.folds.as_deref()
    }
}

impl Cloth {
    fn draw(file: &ClothingFile, seed: u64, identity: [u64; 2], build: &Build) -> Self {
        let mut rng = generator(seed, Purpose::Clothing, identity);
        // cos(k r) averages to exp(-(r/L)^2) over normal k of this deviation.
        let deviation = 2f64.sqrt() / file.correlation_m;
        let mut wave = || {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let k = DVec3::new(normal(), normal(), normal()) * deviation;
            (k, rng.random_range(0.0..TAU))
        };
        let waves = (0..WAVES).map(|_| wave()).collect();
        Cloth { level_db: file.level_db, spread_db: file.spread_db, waves, rest: skin::apart(build) }
    }

    /// Factor on amplitude at a place of the body as it stands over the origin with limbs apart, m.
    pub fn factor(&self, place: DVec3) -> f64 {
        let sum: f64 = self.waves.iter().map(|(k, phase)| (k.dot(place) + phase).cos()).sum();
        let normal = sum * (2.0 / WAVES as f64).sqrt();
        10f64.powf(0.05 * (self.level_db + self.spread_db * normal))
    }

    /// Factor on amplitude that one place in thirty thousand exceeds: four standard deviations above the mean.
    pub fn most(&self) -> f64 {
        10f64.powf(0.05 * (self.level_db + 4.0 * self.spread_db))
    }

    /// Factor on amplitude at a point of the unit sphere of which a segment is the image.
    pub fn factor_on(&self, segment: usize, unit: DVec3) -> f64 {
        self.rest.get(segment).map_or(1.0, |rest| self.factor(rest.surface(unit)))
    }
}

impl Folds {
    fn draw(file: &ClothingFile, seed: u64, identity: [u64; 2], build: &Build) -> Self {
        let rest = skin::apart(build);
        let mut rng = generator(seed, Purpose::Clothing, [identity[0], identity[1] | 1 << 60]);
        let of_segment = |e: &Ellipsoid| {
            let turn = DMat3::from_euler(
                glam::EulerRot::ZYX,
                rng.random_range(0.0..TAU),
                rng.random_range(-0.5 * PI..0.5 * PI),
                rng.random_range(0.0..TAU),
            );
            std::array::from_fn(|i| {
                let normal = turn * lattice(i, FOLD_PLACES);
                let unit = (normal * e.semi_axes_m).normalize_or_zero();
                (unit, Complex64::from_polar(1.0, rng.random_range(0.0..TAU)))
            })
        };
        let places = rest.iter().map(of_segment).collect();
        Folds { roughness_m: file.roughness_m, slope: file.fold_slope_deg.to_radians().tan(), places }
    }

    /// Part of a highlight's field that is left at an angle of incidence.
    pub fn coherent(&self, wavenumber_per_m: f64, cosine: f64) -> f64 {
        let turned = wavenumber_per_m * self.roughness_m * cosine;
        (-2.0 * turned * turned).exp()
    }

    /// One of a segment's places: where it is on the unit sphere, and its field as a part of that of the smooth highlight, whose
    /// normal this is. `None` where nothing comes from.
    pub fn diffuse(
        &self,
        segment: usize,
        place: usize,
        ellipsoid: &Ellipsoid,
        normal: DVec3,
        coherent: f64,
    ) -> Option<(DVec3, Complex64)> {
        let places = self.places.get(segment)?;
        let &(unit, turn) = places.get(place)?;
        let share = |unit: DVec3| {
            let own = (ellipsoid.axes * (unit / ellipsoid.semi_axes_m)).normalize_or_zero();
            let cosine = own.dot(normal).max(1e-3);
            let tangent2 = 1.0 / (cosine * cosine) - 1.0;
            -0.5 * tangent2 / (self.slope * self.slope)
        };
        let own = share(unit);
        if own < LEAST_SHARE {
            return None;
        }
        let total: f64 = places.iter().map(|(unit, _)| share(*unit)).filter(|s| *s >= LEAST_SHARE).map(f64::exp).sum();
        let power = (1.0 - coherent * coherent).max(0.0) * own.exp() / total;
        Some((unit, turn * power.sqrt()))
    }
}

/// Directions spread evenly over all: a Fibonacci lattice.
fn lattice(i: usize, count: usize) -> DVec3 {
    let golden = PI * (3.0 - 5f64.sqrt());
    let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
    let (sine, cosine) = (golden * i as f64).sin_cos();
    let across = (1.0 - z * z).sqrt();
    DVec3::new(across * cosine, across * sine, z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn build() -> Build {
        Build { height_m: 1.75, girth: 1.0 }
    }

    fn drawn(seed: u64, roughness_m: f64) -> Clothing {
        let file = ClothingFile { roughness_m, ..ClothingFile::default() };
        Clothing::draw(&file, seed, [0, 0], &build())
    }

    fn normal(cloth: &Cloth, place: DVec3) -> f64 {
        20.0 * cloth.factor(place).log10()
    }

    /// Over 3000 people: mean, deviation and correlation of the field, at places of the chest.
    #[test]
    fn cloth_has_the_level_the_spread_and_the_correlation_that_were_asked_for() {
        let file = ClothingFile::default();
        let length = file.correlation_m;
        let apart = [0.0, 0.5 * length, length, 2.0 * length];
        let (mut sum, mut products) = (0.0, [0.0; 4]);
        let people = 3000;
        for seed in 0..people {
            let all = drawn(seed, 0.0);
            let cloth = all.cloth().expect("cloth");
            let at = |d: f64| normal(cloth, DVec3::new(0.11, 0.02, 1.3) + DVec3::new(0.36, 0.48, 0.8) * d);
            sum += at(0.0);
            for (product, d) in products.iter_mut().zip(apart) {
                *product += (at(0.0) - file.level_db) * (at(d) - file.level_db);
            }
        }
        let n = people as f64;
        assert!((sum / n - file.level_db).abs() < 4.0 * file.spread_db / n.sqrt(), "mean {} dB", sum / n);
        let deviation = (products[0] / n).sqrt();
        assert!((deviation / file.spread_db - 1.0).abs() < 0.05, "deviation {deviation} dB");
        for (product, d) in products.iter().zip(apart) {
            let expected = (-(d / length).powi(2)).exp();
            assert!((product / products[0] - expected).abs() < 0.06, "{} at {d} m", product / products[0]);
        }
    }

    /// At 60 GHz and normal incidence half a millimetre leaves -6.9 dB, a whole one -27 dB.
    #[test]
    fn folds_leave_what_is_known_of_a_highlight() {
        let k = TAU / 4.996_54e-3;
        for (roughness_m, expected_db) in [(0.5e-3, -6.87), (1e-3, -27.5)] {
            let all = drawn(1, roughness_m);
            let left = all.folds().expect("folds").coherent(k, 1.0);
            assert!((20.0 * left.log10() - expected_db).abs() < 0.05, "{} dB", 20.0 * left.log10());
            let oblique = all.folds().expect("folds").coherent(k, 0.5);
            assert!((oblique.log10() / left.log10() - 0.25).abs() < 1e-9, "by the square of the cosine");
        }
    }

    /// Echo that a highlight loses goes to its neighbours, anywhere on any segment.
    #[test]
    fn power_is_kept() {
        let all = drawn(3, 0.7e-3);
        let folds = all.folds().expect("folds");
        let body = build().segments(&build().standing());
        for (segment, e) in body.iter().enumerate() {
            for i in 0..200 {
                let normal = e.axes * lattice(i, 200);
                let coherent = 0.3;
                let places = (0..FOLD_PLACES).filter_map(|place| folds.diffuse(segment, place, e, normal, coherent));
                let power: f64 = places.map(|(_, field)| field.norm_sqr()).sum();
                assert!((power + coherent * coherent - 1.0).abs() < 1e-12, "{power} on {segment} at {i}");
            }
        }
    }

    #[test]
    fn nothing_is_worn_unless_asked_for_and_seeds_wear_the_same_again() {
        let bare = ClothingFile { spread_db: 0.0, ..ClothingFile::default() };
        assert_eq!(Clothing::draw(&bare, 1, [0, 0], &build()), Clothing::default());
        assert_eq!(drawn(5, 1e-3), drawn(5, 1e-3));
        assert_ne!(drawn(5, 1e-3), drawn(6, 1e-3));
    }
}
