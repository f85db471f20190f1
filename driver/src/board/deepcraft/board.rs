//! PSoC 6 kit with the DEEPCRAFT streaming firmware.

use std::path::Path;
use std::time::Duration;

use radome_dsp::Waveform;

use super::link::Link;
use crate::board::{BoardError, BoardIdentity, DeepcraftError};
use crate::chip::{CHIP_ID_BGT60TR13C, ChipConfiguration, RegisterList, chip_name};
use crate::protocol::deepcraft::{
    Board, CUSTOM, CUSTOM_DATA, Command, ConfigureRequest, Custom, Device, FIFO_LEVEL_CODES, OptionKind, OptionValue,
    PROTOCOL_VERSION, Preset, StreamConfig, USE_CASE, Value, Version, data_type, device_status, device_type, direction,
    stated_frequency_hz,
};
use crate::transport::trace;

/// Vendor and product id of the firmware's USB device, which the protocol does not report.
const USB_ID: (u16, u16) = (0x058B, 0x027D);
/// Name of the radar among the devices of a board.
const RADAR: &str = "Radar";

/// PSoC 6 kit that has been identified and does not measure.
///
/// ```no_run
/// use std::path::Path;
///
/// use radome_driver::DeepcraftBoard;
/// use radome_dsp::{Frame, FrameSource, Waveform, WaveformRequest};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// let board = DeepcraftBoard::open(Path::new("/dev/ttyACM0"))?;
/// let waveform = match board.configured_waveform() {
///     Some(waveform) => waveform,
///     None => Waveform::realise(WaveformRequest::paper())?,
/// };
/// let mut stream = board.start(&waveform)?;
/// let mut frame = Frame::zeroed(stream.waveform().shape());
/// stream.next_frame(&mut frame)?;
/// # Ok(())
/// # }
/// ```
pub struct DeepcraftBoard {
    pub(super) link: Link,
    pub(super) identity: BoardIdentity,
    /// Id of the radar among the board's devices.
    pub(super) device: i32,
    /// Items of the option "use case".
    items: Vec<String>,
    configured: Option<Waveform>,
    pub(super) watchdog: Option<Duration>,
}

/// Waveform with the registers and options that set the radar to it.
pub(super) struct Setting {
    pub(super) waveform: Waveform,
    /// The waveform with the intervals that the registers realise.
    pub(super) realised: Waveform,
    pub(super) registers: RegisterList,
    options: Vec<OptionValue>,
}

/// Stream of the radar, as configured.
pub(super) struct Stream {
    pub(super) index: i32,
    pub(super) next_number: u32,
}

impl DeepcraftBoard {
    /// Opens a port and reads the capabilities of the board. A board that speaks another protocol is not disturbed;
    /// opening then fails after about a second.
    ///
    /// # Errors
    /// [`BoardError`] if the port cannot be opened, nothing answers, the firmware speaks another version, or the board
    /// has no radar.
    pub fn open(path: &Path) -> Result<Self, BoardError> {
        let mut link = Link::open(path)?;
        let answer = link.capabilities()?;
        let board = answer.board.unwrap_or_default();
        let version = board.protocol_version.clone().unwrap_or_default();
        if version.major != PROTOCOL_VERSION[0] {
            return Err(link.error(DeepcraftError::Protocol { major: version.major, minor: version.minor }));
        }
        let is_radar = |d: &&Device| d.device_type == device_type::SENSOR && d.name.eq_ignore_ascii_case(RADAR);
        let Some(radar) = board.devices.iter().find(is_radar) else {
            let names: Vec<&str> = board.devices.iter().map(|d| d.name.as_str()).collect();
            return Err(link.error(DeepcraftError::NoRadar { devices: names.join(", ") }));
        };
        let items = match option(radar, USE_CASE) {
            Some(OptionKind::OneOf(use_case)) => use_case.items.clone(),
            _ => return Err(link.error(DeepcraftError::NoOption { what: "use cases" })),
        };
        let watchdog = u64::try_from(board.watchdog_timeout).ok().filter(|ms| *ms > 0).map(Duration::from_millis);
        Ok(DeepcraftBoard {
            identity: identity(&board, radar),
            device: radar.device_id,
            configured: configured_waveform(radar),
            items,
            watchdog,
            link,
        })
    }

    /// Identity that the board reports.
    pub fn identity(&self) -> &BoardIdentity {
        &self.identity
    }

    /// Path of the serial port.
    pub fn path(&self) -> &Path {
        &self.link.path
    }

    /// Waveform that the radar is configured for: a preset of the firmware, or a custom one. `None` if the custom data
    /// are not a waveform.
    pub fn configured_waveform(&self) -> Option<Waveform> {
        self.configured.clone()
    }

    /// Registers and options for a waveform: a preset of the firmware if one has it, else custom registers.
    pub(super) fn setting_for(&self, waveform: &Waveform) -> Result<Setting, BoardError> {
        let item = |name: &str| {
            let index = self.items.iter().position(|item| item == name);
            index.map(|index| OptionValue { option_id: USE_CASE, value: Some(Value::OneOf(index as i32)) })
        };
        if let Some(preset) = Preset::of(waveform).and_then(|preset| item(preset.name())) {
            let (waveform, registers) = (waveform.clone(), RegisterList::new());
            return Ok(Setting { realised: waveform.clone(), waveform, registers, options: vec![preset] });
        }
        let custom = Custom::compile(waveform)?;
        let configuration = ChipConfiguration { waveform: waveform.clone(), slice_samples: FIFO_LEVEL_CODES };
        let realised = configuration.with_realised_intervals()?;
        let custom_data = OptionValue { option_id: CUSTOM_DATA, value: Some(Value::Blob(custom.encode())) };
        let use_case = item(CUSTOM).ok_or_else(|| {
            self.link.error(DeepcraftError::NoOption { what: "use case for a waveform of one's own" })
        })?;
        Ok(Setting {
            waveform: custom.waveform,
            realised,
            registers: custom.registers,
            options: vec![custom_data, use_case],
        })
    }

    /// Stops and configures the radar, then checks the stream that the radar reports.
    pub(super) fn apply(&mut self, setting: &Setting) -> Result<Stream, BoardError> {
        let device = self.device;
        let answer = self
            .link
            .configure(|tag| Command::Configure(ConfigureRequest { device, options: setting.options.clone(), tag }))?;
        if answer.status == device_status::ERROR {
            return Err(self.link.error(DeepcraftError::Device { message: answer.status_message }));
        }
        check_stream(&answer.streams, &setting.waveform).map_err(|e| self.link.error(e))
    }
}

fn option(device: &Device, option_id: i32) -> Option<&OptionKind> {
    device.options.iter().find(|o| o.option_id == option_id)?.kind.as_ref()
}

fn identity(board: &Board, radar: &Device) -> BoardIdentity {
    let dotted = |version: &Option<Version>| {
        let version = version.clone().unwrap_or_default();
        format!("{}.{}.{}", version.major, version.minor, version.build)
    };
    let uuid = board.serial.as_ref().map_or(&[][..], |serial| &serial.uuid);
    trace::identity(&uuid.iter().map(|byte| format!("{byte:02x}")).collect::<String>());
    BoardIdentity {
        name: board.name.clone(),
        vendor_id: USB_ID.0,
        product_id: USB_ID.1,
        firmware_version: dotted(&board.firmware_version),
        extended_version: radar.description.clone(),
        protocol_version: dotted(&board.protocol_version),
        uuid: (0..16).map(|i| format!("{:02x}", uuid.get(i).unwrap_or(&0))).collect(),
        // The kits of this firmware have this chip; the protocol does not report it.
        chip: chip_name(CHIP_ID_BGT60TR13C).to_owned(),
        chip_id: CHIP_ID_BGT60TR13C,
    }
}

/// Waveform that the radar reports to be configured for.
fn configured_waveform(radar: &Device) -> Option<Waveform> {
    let Some(OptionKind::OneOf(use_case)) = option(radar, USE_CASE) else { return None };
    let item = use_case.items.get(usize::try_from(use_case.current_index).ok()?)?;
    if let Some(preset) = Preset::from_name(item) {
        return preset.waveform().ok();
    }
    let Some(OptionKind::Blob(blob)) = option(radar, CUSTOM_DATA) else { return None };
    let custom = Custom::decode(&blob.current_value);
    custom.inspect_err(|error| tracing::warn!(%error, "the radar's custom data")).ok().map(|custom| custom.waveform)
}

/// Finds the radar's stream and compares it with the waveform.
fn check_stream(streams: &[StreamConfig], waveform: &Waveform) -> Result<Stream, DeepcraftError> {
    let mismatch = |what, expected: String, got: String| Err(DeepcraftError::Stream { what, expected, got });
    let Some((index, stream)) = (0..).zip(streams).find(|(_, s)| s.direction == direction::OUTPUT) else {
        return mismatch("frames for the host:", "one stream".into(), "none".into());
    };
    if stream.data_type != data_type::S16 {
        return mismatch("data type", data_type::S16.to_string(), stream.data_type.to_string());
    }
    let shape = waveform.shape();
    let expected = [("Antenna", shape.rx), ("Chirp", shape.chirps), ("Sample", shape.samples)];
    let got: Vec<(&str, usize)> =
        stream.shape.iter().map(|d| (d.name.as_str(), usize::try_from(d.size).unwrap_or(0))).collect();
    if got != expected {
        return mismatch("shape", format!("{expected:?}"), format!("{got:?}"));
    }
    // The firmware rounds the frame rate to a whole number; it may round halves up or down.
    let rate_hz = 1.0 / waveform.frame_interval_s();
    if (f64::from(stream.frequency) - rate_hz).abs() > 0.5 + 1e-3 * rate_hz {
        let expected = stated_frequency_hz(waveform);
        return mismatch("frequency", format!("{expected} Hz"), format!("{} Hz", stream.frequency));
    }
    Ok(Stream { index, next_number: stream.current_frame as u32 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::deepcraft::Dimension;

    fn stream(waveform: &Waveform) -> StreamConfig {
        let shape = waveform.shape();
        let axes = [("Antenna", shape.rx), ("Chirp", shape.chirps), ("Sample", shape.samples)];
        let axis = |(name, size): (&str, usize)| Dimension { name: name.into(), size: size as i32, labels: Vec::new() };
        StreamConfig {
            direction: direction::OUTPUT,
            data_type: data_type::S16,
            shape: axes.map(axis).to_vec(),
            frequency: stated_frequency_hz(waveform),
            current_frame: 7,
            ..StreamConfig::default()
        }
    }

    #[test]
    fn the_stream_of_a_preset_is_found_behind_others() {
        for preset in Preset::ALL {
            let waveform = preset.waveform().expect("valid");
            let input = StreamConfig { direction: 1, ..StreamConfig::default() };
            let found = check_stream(&[input, stream(&waveform)], &waveform).expect("agrees");
            assert_eq!((found.index, found.next_number), (1, 7));
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_stream_that_does_not_match_is_refused_with_both_values() {
            let waveform = Preset::Gesture.waveform().expect("valid");
            let good = stream(&waveform);
            let refused = |stream: StreamConfig| check_stream(&[stream], &waveform).err().expect("refused").to_string();
            let message = refused(StreamConfig { data_type: 3, ..good.clone() });
            assert!(message.contains("data type 3, 4 was asked for"), "{message}");
            let message = refused(StreamConfig { frequency: 35.0, ..good.clone() });
            assert!(message.contains("frequency 35 Hz, 33 Hz"), "{message}");
            let shape = good.shape.iter().rev().cloned().collect();
            let message = refused(StreamConfig { shape, ..good.clone() });
            assert!(message.contains("shape") && message.contains("(\"Sample\", 64), (\"Chirp\", 32)"), "{message}");
            let message = refused(StreamConfig { direction: 1, ..good });
            assert!(message.contains("none"), "{message}");
        }
    }
}
