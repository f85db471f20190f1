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
    /// A chip that was programmed with the source's waveform and does not measure.
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
        chip.leave_programmed();
        Ok(chip)
    }

    /// As if somebody had measured the source before, so that who asks the chip learns what it is.
    fn leave_programmed(&mut self) {
        let configuration = ChipConfiguration { waveform: self.source.clone(), slice_samples: FIFO_SAMPLES / 2 };
        for register in configuration.compile().unwrap_or_default() {
            let is_main = register.address == address::MAIN;
            let value = if is_main { register.value & !main_bits::ALL } else { register.value };
            self.registers.set(register.address, value);
        }
    }

    /// The reset pin, the software reset, and power that comes back.
    pub fn reset(&mut self) {
        self.registers = RegisterFile::default();
        self.registers.set(address::CHIP_ID, self.chip_id);
        if self.frames.take().is_some() {
            self.world.stop();
        }
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

    /// Codes in the FIFO.
    fn fill(&self) -> u64 {
        if self.frames.is_some() { self.world.in_fifo().min(FIFO_SAMPLES as u64) } else { 0 }
    }

    /// Codes beyond which the chip calls.
    fn interrupt_level(&self) -> u64 {
        2 * u64::from(self.registers.field(field::SFCTL::FIFO_CREF))
    }

    /// Whether the interrupt line is high.
    pub fn interrupt(&self) -> bool {
        self.fill() / 2 * 2 > self.interrupt_level()
    }

    fn fifo_status(&self) -> u32 {
        let codes = self.fill();
        let flags = [
            (field::FSTAT::FOF_ERR, self.overflowed),
            (field::FSTAT::FUF_ERR, self.underflowed),
            (field::FSTAT::FULL, codes >= FIFO_SAMPLES as u64),
            (field::FSTAT::EMPTY, codes == 0),
            (field::FSTAT::CREF, self.interrupt()),
        ];
        let status = field::FSTAT::FILL_STATUS.put(0, (codes / 2) as u32);
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
        self.world.slice(codes.min(self.interrupt_level() + 2))
    }

    /// A burst read of the FIFO, appended.
    pub fn read_fifo(&mut self, codes: usize, out: &mut Vec<u16>) {
        let there = codes.min(self.world.in_fifo() as usize).min(self.world.at_hand());
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

#[cfg(test)]
mod tests {
    use radome_dsp::{Frame, SourceError, SourceEvent, WaveformRequest};

    use super::*;
    use crate::chip::RegisterList;

    /// Frames whose codes count on from 0.
    struct Ramp(Waveform, u64);

    impl FrameSource for Ramp {
        fn waveform(&self) -> &Waveform {
            &self.0
        }

        fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
            let first = self.1 * frame.codes.len() as u64;
            frame.codes.iter_mut().zip(first..).for_each(|(code, value)| *code = (value & 0xFFF) as u16);
            frame.time_ns = (self.1 as f64 * self.0.frame_interval_s() * 1e9) as u64;
            self.1 += 1;
            Ok(SourceEvent::Frame)
        }
    }

    /// One receiver, 4 chirps of 64 samples.
    fn waveform() -> Waveform {
        let rx_antennas = radome_dsp::RxMask::from_antennas(&[1]).expect("valid");
        let request =
            WaveformRequest { rx_antennas, samples_per_chirp: 64, chirps_per_frame: 4, ..WaveformRequest::paper() };
        Waveform::realise(request).expect("valid")
    }

    fn chip(pace: Pace) -> Chip {
        Chip::new(Box::new(Ramp(waveform(), 0)), pace, &[]).expect("threads")
    }

    fn list(slice_samples: usize) -> RegisterList {
        ChipConfiguration { waveform: waveform(), slice_samples }.compile().expect("fits")
    }

    fn started(pace: Pace, slice_samples: usize) -> Chip {
        started_with(waveform(), pace, slice_samples)
    }

    fn started_with(waveform: Waveform, pace: Pace, slice_samples: usize) -> Chip {
        let mut chip = Chip::new(Box::new(Ramp(waveform.clone(), 0)), pace, &[]).expect("threads");
        let list = ChipConfiguration { waveform, slice_samples }.compile().expect("fits");
        list.iter().for_each(|r| chip.write(r.address, r.value).expect("starts"));
        chip
    }

    fn poll(chip: &mut Chip, codes: u64) -> Slice {
        for _ in 0..1000 {
            match chip.poll(codes) {
                Slice::Wait => std::thread::sleep(std::time::Duration::from_millis(1)),
                other => return other,
            }
        }
        Slice::Wait
    }

    const RESET: u32 = main_bits::FIFO_RESET | main_bits::FSM_RESET;

    #[test]
    fn a_software_reset_puts_every_register_back_and_clears_itself() {
        let mut chip = started(Pace::AsFastAsRead, 128);
        assert!(chip.frames().is_some());
        assert_eq!(chip.read(address::MAIN) & main_bits::ALL, 0);
        chip.write(address::MAIN, main_bits::SW_RESET).expect("resets");
        assert!(chip.frames().is_none());
        for register in
            crate::chip::REGISTERS.iter().filter(|r| r.address != address::MAIN && r.address != address::CHIP_ID)
        {
            assert_eq!(chip.read(register.address), register.reset, "{}", register.name);
        }
        assert_eq!(chip.read(address::MAIN), 0);
        assert_eq!(chip.read(address::CHIP_ID), CHIP_ID_BGT60TR13C);
    }

    #[test]
    fn an_answer_is_the_status_and_what_the_register_held_before() {
        let mut chip = chip(Pace::AsFastAsRead);
        chip.reset();
        let write = SpiWord::write(address::SFCTL, 0x10_2BFF);
        assert_eq!(chip.transfer(write), Ok(0xF071_0000));
        assert_eq!(chip.transfer(write), Ok(0xF010_2BFF));
    }

    #[test]
    fn frames_end_by_themselves_when_their_count_is_set() {
        let mut chip = chip(Pace::AsFastAsRead);
        for register in list(256) {
            let counted = register.address == address::CCR2;
            let value = if counted { field::CCR2::MAX_FRAME_CNT.put(register.value, 2) } else { register.value };
            chip.write(register.address, value).expect("starts");
        }
        let mut codes = Vec::new();
        for _ in 0..2 {
            assert!(matches!(poll(&mut chip, 256), Slice::Ready { .. }));
            chip.read_fifo(256, &mut codes);
        }
        assert_eq!(codes, (0..512).collect::<Vec<u16>>());
        assert!(matches!(chip.poll(256), Slice::Wait));
    }

    #[test]
    fn the_frame_counter_and_the_fifo_fill_as_frames_are_sampled() {
        let mut chip = started(Pace::RealTime(1.0), 128);
        assert_eq!(field::FSTAT::EMPTY.of(chip.read(address::FSTAT)), 1);
        assert!(matches!(poll(&mut chip, 128), Slice::Ready { .. }));
        assert!(chip.interrupt());
        let status = chip.read(address::FSTAT);
        assert_eq!((field::FSTAT::CREF.of(status), field::FSTAT::EMPTY.of(status)), (1, 0));
        assert!(field::FSTAT::FILL_STATUS.of(status) >= 64);
        let mut codes = Vec::new();
        while codes.len() < 3 * 256 {
            assert!(matches!(poll(&mut chip, 128), Slice::Ready { .. }));
            chip.read_fifo(128, &mut codes);
        }
        assert_eq!(codes, (0..3 * 256).collect::<Vec<u16>>());
        assert!(field::STAT1::FRAME_CNT.of(chip.read(address::STAT1)) >= 3);
        chip.write(address::MAIN, RESET).expect("resets");
        assert_eq!(chip.read(address::STAT1), 0);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn an_overflow_stays_until_the_fifo_is_reset() {
            let mut chip = started(Pace::AsFastAsRead, 128);
            chip.overflow();
            let status = chip.transfer(SpiWord::read(address::FSTAT)).expect("answers");
            assert_eq!((status >> 24, field::FSTAT::FOF_ERR.of(status & 0xFF_FFFF)), (0xF8, 1));
            chip.write(address::MAIN, main_bits::FSM_RESET).expect("resets");
            assert!(chip.fifo_failed());
            chip.write(address::MAIN, main_bits::FIFO_RESET).expect("resets");
            assert!(!chip.fifo_failed());
            assert_eq!(chip.transfer(SpiWord::read(address::CHIP_ID)), Ok(0xF000_0303));
        }

        /// 16384 codes and not one more: a host that does not read loses the frames after them.
        #[test]
        fn a_fifo_that_nobody_reads_overflows() {
            let request = WaveformRequest { chirps_per_frame: 64, ..waveform().request };
            let waveform = Waveform::realise(request).expect("valid");
            let mut chip = started_with(waveform, Pace::RealTime(10.0), 128);
            for _ in 0..5000 {
                chip.world().advance();
                chip.look_for_overflow();
                if chip.fifo_failed() {
                    break;
                }
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            assert!(chip.fifo_failed());
            let status = chip.read(address::FSTAT);
            assert_eq!((field::FSTAT::FULL.of(status), field::FSTAT::FILL_STATUS.of(status)), (1, 8192));
        }

        #[test]
        fn a_read_past_the_end_gives_ones_and_is_told() {
            let mut chip = started(Pace::RealTime(1.0), 64);
            assert!(matches!(poll(&mut chip, 16_384), Slice::Ready { .. }));
            let mut codes = Vec::new();
            chip.read_fifo(16_384, &mut codes);
            assert_eq!(codes.len(), 16_384);
            assert_eq!(codes.last(), Some(&0xFFF));
            assert_eq!(field::FSTAT::FUF_ERR.of(chip.read(address::FSTAT)), 1);
        }

        #[test]
        fn another_waveform_is_refused_with_both_named() {
            let mut chip = chip(Pace::AsFastAsRead);
            let request = WaveformRequest { chirps_per_frame: 8, ..waveform().request };
            let other = Waveform::realise(request).expect("valid");
            let list = ChipConfiguration { waveform: other, slice_samples: 128 }.compile().expect("fits");
            let refused = list.iter().find_map(|r| chip.write(r.address, r.value).err()).expect("refused");
            assert!(refused.contains("4 chirps") && refused.contains("8 chirps"), "{refused}");
        }
    }
}
