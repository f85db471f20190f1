//! Messages of boards and probes as pure functions over bytes. Each decoder stands beside its encoder; nothing here
//! does I/O.

pub mod ascii;
pub mod cmsis_dap;
pub mod crc;
pub mod deepcraft;
pub mod fifo;
pub mod mcu7;
pub mod packed12;
