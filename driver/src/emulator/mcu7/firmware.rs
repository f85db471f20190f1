//! Requests to the emulated MCU7 firmware: requests in, answers out, and the state that they change.

use std::sync::Arc;

use crate::chip::{address, field, main_bits};
use crate::emulator::chip::Chip;
use crate::emulator::{Fault, Shared};
use crate::protocol::mcu7::{
    BoardInfo, COMPONENT_AVIAN, COMPONENT_RADAR, Command, FirmwareVersion, Framing, HostEvent, IMPLEMENTATION_AVIAN,
    Protocol, Request, RequestKind, Response, SliceLayout, SpiWord, Status,
};

/// Longest board info that version 3 gives in a fixed length.
const MAX_FIXED_INFO: u16 = 256;

fn board_info(framing: Framing) -> Vec<u8> {
    let product_id = match framing {
        Framing::Serial => 0x0251,
        Framing::Bulk => 0x0252,
    };
    let name = "Radar Baseboard MCU7 (MCU B)".to_owned();
    BoardInfo { vendor_id: 0x058B, product_id, name }.encode()
}

pub(super) struct Requests {
    pub chip: Chip,
    protocol: Protocol,
    framing: Framing,
    protocol_version: u16,
    slice: Option<SliceLayout>,
    data_started: bool,
    /// Number of starts of data: the sender discards its buffer when it changes.
    pub starts: u64,
    /// Whether the use of the other version by a client has been logged.
    has_logged_version: bool,
    shared: Arc<Shared>,
}

impl Requests {
    pub fn new(chip: Chip, protocol: Protocol, framing: Framing, faults: &[Fault], shared: Arc<Shared>) -> Self {
        let wrong_version = faults.iter().find_map(|fault| match fault {
            Fault::WrongVersion(major) => Some(*major),
            _ => None,
        });
        Requests {
            chip,
            protocol,
            framing,
            protocol_version: wrong_version.unwrap_or(protocol.major()),
            slice: None,
            data_started: false,
            starts: 0,
            has_logged_version: false,
            shared,
        }
    }

    /// Resets all state except the numbers of starts, after a loss of power.
    pub fn power_up(&mut self) {
        self.chip.reset();
        self.slice = None;
        self.data_started = false;
    }

    /// Stops measuring after the last client has left. Registers and slice stay as they are.
    pub fn client_left(&mut self) {
        self.chip.halt();
        self.data_started = false;
    }

    /// Layout of the slices, while data run.
    pub fn streaming(&self) -> Option<SliceLayout> {
        self.slice.filter(|_| self.data_started && self.chip.running.is_some())
    }

    /// Stops data after an overflow, as the firmware does by itself. The chip goes on measuring until it is reset.
    pub fn stop_data(&mut self) {
        self.data_started = false;
    }

    pub fn handle(&mut self, event: &HostEvent, out: &mut Vec<u8>) {
        match event {
            HostEvent::Refused { kind_code, status } => {
                self.log_other_version(*kind_code);
                Response { kind_code: *kind_code, status: *status, payload: &[] }.encode(out);
            }
            HostEvent::Request(request) => {
                let (status, payload) = self.answer(request);
                Response { kind_code: request.kind_code(), status, payload: &payload }.encode(out);
            }
        }
    }

    /// Logs once that a client uses the other version: firmware of version 4 refuses the codes of version 3, and such
    /// clients report no reason.
    fn log_other_version(&mut self, kind_code: u8) {
        let is_v3 = RequestKind::from_code(kind_code).is_some_and(|(_, version)| version == Protocol::V3);
        if self.protocol == Protocol::V4 && is_v3 && !self.has_logged_version {
            self.has_logged_version = true;
            tracing::warn!(
                "a client speaks protocol 3, which firmware of protocol 4 refuses; radome board emulate --protocol mcu7-3 is a board for it"
            );
        }
    }

    /// Computes the status of a request, and the payload of the answer.
    pub fn answer(&mut self, request: &Request) -> (Status, Vec<u8>) {
        let command = Command::from_request(request);
        // A configuration that is refused stops the data, too.
        if command == Err(Status::InvalidParameter) {
            self.data_started = false;
        }
        match command.and_then(|command| self.execute(&command)) {
            Ok(payload) => (Status::Ok, payload),
            Err(status) => (status, Vec::new()),
        }
    }

    fn execute(&mut self, command: &Command) -> Result<Vec<u8>, Status> {
        let mut answer = Vec::new();
        match command {
            Command::BoardInfo => answer = board_info(self.framing),
            Command::BoardInfoFixed { length } => {
                answer = board_info(self.framing);
                answer.resize(usize::from((*length).min(MAX_FIXED_INFO)), 0);
            }
            Command::FirmwareVersion => {
                // Firmware 2.5 was the last to speak version 3.
                let minor = if self.protocol == Protocol::V3 { 5 } else { 9 };
                answer = FirmwareVersion { firmware: [2, minor, 0, 0], protocol: [self.protocol_version, 0] }.encode();
            }
            Command::Uuid => answer.extend(0..16),
            Command::ExtendedVersion => answer.extend(b"emulated\0"),
            Command::ComponentCount { component } => answer.push(u8::from(*component == COMPONENT_AVIAN)),
            Command::ComponentImplementation { component } => {
                answer.push(if *component == COMPONENT_RADAR { IMPLEMENTATION_AVIAN } else { 0 });
            }
            Command::DataIndex => answer.push(0),
            Command::WriteRegisters { address, values } => self.write_burst(*address, values)?,
            Command::ReadRegisters { address, count } => {
                let read = |offset: u8| self.chip.read(address.wrapping_add(offset));
                answer.extend((0..*count).flat_map(|offset| read(offset).to_le_bytes()));
            }
            Command::SetBits { address, mask } => self.write(*address, self.chip.read(*address) | mask)?,
            Command::HardwareReset => self.chip.reset(),
            Command::InterruptLevel => answer.push(u8::from(self.chip.interrupt())),
            Command::Execute { words, answer: is_answered } => {
                for word in words {
                    self.check_start(word)?;
                    let read = self.chip.transfer(*word);
                    if *is_answered {
                        answer.extend(read.to_le_bytes());
                    }
                }
            }
            Command::ConfigureData { slice_samples } => {
                self.data_started = false;
                self.slice = Some(SliceLayout { samples: usize::from(*slice_samples), framing: self.framing });
            }
            Command::DataStatus => answer.extend(u32::from(self.data_started).to_le_bytes()),
            Command::StartData if self.slice.is_none() => return Err(Status::NotConfigured),
            Command::StartData => {
                self.data_started = true;
                self.starts += 1;
            }
            Command::StopData => self.data_started = false,
        }
        Ok(answer)
    }

    fn write_burst(&mut self, address: u8, values: &[u32]) -> Result<(), Status> {
        // The GSR0 of a burst shows the state from before the burst.
        let failed = self.chip.fifo_failed();
        for (offset, value) in values.iter().enumerate() {
            self.write(address.wrapping_add(offset as u8), *value)?;
        }
        if failed { Err(Status::UnexpectedValue) } else { Ok(()) }
    }

    fn write(&mut self, address: u8, value: u32) -> Result<(), Status> {
        self.check_start(&SpiWord::write(address, value))?;
        self.chip.write(address, value);
        Ok(())
    }

    /// Refuses a start of frames with a slice for which the real firmware sends garbage.
    fn check_start(&mut self, word: &SpiWord) -> Result<(), Status> {
        let starts = word.write && word.address == address::MAIN && word.value & main_bits::FRAME_START != 0;
        let has_frames = field::MAIN::CW_MODE.of(word.value) == 0;
        match self.slice {
            Some(slice) if starts && has_frames && !slice.is_safe() => {
                self.shared.refuse(&format!("slices of {} samples make firmware 2.x send garbage", slice.samples));
                Err(Status::Failed)
            }
            _ => Ok(()),
        }
    }
}
