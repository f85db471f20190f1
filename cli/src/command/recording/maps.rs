use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_dsp::rdm::{Channels, SlowTime, StaticRemoval};
use radome_dsp::{MapStatus, Rdm, RdmProcessor, RdmSpec, Waveform};
use serde_json::json;

use crate::exit::wrong_use;
use crate::live::pipeline::Items;
use crate::map_preset::MapPreset;
use crate::output_file::{Overwrite, check_ending, is_stdout};
use crate::picture::plot;
use crate::source::{self, SourceArgs};
use crate::{files, output};

/// `radome recording maps`
#[derive(clap::Args)]
#[command(mut_arg("frames", |frames| frames.help("Stop after this number of frames; a simulated scene ends after 100 if absent")))]
pub struct Arguments {
    #[command(flatten)]
    source: SourceArgs,
    /// Array to write, f32 dB `[frame][rx][doppler][range]`, as NPY; `-` is stdout. -o, --png or both are required
    #[arg(short, long, value_name = "FILE.npy")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Picture of one map to write: PNG, or SVG if its name ends in .svg
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    /// Frame of the picture; the last if absent
    #[arg(long, requires = "png")]
    frame: Option<u64>,
    /// Kind of map
    #[arg(long, value_enum, default_value_t)]
    preset: MapPreset,
    /// One receive channel, 1-based
    #[arg(long, conflicts_with = "incoherent")]
    rx: Option<usize>,
    /// Mean power of all receive channels
    #[arg(long)]
    incoherent: bool,
    /// Remove static echoes: subtract the slow-time mean
    #[arg(long)]
    remove_static: bool,
    /// Compute each map from this number of frames up to its own, instead of from the chirps of one frame
    #[arg(long, value_name = "FRAMES")]
    across_frames: Option<usize>,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

impl Arguments {
    fn is_to_stdout(&self) -> bool {
        self.output.as_deref().is_some_and(is_stdout)
    }

    /// Refuses outputs that cannot be written, before anything is computed.
    fn check_outputs(&self) -> anyhow::Result<()> {
        let inputs = self.source.inputs();
        if let Some(picture) = &self.png {
            self.overwrite.check(picture, &inputs)?;
            check_ending(picture, &["png", "svg"], "end the picture's name in .png or .svg; -o writes the array")?;
            if self.output.as_ref() == Some(picture) {
                wrong_use!("-o and --png name one file\n\nhint: name two");
            }
        }
        match &self.output {
            None if self.png.is_none() => {
                wrong_use!(
                    "nothing to write\n\nhint: name an array with -o maps.npy, a picture with --png map.png, or both"
                )
            }
            None => Ok(()),
            Some(path) if !is_stdout(path) => {
                self.overwrite.check(path, &inputs)?;
                check_ending(path, &["npy"], "end the array's name in .npy; --png writes a picture")
            }
            Some(_) if self.json => {
                wrong_use!("the array and --json cannot both go to stdout\n\nhint: name a file with -o maps.npy")
            }
            Some(_) => output::check_no_terminal(),
        }
    }

    /// Returns the preset with the changes that the options make.
    fn spec(&self, waveform: &Waveform) -> anyhow::Result<RdmSpec> {
        let mut spec = self.preset.spec(waveform);
        if let Some(rx) = self.rx {
            let channels = waveform.shape().rx;
            let index = rx.checked_sub(1).filter(|index| *index < channels);
            match index {
                Some(index) => spec.channels = Channels::One(index),
                None => wrong_use!("--rx {rx}: frames have {channels} receive channels, from 1 on"),
            }
        }
        if self.incoherent {
            spec.channels = Channels::IncoherentSum;
        }
        if self.remove_static {
            spec.static_removal = StaticRemoval::SlowTimeMean;
        }
        if let Some(frames) = self.across_frames {
            if frames < 2 {
                wrong_use!("--across-frames {frames}: a map needs at least 2 frames to measure velocities");
            }
            spec.slow_time = SlowTime::Frames { frames };
            spec.doppler_fft_length = None;
        }
        Ok(spec)
    }
}

/// Numbers of maps and of their defects.
#[derive(Default)]
struct Counts {
    maps: u64,
    saturated_samples: u64,
    non_finite_cells: u64,
}

/// Computes the range-Doppler maps of a source.
///
/// # Errors
/// The source cannot be opened, the map is not valid for its waveform, or an output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    arguments.check_outputs()?;
    let source = source::open(&arguments.source.source, &arguments.source.finite_options()?)?;
    let waveform = source.frames.waveform().clone();
    let mut processor = RdmProcessor::new(&arguments.spec(&waveform)?, &waveform)?;
    let mut map = processor.empty_map();
    let row_shape = map_shape(&map);
    let is_live = source.is_live;
    let (mut counts, mut is_drawn, mut read_range) = (Counts::default(), false, None::<(u64, u64)>);
    let bar = output::progress(source.frames.frame_count().unwrap_or(0), "maps");
    let items = Items::of(source.frames, arguments.source.frames);
    // The array is written map by map, since the maps of a night do not fit in memory.
    let mut each_map = |write: &mut dyn FnMut(&Rdm) -> anyhow::Result<()>| {
        while let Some(frame) = items.next_frame(|| processor.reset_at_gap())? {
            read_range = Some((read_range.map_or(frame.sequence, |(first, _)| first), frame.sequence));
            bar.inc(1);
            if processor.process(&frame, &mut map)? != MapStatus::Ready {
                continue;
            }
            counts.maps += 1;
            counts.saturated_samples += u64::from(map.flags.saturated_samples);
            counts.non_finite_cells += u64::from(map.flags.non_finite_cells);
            write(&map)?;
            if let (Some(path), true) = (&arguments.png, arguments.frame == Some(frame.sequence)) {
                plot::save_map(path, &map)?;
                is_drawn = true;
            }
        }
        // Checked before the array gets its final name. A board sends until it is stopped; a part of a recording is no array of it.
        match output::interrupted() {
            false => check_maps(arguments, counts.maps, read_range, is_drawn)?,
            true => ensure!(is_live, "interrupted after {} maps: nothing is written", counts.maps),
        }
        anyhow::Ok(counts.maps)
    };
    match &arguments.output {
        None => {
            each_map(&mut |_| Ok(()))?;
        }
        Some(path) => write_array(path, arguments.overwrite, &row_shape, &mut each_map)?,
    }
    bar.finish_and_clear();
    if let (Some(path), false, true) = (&arguments.png, is_drawn, counts.maps > 0) {
        plot::save_map(path, &map)?;
    }
    print_summary(arguments, &counts, &map)
}

/// Fails if no frame gave a map, or if the frame of the picture gave none. `read_range` holds the numbers of the first and the last frame.
fn check_maps(arguments: &Arguments, maps: u64, read_range: Option<(u64, u64)>, is_drawn: bool) -> anyhow::Result<()> {
    let source = &arguments.source.source;
    let read_range =
        read_range.map_or("no frame was read".into(), |(first, last)| format!("frames {first} to {last} were read"));
    ensure!(
        maps > 0,
        "{source}: there is no map; {read_range}\n\nhint: with --across-frames N the first map needs N frames without a gap; take more \
         --frames, or a smaller N"
    );
    match (&arguments.png, arguments.frame) {
        (Some(_), Some(wanted)) if !is_drawn => bail!(
            "{source}: there is no map of frame {wanted}; {read_range}\n\nhint: with --across-frames N the first N - 1 have no map"
        ),
        _ => Ok(()),
    }
}

/// Prints the number of maps and the meaning of their cells; on stderr where the array goes to stdout.
fn print_summary(arguments: &Arguments, counts: &Counts, map: &Rdm) -> anyhow::Result<()> {
    let Counts { maps, saturated_samples, non_finite_cells } = *counts;
    if arguments.json {
        let [rx, doppler, range] = map_shape(map);
        return output::json_line(&json!({
            "maps": maps,
            "shape": [maps, rx, doppler, range],
            "range_step_m": map.range_step_m,
            "velocity_step_m_per_s": map.velocity_step_m_per_s,
            "saturated_samples": saturated_samples,
            "non_finite_cells": non_finite_cells,
        }));
    }
    let summary = format!(
        "{maps} maps of {}, {:.4} m by {:.4} m/s{}",
        map.shape,
        map.range_step_m,
        map.velocity_step_m_per_s,
        if saturated_samples > 0 {
            format!(", {saturated_samples} samples at the ends of the ADC")
        } else {
            String::new()
        }
    );
    if arguments.is_to_stdout() {
        message!("{summary}");
        return Ok(());
    }
    output::text_line(&summary)
}

/// Function that passes every map to a callback and returns the number of maps.
type EachMap<'a> = dyn FnMut(&mut dyn FnMut(&Rdm) -> anyhow::Result<()>) -> anyhow::Result<u64> + 'a;

/// Writes the array to a file or to stdout. Its header holds the number of maps, so output for stdout is first
/// collected in an unnamed file.
fn write_array(path: &Path, overwrite: Overwrite, row_shape: &[u64], each_map: &mut EachMap) -> anyhow::Result<()> {
    if !is_stdout(path) {
        return files::write_output(path, overwrite.existing(), |file| write_maps(file, row_shape, each_map));
    }
    let file = tempfile::tempfile().context("cannot make a file for the array")?;
    let mut file = BufWriter::new(file);
    write_maps(&mut file, row_shape, each_map)?;
    file.rewind().context("cannot write the array")?;
    output::bytes(file.get_mut())
}

fn write_maps<W: Write + Seek>(file: &mut W, row_shape: &[u64], each_map: &mut EachMap) -> anyhow::Result<()> {
    files::write_growing_array(file, row_shape, |file| {
        each_map(&mut |map| {
            map.db.iter().try_for_each(|value| file.write_all(&value.to_le_bytes())).context("cannot write the array")
        })
    })
}

fn map_shape(map: &Rdm) -> [u64; 3] {
    [map.shape.rx as u64, map.shape.doppler as u64, map.shape.range as u64]
}
