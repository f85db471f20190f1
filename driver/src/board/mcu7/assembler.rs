//! Assembler of frames from data packets. It does no I/O: it turns packets into frames and gaps.
//!
//! Slices carry no mark of where a radar frame begins: alignment is kept by counting from the start. The slice and so
//! the size of every packet is fixed. A packet's counter therefore gives exactly the bytes of the stream that it carries.
//! Lost packets lose only the frames that they belong to, because the start of the next whole frame is known.
//!
//! A counter can be wrong without a byte being lost, or right although the firmware has left slices out. After each
//! jump the slices' time stamps must therefore agree with their positions until a whole frame has been seen; otherwise
//! alignment is lost.

use std::collections::VecDeque;
use std::time::Duration;

use radome_dsp::{Frame, FrameShape, Gap, GapReason, SourceEvent, Waveform};

use crate::chip::SampleTiming;
use crate::protocol::mcu7::{DataError, Packet, SliceLayout};
use crate::protocol::{fifo, packed12};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    /// The packet was used, or ignored as a duplicate.
    Accepted,
    /// The board has stopped by itself.
    Stopped(DataError),
    /// The packet cannot be the one that its counter says it is: alignment is lost.
    Misaligned,
}

enum Ready {
    Frame { sequence: u64, time_ns: u64, codes: Vec<u16> },
    Gap(Gap),
}

/// Most duplicate packets in a row. More packets from the past mean that the counter has been set back.
const MOST_DUPLICATES: u32 = 8;
/// Number of characters of a text that are printed.
const MOST_TEXT: usize = 200;

pub(super) struct Assembler {
    slice: SliceLayout,
    shape: FrameShape,
    timing: SampleTiming,
    frame_interval_us: f64,
    /// Number of the next packet with data since the start: the counter, unwrapped, less the packets with texts.
    next_packet: u64,
    /// Packets with texts since the start, modulo 2^16.
    text_packets: u16,
    /// Stream offset up to which bytes have been received or given up.
    received: u64,
    /// Contiguous bytes of the stream from `buffer_start` on.
    buffer: Vec<u8>,
    buffer_start: u64,
    /// Next frame of this stream to complete.
    next_frame: u64,
    /// Sequence number of this stream's frame 0, modulo 2^64; unknown after a restart until a frame has a time.
    base_sequence: Option<u64>,
    next_sequence: u64,
    /// Frames lost since the last whole one. Reported with the next one, whose sequence number it needs.
    gap: Option<Gap>,
    /// Board time of sequence number 0, microseconds.
    origin_us: Option<f64>,
    last_time_us: f64,
    /// Host time since the last frame, microseconds. Set after a reconnection, when the board's clock may have restarted.
    host_elapsed_us: Option<f64>,
    /// Slices and the board's time at which they were complete, oldest first.
    stamps: VecDeque<(u64, u64)>,
    last_stamp: Option<(u64, u64)>,
    /// After a jump of the counter: slices before this one must come at the times of their positions.
    check_until: u64,
    /// Packets from the past in a row.
    duplicates: u32,
    damaged: bool,
    restart_reason: GapReason,
    ready: VecDeque<Ready>,
    free_buffers: Vec<Vec<u16>>,
    scratch: Vec<u16>,
}

impl Assembler {
    pub fn new(waveform: &Waveform, slice: SliceLayout) -> Self {
        let shape = waveform.shape();
        // Frames that a slice can complete, allocated in advance.
        let frames_per_slice = slice.samples / shape.codes().max(1) + 2;
        let frame_bytes = packed12::packed_length(shape.codes()) + 3;
        Assembler {
            slice,
            shape,
            timing: SampleTiming::new(waveform),
            frame_interval_us: waveform.frame_interval_s() * 1e6,
            next_packet: 0,
            text_packets: 0,
            received: 0,
            buffer: Vec::with_capacity(frame_bytes + 2 * slice.data_bytes()),
            buffer_start: 0,
            next_frame: 0,
            base_sequence: Some(0),
            next_sequence: 0,
            gap: None,
            origin_us: None,
            last_time_us: 0.0,
            host_elapsed_us: None,
            stamps: VecDeque::with_capacity(shape.codes() / slice.samples.max(1) + 4),
            last_stamp: None,
            check_until: 0,
            duplicates: 0,
            damaged: false,
            restart_reason: GapReason::Disconnected,
            ready: VecDeque::with_capacity(frames_per_slice + 2),
            free_buffers: vec![vec![0; shape.codes()]; frames_per_slice],
            scratch: vec![0; shape.codes() + 2],
        }
    }

    /// Notes that bytes were damaged in transmission, which is the reason of the next missing packets.
    pub fn note_damage(&mut self) {
        self.damaged = true;
    }

    /// Restarts the stream from packet 0. The board's clock then gives the number of lost frames.
    pub fn restart(&mut self, reason: GapReason) {
        (self.next_packet, self.received, self.buffer_start, self.next_frame) = (0, 0, 0, 0);
        self.text_packets = 0;
        self.buffer.clear();
        self.stamps.clear();
        (self.last_stamp, self.check_until, self.duplicates) = (None, 0, 0);
        self.damaged = false;
        // The gap of the restart begins where this one would have.
        self.gap = None;
        // The first of several restarts without a frame between them is the reason of the gap.
        if self.base_sequence.take().is_some() {
            self.restart_reason = reason;
        }
    }

    /// Notes that the board may have been without power. The host's clock then gives the number of lost frames, unless
    /// the board's clock has kept running.
    pub fn note_reconnection(&mut self) {
        self.restart(GapReason::Disconnected);
        self.restart_reason = GapReason::Disconnected;
        self.host_elapsed_us = Some(0.0);
    }

    /// Sets the host time since the last frame was handed out.
    pub fn set_host_elapsed(&mut self, since_last_frame: Duration) {
        if let Some(elapsed_us) = &mut self.host_elapsed_us {
            *elapsed_us = since_last_frame.as_secs_f64() * 1e6;
        }
    }

    /// Offset of the pair of codes in which this frame starts, bytes. With an odd number of codes that pair may also
    /// hold a code of the neighbouring frame.
    fn start_byte(&self, frame: u64) -> u64 {
        frame * self.shape.codes() as u64 / 2 * 3
    }

    fn end_byte(&self, frame: u64) -> u64 {
        ((frame + 1) * self.shape.codes() as u64).div_ceil(2) * 3
    }

    /// Slice that holds the last code of a frame.
    fn end_slice(&self, frame: u64) -> u64 {
        ((frame + 1) * self.shape.codes() as u64 - 1) / self.slice.samples.max(1) as u64
    }

    /// Time of a slice's last code by its position, microseconds.
    fn nominal_us(&self, slice: u64) -> f64 {
        self.timing.in_stream_s((slice + 1) * self.slice.samples as u64 - 1) * 1e6
    }

    /// Returns whether the time since the previous slice agrees with the positions of both, to half the time between
    /// slices. The two clocks differ by far less.
    fn is_on_time(&self, slice: u64, time_us: u64) -> bool {
        let Some((before, before_us)) = self.last_stamp else { return true };
        let nominal_us = self.nominal_us(slice) - self.nominal_us(before);
        let to_previous_us = self.nominal_us(slice) - self.nominal_us(slice.saturating_sub(1).max(before));
        let to_next_us = self.nominal_us(slice + 1) - self.nominal_us(slice);
        let measured_us = time_us as f64 - before_us as f64;
        // Over a long gap the error of the frame interval adds up. The clocks of board and chip differ by less than a
        // thousandth.
        let tolerance_us = 0.5 * to_previous_us.min(to_next_us) + 1e-3 * nominal_us;
        let agrees = (measured_us - nominal_us).abs() <= tolerance_us;
        if !agrees {
            tracing::debug!(slice, measured_us, nominal_us, "a slice came at another time than its position says");
        }
        agrees
    }

    /// Takes the next packet.
    pub fn push_packet(&mut self, packet: &Packet<'_>) -> Outcome {
        if let Some(error) = packet.error() {
            return Outcome::Stopped(error);
        }
        let ahead = packet.counter.wrapping_sub(self.text_packets).wrapping_sub(self.next_packet as u16);
        if packet.flags.error {
            if ahead < 0x8000 {
                self.take_text(packet);
            }
            return Outcome::Accepted;
        }
        if ahead >= 0x8000 {
            return self.take_earlier(packet.counter, ahead);
        }
        self.duplicates = 0;
        let number = self.next_packet + u64::from(ahead);
        let packets = self.slice.packets() as u64;
        let (slice, index) = (number / packets, (number % packets) as usize);
        let is_last = index + 1 == self.slice.packets();
        let flags = packet.flags;
        if (flags.first, flags.last, flags.timestamp) != (index == 0, is_last, is_last)
            || packet.payload.len() != self.slice.payload_length(index)
        {
            return Outcome::Misaligned;
        }
        self.next_packet = number + 1;

        let bytes = self.slice.data_bytes();
        let offset = self.slice.offset(index);
        let position = slice * bytes as u64 + offset as u64;
        if position != self.received && !self.jump_to(position) {
            return Outcome::Misaligned;
        }
        self.append(position, packet.payload.get(..bytes - offset).unwrap_or(packet.payload));
        if is_last {
            if let (_, Some(time_us)) = packet.split_timestamp() {
                if slice < self.check_until && !self.is_on_time(slice, time_us) {
                    return Outcome::Misaligned;
                }
                self.last_stamp = Some((slice, time_us));
                self.stamps.push_back((slice, time_us));
            }
            self.complete_frames();
        }
        Outcome::Accepted
    }

    /// Takes a packet with an earlier counter than the next one's: a duplicate, unless the counter has been set back.
    fn take_earlier(&mut self, counter: u16, ahead: u16) -> Outcome {
        // The counter has been set back if the packet would be earlier than the first one.
        if u64::from(ahead.wrapping_neg()) > self.next_packet {
            return Outcome::Misaligned;
        }
        tracing::debug!(counter, "a packet came twice");
        self.duplicates += 1;
        // The packet may also be a new one, sent after the counter was set back.
        self.check_until = self.end_slice(self.next_frame) + 1;
        if self.duplicates > MOST_DUPLICATES { Outcome::Misaligned } else { Outcome::Accepted }
    }

    /// Continues the stream at this byte after a jump of the counter; returns `false` if it is unknown where frames begin.
    fn jump_to(&mut self, position: u64) -> bool {
        // Without an earlier time stamp, only the count of slices from the start tells where frames begin.
        if self.last_stamp.is_none() && !self.slice.samples.is_multiple_of(self.shape.codes().max(1)) {
            return false;
        }
        self.skip_to(position);
        // The slice that ends the next whole frame is the last to be checked.
        self.check_until = self.end_slice(self.next_frame) + 1;
        true
    }

    /// Appends data of the stream that begin at this byte. After a loss everything up to the next whole frame is discarded.
    fn append(&mut self, position: u64, data: &[u8]) {
        self.damaged = false;
        let skip = self.buffer_start.saturating_sub(position).min(data.len() as u64) as usize;
        self.buffer.extend_from_slice(data.get(skip..).unwrap_or(&[]));
        self.received = position + data.len() as u64;
    }

    /// Takes a packet with a text, which counts among the packets but carries no byte of the stream. On a transport
    /// without CRC it may have been a packet with data: the slices' times must agree until a whole frame has been seen.
    fn take_text(&mut self, packet: &Packet<'_>) {
        let text: String = String::from_utf8_lossy(packet.payload).chars().take(MOST_TEXT).collect();
        let text = text.trim_end_matches(['\0', '\n', '\r']);
        if text.contains(|c: char| c == char::REPLACEMENT_CHARACTER || (c.is_control() && !c.is_whitespace())) {
            tracing::warn!(
                bytes = packet.payload.len(),
                "the board sent a packet that is marked as text and holds none"
            );
        } else {
            tracing::warn!(text, "the board sent a text among its data");
        }
        self.text_packets = self.text_packets.wrapping_add(1);
        self.check_until = self.end_slice(self.next_frame) + 1;
    }

    /// Continues the stream at this byte; frames that reach into the skipped bytes are lost.
    fn skip_to(&mut self, position: u64) {
        self.complete_frames();
        let codes = self.shape.codes() as u64;
        let mut next = position / 3 * 2 / codes;
        while self.start_byte(next) < position {
            next += 1;
        }
        if let Some(base) = self.base_sequence
            && next > self.next_frame
        {
            let reason = if self.damaged { GapReason::Crc } else { GapReason::PacketLost };
            let first_sequence = base.wrapping_add(self.next_frame);
            let gap = self.gap.get_or_insert(Gap { first_sequence, frames: 0, reason });
            gap.frames = base.wrapping_add(next).wrapping_sub(gap.first_sequence);
        }
        self.next_frame = next.max(self.next_frame);
        self.buffer.clear();
        self.buffer_start = self.start_byte(self.next_frame);
    }

    /// Moves the whole frames of the buffer to the queue.
    fn complete_frames(&mut self) {
        let mut used_bytes = 0;
        while self.end_byte(self.next_frame) <= self.buffer_start + self.buffer.len() as u64 {
            let frame = self.next_frame;
            // Without a time the sequence number is unknown, and the frame is lost.
            let Some(start_us) = self.start_us(frame) else { break };
            let start = (self.start_byte(frame) - self.buffer_start) as usize;
            let end = (self.end_byte(frame) - self.buffer_start) as usize;
            packed12::unpack(self.buffer.get(start..end).unwrap_or(&[]), &mut self.scratch);
            // The first pair of codes may begin with the last code of the previous frame.
            let skipped_codes = (frame * self.shape.codes() as u64 % 2) as usize;
            let mut codes = self.free_buffers.pop().unwrap_or_default();
            codes.resize(self.shape.codes(), 0);
            fifo::deinterleave(self.scratch.get(skipped_codes..).unwrap_or(&[]), self.shape, &mut codes);

            let sequence = self.sequence(frame, start_us);
            if let Some(gap) = self.gap.take() {
                self.ready.push_back(Ready::Gap(gap));
            }
            let origin_us = *self.origin_us.get_or_insert(start_us - sequence as f64 * self.frame_interval_us);
            let time_ns = ((start_us - origin_us).max(0.0) * 1e3).round() as u64;
            self.ready.push_back(Ready::Frame { sequence, time_ns, codes });
            self.last_time_us = start_us;
            self.next_sequence = sequence + 1;
            self.next_frame += 1;
            used_bytes = (self.start_byte(self.next_frame) - self.buffer_start) as usize;
        }
        let used_bytes = used_bytes.min(self.buffer.len());
        self.buffer.drain(..used_bytes);
        self.buffer_start += used_bytes as u64;
        let current_slice = self.next_frame * self.shape.codes() as u64 / self.slice.samples as u64;
        while self.stamps.front().is_some_and(|(slice, _)| *slice < current_slice) {
            self.stamps.pop_front();
        }
    }

    /// Board time of a frame's start, from the stamp of the slice that it begins in, or of the next one received. A
    /// stamp is taken when the slice's last code has been sampled. If the packet with the stamp is lost, the times of
    /// whole frames follow from the frame interval and an earlier frame, if there is one.
    fn start_us(&self, frame: u64) -> Option<f64> {
        let first_slice = frame * self.shape.codes() as u64 / self.slice.samples as u64;
        if let Some((slice, stamp_us)) = self.stamps.iter().find(|(slice, _)| *slice >= first_slice) {
            let since_start_us = self.nominal_us(*slice) - frame as f64 * self.frame_interval_us;
            return Some(*stamp_us as f64 - since_start_us);
        }
        let since_last = (self.base_sequence?.wrapping_add(frame) + 1).saturating_sub(self.next_sequence);
        self.origin_us.map(|_| self.last_time_us + since_last as f64 * self.frame_interval_us)
    }

    /// Sequence number of a frame of this stream. After a restart the board's clock gives it, and the gap is noted.
    fn sequence(&mut self, frame: u64, start_us: f64) -> u64 {
        if let Some(base) = self.base_sequence {
            return base.wrapping_add(frame);
        }
        let intervals = |elapsed_us: f64| (elapsed_us / self.frame_interval_us).round().max(0.0) as u64;
        // If the board's clock agrees with the host's to one frame, it has kept running; otherwise the board was
        // without power. The board was also without power if this frame would not be later than the last one.
        let by_board_us = start_us - self.last_time_us;
        let has_kept_running = |host_us: f64| {
            by_board_us > 0.5 * self.frame_interval_us && (by_board_us - host_us).abs() < self.frame_interval_us
        };
        let by_clock = match self.host_elapsed_us.take().filter(|elapsed_us| !has_kept_running(*elapsed_us)) {
            Some(elapsed_us) => {
                self.origin_us = None;
                Some(self.next_sequence.saturating_sub(1) + intervals(elapsed_us))
            }
            // Intervals are counted from the last frame. Counted from the first one, the difference between the clocks of
            // board and chip would add up.
            None => self.origin_us.map(|_| self.next_sequence.saturating_sub(1) + intervals(by_board_us)),
        };
        // At least the frame that was cut short is lost.
        let sequence = by_clock.map_or(self.next_sequence, |s| s.max(self.next_sequence + 1));
        let gap = Gap {
            first_sequence: self.next_sequence,
            frames: sequence - self.next_sequence,
            reason: self.restart_reason,
        };
        self.ready.push_back(Ready::Gap(gap));
        // The difference wraps if the counter has jumped by more frames than were ever sent.
        self.base_sequence = Some(sequence.wrapping_sub(frame));
        sequence
    }

    /// Returns whether [`Self::pop`] has an event.
    pub fn is_ready(&self) -> bool {
        !self.ready.is_empty()
    }

    /// Pops the next frame or gap into `frame`, whose memory is reused.
    pub fn pop(&mut self, frame: &mut Frame) -> Option<SourceEvent> {
        match self.ready.pop_front()? {
            Ready::Gap(gap) => Some(SourceEvent::Gap(gap)),
            Ready::Frame { sequence, time_ns, mut codes } => {
                std::mem::swap(&mut frame.codes, &mut codes);
                self.free_buffers.push(codes);
                (frame.sequence, frame.time_ns, frame.shape) = (sequence, time_ns, self.shape);
                (frame.truth, frame.temperature_millicelsius) = (None, None);
                Some(SourceEvent::Frame)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pattern::waveform;
    use crate::protocol::mcu7::PacketFlags;

    const FRAME_US: u64 = 37_000;

    /// Assembler of frames of one receiver.
    fn assembler(chirps: usize, samples: usize) -> Assembler {
        let waveform = waveform(&[1], chirps, samples, FRAME_US as f64 * 1e-6);
        Assembler::new(&waveform, SliceLayout::for_frame(waveform.shape().codes()))
    }

    /// Assembler of frames with an odd number of codes. A slice holds two frames in two packets; the first packet holds
    /// the whole first frame.
    fn two_frames_a_slice() -> Assembler {
        let assembler = assembler(45, 45);
        assert_eq!((assembler.slice.samples, assembler.slice.packets()), (2 * 45 * 45, 2));
        assembler
    }

    /// Feeds the packets `indices` of a slice that is complete at `time_us` by the board's clock. Returns the gaps, and
    /// the frames as sequence number and time.
    fn packets(assembler: &mut Assembler, slice: u64, indices: &[usize], time_us: u64) -> Vec<Result<(u64, u64), Gap>> {
        let first_counter = slice as usize * assembler.slice.packets();
        packets_from(assembler, first_counter, indices, time_us)
    }

    /// The same, where the first packet of the slice has this counter.
    fn packets_from(
        assembler: &mut Assembler,
        first_counter: usize,
        indices: &[usize],
        time_us: u64,
    ) -> Vec<Result<(u64, u64), Gap>> {
        let layout = assembler.slice;
        let bytes = [vec![0; layout.data_bytes()], time_us.to_le_bytes().to_vec()].concat();
        let mut rest = bytes.as_slice();
        for index in 0..layout.packets() {
            let (payload, after) = rest.split_at(layout.payload_length(index));
            rest = after;
            let is_last = index + 1 == layout.packets();
            let flags = PacketFlags { first: index == 0, last: is_last, timestamp: is_last, error: false };
            let counter = (first_counter + index) as u16;
            if indices.contains(&index) {
                assert_eq!(assembler.push_packet(&Packet { flags, channel: 0, counter, payload }), Outcome::Accepted);
            }
        }
        let mut frame = Frame::zeroed(assembler.shape);
        let mut found = Vec::new();
        while let Some(event) = assembler.pop(&mut frame) {
            match event {
                SourceEvent::Frame => found.push(Ok((frame.sequence, frame.time_ns))),
                SourceEvent::Gap(gap) => found.push(Err(gap)),
                SourceEvent::End => panic!("no end"),
            }
        }
        found
    }

    mod hard_cases {
        use super::*;

        const FRAME_NS: u64 = FRAME_US * 1000;
        /// Board time one hour after power-up, microseconds.
        const HOUR_US: u64 = 3_600_000_000;

        fn lost(first_sequence: u64, frames: u64, reason: GapReason) -> Result<(u64, u64), Gap> {
            Err(Gap { first_sequence, frames, reason })
        }

        /// Expected frame, with its time since the first frame.
        fn frame(sequence: u64) -> Result<(u64, u64), Gap> {
            Ok((sequence, sequence * FRAME_NS))
        }

        /// Regression test: a whole frame whose slice had lost its stamp set the board's clock. The times of all later
        /// frames were an hour off, and so was the number of frames counted at the next overflow.
        #[test]
        fn a_first_frame_without_time_does_not_set_the_clock() {
            let mut assembler = two_frames_a_slice();
            assert_eq!(packets(&mut assembler, 0, &[0], HOUR_US), []);
            let found = packets(&mut assembler, 1, &[0, 1], HOUR_US + 2 * FRAME_US);
            assert_eq!(found, [lost(0, 2, GapReason::PacketLost), frame(2), frame(3)]);
            assembler.restart(GapReason::FifoOverflow);
            let found = packets(&mut assembler, 0, &[0, 1], HOUR_US + 10 * FRAME_US);
            assert_eq!(found, [lost(4, 6, GapReason::FifoOverflow), frame(10), frame(11)]);
        }

        /// Regression test: after an overflow, a frame without a time counted as the very next one.
        #[test]
        fn a_frame_without_time_after_a_restart_does_not_set_the_gap() {
            let mut assembler = two_frames_a_slice();
            packets(&mut assembler, 0, &[0, 1], HOUR_US);
            assembler.restart(GapReason::FifoOverflow);
            assert_eq!(packets(&mut assembler, 0, &[0], HOUR_US + 10 * FRAME_US), []);
            // Frames 10 and 11 are lost with the packet.
            let found = packets(&mut assembler, 1, &[0, 1], HOUR_US + 12 * FRAME_US);
            assert_eq!(found, [lost(2, 10, GapReason::FifoOverflow), frame(12), frame(13)]);
        }

        /// A frame without a time behind a gap is later than the last frame by the length of the gap.
        #[test]
        fn a_frame_without_time_behind_a_gap_has_its_own_time() {
            let mut assembler = two_frames_a_slice();
            packets(&mut assembler, 0, &[0, 1], HOUR_US);
            assert_eq!(packets(&mut assembler, 3, &[0], 0), []);
            let found = packets(&mut assembler, 4, &[0, 1], HOUR_US + 8 * FRAME_US);
            let gap = |first_sequence, frames| lost(first_sequence, frames, GapReason::PacketLost);
            assert_eq!(found, [gap(2, 4), frame(6), gap(7, 1), frame(8), frame(9)]);
        }

        /// Regression test: the first four bytes of a text were taken for a fatal error code.
        #[test]
        fn a_text_of_the_firmware_does_not_end_the_stream() {
            let mut assembler = assembler(64, 128);
            let flags = PacketFlags { first: true, last: true, error: true, ..PacketFlags::default() };
            assert_eq!(packets(&mut assembler, 0, &[0, 1, 2, 3], HOUR_US), [frame(0)]);
            for payload in [&b"hello"[..], b"ab", b"a longer text of the firmware\n"] {
                let text = Packet { flags, channel: 0, counter: 4, payload };
                // The second and third ones come from the past.
                assert_eq!(assembler.push_packet(&text), Outcome::Accepted);
            }
            let found = packets_from(&mut assembler, 5, &[0, 1, 2, 3], HOUR_US + FRAME_US);
            assert_eq!(found, [frame(1)]);
            let code = Packet { flags, channel: 0, counter: 9, payload: &5u32.to_le_bytes() };
            assert_eq!(assembler.push_packet(&code), Outcome::Stopped(DataError::Other(5)));
        }

        /// Regression test: lost frames were counted from the first frame on, so that the count was wrong by more the
        /// longer the stream had run.
        #[test]
        fn after_a_restart_lost_frames_are_counted_from_the_last_frame_on() {
            // A slice holds one frame in four packets.
            let mut assembler = assembler(64, 128);
            // The board's clock is fast by a thousandth.
            let at = |frame: u64| HOUR_US + frame * (FRAME_US + FRAME_US / 1000);
            for sequence in 0..1000 {
                assert_eq!(packets(&mut assembler, sequence, &[0, 1, 2, 3], at(sequence)).len(), 1);
            }
            assembler.restart(GapReason::FifoOverflow);
            let found = packets(&mut assembler, 0, &[0, 1, 2, 3], at(1005));
            assert_eq!(found[0], lost(1000, 5, GapReason::FifoOverflow));
        }

        /// Regression test, found by the test campaign: the board lost power twice and measured at once each time. The
        /// second time its clock had the same value as the first time, which was mistaken for a clock that had kept
        /// running. Every later count was one short.
        #[test]
        fn a_clock_with_the_same_value_as_before_has_not_kept_running() {
            // A slice holds one frame in four packets.
            let mut assembler = assembler(64, 128);
            let first_slice = |assembler: &mut Assembler, time_us| packets(assembler, 0, &[0, 1, 2, 3], time_us);
            assert!(matches!(first_slice(&mut assembler, 31_626)[..], [Ok(_)]));
            for (away_ms, first_sequence) in [(30, 1), (11, 3)] {
                assembler.note_reconnection();
                assembler.set_host_elapsed(Duration::from_millis(away_ms));
                let found = first_slice(&mut assembler, 0);
                let gap = lost(first_sequence, 1, GapReason::Disconnected);
                assert!(matches!(found[..], [first, Ok(_)] if first == gap), "{found:?}");
            }
            assembler.restart(GapReason::FifoOverflow);
            let found = first_slice(&mut assembler, 6 * FRAME_US);
            let gap = lost(5, 5, GapReason::FifoOverflow);
            assert!(matches!(found[..], [first, Ok(_)] if first == gap), "{found:?}");
        }
    }
}
