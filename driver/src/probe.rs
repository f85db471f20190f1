//! CMSIS-DAP debug probes, such as the KitProg3 of a PSoC 6 kit: their identity, and the reset of a kit that hangs.

mod packets;

use std::io;
use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use serde::Serialize;
use thiserror::Error;

use crate::candidate::{Candidate, Transport};
use crate::protocol::cmsis_dap::{Answer, AnswerError, Command, Info, MAX_PACKET, NRESET};
use packets::Packets;

/// Duration for which the reset line is held low.
const RESET_PULSE: Duration = Duration::from_millis(20);
/// Longest time that the line may take to rise, microseconds.
const RISE_US: u32 = 100_000;

/// Errors of a debug probe.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum ProbeError {
    /// The probe cannot be opened.
    #[error("{path}: cannot open the debug probe")]
    Open { path: PathBuf, source: io::Error },
    /// Another program holds the probe.
    #[error("{path}: another program has this debug probe; close it and try again")]
    Busy { path: PathBuf },
    /// The user may not open the probe.
    #[error(
        "{path}: permission denied\n\nhint: {remedy}",
        remedy = crate::transport::PERMISSION_REMEDY
    )]
    PermissionDenied { path: PathBuf },
    /// The connection broke.
    #[error("{path}: the connection to the debug probe broke")]
    Disconnected { path: PathBuf, source: io::Error },
    /// No answer came.
    #[error("{path}: the debug probe does not answer; does another program use it?")]
    NoAnswer { path: PathBuf },
    /// The answer is malformed.
    #[error("{path}: malformed answer")]
    Malformed { path: PathBuf, source: AnswerError },
    /// The probe could not carry out a command.
    #[error("{path}: the debug probe could not {what}")]
    Refused { path: PathBuf, what: &'static str },
}

/// Identity that a probe reports.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ProbeIdentity {
    /// Vendor's name.
    pub vendor: String,
    /// Product's name.
    pub product: String,
    /// Serial number.
    pub serial_number: String,
    /// Version of its firmware, or of the protocol if it reports no other.
    pub firmware_version: String,
    /// Whether the probe supports SWD, the debug interface of PSoC chips.
    pub has_swd: bool,
}

/// Method by which a target was reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ResetMethod {
    /// A sequence that the probe has for its target.
    Sequence,
    /// A pulse on the nRESET line.
    Pin,
}

/// Open debug probe.
pub struct Probe {
    path: PathBuf,
    packets: Box<dyn Packets>,
}

impl Probe {
    /// Opens the probe of a candidate.
    ///
    /// # Errors
    /// [`ProbeError::PermissionDenied`], [`ProbeError::Busy`], or [`ProbeError::Open`] for any other error of the
    /// system.
    pub fn open(candidate: &Candidate) -> Result<Probe, ProbeError> {
        let path = candidate.path.clone();
        let opened = match (candidate.transport, &candidate.usb) {
            (Transport::Usb, Some(usb)) => packets::bulk(usb.bus, usb.address),
            _ => packets::hid(&path),
        };
        let packets = opened.map_err(|source| match source.kind() {
            io::ErrorKind::PermissionDenied => ProbeError::PermissionDenied { path: path.clone() },
            io::ErrorKind::ResourceBusy => ProbeError::Busy { path: path.clone() },
            _ => ProbeError::Open { path: path.clone(), source },
        })?;
        Ok(Probe { path, packets })
    }

    #[cfg(test)]
    pub(crate) fn with_packets(packets: Box<dyn Packets>) -> Probe {
        Probe { path: "emulated".into(), packets }
    }

    /// Sends a command and converts its answer by `read`.
    fn command<T>(&mut self, command: Command, read: impl FnOnce(Answer<'_>) -> T) -> Result<T, ProbeError> {
        let path = || self.path.clone();
        let mut buffer = [0; MAX_PACKET];
        let count = self
            .packets
            .exchange(&command.encode(), &mut buffer)
            .map_err(|source| ProbeError::Disconnected { path: path(), source })?;
        let answer = buffer.get(..count).filter(|answer| !answer.is_empty());
        let answer = answer.ok_or_else(|| ProbeError::NoAnswer { path: path() })?;
        let answer = command.answer(answer).map_err(|source| ProbeError::Malformed { path: path(), source })?;
        Ok(read(answer))
    }

    fn info(&mut self, info: Info) -> Result<Vec<u8>, ProbeError> {
        self.command(Command::Info(info), |answer| match answer {
            Answer::Info(data) => data.to_vec(),
            _ => Vec::new(),
        })
    }

    fn text(&mut self, info: Info) -> Result<String, ProbeError> {
        self.info(info).map(|bytes| crate::protocol::mcu7::text(&bytes))
    }

    /// Reads the identity of the probe.
    ///
    /// # Errors
    /// [`ProbeError::NoAnswer`], [`ProbeError::Malformed`] or [`ProbeError::Disconnected`].
    pub fn identity(&mut self) -> Result<ProbeIdentity, ProbeError> {
        let mut firmware_version = self.text(Info::FirmwareVersion)?;
        if firmware_version.is_empty() {
            firmware_version = self.text(Info::ProtocolVersion)?;
        }
        Ok(ProbeIdentity {
            vendor: self.text(Info::Vendor)?,
            product: self.text(Info::Product)?,
            serial_number: self.text(Info::SerialNumber)?,
            firmware_version,
            has_swd: self.info(Info::Capabilities)?.first().is_some_and(|bits| bits & 1 != 0),
        })
    }

    /// Resets the chip that the probe is wired to: by the probe's own sequence if it has one, else by its nRESET line.
    ///
    /// # Errors
    /// [`ProbeError::Refused`] if the probe has no port to the target or the line does not rise again; else those of
    /// [`Probe::identity`].
    pub fn reset_target(&mut self) -> Result<ResetMethod, ProbeError> {
        let path = self.path.clone();
        let refused = move |what| ProbeError::Refused { path: path.clone(), what };
        if self.command(Command::Connect, |answer| answer == Answer::Port(0))? {
            return Err(refused("connect to its target"));
        }
        let reset = self.reset_connected(&refused);
        let disconnected = self.command(Command::Disconnect, |_| ());
        let method = reset?;
        disconnected?;
        Ok(method)
    }

    fn reset_connected(&mut self, refused: &dyn Fn(&'static str) -> ProbeError) -> Result<ResetMethod, ProbeError> {
        let by_sequence =
            self.command(Command::ResetTarget, |answer| answer == Answer::Reset { is_ok: true, is_implemented: true })?;
        if by_sequence {
            return Ok(ResetMethod::Sequence);
        }
        self.command(Command::Pins { output: 0, select: NRESET, wait_us: 0 }, |_| ())?;
        thread::sleep(RESET_PULSE);
        let release = Command::Pins { output: NRESET, select: NRESET, wait_us: RISE_US };
        let is_high = self.command(release, |answer| matches!(answer, Answer::Pins(pins) if pins & NRESET != 0))?;
        if is_high { Ok(ResetMethod::Pin) } else { Err(refused("let the reset line rise: it stays low")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emulator::probe::EmulatedProbe;

    impl Packets for EmulatedProbe {
        fn exchange(&mut self, packet: &[u8], answer: &mut [u8]) -> io::Result<usize> {
            let bytes = self.answer(packet);
            answer.iter_mut().zip(&bytes).for_each(|(to, from)| *to = *from);
            Ok(bytes.len().min(answer.len()))
        }
    }

    #[test]
    fn a_probe_reports_its_identity() {
        let identity = Probe::with_packets(Box::new(EmulatedProbe::default())).identity().expect("answers");
        assert_eq!((identity.product.as_str(), identity.has_swd), ("Emulated CMSIS-DAP", true));
        assert_eq!(identity.firmware_version, "1.0.0");
    }

    #[test]
    fn the_target_is_reset_by_the_line_where_there_is_no_sequence() {
        for (has_sequence, method) in [(true, ResetMethod::Sequence), (false, ResetMethod::Pin)] {
            let probe = EmulatedProbe { has_sequence, ..EmulatedProbe::default() };
            let resets = probe.resets.clone();
            let mut probe = Probe::with_packets(Box::new(probe));
            assert_eq!(probe.reset_target().expect("resets"), method);
            assert_eq!(resets.load(std::sync::atomic::Ordering::Relaxed), 1);
        }
    }

    mod hard_cases {
        use super::*;
        use crate::candidate::{Access, Belief, UsbIdentity};

        /// Probe that answers every packet with these bytes.
        struct FixedAnswer(&'static [u8]);

        impl Packets for FixedAnswer {
            fn exchange(&mut self, _: &[u8], answer: &mut [u8]) -> io::Result<usize> {
                answer.iter_mut().zip(self.0).for_each(|(to, from)| *to = *from);
                Ok(self.0.len())
            }
        }

        #[test]
        fn silence_and_malformed_answers_of_a_probe_are_errors() {
            for (bytes, expected) in [
                (&[][..], "does not answer"),
                (&[0xFF], "malformed"),
                (&[0, 200, 1], "malformed"),
                (&[0x55, 0x55], "malformed"),
            ] {
                let error = Probe::with_packets(Box::new(FixedAnswer(bytes))).identity().expect_err(expected);
                assert!(error.to_string().contains(expected), "{error}");
            }
            let error = Probe::with_packets(Box::new(FixedAnswer(&[2, 0]))).reset_target().expect_err("no port");
            assert!(error.to_string().contains("connect to its target"), "{error}");
        }

        #[test]
        fn a_reset_line_that_stays_low_is_an_error() {
            let probe = EmulatedProbe { has_sequence: false, is_line_stuck: true, ..EmulatedProbe::default() };
            let error = Probe::with_packets(Box::new(probe)).reset_target().expect_err("stuck");
            assert!(error.to_string().contains("stays low"), "{error}");
        }

        #[test]
        fn a_probe_that_is_not_there_cannot_be_opened() {
            for transport in [Transport::Hid, Transport::Usb] {
                let candidate = Candidate {
                    path: "/dev/no-such-probe".into(),
                    transport,
                    belief: Belief::DebugProbe,
                    usb: Some(UsbIdentity { bus: 99, address: 99, ..UsbIdentity::default() }),
                    debug_probe: None,
                    access: Access::Absent,
                };
                assert!(matches!(Probe::open(&candidate), Err(ProbeError::Open { .. })), "{transport:?}");
            }
        }
    }
}
