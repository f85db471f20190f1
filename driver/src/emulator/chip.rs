//! Emulated radar chip as its board sees it: registers, resets, frames and the FIFO.
//!
//! Behaviour according to the vendor's library and the datasheet:
//! - a hardware or software reset puts every register back and ends the frames; MAIN's reset bits clear themselves;
//! - `FSM_RESET` ends the frames, `FIFO_RESET` empties the FIFO; so does the start of frames;
//! - the interrupt line is high while the FIFO holds more than `FIFO_CREF` words of two codes;
//! - an overflow is sticky: FSTAT and every answer's GSR0 show it until the FIFO is reset;
//! - a read past the FIFO's end gives all ones and sets the underflow flag, as sticky;
//! - `MAX_FRAME_CNT` frames end by themselves, 0 means without end;
//! - a start in continuous-wave mode (`CW_MODE`) starts no frames: the first one takes the chip from deep sleep to idle
//!   mode, the next one to active mode. The band gap is up and the ADCs are ready then, as far as `CSCI` switches them
//!   on;
//! - the slow ADC converts when `START_SADC` is written, and by itself while frames run. Channel 0 is the temperature;
//!   others read 0.
//!
//! The FIFO has its real depth of 8192 words. Not modelled: the prefix of chirps (`PREFIX_EN`), samples in
//! continuous-wave mode, the time that the band gap and the slow ADC take.

use std::sync::Arc;

use radome_dsp::{FIFO_SAMPLES, Waveform};

use super::sample_source::{SampleSource, Slice};
use super::thermometer::Thermometer;
use super::{EmulatorOptions, Fault, Feed, Shared};
use crate::chip::{CHIP_ID_BGT60TR13C, ChipConfiguration, Field, RegisterFile, SpiWord, address, field, main_bits};

/// Upper half of GSR0, which is constant.
const GSR0_IDLE: u32 = 0xF0;
/// Overflow or underflow of the FIFO in GSR0.
const GSR0_FIFO_ERROR: u32 = 1 << 3;

/// Power modes of the state machine, as STAT0 encodes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Power {
    Active = 1,
    Idle = 3,
    DeepSleep = 5,
}

/// Emulated chip and its sample source.
pub(super) struct Chip {
    registers: RegisterFile,
    chip_id: u32,
    pub source: SampleSource,
    /// Waveform of the running frames; `None` while none run.
    pub running: Option<Waveform>,
    power: Power,
    thermometer: Thermometer,
    /// Number of conversions of the slow ADC, and the result of the last one.
    conversions: u64,
    converted: u32,
    overflowed: bool,
    underflowed: bool,
    /// Number of starts of frames: the firmware discards its buffer when it changes.
    pub starts: u64,
}

impl Chip {
    /// Creates a chip that was programmed with the source's waveform and does not measure.
    pub fn new(feed: Feed, options: &EmulatorOptions, shared: &Arc<Shared>) -> std::io::Result<Self> {
        let chip_id = options.faults.iter().find_map(|fault| match fault {
            Fault::ForeignChip(id) => Some(*id),
            _ => None,
        });
        let waveform = feed.source.waveform().clone();
        let mut chip = Chip {
            registers: RegisterFile::default(),
            chip_id: chip_id.unwrap_or(CHIP_ID_BGT60TR13C),
            source: SampleSource::new(feed, options.pace, options.repeat, shared.clone())?,
            running: None,
            power: Power::DeepSleep,
            thermometer: Thermometer::new(options.seed),
            conversions: 0,
            converted: 0,
            overflowed: false,
            underflowed: false,
            starts: 0,
        };
        chip.reset();
        chip.program_registers(waveform);
        Ok(chip)
    }

    /// Programs the registers as an earlier client would have, so that a client can read the waveform.
    fn program_registers(&mut self, waveform: Waveform) {
        let configuration = ChipConfiguration { waveform, slice_samples: FIFO_SAMPLES / 2 };
        for register in configuration.compile().unwrap_or_default() {
            let is_main = register.address == address::MAIN;
            let value = if is_main { register.value & !main_bits::ALL } else { register.value };
            self.registers.set(register.address, value);
        }
    }

    /// Resets the chip: by its pin, by software or by a loss of power.
    pub fn reset(&mut self) {
        self.registers = RegisterFile::default();
        self.registers.set(address::CHIP_ID, self.chip_id);
        if self.running.is_some() {
            self.source.stop();
        }
        self.sleep();
        self.converted = 0;
        self.reset_fifo();
    }

    /// Ends frames and empties the FIFO, since no client reads it. The registers stay as they are.
    pub fn halt(&mut self) {
        self.sleep();
        self.reset_fifo();
    }

    /// Ends frames and goes to deep sleep.
    fn sleep(&mut self) {
        // The register keeps the last conversion.
        self.converted = self.slow_adc();
        self.running = None;
        self.power = Power::DeepSleep;
    }

    /// Clears the error flags of the FIFO.
    fn reset_fifo(&mut self) {
        (self.overflowed, self.underflowed) = (false, false);
    }

    /// Returns whether GSR0 reports an error of the FIFO.
    pub fn fifo_failed(&self) -> bool {
        self.overflowed || self.underflowed
    }

    /// Executes an SPI word; the answer is GSR0 and the former content of the register.
    pub fn transfer(&mut self, word: SpiWord) -> u32 {
        let gsr0 = GSR0_IDLE | if self.fifo_failed() { GSR0_FIFO_ERROR } else { 0 };
        let answer = gsr0 << 24 | self.read(word.address);
        if word.write {
            self.write(word.address, word.value);
        }
        answer
    }

    /// Returns the content of a register; the status registers show the current state.
    pub fn read(&self, address: u8) -> u32 {
        match address {
            address::FSTAT => self.fifo_status(),
            address::STAT0 => self.power_status(),
            address::STAT1 => self.frame_status(),
            address::SADC_RESULT => field::SADC_RESULT::SADC_RESULT.put(0, self.slow_adc()),
            _ => self.registers.get(address),
        }
    }

    /// Codes in the FIFO.
    fn fifo_codes(&self) -> u64 {
        if self.running.is_some() { self.source.in_fifo().min(FIFO_SAMPLES as u64) } else { 0 }
    }

    /// FIFO level of the interrupt, codes.
    fn interrupt_level(&self) -> u64 {
        2 * u64::from(self.registers.field(field::SFCTL::FIFO_CREF))
    }

    /// Returns whether the interrupt line is high.
    pub fn interrupt(&self) -> bool {
        self.fifo_codes() / 2 * 2 > self.interrupt_level()
    }

    /// Content of FSTAT.
    fn fifo_status(&self) -> u32 {
        let codes = self.fifo_codes();
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

    /// Returns whether the band gap is up, which the ADCs need.
    fn has_band_gap(&self) -> bool {
        self.power != Power::DeepSleep && self.registers.field(field::CSCI::BG_EN) == 1
    }

    /// Returns whether the ADC is ready that the field `isolated` of `CSCI` switches off between chirps.
    fn is_ready(&self, isolated: Field) -> bool {
        self.has_band_gap() && (self.running.is_some() || self.registers.field(isolated) == 0)
    }

    /// Power mode and ready bits of the status register.
    fn power_status(&self) -> u32 {
        let flags = [
            (field::STAT0::MADC_BGUP, self.has_band_gap()),
            (field::STAT0::MADC_RDY, self.is_ready(field::CSCI::MADC_ISOPD)),
            (field::STAT0::SADC_RDY, self.is_ready(field::CSCI::SADC_ISOPD)),
            (field::STAT0::LDO_RDY, true),
        ];
        let status = field::STAT0::PM.put(0, self.power as u32);
        flags.iter().fold(status, |status, (flag, is_set)| flag.put(status, u32::from(*is_set)))
    }

    /// Last result of the slow ADC: the temperature in each chirp, while frames run with the sensor switched on.
    fn slow_adc(&self) -> u32 {
        match &self.running {
            Some(waveform) if self.registers.field(field::CS1_U_1::TEMP_MEAS_EN) == 1 => {
                self.thermometer.code(self.chirps(waveform))
            }
            _ => self.converted,
        }
    }

    /// Starts a conversion of the slow ADC.
    fn convert(&mut self) {
        if self.is_ready(field::CSCI::SADC_ISOPD) {
            self.conversions += 1;
            let is_temperature = self.registers.field(field::SADC_CTRL::SADC_CHSEL) == 0;
            self.converted = if is_temperature { self.thermometer.code(self.conversions) } else { 0 };
        }
    }

    /// Chirps sampled since the frames were started.
    fn chirps(&self, waveform: &Waveform) -> u64 {
        let shape = waveform.shape();
        self.source.sampled() / (shape.rx * shape.samples).max(1) as u64
    }

    /// Frames and chirps since the start.
    fn frame_status(&self) -> u32 {
        let Some(waveform) = &self.running else { return 0 };
        let chirps = self.chirps(waveform);
        let per_frame = waveform.shape().chirps.max(1) as u64;
        let count = |field: Field, value: u64, content| field.put(content, (value & u64::from(field.max())) as u32);
        count(field::STAT1::FRAME_CNT, chirps / per_frame, count(field::STAT1::SHAPE_GRP_CNT, chirps % per_frame, 0))
    }

    /// Number of frames begun since the start, modulo 4096: the frame counter has twelve bits.
    pub fn frames_begun(&self) -> u32 {
        let status = self.frame_status();
        let is_within = field::STAT1::SHAPE_GRP_CNT.of(status) > 0;
        field::STAT1::FRAME_CNT.of(status) + u32::from(is_within)
    }

    /// Writes a register.
    pub fn write(&mut self, address: u8, value: u32) {
        match address {
            address::CHIP_ID | address::FSTAT | address::STAT0 | address::STAT1 | address::SADC_RESULT => {}
            address::SADC_CTRL => {
                let start = field::SADC_CTRL::START_SADC;
                self.registers.set(address::SADC_CTRL, start.put(value, 0));
                if start.of(value) == 1 {
                    self.convert();
                }
            }
            address::MAIN => {
                if value & main_bits::SW_RESET != 0 {
                    self.reset();
                }
                self.registers.set(address::MAIN, value & !main_bits::ALL);
                if value & main_bits::FSM_RESET != 0 {
                    self.sleep();
                }
                if value & main_bits::FIFO_RESET != 0 {
                    self.sleep();
                    self.reset_fifo();
                }
                if value & main_bits::FRAME_START != 0 {
                    match field::MAIN::CW_MODE.of(value) {
                        0 => self.start_frames(),
                        _ => self.start_continuous_wave(),
                    }
                }
            }
            _ => self.registers.set(address, value),
        }
    }

    /// Executes a start in continuous-wave mode: the state machine takes one step towards active mode and stays there.
    fn start_continuous_wave(&mut self) {
        let next = if self.power == Power::DeepSleep { Power::Idle } else { Power::Active };
        self.sleep();
        self.power = next;
    }

    /// Starts frames. The chip answers normally even if the source does not have frames of the waveform. A client that
    /// gets an error abandons the board, while one that gets no frames may program another waveform.
    fn start_frames(&mut self) {
        self.sleep();
        let waveform = match ChipConfiguration::decode(&self.registers) {
            Ok(configuration) => configuration.waveform,
            Err(error) => return self.source.refuse(&error.to_string()),
        };
        self.source.restart(&waveform);
        self.power = Power::Active;
        self.running = Some(waveform);
        self.starts += 1;
    }

    /// Returns the state of the next burst read of this many codes, which the interrupt line announces.
    pub fn poll(&mut self, codes: u64) -> Slice {
        let Some(waveform) = &self.running else { return Slice::Wait };
        let frames = self.registers.field(field::CCR2::MAX_FRAME_CNT);
        let last = u64::from(frames) * waveform.shape().codes() as u64;
        if frames > 0 && self.source.codes_out + codes > last {
            return Slice::Wait;
        }
        // The interrupt line rises at its own level; firmware that reads more than that reads past the end.
        self.source.slice(codes.min(self.interrupt_level() + 2))
    }

    /// Reads a burst from the FIFO and appends it to `out`.
    pub fn read_fifo(&mut self, codes: usize, out: &mut Vec<u16>) {
        let available = codes.min(self.source.in_fifo() as usize).min(self.source.available());
        out.extend_from_slice(self.source.codes(available));
        self.source.take(available);
        let missing = codes - available;
        if missing > 0 {
            out.extend(std::iter::repeat_n(0xFFF, missing));
            self.underflowed = true;
        }
    }

    /// Sets the sticky overflow flag if more has been sampled than the FIFO holds.
    pub fn check_overflow(&mut self) {
        self.overflowed |= self.running.is_some() && self.source.overflows();
    }

    /// Makes the FIFO overflow.
    pub fn overflow(&mut self) {
        self.overflowed = true;
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::{SourceEvent, source_from_fn};

    use super::*;
    use crate::chip::RegisterList;
    use crate::emulator::Pace;
    use crate::pattern;

    /// Frames whose codes count up from 0.
    fn ramp(waveform: Waveform) -> Feed {
        let (interval_s, mut next) = (waveform.frame_interval_s(), 0);
        let source = source_from_fn(waveform, move |frame| {
            let first = next * frame.codes.len() as u64;
            frame.codes.iter_mut().zip(first..).for_each(|(code, value)| *code = (value & 0xFFF) as u16);
            frame.time_ns = (next as f64 * interval_s * 1e9) as u64;
            next += 1;
            Ok(SourceEvent::Frame)
        });
        Feed::from(Box::new(source))
    }

    /// One receiver, 4 chirps of 64 samples.
    fn waveform() -> Waveform {
        pattern::waveform(&[1], 4, 64, 0.1)
    }

    fn chip_of(waveform: Waveform, pace: Pace) -> Chip {
        let options = EmulatorOptions { pace, ..EmulatorOptions::default() };
        Chip::new(ramp(waveform), &options, &Arc::default()).expect("threads")
    }

    fn chip(pace: Pace) -> Chip {
        chip_of(waveform(), pace)
    }

    /// Registers of a waveform, with an interrupt at this many codes.
    fn list(waveform: Waveform, slice_samples: usize) -> RegisterList {
        ChipConfiguration { waveform, slice_samples }.compile().expect("fits")
    }

    fn program(chip: &mut Chip, list: &RegisterList) {
        list.iter().for_each(|r| chip.write(r.address, r.value));
    }

    fn started(pace: Pace, slice_samples: usize) -> Chip {
        started_with(waveform(), pace, slice_samples)
    }

    fn started_with(waveform: Waveform, pace: Pace, slice_samples: usize) -> Chip {
        let mut chip = chip_of(waveform.clone(), pace);
        program(&mut chip, &list(waveform, slice_samples));
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
        assert!(chip.running.is_some());
        assert_eq!(chip.read(address::MAIN) & main_bits::ALL, 0);
        chip.write(address::MAIN, main_bits::SW_RESET);
        assert!(chip.running.is_none());
        for register in
            crate::chip::REGISTERS.iter().filter(|r| r.address != address::MAIN && r.address != address::CHIP_ID)
        {
            assert_eq!(chip.read(register.address), register.reset, "{}", register.name);
        }
        assert_eq!(chip.read(address::MAIN), 0);
        assert_eq!(chip.read(address::CHIP_ID), CHIP_ID_BGT60TR13C);
    }

    #[test]
    fn an_answer_is_the_status_and_the_earlier_content_of_the_register() {
        let mut chip = chip(Pace::AsFastAsRead);
        chip.reset();
        let write = SpiWord::write(address::SFCTL, 0x10_2BFF);
        assert_eq!(chip.transfer(write), 0xF071_0000);
        assert_eq!(chip.transfer(write), 0xF010_2BFF);
    }

    #[test]
    fn frames_end_by_themselves_when_their_count_is_set() {
        let mut chip = chip(Pace::AsFastAsRead);
        for register in list(waveform(), 256) {
            let counted = register.address == address::CCR2;
            let value = if counted { field::CCR2::MAX_FRAME_CNT.put(register.value, 2) } else { register.value };
            chip.write(register.address, value);
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
        chip.write(address::MAIN, RESET);
        assert_eq!(chip.read(address::STAT1), 0);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn an_overflow_stays_until_the_fifo_is_reset() {
            let mut chip = started(Pace::AsFastAsRead, 128);
            chip.overflow();
            let status = chip.transfer(SpiWord::read(address::FSTAT));
            assert_eq!((status >> 24, field::FSTAT::FOF_ERR.of(status & 0xFF_FFFF)), (0xF8, 1));
            chip.write(address::MAIN, main_bits::FSM_RESET);
            assert!(chip.fifo_failed());
            chip.write(address::MAIN, main_bits::FIFO_RESET);
            assert!(!chip.fifo_failed());
            assert_eq!(chip.transfer(SpiWord::read(address::CHIP_ID)), 0xF000_0303);
        }

        /// The FIFO holds exactly 16384 codes: a host that does not read loses the frames after them.
        #[test]
        fn a_fifo_that_is_not_read_overflows() {
            let mut chip = started_with(pattern::waveform(&[1], 64, 64, 0.1), Pace::RealTime(10.0), 128);
            for _ in 0..5000 {
                chip.source.advance();
                chip.check_overflow();
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
        fn a_read_past_the_end_gives_ones_and_sets_the_underflow_flag() {
            let mut chip = started(Pace::RealTime(1.0), 64);
            assert!(matches!(poll(&mut chip, 16_384), Slice::Ready { .. }));
            let mut codes = Vec::new();
            chip.read_fifo(16_384, &mut codes);
            assert_eq!(codes.len(), 16_384);
            assert_eq!(codes.last(), Some(&0xFFF));
            assert_eq!(field::FSTAT::FUF_ERR.of(chip.read(address::FSTAT)), 1);
        }

        /// The client gets no error: only the emulator can lack frames, a real chip cannot.
        #[test]
        fn another_waveform_is_not_measured_and_the_refusal_names_both() {
            let shared = Arc::new(Shared::default());
            let options = EmulatorOptions { pace: Pace::AsFastAsRead, ..EmulatorOptions::default() };
            let mut chip = Chip::new(ramp(waveform()), &options, &shared).expect("threads");
            program(&mut chip, &list(pattern::waveform(&[1], 8, 64, 0.1), 128));
            assert!(chip.running.is_some() && matches!(chip.poll(128), Slice::Wait));
            let refusal = shared.refusal().expect("says why");
            assert!(refusal.contains("4 chirps") && refusal.contains("8 chirps"), "{refusal}");
            // The source's own waveform is still measured afterwards.
            chip.write(address::MAIN, main_bits::SW_RESET);
            program(&mut chip, &list(waveform(), 128));
            assert!(matches!(poll(&mut chip, 128), Slice::Ready { .. }));
            assert_eq!(shared.refusal(), None);
        }

        #[test]
        fn registers_that_hold_no_waveform_start_nothing() {
            let mut chip = chip(Pace::AsFastAsRead);
            chip.reset();
            chip.write(address::MAIN, main_bits::FRAME_START);
            assert!(chip.running.is_none());
        }
    }

    mod temperature {
        use super::*;

        fn celsius(chip: &Chip) -> f64 {
            let code = field::SADC_RESULT::SADC_RESULT.of(chip.read(address::SADC_RESULT));
            (f64::from(code) * 1.21 / 1023.0 - 0.789_84) / 0.002_86
        }

        fn is_set(chip: &Chip, flag: Field) -> bool {
            flag.of(chip.read(address::STAT0)) == 1
        }

        /// The vendor's library wakes the chip in continuous-wave mode, waits for the band gap, switches the ADC on,
        /// waits for that, converts, and resets the chip.
        #[test]
        fn a_sleeping_chip_measures_after_it_is_woken() {
            let mut chip = chip(Pace::AsFastAsRead);
            chip.reset();
            assert_eq!(chip.read(address::STAT0), 0xA8, "deep sleep, as after a reset");
            chip.write(address::CSCI, 0x0B60 | 0x0080 | 0x0400);
            chip.write(address::MAIN, 0x1E_8270 | 1 << 16 | main_bits::FRAME_START);
            assert!(chip.running.is_none(), "continuous wave is no frames");
            assert!(is_set(&chip, field::STAT0::MADC_BGUP) && !is_set(&chip, field::STAT0::SADC_RDY));
            chip.write(address::SADC_CTRL, 0x01_0F10);
            assert!(celsius(&chip) < 0.0, "an ADC that is off converts nothing");
            chip.write(address::CSCI, 0x0400 | 0x0080 | 0x0800 | 0x0100);
            assert!(is_set(&chip, field::STAT0::SADC_RDY) && !is_set(&chip, field::STAT0::MADC_RDY));
            chip.write(address::SADC_CTRL, 0x01_0F10);
            assert_eq!(field::SADC_RESULT::SADC_BUSY.of(chip.read(address::SADC_RESULT)), 0);
            assert!((30.0..45.0).contains(&celsius(&chip)), "{}", celsius(&chip));
            // A client that waits for active mode repeats the start.
            chip.write(address::MAIN, 0x1E_8270 | 1 << 16 | main_bits::FRAME_START);
            assert_eq!(field::STAT0::PM.of(chip.read(address::STAT0)), 1);
            chip.reset();
            assert_eq!((chip.read(address::STAT0), chip.read(address::SADC_RESULT)), (0xA8, 0));
        }

        #[test]
        fn a_measuring_chip_has_the_temperature_of_the_last_chirp() {
            let mut chip = started(Pace::AsFastAsRead, 128);
            assert!(is_set(&chip, field::STAT0::SADC_RDY));
            let mut codes = Vec::new();
            for _ in 0..20 {
                assert!(matches!(poll(&mut chip, 128), Slice::Ready { .. }));
                chip.read_fifo(128, &mut codes);
                assert!((30.0..45.0).contains(&celsius(&chip)), "{}", celsius(&chip));
            }
            assert_eq!(codes, (0..20 * 128).map(|code| code & 0xFFF).collect::<Vec<u16>>());
            chip.write(address::MAIN, main_bits::FSM_RESET);
            assert!((30.0..45.0).contains(&celsius(&chip)), "the last one stays");
        }
    }
}
