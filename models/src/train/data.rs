//! The maps of a training, standardised and in memory.

use std::collections::BTreeSet;

use candle_core::{Device, Result as CandleResult, Tensor};
use radome_dsp::Occupancy;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_distr::{Distribution, Normal};
use rayon::prelude::*;

use super::{Augmentation, TrainError, TrainSpec};
use crate::dataset::{Dataset, Split};
use crate::model_file::input_shape;
use crate::standardise::Standardisation;
use crate::stream;

/// Maps `[range][doppler]`, standardised, and their classes.
pub(super) struct Part {
    /// Index of each map in the dataset.
    pub indices: Vec<usize>,
    pub maps: Vec<Vec<f32>>,
    pub labels: Vec<usize>,
}

pub(super) struct Data {
    pub train: Part,
    pub validation: Part,
    /// Indices only: the test maps are read when all is done.
    pub test: Vec<usize>,
    pub standardisation: Standardisation,
    pub class_weights: Vec<f32>,
    pub range: usize,
    pub doppler: usize,
    /// Whether batches have range and Doppler exchanged.
    pub transposed: bool,
    pub warnings: Vec<String>,
}

impl Data {
    pub(super) fn load(dataset: &Dataset, spec: &TrainSpec) -> Result<Self, TrainError> {
        let shape = dataset.header().shape;
        if shape.rx != 1 {
            return Err(TrainError::Channels { rx: shape.rx });
        }
        let [_, rows, columns] = input_shape(shape.range, shape.doppler, spec.transposed);
        if let Some(layer) = spec.network_spec().too_small_for(rows, columns) {
            return Err(TrainError::TooSmall { layer, range: shape.range, doppler: shape.doppler });
        }
        let splits = dataset.splits(&spec.split)?;
        let rows = dataset.rows();
        let part = |split: Split| -> Result<Part, TrainError> {
            let of_split = splits.iter().enumerate().filter(|&(_, &s)| s == split).map(|(index, _)| index);
            let wanted =
                |i: &usize| split != Split::Train || spec.transitions || rows.get(*i).is_none_or(|r| !r.transition);
            let mut indices: Vec<usize> = of_split.filter(wanted).collect();
            let most = spec.most_training_maps.map_or(1.0, |most| most as f64 / indices.len().max(1) as f64);
            let fraction = spec.label_fraction * most.min(1.0);
            if split == Split::Train && fraction < 1.0 {
                indices = fraction_by_class(&indices, |i| rows.get(i).map(|r| r.label.index()), fraction, spec.seed);
            }
            let mut maps: Vec<Vec<f32>> = indices.iter().map(|&i| dataset.input(i, 0)).collect::<Result<_, _>>()?;
            maps.iter_mut().for_each(|map| spec.reference.apply(map, shape.doppler));
            let labels = indices.iter().filter_map(|&i| rows.get(i)).map(|r| r.label.index()).collect();
            Ok(Part { indices, maps, labels })
        };
        let (mut train, mut validation) = (part(Split::Train)?, part(Split::Validation)?);
        for (split, part) in [(Split::Train, &train), (Split::Validation, &validation)] {
            if part.indices.is_empty() {
                let sequences = rows.iter().map(|r| r.sequence.as_str()).collect::<BTreeSet<_>>().len();
                return Err(TrainError::EmptySplit { split, maps: rows.len(), sequences });
            }
        }
        let test: Vec<usize> =
            splits.iter().enumerate().filter(|&(_, &s)| s == Split::Test).map(|(index, _)| index).collect();

        let count = |part: &Part| Occupancy::ALL.map(|o| part.labels.iter().filter(|&&l| l == o.index()).count());
        let counts = count(&train);
        let present: Vec<Occupancy> = Occupancy::ALL.into_iter().filter(|o| counts[o.index()] > 0).collect();
        if let [class] = present[..] {
            return Err(TrainError::OneClass { class });
        }
        let mut warnings = Vec::new();
        for (split, counts) in [(Split::Train, counts), (Split::Validation, count(&validation))] {
            for class in Occupancy::ALL.into_iter().filter(|o| counts[o.index()] == 0) {
                warnings.push(format!("the {split} split has no map of class '{class}'"));
            }
        }
        if test.is_empty() {
            warnings.push("the test split is empty: scores on the validation split are optimistic".to_owned());
        }
        // n / (k n_c) over the k classes present, so that the mean weight of a map is one.
        let class_weights = counts
            .map(|c| match c {
                0 => 0.0,
                _ if !spec.class_weights => 1.0,
                c => train.labels.len() as f32 / (present.len() * c) as f32,
            })
            .to_vec();

        let mut standardisation = Standardisation::measure(spec.reference, train.maps.iter().map(Vec::as_slice))?;
        if spec.network.reads_descriptors() {
            // They are of levels in dB.
            (standardisation.mean_db, standardisation.sigma_db) = (0.0, 1.0);
        }
        let cell = |index: usize| rows.get(index).map(|row| (row.scene.as_str(), row.label));
        if spec.label_leaking_cells {
            let cells: BTreeSet<_> = train.indices.iter().filter_map(|&index| cell(index)).collect();
            for of in cells {
                let maps = train.indices.iter().zip(&train.maps).filter(|(index, _)| cell(**index) == Some(of));
                standardisation.add_cell(of.0, of.1, maps.map(|(_, map)| map.as_slice()))?;
            }
            warnings.push(
                "maps are standardised by scene and class: every map's label, those of the test split too, is told to the \
                 network by its scale, and no score says what the model would do on maps without labels"
                    .to_owned(),
            );
        }
        for part in [&mut train, &mut validation] {
            for (index, map) in part.indices.iter().zip(&mut part.maps) {
                standardisation.scale(map, cell(*index));
            }
        }
        let (range, doppler) = (shape.range, shape.doppler);
        Ok(Data {
            train,
            validation,
            test,
            standardisation,
            class_weights,
            range,
            doppler,
            transposed: spec.transposed,
            warnings,
        })
    }

    /// Maps of a part by their position in it, `[batch][range][doppler]` or with both exchanged.
    pub(super) fn batch(&self, part: &Part, positions: &[usize]) -> CandleResult<Tensor> {
        self.tensor(self.cells(part, positions), positions.len())
    }

    fn cells(&self, part: &Part, positions: &[usize]) -> Vec<f32> {
        let maps: Vec<&[f32]> = positions.iter().filter_map(|&p| part.maps.get(p)).map(Vec::as_slice).collect();
        maps.concat()
    }

    fn tensor(&self, cells: Vec<f32>, batch: usize) -> CandleResult<Tensor> {
        let maps = Tensor::from_vec(cells, (batch, self.range, self.doppler), &Device::Cpu)?;
        if self.transposed { maps.transpose(1, 2)?.contiguous() } else { Ok(maps) }
    }

    /// Training maps with augmentation: what happens to a map is a function of seed, epoch and map.
    pub(super) fn augmented(
        &self,
        positions: &[usize],
        augmentation: Augmentation,
        seed: u64,
        epoch: usize,
    ) -> CandleResult<Tensor> {
        if augmentation == Augmentation::default() {
            return self.batch(&self.train, positions);
        }
        let sigma = augmentation.noise_db / self.standardisation.sigma_db as f32;
        let mut cells = self.cells(&self.train, positions);
        let maps = cells.par_chunks_exact_mut((self.range * self.doppler).max(1)).zip(positions);
        maps.for_each(|(map, &position)| {
            let mut rng = stream(seed, "augmentation", (epoch * self.train.maps.len() + position) as u64);
            if augmentation.doppler_flip && rng.random::<bool>() {
                flip_doppler(map, self.doppler);
            }
            if sigma > 0.0
                && let Ok(normal) = Normal::new(0.0f32, sigma)
            {
                map.iter_mut().for_each(|v| *v += normal.sample(&mut rng));
            }
        });
        self.tensor(cells, positions.len())
    }
}

/// A share of the maps, drawn class by class (at least one of each), in their order.
fn fraction_by_class(
    indices: &[usize],
    class: impl Fn(usize) -> Option<usize>,
    fraction: f64,
    seed: u64,
) -> Vec<usize> {
    let mut kept = Vec::new();
    for label in Occupancy::ALL {
        let mut of_class: Vec<usize> = indices.iter().copied().filter(|&i| class(i) == Some(label.index())).collect();
        of_class.shuffle(&mut stream(seed, "label fraction", label.index() as u64));
        of_class.truncate(((fraction * of_class.len() as f64).round() as usize).max(1));
        kept.extend(of_class);
    }
    kept.sort_unstable();
    kept
}

/// Exchanges velocity `v` and `-v` in `[range][doppler]`. Zero is at `n / 2`; for an even n, bin 0 (the most negative
/// velocity) has no partner and stays.
fn flip_doppler(map: &mut [f32], doppler: usize) {
    for row in map.chunks_exact_mut(doppler) {
        if doppler.is_multiple_of(2) { row[1..].reverse() } else { row.reverse() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flipping_keeps_zero_doppler() {
        let mut even = vec![-3.0, -2.0, -1.0, 0.0, 1.0, 2.0];
        flip_doppler(&mut even, 6);
        assert_eq!(even, [-3.0, 2.0, 1.0, 0.0, -1.0, -2.0]);
        let mut odd = vec![-1.0, 0.0, 1.0];
        flip_doppler(&mut odd, 3);
        assert_eq!(odd, [1.0, 0.0, -1.0]);
    }
}
