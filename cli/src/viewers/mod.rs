//! Export of recordings for public viewers: an MCAP file with message types that Foxglove, Rerun and PlotJuggler
//! support.

mod clock;
mod export;
mod message_type;
mod messages;

pub use export::export;
