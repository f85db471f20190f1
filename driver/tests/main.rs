//! Tests of boards, protocols and recordings through the public API, in one program, so that it is linked once.

mod bulk_board;
mod common;
mod deepcraft;
mod deepcraft_board;
mod detect;
mod discover;
mod emulated_board;
mod line_board;
mod lost_for_good;
mod mcu7;
mod particular_clients;
mod player;
mod recording_formats;
mod recordings;
mod repair;
mod rewritten;
mod seek;
mod staying_alive;
mod transcripts;
