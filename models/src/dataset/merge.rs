//! Concatenation of datasets.

use std::path::Path;

use super::error::DatasetError;
use super::header::DatasetHeader;
use super::reader::Dataset;
use super::split::SplitSpec;
use super::writer::DatasetWriter;

/// Writes the maps of all `parts`, in order, as one dataset at `dir`; returns how many there are. With `split`, every row
/// gets its split ([`SplitSpec::assign`]), fixed from then on.
///
/// The result depends on the parts' maps and rows alone, not on how they were cut into parts. Every map is compared with
/// its hash on the way.
///
/// The waveform of parts on physical axes is the nominal one: it may differ, and the first part's is kept.
///
/// # Errors
/// Parts with another header than the first one's; a damaged map; what [`DatasetWriter`] and [`SplitSpec`] refuse.
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
        let is_any_waveform = expected.rdm_spec.physical_axes.is_some();
        let waveform = if is_any_waveform { &expected.waveform } else { &header.waveform };
        let compared = DatasetHeader { waveform: waveform.clone(), ..header.clone() };
        let what = match () {
            () if header.rdm_spec != expected.rdm_spec => "the map spec",
            () if compared.waveform != expected.waveform => "the waveform",
            () if compared != *expected => "the header",
            () => continue,
        };
        return Err(DatasetError::Unlike {
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
