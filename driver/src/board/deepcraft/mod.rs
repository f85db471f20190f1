//! PSoC 6 kit with the DEEPCRAFT streaming firmware ([`crate::protocol::deepcraft`]).

mod board;
mod error;
mod link;
mod resequencer;
mod stream;

pub use board::DeepcraftBoard;
pub use error::DeepcraftError;
pub use stream::DeepcraftStream;
