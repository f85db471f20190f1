//! The board's end of a serial line: a pseudo-terminal whose far end looks like a serial port.

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

pub(super) struct Port {
    master: OwnedFd,
    /// Kept open where a client that closes the port is not to hang up the line.
    slave: Option<OwnedFd>,
    pub path: PathBuf,
}

impl Port {
    pub fn open() -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let path = PathBuf::from(OsStr::from_bytes(ptsname(&master, Vec::new())?.as_bytes()));
        let slave = open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
        let mut settings = tcgetattr(&slave)?;
        settings.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &settings)?;
        fcntl_setfl(&master, fcntl_getfl(&master)? | OFlags::NONBLOCK)?;
        Ok(Port { master, slave: Some(slave), path })
    }

    /// From now on [`Port::has_client`] tells whether a client has the port open.
    pub fn watch_clients(&mut self) {
        self.slave = None;
    }

    /// Whether a client has the port open.
    pub fn has_client(&self) -> io::Result<bool> {
        let mut state = [PollFd::new(&self.master, PollFlags::IN)];
        poll(&mut state, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }))?;
        let [state] = state;
        Ok(self.slave.is_some() || !state.revents().contains(PollFlags::HUP))
    }

    /// Makes a symbolic link to the terminal, in the place of a former one.
    pub fn link(&self, link: &Path) -> io::Result<()> {
        let mut fresh = link.as_os_str().to_owned();
        fresh.push(".new");
        std::os::unix::fs::symlink(&self.path, &fresh)?;
        std::fs::rename(&fresh, link)
    }

    /// Waits until there are bytes to read, or room to write if `write` is set, at most so long.
    pub fn wait(&self, write: bool, timeout: Duration) -> io::Result<()> {
        let interest = if write { PollFlags::IN | PollFlags::OUT } else { PollFlags::IN };
        let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
        match poll(&mut [PollFd::new(&self.master, interest)], Some(&timeout)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    /// Reads what is there; 0 if nothing.
    pub fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        none_if_would_block(rustix::io::read(&self.master, buffer))
    }

    /// Writes what there is room for; 0 if none.
    pub fn write(&self, bytes: &[u8]) -> io::Result<usize> {
        none_if_would_block(rustix::io::write(&self.master, bytes))
    }
}

fn none_if_would_block(result: rustix::io::Result<usize>) -> io::Result<usize> {
    use rustix::io::Errno;
    match result {
        // EIO: nobody has the other end open.
        Err(Errno::AGAIN | Errno::INTR | Errno::IO) => Ok(0),
        result => Ok(result?),
    }
}
