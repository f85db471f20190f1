//! Emulated debug probe: the commands of [`crate::protocol::cmsis_dap`], and a target that counts its resets.

use std::fs::OpenOptions;
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::protocol::cmsis_dap::{Answer, Command, HID_PACKET, INVALID, Info, NRESET};

/// Emulated debug probe.
#[derive(Debug, Clone, Default)]
pub struct EmulatedProbe {
    /// Number of resets of its target.
    pub resets: Arc<AtomicU64>,
    /// Whether the probe has a reset sequence for the target.
    pub has_sequence: bool,
    /// Whether the reset line stays low.
    pub is_line_stuck: bool,
    pub(crate) is_reset_low: bool,
}

impl EmulatedProbe {
    /// Computes the answer to a packet.
    pub fn answer(&mut self, packet: &[u8]) -> Vec<u8> {
        let Some(command) = Command::decode(packet) else { return vec![INVALID] };
        match command {
            Command::Info(info) => Answer::Info(match info {
                Info::Vendor => b"radome\0",
                Info::Product => b"Emulated CMSIS-DAP\0",
                Info::SerialNumber => b"EMULATED01\0",
                Info::ProtocolVersion => b"2.1.1\0",
                Info::FirmwareVersion => b"1.0.0\0",
                Info::Capabilities => &[1],
            })
            .encode(),
            Command::Connect => Answer::Port(1).encode(),
            Command::Disconnect => Answer::Disconnected(true).encode(),
            Command::ResetTarget => {
                if self.has_sequence {
                    self.resets.fetch_add(1, Ordering::Relaxed);
                }
                Answer::Reset { is_ok: true, is_implemented: self.has_sequence }.encode()
            }
            Command::Pins { output, select, .. } => {
                if select & NRESET != 0 {
                    let was_low = std::mem::replace(&mut self.is_reset_low, output & NRESET == 0);
                    if was_low && !self.is_reset_low && !self.is_line_stuck {
                        self.resets.fetch_add(1, Ordering::Relaxed);
                    }
                }
                let is_low = self.is_reset_low || self.is_line_stuck;
                Answer::Pins(if is_low { 0 } else { NRESET }).encode()
            }
        }
    }

    /// Serves a HID gadget's node, such as `/dev/hidg0`, until it fails. `ready` is called when the node is open.
    ///
    /// # Errors
    /// Error of the system if the node cannot be opened, read or written, or has ended; [`ErrorKind::InvalidInput`] if it is no
    /// device.
    pub fn serve_hid(&mut self, gadget: &Path, ready: impl FnOnce()) -> io::Result<()> {
        let mut gadget = OpenOptions::new().read(true).write(true).open(gadget)?;
        // Answers would overwrite the content of a file.
        if !gadget.metadata()?.file_type().is_char_device() {
            let what = "it is no device, expected a HID gadget's node such as /dev/hidg0";
            return Err(io::Error::new(ErrorKind::InvalidInput, what));
        }
        ready();
        let mut report = [0; HID_PACKET];
        loop {
            let count = gadget.read(&mut report)?;
            if count == 0 {
                return Err(ErrorKind::UnexpectedEof.into());
            }
            let mut answer = self.answer(report.get(..count).unwrap_or(&[]));
            answer.resize(HID_PACKET, 0);
            gadget.write_all(&answer)?;
        }
    }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    /// Regression test: a recording that was named as the node was overwritten, and then grew until the disk was full.
    #[test]
    fn a_file_in_the_place_of_the_node_is_refused_and_keeps_its_content() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        std::fs::write(&path, [7u8; 300]).expect("writes");
        let error = EmulatedProbe::default().serve_hid(&path, || panic!("ready")).expect_err("no device");
        assert!(error.kind() == ErrorKind::InvalidInput && error.to_string().contains("/dev/hidg0"), "{error}");
        assert_eq!(std::fs::read(&path).expect("reads"), [7u8; 300]);
    }

    /// Regression test: a node at its end kept a processor busy.
    #[test]
    fn a_node_that_has_ended_is_an_error() {
        let error = EmulatedProbe::default().serve_hid(Path::new("/dev/null"), || {}).expect_err("its end");
        assert_eq!(error.kind(), ErrorKind::UnexpectedEof);
    }
}
