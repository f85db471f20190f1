//! PSoC 6 kit with the DEEPCRAFT streaming firmware ([`crate::protocol::deepcraft`]).

mod board;
mod link;
mod resequencer;
mod stream;

pub use board::DeepcraftBoard;
pub use stream::DeepcraftStream;
