//! The board's end of its line: a terminal or the endpoints of a USB device.

use std::ffi::OsStr;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_getfl, fcntl_setfl, open};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::protocol::strata::bulk::MAX_BULK;
use crate::usb::DeviceSockets;

/// Where the board's line is to be.
#[derive(Debug, Clone)]
pub(super) enum Place {
    /// A new pseudo-terminal, whose far end looks like a serial port.
    Pseudoterminal {
        /// Symbolic link to it.
        link: Option<PathBuf>,
    },
    /// A terminal that is there already, such as the board's end of a USB gadget.
    Terminal(PathBuf),
    /// A folder for the endpoints of a USB device.
    Endpoints(PathBuf),
}

impl Place {
    /// In words.
    pub fn description(&self) -> String {
        match self {
            Place::Pseudoterminal { link: Some(link) } => format!("a pseudo-terminal with the link {}", link.display()),
            Place::Pseudoterminal { link: None } => "a pseudo-terminal".into(),
            Place::Terminal(path) => format!("a line of the terminal {}", path.display()),
            Place::Endpoints(folder) => format!("sockets in the folder {}", folder.display()),
        }
    }

    /// Plugs the board in.
    pub fn open(&self) -> io::Result<Port> {
        match self {
            Place::Pseudoterminal { .. } => Terminal::new().map(Port::Terminal),
            Place::Terminal(path) => Terminal::open(path).map(Port::Terminal),
            Place::Endpoints(folder) => DeviceSockets::bind(folder).map(Port::Endpoints),
        }
    }
}

pub(super) enum Port {
    Terminal(Terminal),
    Endpoints(DeviceSockets),
    /// Unplugged.
    Gone,
}

impl Port {
    /// Where the host finds it.
    pub fn path(&self) -> &Path {
        match self {
            Port::Terminal(terminal) => &terminal.path,
            Port::Endpoints(sockets) => sockets.folder(),
            Port::Gone => Path::new(""),
        }
    }

    /// Waits until there is something to read, or room to write if `write` is set, at most so long.
    pub fn wait(&self, write: bool, timeout: Duration) -> io::Result<()> {
        match self {
            Port::Terminal(terminal) => terminal.wait(write, timeout),
            Port::Endpoints(sockets) => sockets.wait(write, timeout),
            Port::Gone => Ok(()),
        }
    }

    /// Writes what there is room for; 0 if none. What is written to endpoints at once is one bulk transfer.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            _ if bytes.is_empty() => Ok(0),
            Port::Gone => Ok(0),
            Port::Terminal(terminal) => terminal.write(bytes),
            Port::Endpoints(sockets) => sockets.write(bytes.get(..MAX_BULK).unwrap_or(bytes)),
        }
    }

    /// From now on [`Port::has_client`] tells whether a client has the port open, where it can be told.
    pub fn watch_clients(&mut self) {
        if let Port::Terminal(terminal) = self {
            terminal.slave = None;
        }
    }

    /// Whether a client has the port open.
    pub fn has_client(&self) -> io::Result<bool> {
        match self {
            Port::Terminal(terminal) if terminal.is_pseudo => terminal.has_client(),
            _ => Ok(true),
        }
    }

    /// Whether the line has been cut from the other side.
    pub fn is_hung_up(&self) -> bool {
        matches!(self, Port::Terminal(terminal) if terminal.hung_up)
    }
}

pub(super) struct Terminal {
    line: OwnedFd,
    /// Kept open where a client that closes the port is not to hang up the line.
    slave: Option<OwnedFd>,
    path: PathBuf,
    /// Whether the other end is a pseudo-terminal's: it comes and goes with clients.
    is_pseudo: bool,
    hung_up: bool,
}

impl Terminal {
    fn new() -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let path = PathBuf::from(OsStr::from_bytes(ptsname(&master, Vec::new())?.as_bytes()));
        let slave = open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
        make_raw(&slave)?;
        fcntl_setfl(&master, fcntl_getfl(&master)? | OFlags::NONBLOCK)?;
        Ok(Terminal { line: master, slave: Some(slave), path, is_pseudo: true, hung_up: false })
    }

    fn open(path: &Path) -> io::Result<Self> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC | OFlags::NONBLOCK;
        let line = open(path, flags, Mode::empty())?;
        make_raw(&line)?;
        Ok(Terminal { line, slave: None, path: path.into(), is_pseudo: false, hung_up: false })
    }

    fn wait(&self, write: bool, timeout: Duration) -> io::Result<()> {
        let interest = if write { PollFlags::IN | PollFlags::OUT } else { PollFlags::IN };
        let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
        match poll(&mut [PollFd::new(&self.line, interest)], Some(&timeout)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    fn has_client(&self) -> io::Result<bool> {
        let mut state = [PollFd::new(&self.line, PollFlags::IN)];
        poll(&mut state, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }))?;
        let [state] = state;
        Ok(self.slave.is_some() || !state.revents().contains(PollFlags::HUP))
    }

    /// Reads what is there; 0 if nothing.
    pub fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let result = rustix::io::read(&self.line, buffer);
        // A terminal that is hung up reads as ended.
        self.hung_up |= !self.is_pseudo && matches!(result, Ok(0) | Err(rustix::io::Errno::IO));
        none_if_would_block(result)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let result = rustix::io::write(&self.line, bytes);
        self.hung_up |= !self.is_pseudo && matches!(result, Err(rustix::io::Errno::IO));
        none_if_would_block(result)
    }
}

fn make_raw(terminal: &OwnedFd) -> io::Result<()> {
    let mut settings = tcgetattr(terminal)?;
    settings.make_raw();
    Ok(tcsetattr(terminal, OptionalActions::Now, &settings)?)
}

/// Makes a symbolic link to a terminal, in the place of a former one.
pub(super) fn link(terminal: &Path, link: &Path) -> io::Result<()> {
    let mut fresh = link.as_os_str().to_owned();
    fresh.push(".new");
    std::os::unix::fs::symlink(terminal, &fresh)?;
    std::fs::rename(&fresh, link)
}

fn none_if_would_block(result: rustix::io::Result<usize>) -> io::Result<usize> {
    use rustix::io::Errno;
    match result {
        // EIO: nobody has the other end open.
        Err(Errno::AGAIN | Errno::INTR | Errno::IO) => Ok(0),
        result => Ok(result?),
    }
}
