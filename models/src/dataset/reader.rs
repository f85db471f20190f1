//! Datasets in a folder or in memory.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use radome_dsp::{Rdm, RdmShape, Waveform};
use radome_files::{Refused, TEXT_LIMIT_BYTES, read_text, within};
use sha2::{Digest, Sha256};

use super::error::DatasetError;
use super::header::{DatasetHeader, FORMAT_VERSION};
use super::layout::{MAPS_PER_SHARD, network_input, shard_name};
use super::manifest::{ManifestRow, Split};
use super::split::SplitSpec;
use super::writer::{check_map, check_motion, map_hash};

/// Longest manifest that is read. A row has about 300 bytes, and datasets have some hundred thousand maps.
pub const MANIFEST_LIMIT_BYTES: u64 = 512 << 20;
/// Longest row of a manifest. It holds names of scenes, recordings and people, and a hash.
const LONGEST_ROW_BYTES: usize = 64 << 10;

/// Dataset of labelled maps, in a folder or in memory.
///
/// # Examples
/// ```no_run
/// use std::path::Path;
///
/// use radome_models::Dataset;
///
/// let dataset = Dataset::open(Path::new("dataset"))?;
/// println!("{} maps of {}", dataset.len(), dataset.header().shape);
/// # Ok::<(), radome_models::dataset::DatasetError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Dataset {
    header: DatasetHeader,
    rows: Vec<ManifestRow>,
    cells: Cells,
}

/// Location of the cells of all maps.
#[derive(Debug, Clone)]
enum Cells {
    Memory(Vec<Vec<f32>>),
    Shards(Vec<Shard>),
}

#[derive(Debug, Clone)]
struct Shard {
    path: PathBuf,
    /// Position of the first map in the file, bytes.
    data_offset: u64,
}

impl Dataset {
    /// Opens a folder: reads header and manifest, and checks that the shards hold as many maps as the manifest lists.
    /// Cells are read on demand.
    ///
    /// # Errors
    /// [`DatasetError`] where a file is missing, too large, not a regular file of this folder, or contradicts the others.
    pub fn open(dir: &Path) -> Result<Self, DatasetError> {
        let header = read_header(dir)?;
        let rows = read_rows(dir)?;
        for (index, row) in rows.iter().enumerate() {
            check_motion(row.motion, &header, || index.to_string())?;
        }
        let mut shards = Vec::new();
        for (shard, rows) in rows.chunks(MAPS_PER_SHARD).enumerate() {
            let path = dir.join(shard_name(shard));
            within(dir, &shard_name(shard)).map_err(DatasetError::io(&path, "opening"))?;
            let data_offset = check_shard(&path, header.shape, rows.len())?;
            shards.push(Shard { path, data_offset });
        }
        let next = dir.join(shard_name(shards.len()));
        if next.exists() {
            let expected = format!("no shard behind the {} maps that the manifest lists", rows.len());
            let found = "one more; the manifest is cut short, or the shard is of another dataset".to_owned();
            return Err(DatasetError::Inconsistent { path: next, expected, found });
        }
        Ok(Dataset { header, rows, cells: Cells::Shards(shards) })
    }

    /// Makes a dataset in memory, and fills in motion and hash of the rows.
    ///
    /// # Errors
    /// [`DatasetError::Shape`], [`DatasetError::NonFinite`] or [`DatasetError::Motion`] for the first map of another shape than the
    /// header's, with a cell that is not finite, or with motion that is missing or not expected.
    pub fn from_maps(header: DatasetHeader, maps: Vec<(Rdm, ManifestRow)>) -> Result<Self, DatasetError> {
        let mut rows = Vec::with_capacity(maps.len());
        let mut cells = Vec::with_capacity(maps.len());
        for (map, mut row) in maps {
            check_map(&map, &header)?;
            (row.motion, row.hash) = (map.motion, map_hash(&map.db, map.motion));
            rows.push(row);
            cells.push(map.db);
        }
        Ok(Dataset { header, rows, cells: Cells::Memory(cells) })
    }

    /// Properties that all maps share.
    pub fn header(&self) -> &DatasetHeader {
        &self.header
    }

    /// Rows of the manifest, one for each map.
    pub fn rows(&self) -> &[ManifestRow] {
        &self.rows
    }

    /// Number of maps.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Returns whether the dataset has no maps.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Cells of a map, `[rx][doppler][range]` dB. They are finite and match the hash in the manifest.
    ///
    /// # Errors
    /// [`DatasetError::NoSuchMap`] beyond the last map, [`DatasetError::Io`] if the shard cannot be read,
    /// [`DatasetError::NonFinite`] if a cell is NaN or infinite, and [`DatasetError::Hash`] if cells and motion do not match the hash.
    pub fn map(&self, index: usize) -> Result<Vec<f32>, DatasetError> {
        let missing = || DatasetError::NoSuchMap { index, maps: self.rows.len() };
        let row = self.rows.get(index).ok_or_else(missing)?;
        let Shard { path, data_offset } = match &self.cells {
            Cells::Memory(maps) => return maps.get(index).cloned().ok_or_else(missing),
            Cells::Shards(shards) => shards.get(index / MAPS_PER_SHARD).ok_or_else(missing)?,
        };
        let map_bytes = self.header.shape.cells() * 4;
        let mut buffer = vec![0u8; map_bytes];
        let mut read = || -> std::io::Result<()> {
            let mut file = File::open(path)?;
            file.seek(SeekFrom::Start(data_offset + ((index % MAPS_PER_SHARD) * map_bytes) as u64))?;
            file.read_exact(&mut buffer)
        };
        read().map_err(DatasetError::io(path, "reading"))?;
        let db: Vec<f32> = buffer.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        let cells = db.iter().filter(|v| !v.is_finite()).count();
        if cells > 0 {
            return Err(DatasetError::NonFinite { map: index.to_string(), cells });
        }
        let found = map_hash(&db, row.motion);
        if row.hash != found {
            return Err(DatasetError::Hash { path: path.clone(), index, expected: row.hash.clone(), found });
        }
        Ok(db)
    }

    /// One channel of a map as input of a network, `[range][doppler]` dB.
    ///
    /// # Errors
    /// Those of [`Dataset::map`], and [`DatasetError::Inconsistent`] if the maps have no channel `rx`.
    pub fn input(&self, index: usize, rx: usize) -> Result<Vec<f32>, DatasetError> {
        let shape = self.header.shape;
        network_input(&self.map(index)?, shape, rx).ok_or_else(|| DatasetError::Inconsistent {
            path: PathBuf::from(format!("map {index}")),
            expected: format!("a channel with index {rx}"),
            found: shape.to_string(),
        })
    }

    /// Split of each map ([`SplitSpec::assign`]).
    ///
    /// # Errors
    /// Those of [`SplitSpec::assign`].
    pub fn splits(&self, spec: &SplitSpec) -> Result<Vec<Split>, DatasetError> {
        spec.assign(&self.rows)
    }

    /// SHA-256 over header and manifest (which holds the hash of every map), hex.
    pub fn hash(&self) -> String {
        let mut hash = Sha256::new();
        // Serialisation fails only for maps with keys that are not strings; neither type has such keys.
        hash.update(serde_json::to_vec(&self.header).unwrap_or_default());
        for row in &self.rows {
            hash.update(serde_json::to_vec(row).unwrap_or_default());
        }
        format!("{:x}", hash.finalize())
    }

    /// Reads and checks every map.
    ///
    /// # Errors
    /// The first error of [`Dataset::map`].
    pub fn verify(&self) -> Result<(), DatasetError> {
        (0..self.len()).try_for_each(|index| self.map(index).map(|_| ()))
    }
}

/// Reads a text file in a dataset's folder. Returns its path and its content.
fn read(dir: &Path, name: &str, limit_bytes: u64) -> Result<(PathBuf, String), DatasetError> {
    let path = dir.join(name);
    let text = within(dir, name).and_then(|path| read_text(&path, limit_bytes));
    match text {
        Ok(text) => Ok((path, text)),
        Err(error) => Err(DatasetError::io(&path, "reading")(error)),
    }
}

/// Reads `dataset.json`, and checks that its entries agree.
fn read_header(dir: &Path) -> Result<DatasetHeader, DatasetError> {
    if !dir.join("dataset.json").exists() {
        return Err(DatasetError::NoDataset { path: dir.to_owned() });
    }
    let (path, text) = read(dir, "dataset.json", TEXT_LIMIT_BYTES)?;
    let json = |source: serde_json::Error| DatasetError::Json { path: path.clone(), line: source.line(), source };
    // Reads the version alone first: a newer header may have other fields.
    #[derive(serde::Deserialize)]
    struct Version {
        format_version: u32,
    }
    let found = serde_json::from_str::<Version>(&text).map_err(json)?.format_version;
    if found > FORMAT_VERSION {
        return Err(DatasetError::Newer { path, found, supported: FORMAT_VERSION });
    }
    let header: DatasetHeader = serde_json::from_str(&text).map_err(json)?;
    let expected = header.rdm_spec.shape(&header.waveform)?;
    if header.shape != expected {
        let expected = format!("maps of {expected}, as waveform and map spec give");
        return Err(DatasetError::Inconsistent { path, expected, found: header.shape.to_string() });
    }
    let known = DatasetHeader::new(header.waveform.clone(), header.rdm_spec)?;
    if (&header.dimensions, &header.class_names) != (&known.dimensions, &known.class_names) {
        let expected = format!("dimensions {:?} and classes {:?}", known.dimensions, known.class_names);
        let found = format!("{:?} and {:?}", header.dimensions, header.class_names);
        return Err(DatasetError::Inconsistent { path, expected, found });
    }
    check_waveform(path, &header.waveform)?;
    Ok(header)
}

/// Largest relative difference of a realised quantity from the one that the request gives. It is not 0, because boards measure
/// their chirp interval.
const WAVEFORM_TOLERANCE: f64 = 0.05;

/// Checks that the realised quantities of a waveform are those of its request. `path` is used in errors only.
fn check_waveform(path: PathBuf, waveform: &Waveform) -> Result<(), DatasetError> {
    let realised = match Waveform::realise(waveform.request.clone()) {
        Ok(realised) => realised,
        Err(error) => {
            let expected = "a waveform that the chip can produce".to_owned();
            return Err(DatasetError::Inconsistent { path, expected, found: error.to_string() });
        }
    };
    let quantities = |of: &Waveform| {
        [
            ("slope_hz_per_s", of.slope_hz_per_s),
            ("sample_rate_hz", of.sample_rate_hz),
            ("chirp_interval_s", of.chirp_interval_s),
            ("sampled_start_frequency_hz", of.sampled_start_frequency_hz),
        ]
    };
    for ((name, expected), (_, found)) in quantities(&realised).into_iter().zip(quantities(waveform)) {
        let is_near = (found / expected - 1.0).abs() <= WAVEFORM_TOLERANCE;
        if !is_near {
            let (expected, found) = (format!("{name} {expected}, as the request gives"), found.to_string());
            return Err(DatasetError::Inconsistent { path, expected, found });
        }
    }
    Ok(())
}

/// Reads `manifest.jsonl`.
fn read_rows(dir: &Path) -> Result<Vec<ManifestRow>, DatasetError> {
    let (path, text) = read(dir, "manifest.jsonl", MANIFEST_LIMIT_BYTES)?;
    if let Some((index, line)) = text.lines().enumerate().find(|(_, line)| line.len() > LONGEST_ROW_BYTES) {
        let expected = format!("rows of {LONGEST_ROW_BYTES} bytes at most");
        let found = format!("{} bytes in line {}", line.len(), index + 1);
        return Err(DatasetError::Inconsistent { path, expected, found });
    }
    let row = |(index, line): (usize, &str)| {
        serde_json::from_str(line).map_err(|source| DatasetError::Json { path: path.clone(), line: index + 1, source })
    };
    text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()).map(row).collect()
}

/// Longest npy header of version 1, bytes.
const LONGEST_HEADER: u64 = 10 + 65_535;

/// Checks type, shape and length of a shard. Returns the position of its data in the file, bytes.
fn check_shard(path: &Path, shape: RdmShape, maps: usize) -> Result<u64, DatasetError> {
    let inconsistent =
        |expected: String, found: String| DatasetError::Inconsistent { path: path.to_owned(), expected, found };
    // This check comes before opening, because opening a pipe waits for its writer.
    let is_file = std::fs::metadata(path).map_err(DatasetError::io(path, "opening"))?.is_file();
    if !is_file {
        return Err(DatasetError::io(path, "opening")(Refused::NotRegular.into()));
    }
    let file = File::open(path).map_err(DatasetError::io(path, "opening"))?;
    let length = file.metadata().map_err(DatasetError::io(path, "reading"))?.len();
    let mut reader = BufReader::new(file);
    let mut start = vec![0; length.min(LONGEST_HEADER) as usize];
    reader.read_exact(&mut start).map_err(DatasetError::io(path, "reading the npy header"))?;
    check_npy_header(&start).map_err(|(expected, found)| inconsistent(expected, found))?;
    reader.rewind().map_err(DatasetError::io(path, "reading"))?;
    let header = npyz::NpyHeader::from_reader(&mut reader).map_err(DatasetError::io(path, "reading the npy header"))?;
    let expected_shape = [maps, shape.rx, shape.doppler, shape.range].map(|n| n as u64);
    if header.dtype().descr() != "'<f4'" || header.order() != npyz::Order::C || header.shape() != expected_shape {
        return Err(inconsistent(
            format!("little-endian f32 in C order, shape {expected_shape:?}"),
            format!("{}, {:?} order, shape {:?}", header.dtype().descr(), header.order(), header.shape()),
        ));
    }
    let data_offset = reader.stream_position().map_err(DatasetError::io(path, "reading"))?;
    let expected_length = data_offset + (maps * shape.cells() * 4) as u64;
    if length != expected_length {
        return Err(inconsistent(format!("{expected_length} bytes"), format!("{length} bytes")));
    }
    Ok(data_offset)
}

/// Checks the `start` of an npy file before the library parses its header, which takes excessive time or overflows on hostile
/// headers. The error is what was expected, and what was found.
fn check_npy_header(start: &[u8]) -> Result<(), (String, String)> {
    // The parser's time doubles with each level of nested brackets. The header of an array of numbers has one dictionary and one
    // tuple.
    let header_length = start.get(8..10).map_or(0, |l| usize::from(l[0]) | usize::from(l[1]) << 8);
    let text = start.get(10..(10 + header_length).min(start.len())).unwrap_or(&[]);
    let count = |bracket: u8| text.iter().filter(|byte| **byte == bracket).count();
    if start.get(6) != Some(&1) || count(b'[') > 0 || count(b'(') > 1 || count(b'{') > 1 {
        return Err(("an npy header of version 1 of an array of numbers".into(), "another header".into()));
    }
    // The parser multiplies the lengths of the axes without an overflow check.
    let axes = text.split(|byte| *byte == b'(').nth(1).and_then(|rest| rest.split(|byte| *byte == b')').next());
    let axes = String::from_utf8_lossy(axes.unwrap_or(&[])).into_owned();
    let lengths = axes.split(',').map(str::trim).filter(|word| !word.is_empty());
    let product = lengths.map(|word| word.parse::<u64>().ok()).try_fold(1u64, |product, n| product.checked_mul(n?));
    if product.is_none() {
        return Err(("a shape whose product is a 64-bit number".into(), format!("({axes})")));
    }
    Ok(())
}
