//! Export of a recording, message by message.

use std::collections::{BTreeMap, VecDeque};
use std::io::{Seek, Write};
use std::iter::{Flatten, Peekable};
use std::mem::ManuallyDrop;

use anyhow::Context;
use mcap::WriteOptions;
use mcap::records::{MessageHeader, Metadata};
use prost::Message;
use radome_driver::recording::mcap::Results;
use radome_driver::recording::{Recording, WriteReport};
use radome_driver::{FrameResult, LabelSpan};
use radome_dsp::rdm::Channels;
use radome_dsp::{Frame, FrameSource, Gap, MapStatus, Occupancy, Rdm, RdmProcessor, RdmSpec, SourceEvent, Waveform};
use serde_json::json;

use super::clock::Clock;
use super::message_type::MessageType;
use super::messages::{
    ANSWER, Answer, COMPRESSED_IMAGE, CompressedImage, INFO, LOG, Log, RAW_IMAGE, RawImage, STATE, State, WARNING,
    timestamp,
};
use crate::labels;
use crate::picture::plot;

/// Name of the metadata record with the waveform and the axes of the maps.
const METADATA: &str = "radome.viewers";
/// Coordinate frame of images, as named in viewers.
const FRAME_ID: &str = "radar";
/// Fast compression level, since most bytes are raw codes, which compress little.
const COMPRESSION_LEVEL: u32 = 1;
const WRITE_ERROR: &str = "cannot write the file for viewers";

/// Writes a recording as an MCAP file for viewers. Chirps and maps are images; answers and the board's state are
/// numbers. Gaps, labels and changes of the number of people form a log. `after_event` is called after every frame and
/// gap, and can end the export by an error.
///
/// # Errors
/// The recording cannot be read, no map can be made of its waveform, or `out` cannot be written.
pub fn export<W: Write + Seek>(
    source: &mut Recording,
    spans: Vec<LabelSpan>,
    out: W,
    mut after_event: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<WriteReport> {
    let mut export = Export::start(source, spans, out)?;
    let mut frame = Frame::zeroed(source.waveform().shape());
    loop {
        match source.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::Frame => export.frame(&frame)?,
            SourceEvent::Gap(gap) => export.gap(&gap)?,
            SourceEvent::End => return export.finish(),
        }
        after_event()?;
    }
}

/// Identifiers of the channels.
struct Topics {
    chirps: u16,
    map: u16,
    state: u16,
    answer: u16,
    events: u16,
}

struct Export<W: Write + Seek> {
    /// Dropped only if nothing has failed: `Drop` finishes the file, and panics after some errors.
    mcap: ManuallyDrop<mcap::Writer<W>>,
    topics: Topics,
    /// Number of messages so far.
    messages: u32,
    clock: Clock,
    waveform: Waveform,
    processor: RdmProcessor,
    map: Rdm,
    /// Levels of the first and the last colour of maps, dB, from the first map.
    levels: Option<(f32, f32)>,
    spans: Vec<LabelSpan>,
    /// Starts and ends of labels still to be written: time of the frames' own clock, ns, and text.
    label_events: VecDeque<(u64, String)>,
    results: Peekable<Flatten<std::option::IntoIter<Results>>>,
    /// Number of people in the previous answer.
    people: Option<u8>,
    /// Sequence number and time, ns, of the previous frame.
    previous: Option<(u64, u64)>,
    report: WriteReport,
}

impl<W: Write + Seek> Export<W> {
    fn start(source: &Recording, spans: Vec<LabelSpan>, out: W) -> anyhow::Result<Self> {
        let waveform = source.waveform().clone();
        let spec = RdmSpec { channels: Channels::IncoherentSum, ..RdmSpec::default() };
        let processor = RdmProcessor::new(&spec, &waveform)?;
        let options = WriteOptions::new()
            .library(concat!("radome ", env!("CARGO_PKG_VERSION")))
            .compression_level(COMPRESSION_LEVEL)
            .compression_threads(0);
        let mut mcap = ManuallyDrop::new(options.create(out).context(WRITE_ERROR)?);
        let mut channel = |topic: &str, message_type: &MessageType| -> anyhow::Result<u16> {
            let schema = mcap.add_schema(&message_type.full_name(), "protobuf", &message_type.descriptor_set());
            let schema = schema.context(WRITE_ERROR)?;
            mcap.add_channel(schema, topic, "protobuf", &BTreeMap::new()).context(WRITE_ERROR)
        };
        let topics = Topics {
            chirps: channel("/radome/chirps", &RAW_IMAGE)?,
            map: channel("/radome/map", &COMPRESSED_IMAGE)?,
            state: channel("/radome/state", &STATE)?,
            answer: channel("/radome/answer", &ANSWER)?,
            events: channel("/radome/events", &LOG)?,
        };
        Ok(Export {
            mcap,
            topics,
            messages: 0,
            clock: Clock::default(),
            map: processor.empty_map(),
            waveform,
            processor,
            levels: None,
            label_events: label_events(&spans),
            spans,
            results: source.results()?.into_iter().flatten().peekable(),
            people: None,
            previous: None,
            report: WriteReport::default(),
        })
    }

    fn write(&mut self, channel_id: u16, time_ns: u64, message: &impl Message) -> anyhow::Result<()> {
        let sequence = self.messages;
        self.messages = sequence.wrapping_add(1);
        let header = MessageHeader { channel_id, sequence, log_time: time_ns, publish_time: time_ns };
        self.mcap.write_to_known_channel(&header, &message.encode_to_vec()).context(WRITE_ERROR)
    }

    fn log(&mut self, time_ns: u64, level: i32, name: &str, message: String) -> anyhow::Result<()> {
        let timestamp = timestamp(time_ns);
        let log = Log { timestamp, level, message, name: name.to_owned(), file: String::new(), line: 0 };
        self.write(self.topics.events, time_ns, &log)
    }

    fn frame(&mut self, frame: &Frame) -> anyhow::Result<()> {
        self.clock.update(frame);
        self.write_labels_up_to(frame.time_ns)?;
        let time_ns = self.clock.message_time_ns(frame.time_ns);
        self.write(self.topics.chirps, time_ns, &chirps(frame, time_ns))?;
        let status = self.processor.process(frame, &mut self.map)?;
        if status == MapStatus::Ready {
            let levels = *self.levels.get_or_insert_with(|| plot::levels(&self.map));
            let data = plot::map_png(&self.map, levels)?;
            let (timestamp, format, frame_id) = (timestamp(time_ns), "png".to_owned(), FRAME_ID.to_owned());
            self.write(self.topics.map, time_ns, &CompressedImage { timestamp, data, format, frame_id })?;
        }
        let state = self.state(frame, time_ns);
        self.write(self.topics.state, time_ns, &state)?;
        self.previous = Some((frame.sequence, frame.time_ns));
        self.report.frames += 1;
        self.write_answers_up_to(frame.sequence)
    }

    fn state(&self, frame: &Frame, time_ns: u64) -> State {
        let people = |occupancy: Option<Occupancy>| occupancy.map_or(f64::NAN, |class| class.index() as f64);
        let interval_ns = self
            .previous
            .filter(|(sequence, _)| sequence.checked_add(1) == Some(frame.sequence))
            .and_then(|(_, before_ns)| frame.time_ns.checked_sub(before_ns))
            .filter(|interval_ns| *interval_ns > 0);
        let labelled = labels::truth_of_frame(&self.spans, frame, &self.waveform);
        State {
            timestamp: timestamp(time_ns),
            sequence: frame.sequence,
            temperature_celsius: frame.temperature_millicelsius.map_or(f64::NAN, |t| f64::from(t) * 1e-3),
            frames_per_s: interval_ns.map_or(f64::NAN, |interval_ns| 1e9 / interval_ns as f64),
            frames_lost: self.report.frames_lost,
            saturated_samples: self.map.flags.saturated_samples,
            true_people: people(frame.truth.map(|truth| truth.occupancy)),
            labelled_people: people(labelled.map(|truth| truth.occupancy)),
        }
    }

    fn gap(&mut self, gap: &Gap) -> anyhow::Result<()> {
        self.processor.reset_at_gap();
        self.report.count_gap(gap);
        let lost = match gap.frames {
            0 => "frames".to_owned(),
            1 => "1 frame".to_owned(),
            frames => format!("{frames} frames"),
        };
        let message = format!("{lost} lost from frame {} on: {}", gap.first_sequence, gap.reason.name());
        self.log(self.clock.last_ns, WARNING, "gap", message)
    }

    /// Writes the starts and ends of labels up to a time of the frames' own clock.
    fn write_labels_up_to(&mut self, time_ns: u64) -> anyhow::Result<()> {
        while let Some((event_ns, text)) = self.label_events.pop_front_if(|(event_ns, _)| *event_ns <= time_ns) {
            let at_ns = self.clock.message_time_ns(event_ns);
            self.log(at_ns, INFO, "label", text)?;
        }
        Ok(())
    }

    /// Writes the answers to frames up to this number.
    fn write_answers_up_to(&mut self, sequence: u64) -> anyhow::Result<()> {
        // An error is returned at the next frame, whatever its number.
        while let Some(result) =
            self.results.next_if(|result| !result.as_ref().is_ok_and(|result| result.sequence > sequence))
        {
            self.answer(&result?)?;
        }
        Ok(())
    }

    fn answer(&mut self, result: &FrameResult) -> anyhow::Result<()> {
        let time_ns = self.clock.message_time_ns(result.time_ns);
        let [p_empty, p_one, p_two] = result.probabilities.unwrap_or([f32::NAN; 3]);
        let answer = Answer {
            timestamp: timestamp(time_ns),
            sequence: result.sequence,
            label: result.label.map_or("", Occupancy::name).to_owned(),
            p_empty,
            p_one,
            p_two,
            people: u32::from(result.people),
            occupied: result.occupied,
            latency_ms: result.latency_ns as f64 * 1e-6,
        };
        self.write(self.topics.answer, time_ns, &answer)?;
        match self.people.replace(result.people) {
            Some(previous) if previous != result.people => {
                self.log(time_ns, INFO, "people", format!("people: {previous} to {}", result.people))
            }
            _ => Ok(()),
        }
    }

    fn finish(mut self) -> anyhow::Result<WriteReport> {
        self.write_answers_up_to(u64::MAX)?;
        self.write_labels_up_to(u64::MAX)?;
        let map = json!({
            "range_step_m": self.map.range_step_m,
            "velocity_step_m_per_s": self.map.velocity_step_m_per_s,
            "columns": "range, from 0 to the right",
            "rows": "radial velocity, receding above, 0 at row height / 2 from below",
            "levels_db": self.levels.map(|(low, high)| [low, high]),
        });
        let waveform = serde_json::to_string(&self.waveform).context(WRITE_ERROR)?;
        let metadata = BTreeMap::from([("waveform".to_owned(), waveform), ("map".to_owned(), map.to_string())]);
        self.mcap.write_metadata(&Metadata { name: METADATA.to_owned(), metadata }).context(WRITE_ERROR)?;
        self.mcap.finish().context(WRITE_ERROR)?;
        self.report.bytes = ManuallyDrop::into_inner(self.mcap).into_inner().stream_position().context(WRITE_ERROR)?;
        Ok(self.report)
    }
}

/// Image of the codes of a frame: one row per chirp, receiver by receiver, and one column per sample.
fn chirps(frame: &Frame, time_ns: u64) -> RawImage {
    let mut data = Vec::with_capacity(2 * frame.codes.len());
    for code in &frame.codes {
        data.extend_from_slice(&code.to_le_bytes());
    }
    RawImage {
        timestamp: timestamp(time_ns),
        width: frame.shape.samples as u32,
        height: (frame.shape.rx * frame.shape.chirps) as u32,
        encoding: "16UC1".to_owned(),
        step: 2 * frame.shape.samples as u32,
        data,
        frame_id: FRAME_ID.to_owned(),
    }
}

/// Starts and ends of labels in the order of time; at equal times, ends come first.
fn label_events(spans: &[LabelSpan]) -> VecDeque<(u64, String)> {
    let ns = |time_s: f64| (time_s * 1e9).round() as u64;
    let ends = spans.iter().map(|span| (ns(span.end_s), format!("{} ends", span.label)));
    let starts = spans.iter().map(|span| (ns(span.start_s), format!("{} starts", span.label)));
    let mut events: Vec<_> = ends.chain(starts).collect();
    // The sort is stable: at equal times, ends stay before starts.
    events.sort_by_key(|(time_ns, _)| *time_ns);
    events.into()
}
