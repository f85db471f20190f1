//! An emulated board or probe as a real USB device: its endpoints served through Linux's FunctionFS, on a machine (or
//! virtual machine) with a USB device controller. Layouts are those of the kernel's `linux/usb/functionfs.h`.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use rustix::net::{RecvFlags, recv};

use super::probe::EmulatedProbe;
use crate::protocol::cmsis_dap::MAX_PACKET;
use crate::protocol::mcu7::Framing;
use crate::protocol::mcu7::bulk::{DATA_ENDPOINT, MAX_BULK, is_in};
use crate::transport::usb::{HostSockets, Setup, TransferError};

const DESCRIPTORS_MAGIC: u32 = 3;
const STRINGS_MAGIC: u32 = 2;
/// Descriptors at full speed and at high speed; control transfers to any recipient.
const FLAGS: u32 = 1 | 2 | 64;
const ENGLISH: u16 = 0x0409;
/// Bytes of an event: a setup packet, the type, padding.
const EVENT: usize = 12;
const SETUP_EVENT: u8 = 4;
const VENDOR_SPECIFIC: u8 = 0xFF;
const FULL_SPEED_PACKET: usize = 64;

/// Returns the descriptors of one vendor-specific interface with bulk endpoints of these addresses.
fn descriptors(endpoints: &[u8]) -> Vec<u8> {
    let at_speed = |packet: usize| {
        let interface = [9, 4, 0, 0, endpoints.len() as u8, VENDOR_SPECIFIC, 0, 0, 1];
        let [low, high] = (packet as u16).to_le_bytes();
        let endpoints: Vec<[u8; 7]> = endpoints.iter().map(|address| [7, 5, *address, 2, low, high, 0]).collect();
        [&interface[..], &endpoints.concat()].concat()
    };
    let speeds = [at_speed(FULL_SPEED_PACKET), at_speed(Framing::USB_PACKET)].concat();
    let count = 1 + endpoints.len() as u32;
    let length = 4 * 5 + speeds.len();
    let mut bytes = Vec::with_capacity(length);
    for word in [DESCRIPTORS_MAGIC, length as u32, FLAGS, count, count] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(speeds);
    bytes
}

fn strings(interface: &str) -> Vec<u8> {
    let text = [interface.as_bytes(), &[0]].concat();
    let length = 4 * 4 + 2 + text.len();
    let mut bytes = Vec::with_capacity(length);
    for word in [STRINGS_MAGIC, length as u32, 1, 1] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(ENGLISH.to_le_bytes());
    bytes.extend(text);
    bytes
}

/// Opens the control endpoint of the FunctionFS mounted at `mount`, and writes the descriptors of the function.
fn describe(mount: &Path, endpoints: &[u8], interface: &str) -> io::Result<File> {
    let mut control = OpenOptions::new().read(true).write(true).open(mount.join("ep0"))?;
    control.write_all(&descriptors(endpoints))?;
    control.write_all(&strings(interface))?;
    Ok(control)
}

/// Serves a debug probe by bulk transfers as the function whose FunctionFS is mounted at `mount`, until it fails.
/// `ready` is called when the gadget may be bound.
///
/// # Errors
/// No FunctionFS is mounted there, or another program serves it.
pub fn serve_probe(mount: &Path, probe: &mut EmulatedProbe, ready: impl FnOnce()) -> io::Result<()> {
    // Kept open: closing it ends the function. The kernel itself serves the control transfers.
    let _control = describe(mount, &[1, 0x80 | 2], "CMSIS-DAP v2")?;
    let mut from_host = OpenOptions::new().read(true).open(mount.join("ep1"))?;
    let mut to_host = OpenOptions::new().write(true).open(mount.join("ep2"))?;
    ready();
    let mut packet = [0; MAX_PACKET];
    loop {
        let count = from_host.read(&mut packet)?;
        to_host.write_all(&probe.answer(packet.get(..count).unwrap_or(&[])))?;
    }
}

/// Serves the emulated board whose endpoints are in `folder` as the function whose FunctionFS is mounted at `mount`;
/// the gadget may be bound when this returns. Its threads live as long as the process: nothing wakes a write to an
/// endpoint that no host reads.
///
/// # Errors
/// No FunctionFS is mounted there, or another program serves it.
pub fn serve(mount: &Path, folder: &Path) -> io::Result<()> {
    let mut control = describe(mount, &[0x80 | DATA_ENDPOINT], "Radar")?;
    let (endpoint, folder) = (mount.join(format!("ep{DATA_ENDPOINT}")), folder.to_owned());
    thread::Builder::new().name("control endpoint".into()).spawn(move || {
        loop {
            if let Err(error) = serve_board(&mut control, &endpoint, &folder) {
                tracing::debug!(%error, "the emulated board is away");
            }
            thread::sleep(Duration::from_millis(20));
        }
    })?;
    Ok(())
}

/// Serves the board until it is unplugged from its sockets.
fn serve_board(control: &mut File, endpoint: &Path, folder: &Path) -> io::Result<()> {
    let mut board = HostSockets::connect(folder)?;
    let (data, endpoint) = (board.data.try_clone()?, endpoint.to_owned());
    thread::Builder::new().name("bulk endpoint".into()).spawn(move || {
        if let Err(error) = forward_bulk(&data, &endpoint) {
            tracing::debug!(%error, "the bulk endpoint has ended");
        }
    })?;
    let mut events = [0; 4 * EVENT];
    loop {
        let count = control.read(&mut events)?;
        for event in events.get(..count).unwrap_or(&[]).chunks_exact(EVENT) {
            match event.split_first_chunk() {
                Some((setup, [SETUP_EVENT, ..])) => transfer(control, &mut board, setup)?,
                Some((_, [kind, ..])) => tracing::debug!(kind, "USB event"),
                _ => {}
            }
        }
    }
}

/// Serves one control transfer. An error of the endpoint alone means that the host has begun another one.
fn transfer(control: &mut File, board: &mut HostSockets, setup: &Setup) -> io::Result<()> {
    let length = usize::from(u16::from_le_bytes([setup[6], setup[7]]));
    let mut data = vec![0; if is_in(setup) { 0 } else { length }];
    if !is_in(setup) && control.read(&mut data).is_err() {
        return Ok(());
    }
    let result = board.transfer(setup, &data);
    let done = match result {
        Ok(answer) if is_in(setup) => control.write(answer.get(..length).unwrap_or(answer)),
        // A read where the host wants to read stalls the endpoint.
        Err(TransferError::Stall | TransferError::Timeout) if is_in(setup) => control.read(&mut []),
        Ok(_) | Err(TransferError::Stall | TransferError::Timeout) => Ok(0),
        Err(TransferError::Lost(error)) => return Err(error),
    };
    if let Err(error) = done {
        tracing::debug!(%error, "control transfer");
    }
    Ok(())
}

/// Forwards bulk transfers from the board to the host.
fn forward_bulk(board: &std::os::fd::OwnedFd, endpoint: &PathBuf) -> io::Result<()> {
    let mut endpoint = OpenOptions::new().write(true).open(endpoint)?;
    let mut message = vec![0; MAX_BULK];
    loop {
        let (count, _) = recv(board, &mut message[..], RecvFlags::empty())?;
        if count == 0 {
            return Ok(());
        }
        // Packets are lost while no host is attached.
        if let Err(error) = endpoint.write(message.get(..count).unwrap_or(&[])) {
            tracing::debug!(%error, "bulk transfer");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_state_their_length() {
        for bytes in [descriptors(&[0x81]), descriptors(&[1, 0x82]), strings("Radar")] {
            let length = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]);
            assert_eq!(length as usize, bytes.len());
        }
        assert!(descriptors(&[0x81]).ends_with(&[7, 5, 0x81, 2, 0, 2, 0]));
    }
}
