//! The board's end of its line: a terminal or the endpoints of a USB device.

use std::ffi::OsStr;
use std::io;
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::Duration;

use radome_files::parent_folder;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_getfl, fcntl_setfl, inotify, open};
use rustix::io::{Errno, retry_on_intr};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, socket_with};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflush, tcgetattr, tcsetattr};

use super::EmulatorError;
use crate::protocol::mcu7::bulk::MAX_BULK;
use crate::transport::usb::DeviceSockets;

/// Largest number of bytes of clients that are read at once while the port checks for clients.
const MOST_RECEIVED: usize = 65_536;

/// Line of the board to its host.
#[derive(Debug, Clone)]
pub(super) enum HostLine {
    /// A new pseudo-terminal, whose far end looks like a serial port.
    Pseudoterminal {
        /// Symbolic link to it.
        link: Option<PathBuf>,
    },
    /// An existing terminal, such as the board's end of a USB gadget.
    Terminal(PathBuf),
    /// A folder for the endpoints of a USB device.
    Endpoints(PathBuf),
}

impl HostLine {
    /// Description for messages.
    pub fn description(&self) -> String {
        match self {
            HostLine::Pseudoterminal { link: Some(link) } => {
                format!("a pseudo-terminal with the link {}", link.display())
            }
            HostLine::Pseudoterminal { link: None } => "a pseudo-terminal".into(),
            HostLine::Terminal(path) => format!("a line of the terminal {}", path.display()),
            HostLine::Endpoints(folder) => format!("sockets in the folder {}", folder.display()),
        }
    }

    /// Opens the line: plugs the board in.
    pub fn open(&self) -> io::Result<Port> {
        match self {
            HostLine::Pseudoterminal { .. } => Terminal::new().map(Port::Terminal),
            HostLine::Terminal(path) => Terminal::open(path).map(Port::Terminal),
            HostLine::Endpoints(folder) => DeviceSockets::bind(folder).map(Port::Endpoints),
        }
    }
}

pub(super) enum Port {
    Terminal(Terminal),
    Endpoints(DeviceSockets),
    /// The board is unplugged.
    Unplugged,
}

impl Port {
    /// Path for the host.
    pub fn path(&self) -> &Path {
        match self {
            Port::Terminal(terminal) => &terminal.path,
            Port::Endpoints(sockets) => sockets.folder(),
            Port::Unplugged => Path::new(""),
        }
    }

    /// Waits until there is something to read, or room to write if `write` is set, at most `timeout`.
    pub fn wait(&self, write: bool, timeout: Duration) -> io::Result<()> {
        match self {
            Port::Terminal(terminal) => terminal.wait(write, timeout),
            Port::Endpoints(sockets) => sockets.wait(write, timeout),
            Port::Unplugged => Ok(()),
        }
    }

    /// Writes the bytes that there is room for; returns their number. One write to endpoints is one bulk transfer.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            _ if bytes.is_empty() => Ok(0),
            Port::Unplugged => Ok(0),
            Port::Terminal(terminal) => terminal.write(bytes),
            Port::Endpoints(sockets) => sockets.write(bytes.get(..MAX_BULK).unwrap_or(bytes)),
        }
    }

    /// Makes [`Port::has_client`] detect clients, if the port supports it.
    pub fn watch_clients(&mut self) {
        if let Port::Terminal(terminal) = self {
            (terminal.slave, terminal.watch) = (None, None);
        }
    }

    /// Returns whether the last client has closed the port or was killed since this was last true. Its data on the line
    /// are discarded then, in both directions. Bytes of a client that has just taken its place are appended to
    /// `received`.
    pub fn has_disconnected(&mut self, received: &mut Vec<u8>) -> io::Result<bool> {
        match self {
            Port::Terminal(terminal) => terminal.has_disconnected(received),
            Port::Endpoints(sockets) => Ok(sockets.has_disconnected()),
            Port::Unplugged => Ok(false),
        }
    }

    /// Returns whether a host has yet to read what was written to it.
    pub fn holds_unread(&self) -> bool {
        matches!(self, Port::Terminal(terminal) if terminal.holds_unread())
    }

    /// Returns whether a client has the port open.
    pub fn has_client(&self) -> io::Result<bool> {
        match self {
            Port::Terminal(terminal) if terminal.is_pseudo => terminal.has_client(),
            _ => Ok(true),
        }
    }

    /// Returns whether the line has been cut from the other side.
    pub fn is_hung_up(&self) -> bool {
        matches!(self, Port::Terminal(terminal) if terminal.hung_up)
    }
}

pub(super) struct Terminal {
    line: OwnedFd,
    /// The board's own handle of the terminal, open so that a client that closes the port does not hang up the line.
    /// It is closed while the board finds out whether its last client has left.
    slave: Option<OwnedFd>,
    /// Watch on the terminal, if the board notices when clients leave.
    watch: Option<TerminalWatch>,
    /// Whether a client may have left since the board last found that nobody has the terminal open.
    client_may_have_left: bool,
    path: PathBuf,
    /// Whether the other end is a pseudo-terminal, which clients open and close.
    is_pseudo: bool,
    hung_up: bool,
}

/// Watch on a terminal's node. It reports the board's own openings and closings too.
struct TerminalWatch {
    events: OwnedFd,
}

/// Openings and closings of a terminal since they were last read.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
struct Events {
    /// Whether there was a closing.
    any_closing: bool,
    /// Whether there was a closing after an opening.
    closing_after_opening: bool,
}

impl TerminalWatch {
    fn of(path: &Path) -> rustix::io::Result<Self> {
        let events = inotify::init(inotify::CreateFlags::CLOEXEC | inotify::CreateFlags::NONBLOCK)?;
        inotify::add_watch(&events, path, inotify::WatchFlags::OPEN | inotify::WatchFlags::CLOSE)?;
        Ok(TerminalWatch { events })
    }

    /// Reads the events since the last call.
    fn read(&self) -> Events {
        let mut buffer = [MaybeUninit::uninit(); 1024];
        let mut reader = inotify::Reader::new(&self.events, &mut buffer);
        let (mut events, mut is_opened) = (Events::default(), false);
        loop {
            match reader.next() {
                Ok(event) if event.events().contains(inotify::ReadFlags::OPEN) => is_opened = true,
                // A queue that has overflowed counts as closings.
                Ok(_) => {
                    events.any_closing = true;
                    events.closing_after_opening |= is_opened;
                }
                Err(Errno::INTR) => {}
                Err(_) => return events,
            }
        }
    }
}

impl Terminal {
    fn new() -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let path = PathBuf::from(OsStr::from_bytes(ptsname(&master, Vec::new())?.as_bytes()));
        let slave = open_slave(&path)?;
        make_raw(&slave)?;
        fcntl_setfl(&master, fcntl_getfl(&master)? | OFlags::NONBLOCK)?;
        let watch = TerminalWatch::of(&path);
        if let Err(error) = &watch {
            tracing::warn!(%error, path = %path.display(), "the emulated board cannot tell when its clients go");
        }
        Ok(Terminal {
            line: master,
            slave: Some(slave),
            watch: watch.ok(),
            client_may_have_left: false,
            path,
            is_pseudo: true,
            hung_up: false,
        })
    }

    fn open(path: &Path) -> io::Result<Self> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC | OFlags::NONBLOCK;
        let line = open(path, flags, Mode::empty())?;
        make_raw(&line)?;
        Ok(Terminal {
            line,
            slave: None,
            watch: None,
            client_may_have_left: false,
            path: path.into(),
            is_pseudo: false,
            hung_up: false,
        })
    }

    fn wait(&self, write: bool, timeout: Duration) -> io::Result<()> {
        let interest = if write { PollFlags::IN | PollFlags::OUT } else { PollFlags::IN };
        let timeout = Timespec::try_from(timeout).ok();
        let line = PollFd::new(&self.line, interest);
        let result = match &self.watch {
            Some(watch) => poll(&mut [line, PollFd::new(&watch.events, PollFlags::IN)], timeout.as_ref()),
            None => poll(&mut [line], timeout.as_ref()),
        };
        match result {
            Ok(_) | Err(Errno::INTR) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    /// Implements [`Port::has_disconnected`]. While the board's own handle of the terminal is closed, and only then, the
    /// line is hung up if no client has the terminal open.
    ///
    /// The system reports a closing before it takes effect. After a closing, the board's own handle therefore stays
    /// closed until the line is hung up. The number of later reports does not matter.
    fn has_disconnected(&mut self, received: &mut Vec<u8>) -> io::Result<bool> {
        let Some(watch) = &self.watch else { return Ok(false) };
        self.client_may_have_left |= watch.read().any_closing;
        if !self.client_may_have_left {
            return Ok(false);
        }
        if let Some(slave) = self.slave.take() {
            // A client that was killed leaves the terminal reserved for itself.
            let _ = ioctl_tiocnxcl(&slave);
        }
        if !self.is_line_hung_up()? {
            return Ok(false);
        }
        let mut buffer = [0u8; 4096];
        // The read fails if no client has the terminal open and nothing is left to read.
        loop {
            if received.len() >= MOST_RECEIVED {
                return Ok(false);
            }
            match rustix::io::read(&self.line, &mut buffer[..]) {
                Ok(count) if count > 0 => received.extend_from_slice(buffer.get(..count).unwrap_or(&[])),
                // A client has opened the terminal meanwhile.
                Ok(_) | Err(Errno::AGAIN) => return Ok(false),
                Err(Errno::INTR) => {}
                Err(Errno::IO) => break,
                Err(e) => return Err(e.into()),
            }
        }
        received.clear();
        self.slave = match open_slave(&self.path) {
            Ok(slave) => Some(slave),
            // A client that has opened the port meanwhile has exclusive use. The board opens its own handle again when
            // that client leaves.
            Err(Errno::BUSY) => None,
            Err(e) => return Err(e.into()),
        };
        // Closings before the hang-up belong to this departure. A closing after a later opening is another departure.
        self.client_may_have_left = watch.read().closing_after_opening;
        if let Some(slave) = &self.slave {
            // Nothing has been written yet for a client that has opened the port meanwhile: all unread data were for
            // former clients.
            tcflush(slave, QueueSelector::IFlush)?;
        }
        Ok(true)
    }

    /// Returns whether no handle of the terminal is open, neither of a client nor of the board.
    fn is_line_hung_up(&self) -> io::Result<bool> {
        let mut state = [PollFd::new(&self.line, PollFlags::IN)];
        retry_on_intr(|| poll(&mut state, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })))?;
        let [state] = state;
        Ok(state.revents().contains(PollFlags::HUP))
    }

    fn has_client(&self) -> io::Result<bool> {
        Ok(self.slave.is_some() || !self.is_line_hung_up()?)
    }

    /// Implements [`Port::holds_unread`].
    fn holds_unread(&self) -> bool {
        let is_unread = |slave: &OwnedFd| rustix::io::ioctl_fionread(slave).is_ok_and(|bytes| bytes > 0);
        match &self.slave {
            Some(slave) => is_unread(slave),
            // A client has left and another is still there. A handle that is opened and closed again changes nothing for
            // it.
            None if self.watch.is_some() && self.is_line_hung_up().is_ok_and(|is_hung_up| !is_hung_up) => {
                open_slave(&self.path).is_ok_and(|slave| is_unread(&slave))
            }
            None => false,
        }
    }

    /// Reads the bytes that are there; returns 0 if none.
    pub fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let result = rustix::io::read(&self.line, buffer);
        // A terminal that is hung up reads as ended.
        self.hung_up |= !self.is_pseudo && matches!(result, Ok(0) | Err(Errno::IO));
        none_if_would_block(result)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let result = rustix::io::write(&self.line, bytes);
        self.hung_up |= !self.is_pseudo && matches!(result, Err(Errno::IO));
        none_if_would_block(result)
    }
}

fn open_slave(path: &Path) -> rustix::io::Result<OwnedFd> {
    open(path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())
}

fn make_raw(terminal: &OwnedFd) -> io::Result<()> {
    let mut settings = tcgetattr(terminal)?;
    settings.make_raw();
    Ok(tcsetattr(terminal, OptionalActions::Now, &settings)?)
}

/// Reserves the path of a link for one emulated board of this machine, until the returned descriptor is dropped. The
/// system releases it when the process ends.
///
/// # Errors
/// [`EmulatorError`] if another board has it, or the folder does not exist.
pub(super) fn claim(link: &Path) -> Result<OwnedFd, EmulatorError> {
    let failed = |source: io::Error| EmulatorError::Line { what: format!("the link {}", link.display()), source };
    let folder = parent_folder(link);
    let folder = folder.canonicalize().or_else(|_| std::path::absolute(folder)).map_err(failed)?;
    let path = folder.join(link.file_name().unwrap_or_default());
    let bytes = path.as_os_str().as_bytes();
    // A name has 107 bytes at most.
    let end_of_path = bytes.get(bytes.len().saturating_sub(80)..).unwrap_or(bytes);
    let mut name = format!("radome-link-{:08x}:", crc32fast::hash(bytes)).into_bytes();
    name.extend_from_slice(end_of_path);
    let address = SocketAddrUnix::new_abstract_name(&name).map_err(|e| failed(e.into()))?;
    let socket = socket_with(AddressFamily::UNIX, SocketType::DGRAM, SocketFlags::CLOEXEC, None)
        .map_err(|e| failed(e.into()))?;
    match bind(&socket, &address) {
        Ok(()) => Ok(socket),
        Err(Errno::ADDRINUSE) => Err(EmulatorError::LinkTaken { link: link.into() }),
        Err(e) => Err(failed(e.into())),
    }
}

/// Makes a symbolic link to a terminal. The remaining link of a former board is replaced.
///
/// # Errors
/// [`io::ErrorKind::AlreadyExists`] if the path is anything else; another error of the system if the link cannot be
/// made.
pub(super) fn link(terminal: &Path, link: &Path) -> io::Result<()> {
    match symlink(terminal, link) {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists && is_old_link(link) => {
            let mut new_link = link.as_os_str().to_owned();
            new_link.push(format!(".{}.new", std::process::id()));
            let _ = std::fs::remove_file(&new_link);
            symlink(terminal, &new_link)?;
            std::fs::rename(&new_link, link)
        }
        result => result,
    }
}

/// Returns whether a link points to a pseudo-terminal, or to nothing.
fn is_old_link(link: &Path) -> bool {
    std::fs::read_link(link).is_ok_and(|target| target.starts_with("/dev/pts") || !link.exists())
}

/// Removes the link if it points to this terminal.
pub(super) fn unlink(terminal: &Path, link: &Path) -> io::Result<()> {
    match std::fs::read_link(link) {
        Ok(target) if target == terminal => std::fs::remove_file(link),
        _ => Ok(()),
    }
}

fn none_if_would_block(result: rustix::io::Result<usize>) -> io::Result<usize> {
    match result {
        // EIO: no process has the other end open.
        Err(Errno::AGAIN | Errno::INTR | Errno::IO) => Ok(0),
        result => Ok(result?),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Write;

    use super::*;

    fn has_disconnected(terminal: &mut Terminal) -> (bool, Vec<u8>) {
        let mut received = Vec::new();
        let is_disconnected = terminal.has_disconnected(&mut received).expect("asks");
        (is_disconnected, received)
    }

    fn client(terminal: &Terminal) -> File {
        File::from(open_slave(&terminal.path).expect("opens"))
    }

    #[test]
    fn a_terminal_that_its_last_client_leaves_is_empty_in_both_directions() {
        let mut terminal = Terminal::new().expect("a terminal");
        assert_eq!(has_disconnected(&mut terminal), (false, vec![]), "nobody was there");
        let mut first = client(&terminal);
        first.write_all(b"half a req").expect("writes");
        let second = client(&terminal);
        assert_eq!(terminal.write(b"frames").expect("writes"), 6);
        drop(first);
        assert_eq!(has_disconnected(&mut terminal), (false, vec![]), "one is still there");
        let mut buffer = [0; 16];
        assert_eq!(terminal.read(&mut buffer).expect("reads"), 10, "what the first one wrote is still there");
        drop(second);
        assert_eq!(has_disconnected(&mut terminal), (true, vec![]));
        assert_eq!(has_disconnected(&mut terminal), (false, vec![]), "reported once");
        let port = Port::Terminal(terminal);
        assert!(!port.holds_unread());
    }

    #[test]
    fn data_of_a_client_that_has_left_are_never_read() {
        let mut terminal = Terminal::new().expect("a terminal");
        let mut gone = client(&terminal);
        gone.write_all(b"half a req").expect("writes");
        drop(gone);
        assert_eq!(has_disconnected(&mut terminal), (true, vec![]));
        let mut next = client(&terminal);
        next.write_all(b"hello").expect("writes");
        let mut buffer = [0; 16];
        assert_eq!(terminal.read(&mut buffer).expect("reads"), 5);
        assert_eq!(&buffer[..5], b"hello");
    }

    #[test]
    fn a_terminal_that_a_client_reserved_can_be_opened_after_it() {
        let mut terminal = Terminal::new().expect("a terminal");
        let gone = client(&terminal);
        rustix::termios::ioctl_tiocexcl(&gone).expect("reserves");
        drop(gone);
        assert_eq!(has_disconnected(&mut terminal), (true, vec![]));
        client(&terminal);
    }

    #[test]
    fn every_departure_is_noticed_once() {
        const ROUNDS: usize = 5000;
        let mut terminal = Terminal::new().expect("a terminal");
        let path = terminal.path.clone();
        let (turn, turns) = std::sync::mpsc::channel();
        let clients = std::thread::spawn(move || {
            while turns.recv().is_ok() {
                drop(open_slave(&path).expect("opens"));
            }
        });
        for round in 0..ROUNDS {
            turn.send(()).expect("there are clients");
            let start = std::time::Instant::now();
            while !has_disconnected(&mut terminal).0 {
                assert!(start.elapsed() < Duration::from_secs(60), "departure {round} is not noticed");
            }
        }
        drop(turn);
        clients.join().expect("clients end");
        assert_eq!(has_disconnected(&mut terminal), (false, vec![]), "nobody else was there");
    }

    #[test]
    fn a_closing_after_an_opening_is_distinguished_from_one_before_it() {
        let terminal = Terminal::new().expect("a terminal");
        let read = || terminal.watch.as_ref().expect("a watch").read();
        assert_eq!(read(), Events::default(), "nobody was there");
        let first = client(&terminal);
        assert_eq!(read(), Events::default(), "one has come");
        drop(first);
        let next = client(&terminal);
        assert_eq!(read(), Events { any_closing: true, closing_after_opening: false });
        drop(next);
        drop(client(&terminal));
        assert_eq!(read(), Events { any_closing: true, closing_after_opening: true });
    }

    #[test]
    fn a_link_belongs_to_one_board_at_a_time() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("board");
        let claimed = claim(&path).expect("free");
        // The claim holds for every path to the same folder.
        let other = folder.path().join(".").join("board");
        for link in [&path, &other] {
            assert!(matches!(claim(link), Err(EmulatorError::LinkTaken { .. })), "{}", link.display());
        }
        claim(&folder.path().join("another")).expect("another link");
        drop(claimed);
        claim(&path).expect("free again");
        let long = folder.path().join("x".repeat(200));
        let _claimed = claim(&long).expect("free");
        assert!(matches!(claim(&long), Err(EmulatorError::LinkTaken { .. })));
    }

    #[test]
    fn only_old_links_of_boards_are_replaced_and_only_the_own_link_is_removed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("board");
        let terminal = Path::new("/dev/pts/4242");
        for left in ["/dev/pts/4243", "/nowhere/at/all"] {
            symlink(left, &path).expect("links");
            link(terminal, &path).expect("replaces it");
            assert_eq!(std::fs::read_link(&path).expect("a link"), terminal);
            unlink(Path::new("/dev/pts/4243"), &path).expect("leaves it");
            unlink(terminal, &path).expect("removes it");
            assert!(std::fs::read_link(&path).is_err());
        }
        std::fs::write(&path, "mine").expect("writes");
        assert_eq!(link(terminal, &path).expect_err("a file").kind(), io::ErrorKind::AlreadyExists);
        std::fs::remove_file(&path).expect("removes");
        symlink(folder.path(), &path).expect("links");
        assert_eq!(link(terminal, &path).expect_err("a folder").kind(), io::ErrorKind::AlreadyExists);
        let names = std::fs::read_dir(folder.path()).expect("reads").count();
        assert_eq!(names, 1, "nothing is left beside it");
    }

    mod hard_cases {
        use super::*;

        /// Regression test: the system reports a closing before it takes effect. A board that looked in between never
        /// noticed that its client had gone.
        #[test]
        fn a_closing_that_is_reported_before_it_takes_effect_is_noticed_later() {
            let mut terminal = Terminal::new().expect("a terminal");
            let mut reported = client(&terminal);
            reported.write_all(b"half a req").expect("writes");
            // Stands for the client's handle until its closing takes effect.
            let closing = client(&terminal);
            drop(reported);
            assert_eq!(has_disconnected(&mut terminal), (false, vec![]), "it is still there");
            drop(closing);
            // No other closing is reported.
            terminal.watch.as_ref().expect("a watch").read();
            assert_eq!(has_disconnected(&mut terminal), (true, vec![]));
            assert_eq!(has_disconnected(&mut terminal), (false, vec![]), "reported once");
        }
    }
}
