//! Slices of the FIFO: their packets, and the slice to request for a frame.

use radome_dsp::FIFO_SAMPLES;

use super::{Framing, Packet};
use crate::protocol::packed12::packed_length;

/// Bytes of the board's clock at the end of a slice.
pub const TIMESTAMP_LENGTH: usize = 8;

/// Slice of packed codes with timestamp, which determines the sizes of its packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SliceLayout {
    /// Codes in a slice, even.
    pub samples: usize,
    /// Framing of its packets.
    pub framing: Framing,
}

impl SliceLayout {
    /// Chooses the slice to request on the serial port: see [`Self::for_frame_as`].
    pub fn for_frame(codes: usize) -> Self {
        SliceLayout::for_frame_as(codes, Framing::Serial)
    }

    /// Chooses the slice with which frames of this many codes come with the least delay: as few equal parts of a frame
    /// as fit half the FIFO. Slices that the firmware cannot send (see [`Self::is_safe`]) are skipped. Frames with an
    /// odd number of codes cannot be divided equally and share slices with their neighbours.
    pub fn for_frame_as(codes: usize, framing: Framing) -> Self {
        let slice = |samples| SliceLayout { samples, framing };
        let half = FIFO_SAMPLES / 2;
        let codes = codes.max(1);
        let equal_parts = (codes.div_ceil(half)..=codes.div_ceil(half) * 16)
            .filter(|parts| codes.is_multiple_of(*parts))
            .map(|parts| slice(codes / parts))
            .find(|slice| slice.is_safe());
        let whole_frames = (2..=half / codes).map(|frames| slice(frames * codes));
        let any_size = (1..=half / 2).rev().map(|pairs| slice(2 * pairs));
        equal_parts
            .or_else(|| whole_frames.into_iter().find(|slice| slice.is_safe()))
            .or_else(|| any_size.into_iter().find(|slice| slice.is_safe()))
            .unwrap_or(slice(6144))
    }

    /// Returns whether the firmware can send it: an even count of at most half the FIFO. The last packet must hold the
    /// whole timestamp: otherwise firmware 2.x computes a negative length and sends 64 KiB of garbage. In bulk
    /// transfers no packet may fill USB packets exactly, since nothing then ends the transfer.
    pub fn is_safe(self) -> bool {
        let last_part = (self.data_bytes() + TIMESTAMP_LENGTH) % self.framing.max_packet_payload();
        let last = self.payload_length(self.packets().saturating_sub(1)) + Packet::HEADER_LENGTH;
        self.samples > 0
            && self.samples.is_multiple_of(2)
            && self.samples <= FIFO_SAMPLES / 2
            && !(1..TIMESTAMP_LENGTH).contains(&last_part)
            && !(self.framing == Framing::Bulk && last.is_multiple_of(Framing::USB_PACKET))
    }

    /// Packed bytes of the codes.
    pub fn data_bytes(self) -> usize {
        packed_length(self.samples)
    }

    /// Number of packets of the slice.
    pub fn packets(self) -> usize {
        (self.data_bytes() + TIMESTAMP_LENGTH).div_ceil(self.framing.max_packet_payload())
    }

    /// Start of the data of one of its packets, bytes from the start of the slice.
    pub fn offset(self, packet: usize) -> usize {
        (packet * self.framing.max_packet_payload()).min(self.data_bytes())
    }

    /// Payload length of one of its packets, timestamp included.
    pub fn payload_length(self, packet: usize) -> usize {
        let longest = self.framing.max_packet_payload();
        (self.data_bytes() + TIMESTAMP_LENGTH).saturating_sub(packet * longest).min(longest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The vendor's default of 6144 samples comes in packets of 4095, 4095 and 1058 bytes.
    #[test]
    fn default_slice_is_cut_as_in_the_transcript() {
        let slice = SliceLayout::for_frame(64 * 64 * 3);
        assert_eq!(slice.samples, 6144);
        let lengths: Vec<_> = (0..slice.packets()).map(|p| slice.payload_length(p) + 8).collect();
        assert_eq!(lengths, [4095, 4095, 1058]);
    }

    #[test]
    fn paper_frames_come_in_twelve_slices() {
        assert_eq!(SliceLayout::for_frame(3 * 128 * 256).samples, 8192);
    }

    #[test]
    fn every_choice_is_safe_for_the_firmware() {
        for codes in 1..20_000 {
            for framing in [Framing::Serial, Framing::Bulk] {
                let slice = SliceLayout::for_frame_as(codes, framing);
                assert!(slice.is_safe(), "{codes} -> {slice:?}");
            }
        }
        // A whole frame of 5448 samples would be 8172 + 8 bytes = 2 * 4087 + 6. Half of it would be 4087 + 7 bytes:
        // three equal parts are taken.
        assert!(!SliceLayout { samples: 5448, framing: Framing::Serial }.is_safe());
        assert_eq!(SliceLayout::for_frame(5448).samples, 1816);
    }
    /// 338 samples are 507 bytes and 14 more of header and timestamp, which is not a multiple of 512. 332 samples would
    /// be 498 + 14 = 512 bytes.
    #[test]
    fn a_bulk_slice_is_one_packet_that_a_short_usb_packet_ends() {
        assert!(!SliceLayout { samples: 332, framing: Framing::Bulk }.is_safe());
        assert!(SliceLayout { samples: 332, framing: Framing::Serial }.is_safe());
        for codes in [3 * 64 * 64, 3 * 128 * 256, 332] {
            let slice = SliceLayout::for_frame_as(codes, Framing::Bulk);
            assert_eq!(slice.packets(), 1);
            assert_ne!((slice.payload_length(0) + 6) % 512, 0);
        }
    }
}
