//! The radar chip as its board sees it: registers, resets, frames that run or do not, a FIFO that fills.
//!
//! After the vendor's library and datasheet (hardware notes section 4):
//! - a hardware or software reset puts every register back and ends the frames; MAIN's reset bits clear themselves;
//! - `FSM_RESET` ends the frames, `FIFO_RESET` empties the FIFO; so does the start of frames;
//! - the interrupt line is high while the FIFO holds more than `FIFO_CREF` words of two codes;
//! - an overflow is sticky: FSTAT and every answer's GSR0 show it until the FIFO is reset;
//! - a read past the FIFO's end gives all ones and sets the underflow flag, as sticky;
//! - `MAX_FRAME_CNT` frames end by themselves, 0 means without end.
//!
//! The FIFO has its real depth of 8192 words. Not modelled: the prefix of chirps (`PREFIX_EN`), the sensor ADC, CW mode.

use radome_dsp::{FIFO_SAMPLES, FrameSource, Waveform};

use super::world::{Slice, World};
use super::{Fault, Pace};
use crate::board::CHIP_ID_BGT60TR13C;
use crate::chip::{ChipConfiguration, Field, RegisterFile, address, field, main_bits};
use crate::protocol::strata::SpiWord;

/// Upper half of GSR0, which always reads so.
const GSR0_IDLE: u32 = 0xF0;
/// Overflow or underflow of the FIFO in GSR0.
const GSR0_FIFO_ERROR: u32 = 1 << 3;

/// The chip, and the world that it samples.
pub(super) struct Chip {
    registers: RegisterFile,
    chip_id: u32,
    source: Waveform,
    world: World,
    /// Waveform that the frames run with, while they do.
    frames: Option<Waveform>,
    overflowed: bool,
    underflowed: bool,
    /// Counts starts of frames: what sends them begins afresh when it changes.
    pub starts: u64,
}

impl Chip {
    /// A chip that has just got power.
    pub fn new(source: Box<dyn FrameSource>, pace: Pace, faults: &[Fault]) -> std::io::Result<Self> {
        let foreign = faults.iter().find_map(|fault| match fault {
            Fault::ForeignChip(id) => Some(*id),
            _ => None,
        });
        let mut chip = Chip {
            registers: RegisterFile::default(),
            chip_id: foreign.unwrap_or(CHIP_ID_BGT60TR13C),
            source: source.waveform().clone(),
            world: World::new(source, pace)?,
            frames: None,
            overflowed: false,
            underflowed: false,
            starts: 0,
        };
        chip.reset();
        Ok(chip)
    }

    /// The reset pin, the software reset, and power that comes back.
    pub fn reset(&mut self) {
        self.registers = RegisterFile::default();
        self.registers.set(address::CHIP_ID, self.chip_id);
        self.frames = None;
        self.reset_fifo();
    }

    fn reset_fifo(&mut self) {
        (self.overflowed, self.underflowed) = (false, false);
    }

    /// Whether GSR0 reports an error of the FIFO.
    pub fn fifo_failed(&self) -> bool {
        self.overflowed || self.underflowed
    }

    /// Waveform of the frames, while they run.
    pub fn frames(&self) -> Option<&Waveform> {
        self.frames.as_ref()
    }

    /// One SPI word; the answer is GSR0 and what the register held before.
    ///
    /// # Errors
    /// The emulator cannot start these frames, and why.
    pub fn transfer(&mut self, word: SpiWord) -> Result<u32, String> {
        let gsr0 = GSR0_IDLE | if self.fifo_failed() { GSR0_FIFO_ERROR } else { 0 };
        let answer = gsr0 << 24 | self.read(word.address);
        if word.write {
            self.write(word.address, word.value)?;
        }
        Ok(answer)
    }

    /// Content of a register, the status registers as they are now.
    pub fn read(&self, address: u8) -> u32 {
        match address {
            address::FSTAT => self.fifo_status(),
            address::STAT1 => self.frame_status(),
            _ => self.registers.get(address),
        }
    }

    fn fifo_status(&self) -> u32 {
        let codes = if self.frames.is_some() { self.world.in_fifo().min(FIFO_SAMPLES as u64) } else { 0 };
        let words = (codes / 2) as u32;
        let flags = [
            (field::FSTAT::FOF_ERR, self.overflowed),
            (field::FSTAT::FUF_ERR, self.underflowed),
            (field::FSTAT::FULL, codes >= FIFO_SAMPLES as u64),
            (field::FSTAT::EMPTY, codes == 0),
            (field::FSTAT::CREF, words > self.registers.field(field::SFCTL::FIFO_CREF)),
        ];
        let status = field::FSTAT::FILL_STATUS.put(0, words);
        flags.iter().fold(status, |status, (flag, is_set)| flag.put(status, u32::from(*is_set)))
    }

    /// Frames and chirps since the start.
    fn frame_status(&self) -> u32 {
        let Some(waveform) = &self.frames else { return 0 };
        let shape = waveform.shape();
        let chirps = self.world.sampled() / (shape.rx * shape.samples).max(1) as u64;
        let per_frame = shape.chirps.max(1) as u64;
        let count = |field: Field, value: u64, content| field.put(content, (value & u64::from(field.max())) as u32);
        count(field::STAT1::FRAME_CNT, chirps / per_frame, count(field::STAT1::SHAPE_GRP_CNT, chirps % per_frame, 0))
    }

    /// Writes a register.
    ///
    /// # Errors
    /// The emulator cannot start these frames, and why.
    pub fn write(&mut self, address: u8, value: u32) -> Result<(), String> {
        match address {
            address::CHIP_ID | address::FSTAT | address::STAT0 | address::STAT1 => {}
            address::MAIN => {
                if value & main_bits::SW_RESET != 0 {
                    self.reset();
                }
                self.registers.set(address::MAIN, value & !main_bits::ALL);
                if value & main_bits::FSM_RESET != 0 {
                    self.frames = None;
                }
                if value & main_bits::FIFO_RESET != 0 {
                    self.frames = None;
                    self.reset_fifo();
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
    /// loudly.
    fn start_frames(&mut self) -> Result<(), String> {
        let waveform = ChipConfiguration::decode(&self.registers).map_err(|error| error.to_string())?.waveform;
        self.source.check_compatible(&waveform).map_err(|mismatch| mismatch.to_string())?;
        let antennas = self.source.request.rx_antennas.antennas();
        let wanted = waveform.request.rx_antennas.antennas();
        let channels = wanted.iter().filter_map(|a| antennas.iter().position(|b| a == b)).collect();
        let has_test_pattern = self.registers.field(field::SFCTL::LFSR_EN) == 1;
        let test_pattern = wanted.iter().position(|a| *a == 1).filter(|_| has_test_pattern);
        self.world.restart(&waveform, channels, test_pattern);
        self.frames = Some(waveform);
        self.starts += 1;
        Ok(())
    }

    /// Whether this many codes are there for a burst read, which the interrupt line announces.
    pub fn poll(&mut self, codes: u64) -> Slice {
        let Some(waveform) = &self.frames else { return Slice::Wait };
        let frames = self.registers.field(field::CCR2::MAX_FRAME_CNT);
        let last = u64::from(frames) * waveform.shape().codes() as u64;
        if frames > 0 && self.world.taken() + codes > last {
            return Slice::Wait;
        }
        // The line goes up at its own level; who reads more than is there then reads past the end.
        let level = 2 * (u64::from(self.registers.field(field::SFCTL::FIFO_CREF)) + 1);
        self.world.slice(level.min(codes).max(1))
    }

    /// A burst read of the FIFO, appended.
    pub fn read_fifo(&mut self, codes: usize, out: &mut Vec<u16>) {
        let there = codes.min(self.world.in_fifo() as usize);
        out.extend_from_slice(self.world.codes(there));
        self.world.take(there);
        let missing = codes - there;
        if missing > 0 {
            out.extend(std::iter::repeat_n(0xFFF, missing));
            self.underflowed = true;
        }
    }

    /// Looks whether more has been sampled than the FIFO holds; the flag stays.
    pub fn look_for_overflow(&mut self) {
        self.overflowed |= self.frames.is_some() && self.world.overflows();
    }

    /// Makes the FIFO overflow.
    pub fn overflow(&mut self) {
        self.overflowed = true;
    }

    /// The world that it samples.
    pub fn world(&mut self) -> &mut World {
        &mut self.world
    }
}
