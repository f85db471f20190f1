//! Programs that go on while a test talks to them: boards, brokers, pages, ends. Commands, whose work takes all processors, are in
//! a program of their own.

mod boards;
mod doctor;
mod ends;
mod home;
mod live;
mod results;
mod secrets;
mod survival;
