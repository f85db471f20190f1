//! Tests of programs that run while a test talks to them: boards, brokers, pages, shutdown. Commands that use all
//! processors have their own test program.

mod boards;
mod doctor;
mod ends;
mod integrations;
mod live;
mod results;
mod secrets;
mod survival;
