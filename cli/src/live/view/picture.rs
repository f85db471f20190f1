//! Pictures: messages with the content that pages show of a frame.
//!
//! A picture is a message with the length of its header in four bytes, little-endian; the header in JSON; and the parts
//! that it lists. Keys of the header:
//!
//! | key | value |
//! |---|---|
//! | `answer` | [`Answer`] to the frame, with the keys of `--json` |
//! | `health` | counters of the run (`health` below) |
//! | `look` | `channel` and `removal` that the page selected |
//! | `map` | size, steps and scale of the map; parts `map` and `floor`. Absent while there is none |
//! | `partner` | the same of the simulated partner; parts `partner` and `partner_floor`. Absent if it is not shown |
//! | `chirps` | receiver, chirp, number of samples, clipped codes by receiver; part `chirps`. Absent if it is not shown |
//! | `history` | answers that the page has not received, as [`Point::row`](super::history::Point::row) |
//! | `parts` | name and length in bytes of each part, in order |
//!
//! Maps have one byte per cell, `[doppler][range]`, `low_db + step_db * byte`, and 255 for values that are not numbers.
//! The noise floor is f32 by range bin. Chirps are u16: one chirp, and the least and largest code of each sample over all
//! chirps of the channel.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::sync::Arc;

use axum::body::Bytes;
use radome_dsp::rdm::{Channels, StaticRemoval};
use radome_dsp::{Frame, MAX_CODE, MapStatus, Rdm, RdmProcessor, RdmSpec, Waveform, noise_floor_db};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::live::answer::Answer;
use crate::live::sink::ClassifiedFrame;

/// Step of a cell's byte, dB.
const STEP_DB: f32 = 0.5;
/// Number of Doppler bins around zero that do not count as noise.
const GUARD_BINS: usize = 3;
/// The vendor's weight of the newest frame in the MTI filter.
const MTI_ALPHA: f64 = 0.8;

/// Channel of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// Map that the network classifies.
    Network,
    /// Mean power of all receivers.
    #[default]
    Sum,
    /// One receiver, 0-based.
    Rx(usize),
}

/// Removal of static echoes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Removal {
    None,
    /// Subtracts the mean over a frame's chirps.
    #[default]
    Mean,
    /// The vendor's recursive filter over frames.
    Mti,
}

/// Content that a page selects for its pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Selection {
    #[serde(default)]
    pub channel: Channel,
    #[serde(default)]
    pub removal: Removal,
    /// Index of the chirp, if one is shown.
    #[serde(default)]
    pub chirp: Option<usize>,
    /// Whether the simulated partner is shown too.
    #[serde(default)]
    pub partner: bool,
}

/// Channel and static-echo removal of a map.
type Kind = (Channel, Removal);

impl Selection {
    fn kind(&self) -> Kind {
        (self.channel, self.removal)
    }
}

/// Newest frame with its answer and the counters of the run.
pub struct NewestFrame {
    answer: Answer,
    pub frame: Arc<Frame>,
    network_map: Rdm,
    health: serde_json::Value,
}

impl NewestFrame {
    /// Copies the content of pictures from a frame. `frames_per_s` is the rate of the frames that are shown.
    pub fn of(classified: &ClassifiedFrame, frames_per_s: f64) -> Self {
        NewestFrame {
            answer: classified.answer.clone(),
            frame: classified.frame.clone(),
            network_map: classified.map.clone(),
            health: health(classified, frames_per_s),
        }
    }
}

/// Counters of the run, for the line at the top of the page.
fn health(classified: &ClassifiedFrame, frames_per_s: f64) -> serde_json::Value {
    let health = classified.health;
    let dropped: BTreeMap<&str, u64> = health.dropped.iter().map(|(reason, frames)| (reason.name(), *frames)).collect();
    json!({
        "frames": health.frames,
        "frames_per_s": frames_per_s,
        "dropped": health.dropped_total(),
        "dropped_by_reason": dropped,
        "latency_p50_ms": health.latency.quantile_s(0.5) * 1e3,
        "latency_p95_ms": health.latency.quantile_s(0.95) * 1e3,
        "saturated_samples": health.saturated_samples,
        "temperature_c": health.temperature_millicelsius.map(|t| f64::from(t) * 1e-3),
        "running_s": health.started.elapsed().as_secs_f64(),
    })
}

/// Processors of all maps that pages show. Each map is computed once for all pages.
pub struct MapProcessors {
    waveform: Waveform,
    /// Key: whether it is the partner's map, and its kind.
    processors: BTreeMap<(bool, Kind), MapProcessor>,
}

impl MapProcessors {
    pub fn new(waveform: &Waveform) -> Self {
        MapProcessors { waveform: waveform.clone(), processors: BTreeMap::new() }
    }

    /// Removes the processors of maps that no page shows.
    pub fn retain(&mut self, shown: &[Selection]) {
        self.processors.retain(|(_, kind), _| shown.iter().any(|selection| selection.kind() == *kind));
    }

    /// Makes the picture of a page. `partner` is the simulated partner of the frame, if there is one.
    pub fn picture(&mut self, newest: &NewestFrame, selection: &Selection, partner: Option<&Frame>) -> Picture {
        let mut picture = Picture {
            header: json!({ "answer": newest.answer, "health": newest.health, "look": {
                "channel": selection.channel, "removal": selection.removal,
            } }),
            parts: Vec::new(),
        };
        if selection.channel == Channel::Network {
            if newest.answer.warming_up.is_none() {
                picture.add_map("map", "floor", &newest.network_map);
            }
        } else {
            picture.add_computed_map("map", "floor", self.processor(false, selection), &newest.frame);
        }
        if let Some(frame) = partner.filter(|_| selection.partner) {
            // The network's map may span several frames; the partner has only one.
            picture.add_computed_map("partner", "partner_floor", self.processor(true, selection), frame);
        }
        if let Some(chirp) = selection.chirp {
            picture.add_chirps(&newest.frame, selection.channel, chirp);
        }
        picture
    }

    /// Returns the processor of a kind of map; `None` if the frames have no such map.
    fn processor(&mut self, is_partner: bool, selection: &Selection) -> Option<&mut MapProcessor> {
        match self.processors.entry((is_partner, selection.kind())) {
            Entry::Occupied(entry) => Some(entry.into_mut()),
            Entry::Vacant(entry) => {
                MapProcessor::new(selection.kind(), &self.waveform).map(|processor| entry.insert(processor))
            }
        }
    }
}

/// Computes maps of one kind. The static-echo filter counts the frames that it receives, so frames that pages skip do
/// not reset it.
struct MapProcessor {
    processor: RdmProcessor,
    map: Rdm,
    samples: Vec<f32>,
    count: u64,
    /// Number and time of the frame that the map was computed from.
    source_frame: Option<(u64, u64)>,
}

impl MapProcessor {
    fn new((channel, removal): Kind, waveform: &Waveform) -> Option<Self> {
        let channels = match channel {
            Channel::Rx(rx) => Channels::One(rx),
            Channel::Sum | Channel::Network => Channels::IncoherentSum,
        };
        let static_removal = match removal {
            Removal::None => StaticRemoval::None,
            Removal::Mean => StaticRemoval::SlowTimeMean,
            Removal::Mti => StaticRemoval::RecursiveMti { alpha: MTI_ALPHA },
        };
        let spec = RdmSpec { channels, static_removal, ..RdmSpec::default() };
        let processor = RdmProcessor::new(&spec, waveform)
            .inspect_err(|error| tracing::warn!("the page has no map: {error}"))
            .ok()?;
        let map = processor.empty_map();
        Some(MapProcessor { processor, map, samples: Vec::new(), count: 0, source_frame: None })
    }

    /// Returns the map of a frame, computed once per frame; `None` while the filter warms up.
    fn compute(&mut self, frame: &Frame) -> Option<&Rdm> {
        let id = (frame.sequence, frame.time_ns);
        if self.source_frame != Some(id) {
            if self.source_frame.is_some_and(|(sequence, _)| frame.sequence < sequence) {
                self.processor.reset();
            }
            self.samples.clear();
            self.samples.extend(frame.codes.iter().map(|code| f32::from(*code) * (1.0 / 2048.0) - 1.0));
            self.count += 1;
            match self.processor.process_samples(self.count, &self.samples, &mut self.map) {
                Ok(MapStatus::Ready) => self.source_frame = Some(id),
                Ok(MapStatus::WarmingUp { .. }) | Err(_) => return None,
            }
        }
        Some(&self.map)
    }
}

/// Picture under construction.
pub struct Picture {
    header: serde_json::Value,
    parts: Vec<(&'static str, Vec<u8>)>,
}

impl Picture {
    fn add_computed_map(
        &mut self,
        name: &'static str,
        floor: &'static str,
        processor: Option<&mut MapProcessor>,
        frame: &Frame,
    ) {
        if let Some(map) = processor.and_then(|processor| processor.compute(frame)) {
            self.add_map(name, floor, map);
        }
    }

    /// Adds the first channel of a map, and its noise floor.
    fn add_map(&mut self, name: &'static str, floor: &'static str, map: &Rdm) {
        let cells = map.db.get(..map.shape.doppler * map.shape.range).unwrap_or(&[]);
        let finite = || cells.iter().copied().filter(|v| v.is_finite());
        let (low, high) = finite().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)));
        // Range of a byte, from the top.
        let low_db = if low > high { 0.0 } else { low.floor().max((high - 254.0 * STEP_DB).ceil()) };
        self.header[name] = json!({
            "doppler": map.shape.doppler,
            "range": map.shape.range,
            "range_step_m": map.range_step_m,
            "velocity_step_m_per_s": map.velocity_step_m_per_s,
            "low_db": low_db,
            "step_db": STEP_DB,
        });
        let byte = |v: &f32| match v.is_finite() {
            true => ((v - low_db) / STEP_DB).round().clamp(0.0, 254.0) as u8,
            false => 255,
        };
        self.parts.push((name, cells.iter().map(byte).collect()));
        let floor_db = noise_floor_db(map, 0, GUARD_BINS);
        self.parts.push((floor, floor_db.iter().flat_map(|v| v.to_le_bytes()).collect()));
    }

    /// Adds a chirp of a receiver with the envelope of all its chirps.
    fn add_chirps(&mut self, frame: &Frame, channel: Channel, chirp: usize) {
        let rx = if let Channel::Rx(rx) = channel { rx } else { 0 };
        let samples = frame.shape.samples;
        let (mut least, mut most) = (vec![u16::MAX; samples], vec![0u16; samples]);
        for index in 0..frame.shape.chirps {
            for ((code, least), most) in frame.chirp(rx, index).iter().zip(&mut least).zip(&mut most) {
                *least = (*least).min(*code);
                *most = (*most).max(*code);
            }
        }
        let clipped = |rx: usize| {
            let codes = (0..frame.shape.chirps).flat_map(|chirp| frame.chirp(rx, chirp));
            codes.filter(|code| **code == 0 || **code >= MAX_CODE).count()
        };
        let clipped: Vec<usize> = (0..frame.shape.rx).map(clipped).collect();
        self.header["chirps"] = json!({ "rx": rx, "chirp": chirp, "samples": samples, "clipped_by_rx": clipped });
        let codes = frame.chirp(rx, chirp).iter().chain(&least).chain(&most);
        self.parts.push(("chirps", codes.flat_map(|code| code.to_le_bytes()).collect()));
    }

    /// Adds rows of the timeline, and returns the message. `None` if it would be longer than its format allows.
    pub fn message(mut self, history: Vec<serde_json::Value>) -> Option<Bytes> {
        self.header["history"] = history.into();
        let lengths: Vec<_> = self.parts.iter().map(|(name, bytes)| json!([name, bytes.len()])).collect();
        self.header["parts"] = lengths.into();
        let header = serde_json::to_vec(&self.header).ok()?;
        let mut message = Vec::with_capacity(4 + header.len() + self.parts.iter().map(|p| p.1.len()).sum::<usize>());
        message.extend_from_slice(&u32::try_from(header.len()).ok()?.to_le_bytes());
        message.extend_from_slice(&header);
        for (_, bytes) in &self.parts {
            message.extend_from_slice(bytes);
        }
        Some(message.into())
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::detect::LEAKAGE_BINS;

    #[test]
    fn the_page_searches_echoes_in_the_bins_of_the_detector() {
        let script = include_str!("page/plot.js");
        assert!(script.contains(&format!("LEAKAGE_BINS = {LEAKAGE_BINS};")));
    }
}
