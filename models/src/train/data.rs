//! The maps of a training, in memory.

use std::collections::BTreeSet;
use std::sync::Arc;

use candle_core::{Device, Result as CandleResult, Tensor};
use radome_dsp::Occupancy;
use radome_dsp::rdm::Motion;
use rand::seq::SliceRandom;
use rayon::prelude::*;

use super::augmentation::{Augmentation, MapUse, Partners};
use super::error::TrainError;
use super::maps::Maps;
use super::spec::TrainSpec;
use crate::dataset::{Dataset, DatasetError, ManifestRow, Split, SplitSpec};
use crate::model::input_shape;
use crate::network::NetworkKind;
use crate::random::stream;
use crate::standardise::{Scale, Standardisation};

/// Maps `[range][doppler]` and their classes.
pub(super) struct Part {
    /// Index of each map in the dataset.
    pub indices: Vec<usize>,
    /// Cells in the map's reference, before bound and scaling, because augmentation comes first.
    pub maps: Vec<Arc<[f32]>>,
    pub labels: Vec<usize>,
    /// Motion of each map.
    motions: Vec<Option<Motion>>,
    /// Constants of each map.
    scales: Vec<Scale>,
}

impl Part {
    /// Number of maps of each class.
    fn counts(&self) -> [usize; Occupancy::ALL.len()] {
        Occupancy::ALL.map(|o| self.labels.iter().filter(|&&label| label == o.index()).count())
    }
}

pub(super) struct Data {
    pub train: Part,
    pub validation: Part,
    /// Indices of the test maps, which are used only at the end.
    pub test: Vec<usize>,
    pub standardisation: Standardisation,
    pub class_weights: Vec<f32>,
    pub range: usize,
    pub doppler: usize,
    /// Whether batches have range and Doppler exchanged.
    pub transposed: bool,
    network: NetworkKind,
    /// Maps that can be added to each other, if the augmentation superposes maps.
    partners: Option<Partners>,
    pub warnings: Vec<String>,
}

/// Indices of the maps of a training, by split.
pub(crate) struct Indices {
    /// Maps that are trained on.
    pub train: Vec<usize>,
    pub validation: Vec<usize>,
    pub test: Vec<usize>,
}

impl Indices {
    /// Chooses the maps. Their number does not depend on the seed.
    ///
    /// # Errors
    /// Those of [`Dataset::splits`].
    pub(crate) fn choose(dataset: &Dataset, spec: &TrainSpec) -> Result<Self, DatasetError> {
        let splits = dataset.splits(&spec.split)?;
        let rows = dataset.rows();
        let indices_of = |split: Split| -> Vec<usize> {
            splits.iter().enumerate().filter(|&(_, &s)| s == split).map(|(index, _)| index).collect()
        };
        let mut train = indices_of(Split::Train);
        train.retain(|&index| spec.transitions || rows.get(index).is_none_or(|row| !row.transition));
        let most = spec.most_training_maps.map_or(1.0, |most| most as f64 / train.len().max(1) as f64);
        let fraction = spec.label_fraction * most.min(1.0);
        if fraction < 1.0 {
            let most = spec.most_training_maps.unwrap_or(usize::MAX);
            train = fraction_by_class(&train, |i| rows.get(i).map(|r| r.label.index()), fraction, most, spec.seed);
        }
        Ok(Indices { train, validation: indices_of(Split::Validation), test: indices_of(Split::Test) })
    }
}

impl Data {
    /// Reads the maps of a training. `maps` must have the reference of `spec`.
    pub(super) fn load(maps: &Maps, spec: &TrainSpec) -> Result<Self, TrainError> {
        let dataset = maps.dataset();
        let shape = dataset.header().shape;
        if shape.rx != 1 {
            return Err(TrainError::Channels { rx: shape.rx });
        }
        let [_, rows, columns] = input_shape(shape.range, shape.doppler, spec.transposed);
        if let Some(layer) = spec.network_spec().too_small_for(rows, columns) {
            return Err(TrainError::TooSmall { layer, range: shape.range, doppler: shape.doppler });
        }
        let skipped = spec.reference.skipped_range_bins().unwrap_or(0);
        if skipped >= shape.range {
            return Err(TrainError::AllSkipped { skipped, range: shape.range });
        }
        let has_motion = spec.network.reads_descriptors() && dataset.header().rdm_spec.motion_over_s.is_some();
        if let Some(setting) = spec.augmentation.first_motion_setting().filter(|_| has_motion) {
            return Err(TrainError::UnfollowedMotion { setting });
        }
        let warnings = training_warnings(dataset, spec)?;
        let Indices { train, validation, test } = Indices::choose(dataset, spec)?;
        let rows = dataset.rows();
        let part = |indices: Vec<usize>| -> Result<Part, TrainError> {
            let maps: Vec<Arc<[f32]>> = indices.iter().map(|&index| maps.get(index)).collect::<Result<_, _>>()?;
            let rows_of_part = || indices.iter().filter_map(|&index| rows.get(index));
            let labels = rows_of_part().map(|row| row.label.index()).collect();
            let motions = rows_of_part().map(|row| row.motion).collect();
            Ok(Part { indices, maps, labels, motions, scales: Vec::new() })
        };
        let (mut train, mut validation) = (part(train)?, part(validation)?);
        for (split, part) in [(Split::Train, &train), (Split::Validation, &validation)] {
            if part.indices.is_empty() {
                let sequences = rows.iter().map(|r| r.sequence.as_str()).collect::<BTreeSet<_>>().len();
                return Err(TrainError::EmptySplit { split, maps: rows.len(), sequences });
            }
        }
        // Test maps are read now, so that a damaged one is not found only after the training.
        test.iter().try_for_each(|&index| dataset.map(index).map(drop))?;
        let counts = train.counts();
        let present: Vec<Occupancy> = Occupancy::ALL.into_iter().filter(|o| counts[o.index()] > 0).collect();
        if let [class] = present[..] {
            return Err(TrainError::OneClass { class });
        }
        let partners = spec.augmentation.superpose.map(|superpose| {
            let sequences = train.indices.iter().filter_map(|&i| rows.get(i)).map(|row| row.sequence.as_str());
            Partners::new(superpose, &train.labels, sequences)
        });
        let class_weights = class_weights(spec, &train, partners.as_ref());
        let standardisation = standardisation(spec, rows, &train)?;
        for part in [&mut train, &mut validation] {
            part.scales =
                part.indices.iter().map(|index| standardisation.scale(scene_and_class(rows, *index))).collect();
        }
        Ok(Data {
            train,
            validation,
            test,
            standardisation,
            class_weights,
            range: shape.range,
            doppler: shape.doppler,
            transposed: spec.transposed,
            network: spec.network,
            partners,
            warnings,
        })
    }

    /// Inputs of the network for maps of a part by their position in it: `[batch][range][doppler]` or with both exchanged, or
    /// descriptors.
    pub(super) fn batch(&self, part: &Part, positions: &[usize]) -> CandleResult<Tensor> {
        let map = |&position: &usize| {
            let mut cells = part.maps.get(position)?.to_vec();
            self.standardise(part, position, &mut cells)?;
            self.input(part, position, cells)
        };
        let maps: Vec<Vec<f32>> = positions.par_iter().filter_map(map).collect();
        self.tensor(maps)
    }

    /// Bounds and scales a map for the network; `None` if the part has no such map.
    fn standardise(&self, part: &Part, position: usize, cells: &mut [f32]) -> Option<()> {
        self.standardisation.reference.clip(cells);
        part.scales.get(position)?.apply(cells);
        Some(())
    }

    /// Input of the network for standardised cells; `None` if the part has no such map.
    fn input(&self, part: &Part, position: usize, cells: Vec<f32>) -> Option<Vec<f32>> {
        Some(self.network.input(cells, *part.motions.get(position)?, self.doppler))
    }

    fn tensor(&self, inputs: Vec<Vec<f32>>) -> CandleResult<Tensor> {
        let [rows, columns] = self.network.input_size([self.range, self.doppler]);
        let inputs = Tensor::from_vec(inputs.concat(), (inputs.len(), rows, columns), &Device::Cpu)?;
        if self.transposed { inputs.transpose(1, 2)?.contiguous() } else { Ok(inputs) }
    }

    /// Inputs of the network for training maps after augmentation, and their classes, which it may change. The changes of a map are a function of seed, epoch
    /// and map.
    pub(super) fn augmented(
        &self,
        positions: &[usize],
        augmentation: &Augmentation,
        seed: u64,
        epoch: usize,
    ) -> CandleResult<(Tensor, Vec<usize>)> {
        let augmented_map = |&position: &usize| {
            let index = (epoch * self.train.maps.len() + position) as u64;
            self.augmented_map(position, augmentation, MapUse { seed, index })
        };
        let augmented: Vec<(Vec<f32>, usize)> = positions.par_iter().filter_map(augmented_map).collect();
        let (inputs, labels) = augmented.into_iter().unzip();
        Ok((self.tensor(inputs)?, labels))
    }

    /// Input of the network for one use of a training map, and its class.
    fn augmented_map(
        &self,
        position: usize,
        augmentation: &Augmentation,
        map_use: MapUse,
    ) -> Option<(Vec<f32>, usize)> {
        let part = &self.train;
        let (mut cells, mut label) = (part.maps.get(position)?.to_vec(), *part.labels.get(position)?);
        if augmentation.first_power_setting().is_some() {
            let other = self.partners.as_ref().and_then(|partners| partners.partner(position, label, map_use));
            label += other.and_then(|other| part.labels.get(other)).copied().unwrap_or(0);
            let other = other.and_then(|other| part.maps.get(other)).map(|map| &**map);
            let skip = self.standardisation.reference.skipped_range_bins().unwrap_or(0);
            augmentation.change_powers(&mut cells, other, self.doppler, skip, map_use);
        }
        self.standardise(part, position, &mut cells)?;
        let sigma_db = self.standardisation.sigma_db as f32;
        augmentation.flip_and_add_noise(&mut cells, self.doppler, sigma_db, map_use);
        Some((self.input(part, position, cells)?, label))
    }
}

/// Warnings about the maps of a training, from the rows of the dataset alone. The outcome of the training repeats them.
///
/// # Errors
/// Those of [`Dataset::splits`].
pub fn training_warnings(dataset: &Dataset, spec: &TrainSpec) -> Result<Vec<String>, DatasetError> {
    let (indices, rows) = (Indices::choose(dataset, spec)?, dataset.rows());
    let mut warnings = split_warnings(&indices, rows);
    warnings.extend(rule_warnings(&spec.split, rows));
    if spec.label_leaking_cells {
        warnings.push(
            "maps are standardised by scene and class: every map's label, those of the test split too, is told to the \
             network by its scale, and no score says what the model would do on maps without labels"
                .to_owned(),
        );
    }
    Ok(warnings)
}

/// Warnings about classes and splits without maps. Trainings without maps to train or to choose on are refused.
fn split_warnings(indices: &Indices, rows: &[ManifestRow]) -> Vec<String> {
    let Indices { train, validation, test } = indices;
    let mut warnings = Vec::new();
    for (split, maps) in [(Split::Train, train), (Split::Validation, validation), (Split::Test, test)] {
        let labels: BTreeSet<Occupancy> = maps.iter().filter_map(|&map| rows.get(map)).map(|row| row.label).collect();
        for class in Occupancy::ALL.into_iter().filter(|class| !labels.is_empty() && !labels.contains(class)) {
            warnings.push(format!("the {split} split has no map of class '{class}'"));
        }
    }
    if test.is_empty() {
        warnings.push("the test split is empty: scores on the validation split are optimistic".to_owned());
    }
    warnings
}

/// Warnings about sequences that the rule of the splits cannot group, about those that it holds out together with the named one, about
/// splits of rows that it overrides, and about those that override it.
fn rule_warnings(rule: &SplitSpec, rows: &[ManifestRow]) -> Vec<String> {
    // Rows with a split of their own do not depend on the rule, unless it holds a sequence out.
    let ungrouped = rule.by.warning(rows.iter().filter(|row| row.split.is_none() || rule.held_out.is_some()));
    let with_split = rows.iter().filter(|row| row.split.is_some()).count();
    let overridden = rule.held_out.as_ref().filter(|_| with_split > 0).map(|held_out| {
        format!(
            "sequence '{held_out}' is held out, so the splits that {with_split} of {} maps have in the dataset do not count: the other \
             sequences are divided into training and validation by the rule",
            rows.len()
        )
    });
    let unused = rule.unused_warning(rows);
    ungrouped.into_iter().chain(rule.group_warning(rows)).chain(overridden).chain(unused).collect()
}

/// Weight of each class in the loss: `n / (k n_c)` for the k classes with maps, so that the mean weight of a map is one, times the
/// weight of its label.
fn class_weights(spec: &TrainSpec, train: &Part, partners: Option<&Partners>) -> Vec<f32> {
    let counts = partners.map_or(train.counts().map(|c| c as f64), Partners::expected);
    let classes = counts.iter().filter(|n| **n > 0.0).count();
    let balance = |n| match n {
        n if n <= 0.0 => 0.0,
        _ if !spec.class_weights => 1.0,
        n => train.labels.len() as f32 / (classes as f64 * n) as f32,
    };
    counts.iter().zip(spec.label_weights).map(|(&n, label_weight)| balance(n) * label_weight as f32).collect()
}

fn standardisation(spec: &TrainSpec, rows: &[ManifestRow], train: &Part) -> Result<Standardisation, TrainError> {
    let clipped = train.maps.iter().map(|map| spec.reference.clipped(map));
    let mut standardisation = Standardisation::measure(spec.reference, clipped)?;
    if spec.network.reads_descriptors() {
        // Descriptors are computed from levels in dB, which must not be standardised.
        (standardisation.mean_db, standardisation.sigma_db) = (0.0, 1.0);
    }
    if spec.label_leaking_cells {
        let groups: BTreeSet<_> = train.indices.iter().filter_map(|&index| scene_and_class(rows, index)).collect();
        for (scene, class) in groups {
            let is_in_group = |index: usize| scene_and_class(rows, index) == Some((scene, class));
            let maps = train.indices.iter().zip(&train.maps).filter(|(index, _)| is_in_group(**index));
            standardisation.add_scene_and_class(scene, class, maps.map(|(_, map)| spec.reference.clipped(map)))?;
        }
    }
    Ok(standardisation)
}

/// Scene and class of a map.
fn scene_and_class(rows: &[ManifestRow], index: usize) -> Option<(&str, Occupancy)> {
    rows.get(index).map(|row| (row.scene.as_str(), row.label))
}

/// A share of the maps, drawn class by class (at least one of each) and at most `most`, in their order.
fn fraction_by_class(
    indices: &[usize],
    class: impl Fn(usize) -> Option<usize>,
    fraction: f64,
    most: usize,
    seed: u64,
) -> Vec<usize> {
    let indices_of = |label: Occupancy| -> Vec<usize> {
        indices.iter().copied().filter(|&i| class(i) == Some(label.index())).collect()
    };
    let mut by_class = Occupancy::ALL.map(indices_of);
    let counts = counts_to_keep(by_class.each_ref().map(Vec::len), fraction, most);
    for ((label, maps), count) in by_class.iter_mut().enumerate().zip(counts) {
        maps.shuffle(&mut stream(seed, "label fraction", label as u64));
        maps.truncate(count);
    }
    let mut selected = by_class.concat();
    selected.sort_unstable();
    selected
}

/// This fraction of `counts`, each rounded and at least one if the count is not zero. While their sum exceeds `most`, the largest is
/// reduced.
fn counts_to_keep(counts: [usize; Occupancy::ALL.len()], fraction: f64, most: usize) -> [usize; Occupancy::ALL.len()] {
    let mut kept = counts.map(|count| ((fraction * count as f64).round() as usize).max(1).min(count));
    while kept.iter().sum::<usize>() > most
        && let Some(largest) = kept.iter_mut().max()
    {
        *largest = largest.saturating_sub(1);
    }
    kept
}

#[cfg(test)]
pub(super) mod tests {
    use radome_dsp::{RdmSpec, Waveform, WaveformRequest};
    use rand::Rng;
    use rand_distr::{Distribution, Normal};

    use super::*;
    use crate::dataset::{DatasetHeader, Domain};
    use crate::standardise::MapReference;
    use crate::train::{Superpose, Sway};

    const SIZE: usize = 16;

    /// Dataset of `count` maps `size x size` of all classes in turn; the first `train` are in the training split. `cell` gives the cells.
    pub fn dataset_of(size: usize, count: usize, train: usize, mut cell: impl FnMut() -> f32) -> Dataset {
        let request =
            WaveformRequest { samples_per_chirp: 2 * size, chirps_per_frame: size, ..WaveformRequest::paper() };
        let waveform = Waveform::realise(request).expect("waveform");
        let header = DatasetHeader::new(waveform, RdmSpec::paper()).expect("header");
        let maps = (0..count).map(|index| {
            let label = Occupancy::from_index(index % 3).expect("class");
            let mut row = ManifestRow::new(Domain::Sim, "made-up", "run", &format!("s{index}"), 0, label);
            row.split = Some(if index < train { Split::Train } else { Split::Validation });
            let db = (0..header.shape.cells()).map(|_| cell()).collect();
            (header.rdm(db, 0), row)
        });
        let maps = maps.collect();
        Dataset::from_maps(header, maps).expect("dataset")
    }

    fn noise() -> Dataset {
        let mut rng = stream(2, "cells", 0);
        dataset_of(SIZE, 36, 24, || -80.0 + 10.0 * rng.random_range(1e-3f32..1.0).log10())
    }

    fn load(dataset: &Dataset, augmentation: Augmentation, most_db: Option<f32>) -> Data {
        let reference = MapReference::OverNoise { skip_range_bins: 2, most_db };
        let maps = Maps::new(dataset, reference);
        Data::load(&maps, &TrainSpec { reference, augmentation, ..TrainSpec::default() }).expect("data")
    }

    fn cells(tensor: &Tensor) -> Vec<f32> {
        tensor.flatten_all().and_then(|t| t.to_vec1()).expect("cells")
    }

    /// Regression test: fractions of 26, 11 and 11 maps that should make 20 were 21, because each was rounded.
    #[test]
    fn limited_maps_are_no_more_than_the_limit() {
        assert_eq!(counts_to_keep([26, 11, 11], 20.0 / 48.0, 20), [10, 5, 5]);
        assert_eq!(counts_to_keep([46, 1, 1], 3.0 / 48.0, 3), [1, 1, 1]);
        assert_eq!(counts_to_keep([30, 0, 3], 0.1, usize::MAX), [3, 0, 1]);
        for most in 3..=48 {
            let kept = counts_to_keep([22, 15, 11], most as f64 / 48.0, most);
            assert!(kept.iter().all(|count| *count > 0) && kept.iter().sum::<usize>() <= most, "{most}: {kept:?}");
        }
    }

    /// Settings of old training files standardise, flip and add noise with the same random numbers as ever, so that their trainings
    /// give the same bytes.
    #[test]
    fn flip_and_noise_of_old_settings_are_unchanged() {
        let dataset = noise();
        let augmentation = Augmentation { noise_db: 1.5, doppler_flip: true, ..Augmentation::default() };
        let data = load(&dataset, augmentation, None);
        let positions: Vec<usize> = (0..data.train.maps.len()).collect();
        let (seed, epoch) = (7, 3);
        let (augmented, labels) = data.augmented(&positions, &augmentation, seed, epoch).expect("maps");
        assert_eq!(labels, data.train.labels);
        let mut expected = Vec::new();
        for (position, &index) in data.train.indices.iter().enumerate() {
            let mut map = dataset.input(index, 0).expect("a map");
            data.standardisation.apply(&mut map, SIZE, None);
            let mut rng = stream(seed, "augmentation", (epoch * positions.len() + position) as u64);
            if rng.random::<bool>() {
                map.chunks_exact_mut(SIZE).for_each(|row| row[1..].reverse());
            }
            let sigma = augmentation.noise_db / data.standardisation.sigma_db as f32;
            let normal = Normal::new(0.0f32, sigma).expect("normal");
            map.iter_mut().for_each(|v| *v += normal.sample(&mut rng));
            expected.extend(map);
        }
        assert_eq!(cells(&augmented), expected);
        // Without augmentation, a map is the classifier's input.
        let none = data.augmented(&[5], &Augmentation::default(), seed, epoch).expect("maps").0;
        let mut map = dataset.input(data.train.indices[5], 0).expect("a map");
        data.standardisation.apply(&mut map, SIZE, None);
        assert_eq!(cells(&none), map);
        assert_eq!(cells(&data.batch(&data.train, &[5]).expect("maps")), map);
    }

    /// Augmented maps are bounded as in use, at any level.
    #[test]
    fn the_bound_comes_after_augmentation() {
        let dataset = noise();
        let sway = Sway { probability: 1.0, level_db: [40.0, 40.0], ..Sway::default() };
        let augmentation = Augmentation { sway: Some(sway), ..Augmentation::default() };
        let positions: Vec<usize> = (0..24).collect();
        for most_db in [6.0f32, 20.0] {
            let data = load(&dataset, augmentation, Some(most_db));
            let augmented = cells(&data.augmented(&positions, &augmentation, 1, 1).expect("maps").0);
            let most = augmented.iter().copied().fold(f32::MIN, f32::max);
            let expected = (f64::from(most_db) - data.standardisation.mean_db) / data.standardisation.sigma_db;
            assert!((f64::from(most) - expected).abs() < 1e-6, "{most} {expected}");
        }
    }

    /// Superposed maps change classes, and class weights follow the expected number of maps of each class.
    #[test]
    fn superposed_maps_have_the_class_of_both() {
        let dataset = noise();
        let augmentation = Augmentation { superpose: Some(Superpose { probability: 1.0 }), ..Augmentation::default() };
        let data = load(&dataset, augmentation, None);
        let positions: Vec<usize> = (0..24).collect();
        let (_, labels) = data.augmented(&positions, &augmentation, 1, 1).expect("maps");
        let increased = labels.iter().zip(&data.train.labels).filter(|(label, own)| label > own).count();
        assert!(increased > 1, "{labels:?}");
        assert!(labels.iter().zip(&data.train.labels).all(|(label, own)| label >= own && *label <= 2));
        // Of eight maps of each class: 8/3 empty, 8/3 + 4 of one, the others of two.
        for (weight, n) in data.class_weights.iter().zip([8.0 / 3.0, 8.0 / 3.0 + 4.0, 8.0 / 3.0 + 4.0 + 8.0]) {
            assert!((f64::from(*weight) - 24.0 / (3.0 * n)).abs() < 1e-5, "{:?}", data.class_weights);
        }
        assert_eq!(load(&dataset, Augmentation::default(), None).class_weights, [1.0; 3]);
    }
}
