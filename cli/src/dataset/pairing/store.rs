//! Dataset of a recording and its mirror.

use std::fs::File;
use std::io::{BufReader, BufWriter, IntoInnerError, Read, Seek, SeekFrom, Write};
use std::path::Path;

use anyhow::Context;
use radome_dsp::rdm::Motion;
use radome_dsp::{Rdm, Truth};
use radome_models::dataset::{DatasetWriter, Domain, ManifestRow};

use super::echo_finder::FrameInfo;
use crate::shard;

/// Maps of the recording, until the mirror shows which of them have a counterpart. Their cells are in an unnamed file, so that
/// recordings of any length need the same memory.
pub struct WaitingMaps {
    cells: BufWriter<File>,
    /// Index and number of the frame of each map, and its motion.
    frames: Vec<(usize, u64, Option<Motion>)>,
}

impl WaitingMaps {
    /// Creates an empty list, whose file is in a folder.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn new(folder: &Path) -> anyhow::Result<Self> {
        let file =
            tempfile::tempfile_in(folder).with_context(|| format!("cannot make a file in {}", folder.display()))?;
        Ok(WaitingMaps { cells: BufWriter::new(file), frames: Vec::new() })
    }

    /// Appends the map of a frame.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn push(&mut self, frame: usize, map: &Rdm) -> anyhow::Result<()> {
        self.frames.push((frame, map.sequence, map.motion));
        let mut cells = map.db.iter();
        cells.try_for_each(|cell| self.cells.write_all(&cell.to_le_bytes())).context("cannot keep a map")
    }

    /// Reads the maps again, in order, into `map`. `handle` takes each with the index of its frame.
    ///
    /// # Errors
    /// The file cannot be written or read, or `handle` fails.
    pub fn for_each(
        self,
        map: &mut Rdm,
        mut handle: impl FnMut(usize, &Rdm) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let cannot = "cannot read a map again";
        let mut file = self.cells.into_inner().map_err(IntoInnerError::into_error).context(cannot)?;
        file.seek(SeekFrom::Start(0)).context(cannot)?;
        let mut cells = BufReader::new(file);
        for (frame, sequence, motion) in self.frames {
            (map.sequence, map.motion) = (sequence, motion);
            let mut bytes = [0; size_of::<f32>()];
            for cell in &mut map.db {
                cells.read_exact(&mut bytes).context(cannot)?;
                *cell = f32::from_le_bytes(bytes);
            }
            handle(frame, map)?;
        }
        Ok(())
    }
}

/// Writer of maps of both sides of a pair.
pub struct Store {
    pub writer: DatasetWriter,
    pub pair: String,
    pub scene: String,
    pub subject: Option<String>,
}

impl Store {
    /// Stores a map of one side with the class of the frame.
    ///
    /// # Errors
    /// The dataset cannot be written.
    pub fn push(
        &mut self,
        domain: Domain,
        map: &Rdm,
        info: &FrameInfo,
        truth: Truth,
        seed: Option<u64>,
    ) -> anyhow::Result<()> {
        let recording = match domain {
            Domain::Real => self.pair.clone(),
            Domain::Sim => format!("{}-mirror", self.pair),
        };
        // Shards of a simulated run are one sequence, which no two splits share.
        let sequence = shard::name_of_whole(&self.pair);
        let mut row = ManifestRow::new(domain, &self.scene, &recording, sequence, info.sequence, truth.occupancy);
        row.subject.clone_from(&self.subject);
        row.time_ns = Some(info.time_ns);
        row.pair = Some(self.pair.clone());
        row.transition = truth.transition;
        row.seed = seed;
        Ok(self.writer.push(map, row)?)
    }
}
