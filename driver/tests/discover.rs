//! Tests of discovery in a synthetic /sys and /dev.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

use radome_driver::discover::{Belief, Change, Identity, Roots, State, Transport, Watch, ask, candidates_in};
use radome_driver::{Address, Candidate, Detected, EmulatedBoard, Fault, Kind, Mcu7Board, UsbAddress};
use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform};

use crate::common;

/// Devices of a machine, as files in a folder.
struct Machine {
    folder: tempfile::TempDir,
}

impl Machine {
    fn new() -> Self {
        Machine { folder: tempfile::tempdir().expect("a folder") }
    }

    /// A machine with a serial board on its port.
    fn with_board() -> Self {
        let machine = Machine::new();
        machine.plug("1-1", (0x058B, 0x0251), 5, "IFX CDC", "77");
        machine.add_node("1-1", "tty", "ttyACM0", "");
        machine
    }

    fn roots(&self) -> Roots {
        Roots { sys: self.folder.path().join("sys"), dev: self.folder.path().join("dev") }
    }

    fn found(&self) -> Vec<Candidate> {
        candidates_in(&self.roots())
    }

    fn write(path: &Path, text: &str) {
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        fs::write(path, text).expect("written");
    }

    /// Adds a USB device: `socket` is its kernel name; then ids, address, product and serial number.
    fn plug(&self, socket: &str, id: (u16, u16), address: u8, product: &str, serial: &str) {
        let Roots { sys, dev } = self.roots();
        let device = sys.join("devices/usb1").join(socket);
        for (name, text) in [
            ("idVendor", format!("{:04x}\n", id.0)),
            ("idProduct", format!("{:04x}\n", id.1)),
            ("busnum", "1\n".into()),
            ("devnum", format!("{address}\n")),
            ("product", format!("{product}\n")),
            ("serial", format!("{serial}\n")),
        ] {
            Self::write(&device.join(name), &text);
        }
        let list = sys.join("bus/usb/devices");
        fs::create_dir_all(&list).expect("made");
        let _ = fs::remove_file(list.join(socket));
        symlink(&device, list.join(socket)).expect("linked");
        Self::write(&dev.join(format!("bus/usb/001/{address:03}")), "");
    }

    /// Adds a node of this class to a plugged device, below its first interface.
    fn add_node(&self, socket: &str, class: &str, name: &str, below: &str) {
        let Roots { sys, dev } = self.roots();
        let device = sys.join("devices/usb1").join(socket).join(format!("{socket}:1.0")).join(below);
        fs::create_dir_all(&device).expect("made");
        fs::create_dir_all(sys.join("class").join(class).join(name)).expect("made");
        symlink(&device, sys.join("class").join(class).join(name).join("device")).expect("linked");
        Self::write(&dev.join(name), "");
    }

    fn unplug(&self, socket: &str, class: &str, name: &str) {
        let Roots { sys, dev } = self.roots();
        fs::remove_dir_all(sys.join("devices/usb1").join(socket)).expect("gone");
        fs::remove_file(sys.join("bus/usb/devices").join(socket)).expect("gone");
        fs::remove_dir_all(sys.join("class").join(class).join(name)).expect("gone");
        fs::remove_file(dev.join(name)).expect("gone");
    }
}

#[test]
fn a_serial_board_is_one_candidate_with_its_usb_device() {
    let machine = Machine::with_board();
    let found = machine.found();
    let [board] = found.as_slice() else { panic!("{found:?}") };
    let path = machine.roots().dev.join("ttyACM0");
    assert_eq!((board.belief, board.transport, &board.path), (Belief::Mcu7Serial, Transport::Serial, &path));
    let usb = board.usb.as_ref().expect("USB");
    assert_eq!((usb.vendor_id, usb.product_id, usb.bus, usb.address), (0x058B, 0x0251, 1, 5));
    assert_eq!(
        (usb.product.as_deref(), usb.serial_number.as_deref(), usb.socket.as_str()),
        (Some("IFX CDC"), Some("77"), "1-1")
    );
    assert_eq!(board.address(), Some(Address::Serial(path)));
}

#[test]
fn a_bulk_board_is_found_by_its_usb_node() {
    let machine = Machine::new();
    machine.plug("1-1.2", (0x058B, 0x0252), 7, "", "");
    let found = machine.found();
    let [board] = found.as_slice() else { panic!("{found:?}") };
    assert!(board.path.ends_with("dev/bus/usb/001/007"));
    assert_eq!(board.address(), Some(Address::Usb(UsbAddress::Device { bus: 1, address: 7 })));
    assert_eq!(board.usb.as_ref().expect("USB").serial_number, None);
}

/// Asserts that a port finds its kit's debug probe by their common USB device, or by their common serial number.
#[test]
fn a_port_is_paired_with_the_debug_probe_of_its_kit() {
    let machine = Machine::new();
    machine.plug("1-2", (0x04B4, 0xF152), 3, "KitProg3 CMSIS-DAP HID", "K1");
    machine.add_node("1-2", "hidraw", "hidraw0", "0003:04B4:F152.0001");
    machine.add_node("1-2", "tty", "ttyACM3", "");
    machine.plug("1-3", (0x058B, 0x027D), 4, "DEEPCRAFT Streaming Device", "K1");
    machine.add_node("1-3", "tty", "ttyACM1", "");
    machine.plug("1-4", (0x058B, 0x0251), 9, "IFX CDC", "other");
    machine.add_node("1-4", "tty", "ttyACM2", "");
    let found = machine.found();
    let probe = machine.roots().dev.join("hidraw0");
    let probe_of = |name: &str| {
        found.iter().find(|c| c.path.ends_with(name)).unwrap_or_else(|| panic!("{name}")).debug_probe.clone()
    };
    assert_eq!(
        (probe_of("ttyACM3"), probe_of("ttyACM1"), probe_of("ttyACM2"), probe_of("hidraw0")),
        (Some(probe.clone()), Some(probe), None, None)
    );
    assert_eq!(found.len(), 4);
}

/// Asserts that a probe with bulk transfers is found at its USB device, whatever other interfaces it has; HID takes
/// precedence.
#[test]
fn a_probe_with_bulk_transfers_is_found_by_its_interface() {
    let machine = Machine::new();
    machine.plug("1-2", (0x04B4, 0xF155), 3, "KitProg3 CMSIS-DAP BULK", "K1");
    machine.add_node("1-2", "tty", "ttyACM3", "");
    let interface = |name: &str| machine.roots().sys.join("devices/usb1/1-2/1-2:1.1").join(name);
    Machine::write(&interface("bInterfaceClass"), "ff\n");
    Machine::write(&interface("interface"), "KitProg3 CMSIS-DAP v2\n");
    let found = machine.found();
    let node = machine.roots().dev.join("bus/usb/001/003");
    assert_eq!(found.iter().map(|c| c.is_probe()).collect::<Vec<_>>(), [true, false]);
    assert_eq!((&found[0].path, &found[1].debug_probe), (&node, &Some(node.clone())));
    machine.add_node("1-2", "hidraw", "hidraw0", "0003:04B4:F155.0001");
    let found = machine.found();
    assert_eq!(found.iter().filter(|c| c.is_probe()).map(|c| c.transport).collect::<Vec<_>>(), [Transport::Hid]);
}

#[test]
fn other_probes_are_recognised_by_their_name_and_other_hid_devices_are_skipped() {
    let machine = Machine::new();
    machine.plug("1-1", (0x0D28, 0x0204), 3, "Arm DAPLink CMSIS-DAP", "1");
    machine.add_node("1-1", "hidraw", "hidraw0", "0003:0D28:0204.0001");
    machine.plug("1-2", (0x046D, 0xC31C), 4, "Keyboard", "2");
    machine.add_node("1-2", "hidraw", "hidraw1", "0003:046D:C31C.0002");
    // Only the name of the interface identifies this probe.
    machine.plug("1-3", (0x1366, 0x0101), 5, "Something", "3");
    machine.add_node("1-3", "hidraw", "hidraw2", "0003:1366:0101.0003");
    Machine::write(&machine.roots().sys.join("devices/usb1/1-3/1-3:1.0/interface"), "CMSIS-DAP v1\n");
    let found: Vec<_> = machine.found().into_iter().map(|c| (c.path, c.belief)).collect();
    let dev = machine.roots().dev;
    assert_eq!(found, [(dev.join("hidraw0"), Belief::DebugProbe), (dev.join("hidraw2"), Belief::DebugProbe)]);
}

#[test]
fn a_watch_reports_added_and_removed_devices() {
    let machine = Machine::new();
    let mut watch = Watch::new(machine.roots());
    assert_eq!(watch.look(), []);
    machine.plug("1-1", (0x058B, 0x0251), 5, "IFX CDC", "77");
    machine.add_node("1-1", "tty", "ttyACM0", "");
    let changes = watch.look();
    assert!(matches!(changes.as_slice(), [Change::Added(c)] if c.path.ends_with("ttyACM0")), "{changes:?}");
    assert_eq!(watch.look(), []);
    // A device that is replugged between two looks has the same name but counts as a new device.
    machine.plug("1-1", (0x058B, 0x0251), 6, "IFX CDC", "77");
    assert!(matches!(watch.look().as_slice(), [Change::Removed(_), Change::Added(_)]));
    machine.unplug("1-1", "tty", "ttyACM0");
    assert!(matches!(watch.look().as_slice(), [Change::Removed(_)]));
}

/// Candidate for the port of an emulated board.
fn candidate_at(machine: &Machine, board: &EmulatedBoard) -> Candidate {
    let mut found = machine.found();
    let mut candidate = found.remove(0);
    candidate.path = board.path().to_owned();
    candidate
}

#[test]
fn a_board_that_is_asked_gives_its_identity_or_an_error() {
    let machine = Machine::with_board();
    let waveform = common::waveform(&[1, 2, 3], 8, 64, 0.1);
    let state = |faults: &[Fault]| {
        let board = common::board(&waveform, 10, Kind::default(), faults);
        let candidate = candidate_at(&machine, &board);
        let state = ask(&candidate, false);
        // The port is busy while another client holds it.
        let opened = radome_driver::Mcu7Board::open(board.address());
        assert!(opened.is_err() || ask(&candidate, false) == State::Busy, "{:?}", ask(&candidate, false));
        state
    };
    let State::Ready { identity: Identity::Board(identity) } = state(&[]) else { panic!("not ready") };
    assert_eq!((identity.chip.as_str(), identity.firmware_version.as_str()), ("BGT60TR13C", "2.9.0"));
    let State::OtherChip { chip } = state(&[Fault::ForeignChip(0x0606)]) else { panic!("not another chip") };
    assert!(chip.contains("BGT60UTR13D"), "{chip}");
    for id in [0, 0xFF_FFFF] {
        let State::NotAnswering { why } = state(&[Fault::ForeignChip(id)]) else { panic!("answers") };
        assert!(why.contains("radar chip does not"), "{why}");
    }
}

#[test]
fn ports_of_unknown_devices_are_asked_in_every_protocol_on_request() {
    let machine = Machine::new();
    machine.plug("1-1", (0x1A86, 0x7523), 5, "USB Serial", "9");
    machine.add_node("1-1", "tty", "ttyUSB0", "");
    let waveform = common::waveform(&[1], 8, 64, 0.1);
    for kind in [Kind::Mcu7V4, Kind::Deepcraft, Kind::Esp32] {
        let board = common::board(&waveform, 1000, kind, &[]);
        let candidate = candidate_at(&machine, &board);
        assert_eq!(ask(&candidate, false), State::NotAsked);
        match ask(&candidate, true) {
            State::Ready { identity: Identity::Board(identity) } if kind != Kind::Esp32 => {
                assert_eq!(identity.chip, "BGT60TR13C", "{kind:?}");
            }
            State::Prints if kind == Kind::Esp32 => {}
            other => panic!("{kind:?}: {other:?}"),
        }
    }
}

/// Waveform that the chip holds for the next client.
fn programmed_waveform(board: &EmulatedBoard) -> Option<Waveform> {
    let Detected::Mcu7(_, programmed) = Detected::open(board.address(), None).expect("answers") else {
        panic!("another kind of board")
    };
    programmed
}

/// Asserts that a query keeps the programmed waveform. Regression test: after `radome board list`, recordings had to
/// name it again.
#[test]
fn a_query_keeps_the_programmed_waveform() {
    let machine = Machine::with_board();
    let waveform = common::waveform(&[1, 3], 8, 64, 0.1);
    for kind in [Kind::Mcu7V4, Kind::Mcu7V3] {
        let board = common::board(&waveform, 1000, kind, &[]);
        // Opening without starting resets the chip, so that the waveform below cannot be the emulator's initial one.
        let opened = Mcu7Board::open(board.address()).expect("opens");
        let identity = opened.identity().clone();
        drop(opened);
        assert_eq!(programmed_waveform(&board), None);
        let mut stream = Mcu7Board::open(board.address()).expect("opens").start(&waveform).expect("starts");
        let mut frame = Frame::zeroed(waveform.shape());
        assert_eq!(stream.next_frame(&mut frame).expect("frame"), SourceEvent::Frame);
        drop(stream);

        for _ in 0..2 {
            let state = ask(&candidate_at(&machine, &board), false);
            assert_eq!(state, State::Ready { identity: Identity::Board(identity.clone()) });
        }
        let programmed = programmed_waveform(&board).expect("still programmed");
        programmed.check_compatible(&waveform).expect("the same");
        assert_eq!(programmed.request.rx_antennas, waveform.request.rx_antennas);
    }
}

mod hard_cases {
    use super::*;

    /// Asserts that an incomplete entry of a device, which may disappear during a look, counts as no device.
    #[test]
    fn incomplete_and_malformed_devices_are_no_usb_devices() {
        let machine = Machine::with_board();
        let device = machine.roots().sys.join("devices/usb1/1-1");
        fs::write(device.join("idProduct"), "zz\n").expect("written");
        fs::write(device.join("serial"), [0xFF, 0xFE]).expect("written");
        let found = machine.found();
        assert!(matches!(found.as_slice(), [c] if c.belief == Belief::SerialPort && c.usb.is_none()), "{found:?}");
        fs::remove_file(machine.roots().sys.join("class/tty/ttyACM0/device")).expect("gone");
        assert_eq!(machine.found(), []);
    }

    /// Asserts that a board without port, because cdc_acm is absent, is still listed.
    #[test]
    fn a_board_without_driver_is_listed() {
        let machine = Machine::new();
        machine.plug("1-1", (0x058B, 0x0251), 5, "IFX CDC", "77");
        let found = machine.found();
        assert!(
            matches!(found.as_slice(), [c] if c.transport == Transport::Usb && ask(c, true) == State::NoDriver),
            "{found:?}"
        );
    }

    #[test]
    fn unknown_ports_are_asked_only_on_request() {
        let machine = Machine::new();
        machine.plug("1-1", (0x2341, 0x0043), 5, "Arduino Uno", "1");
        machine.add_node("1-1", "tty", "ttyACM0", "");
        let found = machine.found();
        let [port] = found.as_slice() else { panic!("{found:?}") };
        assert_eq!((port.belief, port.address(), ask(port, false)), (Belief::SerialPort, None, State::NotAsked));
        // Here the port is a plain file, which cannot be opened as a port.
        assert!(matches!(ask(port, true), State::NotAnswering { .. }));
    }
}
