//! Handshake with a Radar Baseboard MCU7: identities of its firmware and of its chip, with or without a reset.

use super::link::Link;
use crate::board::{BoardError, BoardIdentity};
use crate::chip::{CHIP_ID_BGT60TR13C, REGISTERS, RegisterFile, SpiWord, address as register, chip_name};
use crate::protocol::mcu7::{
    BoardInfo, COMPONENT_AVIAN, COMPONENT_RADAR, Command, FirmwareVersion, IMPLEMENTATION_AVIAN, Protocol, Status, text,
};
use crate::transport::trace;

/// SFCTL as the vendor's client sets it before the first read. A reset sets `MISO_HF_READ`, which moves the edge on
/// which the chip answers.
const SFCTL_READABLE: u32 = 0x10_0000;

/// Answers of a board's firmware to the handshake. The board has a radar chip, which has not been accessed, and sends
/// no data.
pub(super) struct Handshake {
    info: BoardInfo,
    version: FirmwareVersion,
}

impl Handshake {
    /// Finds the version of the protocol that the board speaks, and stops its data.
    pub fn exchange(link: &mut Link) -> Result<Self, BoardError> {
        let path = link.path.clone();
        let malformed = |source| BoardError::Malformed { path: path.clone(), source };
        // Firmware of version 3 does not know the codes of version 4.
        let answer = match link.request(&Command::BoardInfo)? {
            (Status::Ok, answer) => answer,
            (Status::RequestTypeInvalid, _) => {
                link.protocol = Protocol::V3;
                link.request_ok(&Command::BoardInfo)?
            }
            (status, _) => return Err(BoardError::Refused { path, command: "board info", status }),
        };
        let info = BoardInfo::decode(&answer).map_err(malformed)?;
        let version = FirmwareVersion::decode(&link.request_ok(&Command::FirmwareVersion)?).map_err(malformed)?;
        let [major, minor] = version.protocol;
        if major != link.protocol.major() {
            return Err(BoardError::Protocol { path, major, minor });
        }
        // An earlier program may have ended without stopping the board.
        link.request(&Command::StopData)?;
        let has_chip = match link.protocol {
            Protocol::V4 => {
                let count = link.request_ok(&Command::ComponentCount { component: COMPONENT_AVIAN })?;
                count.first().is_some_and(|count| *count > 0)
            }
            Protocol::V3 => {
                let answer = link.request_ok(&Command::ComponentImplementation { component: COMPONENT_RADAR })?;
                answer.first() == Some(&IMPLEMENTATION_AVIAN)
            }
        };
        if !has_chip {
            return Err(BoardError::ChipSilent { path, chip_id: 0 });
        }
        Ok(Handshake { info, version })
    }

    /// Reads the whole identity: the further fields of the board, then CHIP_ID by the given function.
    pub fn identity(
        self,
        link: &mut Link,
        read_chip_id: fn(&mut Link) -> Result<u32, BoardError>,
    ) -> Result<BoardIdentity, BoardError> {
        let uuid: String = match link.request(&Command::Uuid)? {
            (Status::Ok, uuid) => uuid.iter().map(|b| format!("{b:02x}")).collect(),
            _ => "0".repeat(32),
        };
        trace::identity(&uuid);
        let extended = link.request(&Command::ExtendedVersion)?.1;
        let chip_id = read_chip_id(link)?;
        let path = link.path.clone();
        match chip_id {
            0 | 0xFF_FFFF => return Err(BoardError::ChipSilent { path, chip_id }),
            CHIP_ID_BGT60TR13C => {}
            _ => return Err(BoardError::OtherChip { path, chip: chip_name(chip_id), chip_id }),
        }
        let Handshake { info, version } = self;
        let ([a, b, c, _], [major, minor]) = (version.firmware, version.protocol);
        Ok(BoardIdentity {
            name: info.name,
            vendor_id: info.vendor_id,
            product_id: info.product_id,
            firmware_version: format!("{a}.{b}.{c}"),
            extended_version: text(&extended),
            protocol_version: format!("{major}.{minor}"),
            uuid,
            chip: chip_name(chip_id).to_owned(),
            chip_id,
        })
    }
}

/// Content in the answer to a read of one register.
fn content(answer: &[u8]) -> u32 {
    answer.first_chunk().map_or(0, |word| u32::from_le_bytes(*word) & 0xFF_FFFF)
}

/// Reads CHIP_ID and leaves the waveform in the chip as it is. A chip that has not been programmed may answer on
/// another clock edge. SFCTL is then set as the vendor's client sets it first; that register holds no part of a
/// waveform.
pub(super) fn read_chip_id(link: &mut Link) -> Result<u32, BoardError> {
    let read = Command::ReadRegisters { address: register::CHIP_ID, count: 1 };
    match link.request(&read)? {
        (Status::Ok, answer) if content(&answer) == CHIP_ID_BGT60TR13C => Ok(CHIP_ID_BGT60TR13C),
        _ => {
            set_up_spi(link)?;
            Ok(content(&link.request_ok(&read)?))
        }
    }
}

/// Resets the chip and reads CHIP_ID.
pub(super) fn reset_and_read_chip_id(link: &mut Link) -> Result<u32, BoardError> {
    link.request_ok(&Command::HardwareReset)?;
    let words = vec![SpiWord::write(register::SFCTL, SFCTL_READABLE)];
    link.request_ok(&Command::Execute { words, answer: false })?;
    let words = vec![SpiWord::read(register::CHIP_ID)];
    Ok(content(&link.request_ok(&Command::Execute { words, answer: true })?))
}

/// Sets the edge on which the chip answers. After a stale FIFO overflow the board reports a failure although the write
/// has been done; its status is ignored.
pub(super) fn set_up_spi(link: &mut Link) -> Result<(), BoardError> {
    link.request(&Command::WriteRegisters { address: register::SFCTL, values: vec![SFCTL_READABLE] })?;
    Ok(())
}

/// Reads every register without changing the chip.
pub(super) fn read_every_register(link: &mut Link) -> Result<RegisterFile, BoardError> {
    let mut registers = RegisterFile::default();
    let addresses = REGISTERS.iter().map(|register| register.address);
    let words = addresses.clone().map(SpiWord::read).collect();
    let answer = link.request_ok(&Command::Execute { words, answer: true })?;
    let values = answer.as_chunks::<4>().0.iter().map(|word| u32::from_le_bytes(*word));
    addresses.zip(values).for_each(|(address, value)| registers.set(address, value));
    Ok(registers)
}
