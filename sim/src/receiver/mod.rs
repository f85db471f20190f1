//! From the field at the antennas to 12-bit codes.

mod file;

pub use file::{Antenna, ClutterDrift, Leakage, Noise, OffsetDrift, RECEIVER_FORMAT, Receiver, RxChannel, Transient};
