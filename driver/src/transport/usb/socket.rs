//! The endpoints of an emulated device as two sockets in a folder, `ep0` and `ep1`, for machines without USB. Every
//! message is one transfer; a bulk transfer waits in the socket until the host reads it, as it waits in a device.
//!
//! Control: the host sends a setup packet and the data of an OUT transfer. The device answers with a byte (0 done, 1
//! stall) and the data of an IN transfer. Bulk: the device sends.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, SocketAddrUnix, SocketFlags, SocketType, accept_with, bind, connect, listen,
    recv, send, socket_with,
};

use super::endpoints::{CONTROL_TIMEOUT, Endpoints, Setup, TransferError};

const DONE: u8 = 0;
const STALL: u8 = 1;
const NAMES: [&str; 2] = ["ep0", "ep1"];

fn socket(flags: SocketFlags) -> io::Result<OwnedFd> {
    Ok(socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags | SocketFlags::CLOEXEC, None)?)
}

/// Waits until something can be received, at most `timeout`; returns whether it can.
fn can_receive(socket: &OwnedFd, timeout: Duration) -> io::Result<bool> {
    let end = Instant::now() + timeout;
    loop {
        let left = Timespec::try_from(end.duration_since(Instant::now())).ok();
        match poll(&mut [PollFd::new(socket, PollFlags::IN)], left.as_ref()) {
            Ok(ready) => return Ok(ready > 0),
            Err(Errno::INTR) => {}
            Err(e) => return Err(e.into()),
        }
    }
}

/// The host's side.
pub(crate) struct HostSockets {
    pub control: OwnedFd,
    pub data: OwnedFd,
    message: Vec<u8>,
}

impl HostSockets {
    /// Connects to the sockets of an emulated device.
    ///
    /// # Errors
    /// The folder has no sockets, or no device listens to them.
    pub fn connect(folder: &Path) -> io::Result<Self> {
        let connect_to = |name| -> io::Result<OwnedFd> {
            let socket = socket(SocketFlags::empty())?;
            connect(&socket, &SocketAddrUnix::new(folder.join(name))?)?;
            Ok(socket)
        };
        let [control, data] = NAMES;
        Ok(HostSockets {
            control: connect_to(control)?,
            data: connect_to(data)?,
            message: vec![0; 1 + usize::from(u16::MAX)],
        })
    }

    /// Makes a control transfer; returns the data of an IN transfer.
    ///
    /// # Errors
    /// [`TransferError`] if the device refuses the transfer, is silent or is gone.
    pub fn transfer(&mut self, setup: &Setup, data: &[u8]) -> Result<&[u8], TransferError> {
        let lost = TransferError::Lost;
        let request = [setup, data].concat();
        send(&self.control, &request, SendFlags::NOSIGNAL).map_err(|e| lost(e.into()))?;
        if !can_receive(&self.control, CONTROL_TIMEOUT).map_err(lost)? {
            return Err(TransferError::Timeout);
        }
        let (count, _) = recv(&self.control, &mut self.message[..], RecvFlags::empty()).map_err(|e| lost(e.into()))?;
        match self.message.get(..count) {
            Some([DONE, data @ ..]) => Ok(data),
            Some([_, ..]) => Err(TransferError::Stall),
            _ => Err(lost(io::ErrorKind::UnexpectedEof.into())),
        }
    }
}

impl Endpoints for HostSockets {
    fn control_out(&mut self, setup: &Setup, data: &[u8]) -> Result<(), TransferError> {
        self.transfer(setup, data).map(|_| ())
    }

    fn control_in(&mut self, setup: &Setup, buffer: &mut [u8]) -> Result<usize, TransferError> {
        let data = self.transfer(setup, &[])?;
        let count = data.len().min(buffer.len());
        buffer.iter_mut().zip(data).for_each(|(to, from)| *to = *from);
        Ok(count)
    }

    fn read_bulk(&mut self, buffer: &mut [u8], timeout: Duration) -> Result<usize, TransferError> {
        if !can_receive(&self.data, timeout).map_err(TransferError::Lost)? {
            return Ok(0);
        }
        match recv(&self.data, buffer, RecvFlags::empty()) {
            Ok((0, _)) => Err(TransferError::Lost(io::ErrorKind::UnexpectedEof.into())),
            Ok((count, _)) => Ok(count),
            Err(e) => Err(TransferError::Lost(e.into())),
        }
    }
}

/// The device's side. Its sockets are removed with it, and so is the folder if it was created for them.
pub(crate) struct DeviceSockets {
    folder: PathBuf,
    created_folder: bool,
    listeners: [OwnedFd; 2],
    /// The host's control and bulk connections.
    host: [Option<OwnedFd>; 2],
    /// Whether a host has disconnected, which [`DeviceSockets::has_disconnected`] has not reported yet.
    has_disconnected: bool,
}

impl DeviceSockets {
    /// Creates the folder, or takes an existing one and replaces sockets that an emulated device has left in it.
    ///
    /// # Errors
    /// The folder or a socket in it cannot be created, or a file that is no socket has the name of one.
    pub fn bind(folder: &Path) -> io::Result<Self> {
        // Nothing is removed before both names are known to be free.
        let old_sockets: Vec<PathBuf> =
            NAMES.map(|name| folder.join(name)).into_iter().filter(|path| exists(path)).collect();
        if let Some(other) = old_sockets.iter().find(|path| !is_socket(path)) {
            let why = format!("{} is no socket that an emulated board has left", other.display());
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
        }
        // A folder with sockets was left by an emulated device, which may have created it. It is removed in the end, because
        // an empty folder is no loss.
        let created_folder = !folder.exists() || !old_sockets.is_empty();
        std::fs::create_dir_all(folder)?;
        old_sockets.iter().try_for_each(std::fs::remove_file)?;
        let listen_at = |name| -> io::Result<OwnedFd> {
            let path = folder.join(name);
            let socket = socket(SocketFlags::NONBLOCK)?;
            bind(&socket, &SocketAddrUnix::new(&path)?)?;
            listen(&socket, 1)?;
            Ok(socket)
        };
        let [control, data] = NAMES;
        Ok(DeviceSockets {
            folder: folder.into(),
            created_folder,
            listeners: [listen_at(control)?, listen_at(data)?],
            host: [None, None],
            has_disconnected: false,
        })
    }

    /// Folder to which the host connects.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Waits until there is a control transfer or a new host, or room for a bulk transfer if `write` is set, at most
    /// `timeout`.
    pub fn wait(&self, write: bool, timeout: Duration) -> io::Result<()> {
        let [control, data] = &self.host;
        let free_listeners = self.listeners.iter().zip(&self.host).filter(|(_, host)| host.is_none());
        let mut interests: Vec<PollFd<'_>> = free_listeners.map(|(l, _)| PollFd::new(l, PollFlags::IN)).collect();
        interests.extend(control.iter().map(|c| PollFd::new(c, PollFlags::IN)));
        if write {
            interests.extend(data.iter().map(|d| PollFd::new(d, PollFlags::OUT)));
        }
        match poll(&mut interests, Timespec::try_from(timeout).ok().as_ref()) {
            Ok(_) | Err(Errno::INTR) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    /// Reads a control transfer, setup packet and data; returns 0 if there is none.
    pub fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        for (listener, host) in self.listeners.iter().zip(&mut self.host) {
            if host.is_none() {
                match accept_with(listener, SocketFlags::NONBLOCK | SocketFlags::CLOEXEC) {
                    Ok(socket) => *host = Some(socket),
                    Err(Errno::AGAIN | Errno::INTR | Errno::CONNABORTED) => {}
                    Err(e) => return Err(e.into()),
                }
            }
        }
        let Some(control) = &self.host[0] else { return Ok(0) };
        match recv(control, buffer, RecvFlags::empty()) {
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            // The host has disconnected.
            Ok((0, _)) | Err(Errno::CONNRESET) => {
                (self.host, self.has_disconnected) = ([None, None], true);
                Ok(0)
            }
            Ok((count, _)) => Ok(count),
            Err(e) => Err(e.into()),
        }
    }

    /// Returns whether the host has disconnected since the last call.
    pub fn has_disconnected(&mut self) -> bool {
        std::mem::take(&mut self.has_disconnected)
    }

    /// Answers the control transfer: with the data of an IN transfer, with nothing for an OUT transfer, or by a stall.
    pub fn answer(&mut self, data: Option<&[u8]>) -> io::Result<()> {
        let message = match data {
            Some(data) => [&[DONE], data].concat(),
            None => vec![STALL],
        };
        let Some(control) = &self.host[0] else { return Ok(()) };
        match send(control, &message, SendFlags::NOSIGNAL) {
            // A host that has disconnected or does not read loses it.
            Ok(_) | Err(Errno::AGAIN | Errno::INTR | Errno::PIPE | Errno::CONNRESET) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    /// Sends a bulk transfer; returns 0 if the host has not read the earlier ones.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Some(data) = &self.host[1] else { return Ok(0) };
        match send(data, bytes, SendFlags::NOSIGNAL) {
            Err(Errno::AGAIN | Errno::INTR | Errno::PIPE | Errno::CONNRESET) => Ok(0),
            result => Ok(result?),
        }
    }
}

impl Drop for DeviceSockets {
    fn drop(&mut self) {
        for name in NAMES {
            let _ = std::fs::remove_file(self.folder.join(name));
        }
        // A folder that holds other files stays.
        if self.created_folder {
            let _ = std::fs::remove_dir(&self.folder);
        }
    }
}

/// Returns whether something has this path, be it a link to nothing.
fn exists(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok()
}

fn is_socket(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|metadata| metadata.file_type().is_socket())
}

#[cfg(test)]
mod tests {
    use super::*;

    mod hard_cases {
        use super::*;

        /// Regression test: files of the user with the names of the endpoints were removed, and an empty folder too.
        #[test]
        fn files_that_are_no_sockets_and_folders_of_the_user_stay() {
            let scratch = tempfile::tempdir().expect("a folder");
            let folder = scratch.path().join("own");
            std::fs::create_dir(&folder).expect("a folder");
            drop(DeviceSockets::bind(&folder).expect("an empty folder"));
            assert!(folder.is_dir() && !folder.join("ep0").exists());
            std::fs::write(folder.join("ep1"), "precious").expect("a file");
            let refused = DeviceSockets::bind(&folder).err().expect("a refusal");
            assert!(refused.to_string().contains("ep1 is no socket"), "{refused}");
            assert_eq!(std::fs::read_to_string(folder.join("ep1")).expect("the file"), "precious");
            // Sockets that were left are replaced, and a folder that was created goes with its sockets.
            let created = scratch.path().join("made");
            std::mem::forget(DeviceSockets::bind(&created).expect("a new folder"));
            drop(DeviceSockets::bind(&created).expect("left sockets"));
            assert!(!created.exists());
        }
    }
}
