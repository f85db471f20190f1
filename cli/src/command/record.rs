use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use radome_driver::recording::mcap::{Recorder, RecorderOptions, RecordingHeader, SyncOptions};
use serde_json::json;

use crate::live::pipeline::{Item, Pipeline, Policy};
use crate::output;
use crate::output_file::{self, Overwrite};
use crate::source::{self, SourceOptions};

/// `radome record`
#[derive(clap::Args)]
pub struct Arguments {
    /// serial:PORT, auto, emulated:SOURCE, or anything else that frames come from
    source: String,
    /// MCAP file to write. In a folder it is a file with the time (UTC) as its name; {time} in a name stands for the time
    #[arg(short, long)]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Leave it to the operating system when frames are on the disk
    #[arg(long, hide = true)]
    no_sync: bool,
    /// Waveform to program a board with: `paper`, a .toml file, or a model file
    #[arg(long)]
    waveform: Option<String>,
    /// Stop after so many frames
    #[arg(long)]
    frames: Option<u64>,
    /// Times real time for recordings and simulations; 0, the default, is as fast as it goes
    #[arg(long, default_value_t = 0.0)]
    speed: f64,
    /// Seed of a simulation
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Fail if more frames than this were lost
    #[arg(long)]
    max_dropped: Option<u64>,
    /// One object at the end
    #[arg(long)]
    json: bool,
}

/// Captures every frame, or stops and says why it cannot.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let path = output_file::dated(&arguments.output);
    arguments.overwrite.check(&path)?;
    let options = SourceOptions {
        waveform: arguments.waveform.as_deref().map(source::waveform).transpose()?,
        seed: arguments.seed,
        frames: arguments.frames,
        speed: (arguments.speed > 0.0).then_some(arguments.speed),
        people: None,
        as_tape: false,
    };
    let source = source::open(&arguments.source, &options)?;
    eprintln!("{}", source.description);
    let header = RecordingHeader {
        waveform: source.frames.waveform().clone(),
        board: source.board.clone(),
        registers: source.registers.clone(),
        judge: None,
    };
    let sync = (!arguments.no_sync).then(SyncOptions::default);
    let recorder_options = RecorderOptions { existing: arguments.overwrite.existing(), sync };
    let mut recorder = Recorder::with_options(&path, &header, &recorder_options)?;
    let bar = output::progress(arguments.frames.or(source.frames.frame_count()).unwrap_or(0), "recording");
    let mut pipeline = Pipeline::new();
    let policy = if source.is_live { Policy::Lossless(Duration::from_secs(5)) } else { Policy::Wait };
    let inlet = pipeline.consumer("recorder", 64, policy);
    let reader = pipeline.start(source.frames, arguments.frames);
    let (mut frames, mut dropped) = (0u64, 0u64);
    let mut unflushed = false;
    let end = loop {
        if output::interrupted() {
            break Ok(());
        }
        let Ok(delivery) = inlet.receiver.recv_timeout(Duration::from_millis(200)) else {
            // A board that has gone silent may never come back: what it said is safe.
            if std::mem::take(&mut unflushed) {
                recorder.flush()?;
            }
            continue;
        };
        match delivery.item {
            Item::Frame(frame) => {
                recorder.frame(&frame)?;
                frames += 1;
                unflushed = true;
                bar.inc(1);
            }
            Item::Gap(gap) => {
                recorder.gap(&gap)?;
                dropped += gap.frames;
                eprintln!("{} frames lost from {}: {}", gap.frames, gap.first_sequence, gap.reason.name());
            }
            Item::End(end) => break end,
        }
    };
    reader.stop();
    // What has been captured is made whole whatever ended it.
    recorder.finish()?;
    bar.finish_and_clear();
    end.map_err(anyhow::Error::from_boxed)?;
    let file = path.display().to_string();
    if arguments.json {
        output::json_line(&json!({ "file": file, "frames": frames, "dropped": dropped }))?;
    } else {
        output::text_line(&format!("{file}: {frames} frames, {dropped} dropped"))?;
    }
    if let Some(most) = arguments.max_dropped.filter(|most| dropped > *most) {
        bail!("{dropped} frames were lost, at most {most} allowed");
    }
    Ok(())
}
