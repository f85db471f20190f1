//! Concatenation of datasets.

use std::path::Path;

use super::error::DatasetError;
use super::header::DatasetHeader;
use super::reader::Dataset;
use super::split::SplitSpec;
use super::writer::DatasetWriter;

/// Writes the maps of all `parts`, in order, as one dataset at `dir`, and returns their number. With `split`, every row
/// gets a fixed split ([`SplitSpec::assign`]).
///
/// The result depends on the maps and rows only, not on how they are divided into parts. Every map is compared with its
/// hash.
///
/// On physical axes, the waveforms of the parts are nominal and may differ. That of the first part is kept.
///
/// # Errors
/// [`DatasetError::Inconsistent`] without parts, [`DatasetError::DifferentMaps`] if a part's header differs from the first
/// one's, and those of [`Dataset::map`], [`DatasetWriter`] and [`SplitSpec::assign`].
pub fn merge(parts: &[(&Path, &Dataset)], dir: &Path, split: Option<&SplitSpec>) -> Result<usize, DatasetError> {
    let Some((first_path, first)) = parts.first() else {
        return Err(DatasetError::Inconsistent {
            path: dir.to_owned(),
            expected: "parts to make a dataset of".into(),
            found: "none".into(),
        });
    };
    for (path, part) in parts {
        let (header, expected) = (part.header(), first.header());
        let may_waveforms_differ = expected.rdm_spec.physical_axes.is_some();
        let waveform = if may_waveforms_differ { &expected.waveform } else { &header.waveform };
        let compared = DatasetHeader { waveform: waveform.clone(), ..header.clone() };
        let what = if header.rdm_spec != expected.rdm_spec {
            "the map spec"
        } else if compared.waveform != expected.waveform {
            "the waveform"
        } else if compared != *expected {
            "the header"
        } else {
            continue;
        };
        return Err(DatasetError::DifferentMaps {
            path: path.to_path_buf(),
            what: what.into(),
            first: first_path.to_path_buf(),
        });
    }
    let splits = match split {
        Some(spec) => {
            let rows: Vec<_> = parts.iter().flat_map(|(_, part)| part.rows()).cloned().collect();
            Some(spec.assign(&rows)?)
        }
        None => None,
    };
    let mut writer = DatasetWriter::create(dir, first.header())?;
    for (_, part) in parts {
        for (index, row) in part.rows().iter().enumerate() {
            let mut row = row.clone();
            if let Some(split) = splits.as_ref().and_then(|splits| splits.get(writer.maps())) {
                row.split = Some(*split);
            }
            writer.push_checked(&part.map(index)?, row)?;
        }
    }
    let maps = writer.maps();
    writer.finish()?;
    Ok(maps)
}
