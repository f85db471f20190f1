//! Requests to the emulated DEEPCRAFT firmware: requests in, answers out, and the state that they change.

use std::sync::Arc;
use std::time::{Duration, Instant};

use prost::Message;
use radome_dsp::Waveform;

use crate::chip::{RegisterList, address, field, main_bits};
use crate::emulator::chip::Chip;
use crate::emulator::{EmulatorError, Fault, Shared};
use crate::protocol::deepcraft::{
    Answer, Board, BoardSerial, CUSTOM_DATA, CapabilitiesResponse, Command, ConfigureRequest, ConfigureResponse,
    Custom, Device, DeviceOption, Dimension, ErrorCode, ErrorResponse, FIFO_LEVEL_CODES, ITEMS, MAX_REQUEST,
    MessageParser, OptionBlob, OptionKind, OptionOneOf, OptionValue, PROTOCOL_VERSION, Preset, Request, Response,
    StreamConfig, USE_CASE, Value, Version, data_type, device_status, device_type, direction, holds_frames_of,
    stated_frequency_hz,
};

/// Time without a watchdog reset after which the firmware stops, ms.
const WATCHDOG_TIMEOUT_MS: i32 = 3000;
/// Id of the radar among the board's devices.
pub(super) const DEVICE: i32 = 0;

/// Time at which the watchdog stops the radar.
fn watchdog_deadline() -> Instant {
    Instant::now() + Duration::from_millis(WATCHDOG_TIMEOUT_MS as u64)
}

pub(super) struct Requests {
    parser: MessageParser,
    /// Name of the radar device; another one with a fault.
    name: String,
    protocol_major: u32,
    /// Options at power-up, and now: use case and custom data.
    power_up: (i32, Vec<u8>),
    use_case: i32,
    custom_data: Vec<u8>,
    /// Waveform, and its registers.
    setting: Custom,
    pub chip: Chip,
    /// Time at which the watchdog stops the radar; `None` while it is not active.
    pub active_until: Option<Instant>,
    /// Number of starts: the sender discards its buffer when it changes.
    pub starts: u64,
    pub current_frame: u32,
    pub dropped: i32,
    /// Reason for which the radar cannot be used as configured.
    refusal: Option<String>,
    shared: Arc<Shared>,
}

impl Requests {
    pub fn new(chip: Chip, source: &Waveform, faults: &[Fault], shared: Arc<Shared>) -> Result<Self, EmulatorError> {
        let (mut name, mut protocol_major) = ("Radar".to_owned(), PROTOCOL_VERSION[0]);
        for fault in faults {
            match *fault {
                Fault::ForeignChip(id) => name = format!("Foreign device {id:#08x}"),
                Fault::WrongVersion(major) => protocol_major = u32::from(major),
                _ => {}
            }
        }
        let codes = source.shape().codes();
        let power_up = match Preset::of(source) {
            Some(preset) => (preset as i32, Vec::new()),
            None if holds_frames_of(codes) => (ITEMS.len() as i32 - 1, Custom::compile(source)?.encode()),
            // The board begins as it is sold. A client may program another waveform.
            None if chip.source.check(&Preset::Default.waveform()?).is_ok() => {
                let preset = Preset::Default;
                tracing::warn!(
                    "a frame of the source has {codes} codes, which this firmware cannot hold: the board begins with its preset \
                     {}; name another waveform with --waveform where you read it",
                    preset.name()
                );
                (preset as i32, Vec::new())
            }
            None => return Err(EmulatorError::Frame { codes }),
        };
        let mut requests = Requests {
            chip,
            parser: MessageParser::new(MAX_REQUEST),
            name,
            protocol_major,
            use_case: power_up.0,
            custom_data: power_up.1.clone(),
            power_up,
            setting: Custom { waveform: source.clone(), registers: RegisterList::new() },
            active_until: None,
            starts: 0,
            current_frame: 0,
            dropped: 0,
            refusal: None,
            shared,
        };
        requests.configure();
        Ok(requests)
    }

    /// Resets all state except the number of starts, after a loss of power.
    pub fn power_up(&mut self) {
        self.parser.clear();
        (self.use_case, self.custom_data) = self.power_up.clone();
        self.stop();
        self.configure();
        self.chip.reset();
    }

    /// Stops the radar after the last client has left, as the watchdog would soon, and discards half a request, which
    /// would delay the next client.
    pub fn client_left(&mut self) {
        self.parser.clear();
        self.stop();
    }

    pub fn stop(&mut self) {
        self.active_until = None;
        self.current_frame = 0;
        self.chip.write(address::MAIN, main_bits::FSM_RESET);
    }

    /// Resets the chip, writes its registers with the FIFO level of the firmware, and starts frames.
    pub fn start_chip(&mut self) {
        self.chip.write(address::MAIN, main_bits::SW_RESET);
        for register in &self.setting.registers {
            self.chip.write(register.address, register.value);
        }
        let fifo = self.chip.read(address::SFCTL);
        let level = (FIFO_LEVEL_CODES / 2 - 1) as u32;
        self.chip.write(address::SFCTL, field::SFCTL::FIFO_CREF.put(fifo, level));
        let main = self.chip.read(address::MAIN);
        self.chip.write(address::MAIN, main | main_bits::FIFO_RESET);
        self.chip.write(address::MAIN, main | main_bits::FRAME_START);
    }

    /// Takes bytes of the host. Like the real firmware it waits for the rest of a request that was announced.
    pub fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.parser.push(bytes);
        loop {
            let request = match self.parser.next_message() {
                None => return,
                Some(Ok(message)) => Request::decode(message).ok(),
                Some(Err(_)) => {
                    self.parser.clear();
                    None
                }
            };
            let answer = match request {
                None => Some(Err(ErrorCode::DECODE)),
                Some(Request { command: None }) => Some(Err(ErrorCode::REQUEST_TYPE)),
                Some(Request { command: Some(command) }) => self.execute(command).transpose(),
            };
            match answer {
                None => {}
                Some(Ok(answer)) => Response::from(answer).encode_to(out),
                Some(Err(code)) => {
                    let error = ErrorResponse { message: format!("{}.", code.name()), code: code.0 };
                    Response::from(Answer::Error(error)).encode_to(out);
                }
            }
        }
    }

    fn execute(&mut self, command: Command) -> Result<Option<Answer>, ErrorCode> {
        match command {
            Command::Capabilities(request) => {
                if request.device > DEVICE {
                    return Err(ErrorCode::NO_SUCH_DEVICE);
                }
                let board = Some(self.board());
                Ok(Some(Answer::Capabilities(CapabilitiesResponse { board, tag: request.tag })))
            }
            Command::Configure(request) => self.set_options(&request).map(|answer| Some(Answer::Configuration(answer))),
            Command::Start(request) => {
                check_device(request.device)?;
                match (self.active_until, &self.refusal) {
                    (Some(_), _) => return Err(ErrorCode::ALREADY_ACTIVE),
                    (None, Some(_)) => return Err(ErrorCode::UNSPECIFIED),
                    (None, None) => {}
                }
                self.start_chip();
                self.active_until = Some(watchdog_deadline());
                self.starts += 1;
                Ok(None)
            }
            Command::Stop(request) => {
                if request.device > DEVICE {
                    return Err(ErrorCode::NO_SUCH_DEVICE);
                }
                self.stop();
                Ok(None)
            }
            Command::WatchdogReset(_) => {
                self.active_until = self.active_until.map(|_| watchdog_deadline());
                Ok(None)
            }
            // The radar takes no data.
            Command::Data(chunk) => {
                check_device(chunk.device)?;
                Err(ErrorCode::WRONG_DIRECTION)
            }
            Command::Reset(_) => {
                self.power_up();
                Ok(None)
            }
        }
    }

    /// Sets options and configures the chip; the response holds the resulting state.
    fn set_options(&mut self, request: &ConfigureRequest) -> Result<ConfigureResponse, ErrorCode> {
        check_device(request.device)?;
        request.options.iter().try_for_each(|option| self.set_option(option))?;
        self.configure();
        let (status, status_message) = self.status();
        Ok(ConfigureResponse {
            device: DEVICE,
            options: vec![
                OptionValue { option_id: USE_CASE, value: Some(Value::OneOf(self.use_case)) },
                OptionValue { option_id: CUSTOM_DATA, value: Some(Value::Blob(self.custom_data.clone())) },
            ],
            streams: vec![self.stream()],
            status,
            status_message,
            tag: request.tag,
        })
    }

    fn set_option(&mut self, option: &OptionValue) -> Result<(), ErrorCode> {
        match (option.option_id, &option.value) {
            (USE_CASE, Some(Value::OneOf(index))) => {
                if !(0..ITEMS.len() as i32).contains(index) {
                    return Err(ErrorCode::OUT_OF_RANGE);
                }
                self.use_case = *index;
                Ok(())
            }
            (CUSTOM_DATA, Some(Value::Blob(value))) => {
                self.custom_data.clone_from(value);
                Ok(())
            }
            (USE_CASE | CUSTOM_DATA, _) => Err(ErrorCode::OPTION_TYPE),
            _ => Err(ErrorCode::NO_SUCH_OPTION),
        }
    }

    /// Waveform and registers that the options select.
    fn selected(&self) -> Result<Custom, String> {
        match usize::try_from(self.use_case).ok().and_then(|index| Preset::ALL.get(index)) {
            Some(preset) => {
                let waveform = preset.waveform().map_err(|e| e.to_string())?;
                let registers = Custom::compile(&waveform).map_err(|e| e.to_string())?.registers;
                Ok(Custom { waveform, registers })
            }
            None => Custom::decode(&self.custom_data).map_err(|e| e.to_string()),
        }
    }

    /// Configures the chip, which itself accepts any waveform. A waveform that the source does not have is refused with
    /// an error.
    fn configure(&mut self) {
        (self.current_frame, self.dropped) = (0, 0);
        let checked =
            self.selected().and_then(|selected| self.chip.source.check(&selected.waveform).map(|()| selected));
        self.refusal = match checked {
            Ok(selected) => {
                self.setting = selected;
                self.shared.accept();
                None
            }
            Err(reason) => {
                self.shared.refuse(&reason);
                Some(reason)
            }
        };
    }

    fn status(&self) -> (i32, String) {
        match (&self.refusal, self.active_until) {
            (Some(reason), _) => (device_status::ERROR, reason.clone()),
            (None, Some(_)) => (device_status::ACTIVE, "Device is streaming".to_owned()),
            (None, None) => (device_status::READY, String::new()),
        }
    }

    fn stream(&self) -> StreamConfig {
        let shape = self.setting.waveform.shape();
        let dimension =
            |name: &str, size: usize| Dimension { name: name.into(), size: size as i32, labels: Vec::new() };
        StreamConfig {
            name: "Radar".into(),
            direction: direction::OUTPUT,
            data_type: data_type::S16,
            shape: vec![
                dimension("Antenna", shape.rx),
                dimension("Chirp", shape.chirps),
                dimension("Sample", shape.samples),
            ],
            frequency: stated_frequency_hz(&self.setting.waveform),
            // The firmware states 1; its chunks hold as many frames as one read of the FIFO completes.
            max_frame_count: 1,
            unit: "???".into(),
            current_frame: self.current_frame as i32,
            frames_dropped: self.dropped,
        }
    }

    fn board(&self) -> Board {
        let version = |[major, minor, build, revision]: [u32; 4]| Some(Version { major, minor, build, revision });
        let [_, minor, build, revision] = PROTOCOL_VERSION;
        let (status, status_message) = self.status();
        let options = [
            (
                USE_CASE,
                "Use case",
                "Presets",
                OptionKind::OneOf(OptionOneOf {
                    default_index: 0,
                    current_index: self.use_case,
                    items: ITEMS.map(str::to_owned).to_vec(),
                }),
            ),
            (
                CUSTOM_DATA,
                "Custom data",
                "Binary Custom data",
                OptionKind::Blob(OptionBlob { current_value: self.custom_data.clone(), default_value: Vec::new() }),
            ),
        ];
        Board {
            serial: Some(BoardSerial { uuid: (0..16).collect() }),
            name: "CY8CKIT-062S2-AI".into(),
            firmware_version: version([1, 2, 0, 0]),
            protocol_version: version([self.protocol_major, minor, build, revision]),
            watchdog_timeout: WATCHDOG_TIMEOUT_MS,
            devices: vec![Device {
                device_id: DEVICE,
                name: self.name.clone(),
                description: "Radar device (bgt60trxx)".into(),
                device_type: device_type::SENSOR,
                options: options
                    .map(|(option_id, name, description, kind)| DeviceOption {
                        option_id,
                        name: name.into(),
                        description: description.into(),
                        kind: Some(kind),
                    })
                    .to_vec(),
                streams: vec![self.stream()],
                status,
                status_message,
            }],
        }
    }
}

/// Checks that a request is for the radar.
fn check_device(device: i32) -> Result<(), ErrorCode> {
    if device == DEVICE { Ok(()) } else { Err(ErrorCode::NO_SUCH_DEVICE) }
}
