//! State that pages, server and pipeline share.

use std::sync::Mutex;

use radome_driver::BoardIdentity;
use radome_dsp::Waveform;
use serde_json::json;

use super::feed::Feed;
use super::label_store::LabelStore;
use super::policy::Policy;
use crate::source::Playback;

/// Description of the run, for pages.
pub struct About {
    pub description: String,
    /// Name of the radar or its room, if the user gave one.
    pub name: Option<String>,
    pub model: String,
    pub waveform: Waveform,
    pub board: Option<BoardIdentity>,
    pub playback: Option<Playback>,
    pub has_partner: bool,
    pub read_only_labels: bool,
}

impl About {
    /// Returns the first message to a page.
    pub fn hello(&self) -> serde_json::Value {
        let shape = self.waveform.shape();
        let playback = self.playback.as_ref().map(|playback| {
            let extent = playback.extent;
            json!({
                "first_s": extent.first.time_s(),
                "last_s": extent.last.time_s(),
                "first_sequence": extent.first.sequence,
                "last_sequence": extent.last.sequence,
            })
        });
        json!({ "hello": {
            "version": env!("CARGO_PKG_VERSION"),
            "source": self.description,
            "name": self.name,
            "model": self.model,
            "rx": shape.rx,
            "chirps": shape.chirps,
            "samples": shape.samples,
            "sample_interval_s": 1.0 / self.waveform.sample_rate_hz,
            "frame_interval_s": self.waveform.frame_interval_s(),
            "board": self.board.as_ref().map(|b| json!({ "name": b.name, "firmware": b.firmware_version, "chip": b.chip })),
            "tape": playback,
            "partner": self.has_partner,
            "read_only_labels": self.read_only_labels,
        } })
    }
}

pub struct Shared {
    pub about: About,
    pub feed: Feed,
    pub labels: LabelStore,
    pub policy: Policy,
    /// Summary of the run, once it is over.
    pub summary: Mutex<Option<serde_json::Value>>,
}

#[cfg(test)]
mod tests {
    use radome_dsp::WaveformRequest;

    use super::*;

    /// Regression test: the time axis of the chirps was that of the requested rate, which the chip rounds.
    #[test]
    fn pages_receive_the_realised_sample_interval() {
        let request = WaveformRequest { sample_rate_hz: 0.99e6, ..WaveformRequest::paper() };
        let about = About {
            description: String::new(),
            name: None,
            model: String::new(),
            waveform: Waveform::realise(request).expect("possible"),
            board: None,
            playback: None,
            has_partner: false,
            read_only_labels: false,
        };
        // 81 periods of the chip's clock of 80 MHz.
        let told_s = about.hello()["hello"]["sample_interval_s"].as_f64().expect("a number");
        assert!((told_s - 81.0 / 80e6).abs() < 1e-12, "{told_s}");
    }
}
