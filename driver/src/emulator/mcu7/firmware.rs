//! What the MCU7 firmware answers: requests in, bytes out, and the state that the requests change.

use radome_dsp::Waveform;

use crate::board::CHIP_ID_BGT60TR13C;
use crate::chip::{ChipConfiguration, RegisterFile, address, field, main_bits};
use crate::emulator::Fault;
use crate::protocol::strata::{
    BoardInfo, COMPONENT_AVIAN, COMPONENT_RADAR, Command, DataFormat, FirmwareVersion, HostEvent, IMPLEMENTATION_AVIAN,
    Protocol, Response, SliceLayout, SpiWord, Status,
};

/// Longest board info that version 3 gives in a fixed length.
const MAX_FIXED_INFO: u16 = 256;

fn board_info() -> Vec<u8> {
    let name = "Radar Baseboard MCU7 (MCU B)".to_owned();
    BoardInfo { vendor_id: 0x058B, product_id: 0x0251, name }.encode()
}

pub(super) struct Requests {
    registers: RegisterFile,
    chip_id: u32,
    protocol: Protocol,
    protocol_version: u16,
    source: Waveform,
    slice: Option<SliceLayout>,
    data_started: bool,
    /// Waveform that the chip's frames run with.
    frames: Option<Waveform>,
    /// Counts starts of frames: the sender begins afresh when it changes.
    pub starts: u64,
    /// Why the last start was refused.
    pub refusal: Option<String>,
}

impl Requests {
    pub fn new(source: &Waveform, protocol: Protocol, faults: &[Fault]) -> Self {
        let mut chip_id = CHIP_ID_BGT60TR13C;
        let mut protocol_version = protocol.major();
        for fault in faults {
            match *fault {
                Fault::ForeignChip(id) => chip_id = id,
                Fault::WrongVersion(major) => protocol_version = major,
                _ => {}
            }
        }
        let mut requests = Requests {
            registers: RegisterFile::default(),
            chip_id,
            protocol,
            protocol_version,
            source: source.clone(),
            slice: None,
            data_started: false,
            frames: None,
            starts: 0,
            refusal: None,
        };
        requests.reset();
        requests
    }

    fn reset(&mut self) {
        self.registers = RegisterFile::default();
        self.registers.set(address::CHIP_ID, self.chip_id);
        self.frames = None;
    }

    /// The board was without power: everything is as at first, but for the count of starts.
    pub fn power_up(&mut self) {
        self.reset();
        self.slice = None;
        self.data_started = false;
    }

    /// Slice and waveform while slices are to be sent.
    pub fn streaming(&self) -> Option<(SliceLayout, &Waveform)> {
        self.slice.filter(|_| self.data_started).zip(self.frames.as_ref())
    }

    /// Whether the chip puts its test pattern in the place of RX1's samples.
    pub fn test_pattern(&self) -> bool {
        self.registers.field(field::SFCTL::LFSR_EN) == 1
    }

    /// The firmware stops by itself after an overflow.
    pub fn stop_by_itself(&mut self) {
        self.data_started = false;
        self.frames = None;
    }

    pub fn handle(&mut self, event: &HostEvent, out: &mut Vec<u8>) {
        match event {
            HostEvent::Refused { kind_code, status } => {
                Response { kind_code: *kind_code, status: *status, payload: &[] }.encode(out);
            }
            HostEvent::Request(request) => {
                let answer = Command::from_request(request).and_then(|command| self.run(&command));
                let (status, payload) = match answer {
                    Ok(payload) => (Status::Ok, payload),
                    Err(status) => (status, Vec::new()),
                };
                Response { kind_code: request.kind_code(), status, payload: &payload }.encode(out);
            }
        }
    }

    fn run(&mut self, command: &Command) -> Result<Vec<u8>, Status> {
        let nothing = Ok(Vec::new());
        match command {
            Command::BoardInfo => Ok(board_info()),
            Command::BoardInfoFixed { length } => {
                let mut info = board_info();
                info.resize(usize::from((*length).min(MAX_FIXED_INFO)), 0);
                Ok(info)
            }
            Command::FirmwareVersion => {
                // Firmware 2.5 was the last to speak version 3.
                let minor = if self.protocol == Protocol::V3 { 5 } else { 9 };
                Ok(FirmwareVersion { firmware: [2, minor, 0, 0], protocol: [self.protocol_version, 0] }.encode())
            }
            Command::Uuid => Ok((0..16).collect()),
            Command::ExtendedVersion => Ok(b"emulated\0".to_vec()),
            Command::ComponentCount { component } => Ok(vec![u8::from(*component == COMPONENT_AVIAN)]),
            Command::ComponentImplementation { component } => {
                Ok(vec![if *component == COMPONENT_RADAR { IMPLEMENTATION_AVIAN } else { 0 }])
            }
            Command::DataIndex => Ok(vec![0]),
            Command::WriteRegisters { address, values } => {
                for (offset, value) in values.iter().enumerate() {
                    self.write(address.wrapping_add(offset as u8), *value)?;
                }
                nothing
            }
            Command::ReadRegisters { address, count } => {
                let read = |offset: u8| self.registers.get(address.wrapping_add(offset));
                Ok((0..*count).flat_map(|offset| read(offset).to_le_bytes()).collect())
            }
            Command::SetBits { address, mask } => {
                self.write(*address, self.registers.get(*address) | mask)?;
                nothing
            }
            Command::HardwareReset => {
                self.reset();
                nothing
            }
            Command::Execute { words, answer } => {
                let mut read = Vec::new();
                for SpiWord { address, write, value } in words {
                    read.extend((0xF0 << 24 | self.registers.get(*address)).to_le_bytes());
                    if *write {
                        self.write(*address, *value)?;
                    }
                }
                Ok(if *answer { read } else { Vec::new() })
            }
            Command::ConfigureData { format, slice_samples } => {
                self.data_started = false;
                if *format != DataFormat::Packed12 {
                    return Err(Status::InvalidParameter);
                }
                self.slice = Some(SliceLayout { samples: usize::from(*slice_samples) });
                nothing
            }
            Command::DataStatus => Ok(u32::from(self.data_started).to_le_bytes().to_vec()),
            Command::StartData if self.slice.is_none() => Err(Status::NotConfigured),
            Command::StartData => {
                self.data_started = true;
                self.starts += 1;
                nothing
            }
            Command::StopData => {
                self.data_started = false;
                nothing
            }
        }
    }

    fn write(&mut self, address: u8, value: u32) -> Result<(), Status> {
        match address {
            address::CHIP_ID | address::FSTAT => {}
            address::MAIN => {
                if value & main_bits::SW_RESET != 0 {
                    self.reset();
                }
                self.registers.set(address::MAIN, value & !main_bits::ALL);
                if value & (main_bits::FSM_RESET | main_bits::FIFO_RESET) != 0 {
                    self.frames = None;
                }
                if value & main_bits::FRAME_START != 0 {
                    self.start_frames()?;
                }
            }
            _ => self.registers.set(address, value),
        }
        Ok(())
    }

    /// The chip would measure whatever it is told; the source has frames of one waveform only. Another is refused,
    /// loudly, and so is a slice that would make the real firmware send garbage.
    fn start_frames(&mut self) -> Result<(), Status> {
        let refuse = |this: &mut Self, reason: String| {
            tracing::warn!(reason, "the emulated board does not start");
            this.refusal = Some(reason);
            Err(Status::Failed)
        };
        if let Some(slice) = self.slice
            && !slice.is_safe()
        {
            return refuse(self, format!("slices of {} samples make firmware 2.x send garbage", slice.samples));
        }
        match ChipConfiguration::decode(&self.registers) {
            Err(error) => refuse(self, error.to_string()),
            Ok(configuration) => match self.source.check_compatible(&configuration.waveform) {
                Err(mismatch) => refuse(self, mismatch.to_string()),
                Ok(()) => {
                    self.frames = Some(configuration.waveform);
                    self.starts += 1;
                    Ok(())
                }
            },
        }
    }
}
