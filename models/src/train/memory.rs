//! Check of a training's memory against the available memory.

use std::path::Path;

use radome_files::{TEXT_LIMIT_BYTES, read_text};

use super::data::Indices;
use super::error::TrainError;
use super::spec::TrainSpec;
use crate::dataset::Dataset;
use crate::model::input_shape;

/// Checks before a training that it fits into memory. If the amount of memory is unknown, every training passes.
///
/// # Errors
/// [`TrainError::Memory`] if it does not fit, and [`TrainError::Dataset`] if the dataset cannot be split.
pub(crate) fn check_memory(dataset: &Dataset, spec: &TrainSpec) -> Result<(), TrainError> {
    memory_bytes().map_or(Ok(()), |available_bytes| check_within(dataset, spec, available_bytes))
}

fn check_within(dataset: &Dataset, spec: &TrainSpec, available_bytes: u64) -> Result<(), TrainError> {
    let Indices { train, validation, .. } = Indices::choose(dataset, spec)?;
    let shape = dataset.header().shape;
    let maps = (train.len() + validation.len()) as u64 * (shape.range * shape.doppler) as u64;
    let [_, rows, columns] = input_shape(shape.range, shape.doppler, spec.transposed);
    let input = spec.network.input_size([rows, columns]);
    let batch_size = spec.batch_size.min(train.len());
    let needed_bytes = 4 * maps + spec.network_spec().graph().least_training_bytes(input, batch_size);
    if needed_bytes > available_bytes {
        return Err(TrainError::Memory { network: spec.network, batch_size, needed_bytes, available_bytes });
    }
    Ok(())
}

/// Memory that this process may use, bytes: the machine's, or the least limit of its control groups.
fn memory_bytes() -> Option<u64> {
    let read = |path: &Path| read_text(path, TEXT_LIMIT_BYTES).ok();
    let information = read(Path::new("/proc/meminfo"))?;
    let total = information.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let machine = total.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)?;
    let root = Path::new("/sys/fs/cgroup");
    let groups = read(Path::new("/proc/self/cgroup")).unwrap_or_default();
    let group = groups.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default();
    let group = root.join(group);
    let limits = group.ancestors().take_while(|folder| folder.starts_with(root));
    let limits = limits.filter_map(|folder| read(&folder.join("memory.max"))?.trim().parse::<u64>().ok());
    Some(limits.fold(machine, u64::min))
}

#[cfg(test)]
mod hard_cases {
    use super::super::data::tests::dataset_of;
    use super::*;
    use crate::network::NetworkKind;

    const SIZE: usize = 64;

    fn dataset() -> Dataset {
        dataset_of(SIZE, 40, 32, || 0.0)
    }

    /// ResNet-18 has 11 million parameters, of which training keeps four arrays, and its first layer alone has 64 channels of a
    /// quarter of the cells.
    #[test]
    fn a_network_that_does_not_fit_into_memory_is_refused_with_the_estimate() {
        let dataset = dataset();
        let spec = TrainSpec { network: NetworkKind::ResNet18, ..TrainSpec::default() };
        let parameters = 4 * 4 * 11_171_779u64;
        let first = 4 * 32 * 64 * (SIZE * SIZE) as u64 / 4;
        let error = check_within(&dataset, &spec, parameters + first).expect_err("more layers than the first");
        let TrainError::Memory { needed_bytes, batch_size, .. } = &error else { panic!("{error}") };
        assert!(*needed_bytes > parameters + first && *batch_size == 32, "{error}");
        let text = error.to_string();
        assert!(text.contains("GB") && text.contains("batch_size"), "{text}");
        assert!(check_within(&dataset, &spec, *needed_bytes).is_ok());
        // Smaller batches need less.
        let spec = TrainSpec { batch_size: 4, ..spec };
        assert!(check_within(&dataset, &spec, needed_bytes - 1).is_ok());
    }

    /// The estimate uses at most as many maps for a batch as the training split has.
    #[test]
    fn batches_are_at_most_the_training_split() {
        let spec = TrainSpec { batch_size: 65_536, ..TrainSpec::default() };
        assert!(check_within(&dataset(), &spec, 1 << 30).is_ok());
    }
}
