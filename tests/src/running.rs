//! Program that runs while a test observes it.

use std::borrow::BorrowMut;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream, ToSocketAddrs};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::command;

/// Longest time that a test waits for an expected event: far longer than it takes on any machine.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// Lines that a program has written so far.
#[derive(Clone, Default)]
pub struct Lines(Arc<Mutex<Vec<String>>>);

impl Lines {
    fn from_stream(stream: impl Read + Send + 'static) -> Self {
        let lines = Lines::default();
        let kept = lines.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(stream).lines().map_while(Result::ok) {
                kept.0.lock().unwrap_or_else(PoisonError::into_inner).push(line);
            }
        });
        lines
    }

    /// Copy of all lines.
    pub fn all(&self) -> Vec<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn last(&self, count: usize) -> Vec<String> {
        let all = self.all();
        all[all.len().saturating_sub(count)..].to_vec()
    }

    /// Waits for the first line, from line `from` on, for which `pick` returns a value; returns that value.
    ///
    /// # Panics
    /// If no such line appears in time.
    pub fn find<T>(&self, from: usize, what: &str, pick: impl Fn(&str) -> Option<T>) -> T {
        wait_for(what, || self.all().iter().skip(from).find_map(|line| pick(line)))
    }
}

/// Waits until `look` returns a value.
///
/// # Panics
/// If that takes longer than [`PATIENCE`].
pub fn wait_for<T>(what: &str, look: impl FnMut() -> Option<T>) -> T {
    wait_up_to(PATIENCE, what, look)
}

/// Waits until `look` returns a value, for at most the time `patience`.
///
/// # Panics
/// If that takes longer than `patience`.
pub fn wait_up_to<T>(patience: Duration, what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(start.elapsed() < patience, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Sends these bytes to a server; returns as much of its answer as arrives.
pub fn send_request(address: impl ToSocketAddrs, request: impl AsRef<[u8]>) -> String {
    let mut answer = Vec::new();
    if let Ok(mut socket) = TcpStream::connect(address) {
        // Whoever waits for an answer can ask again.
        let _ = socket.set_read_timeout(Some(PATIENCE / 2));
        let _ = socket.write_all(request.as_ref());
        let _ = socket.read_to_end(&mut answer);
    }
    String::from_utf8_lossy(&answer).into_owned()
}

/// Program that is killed when the test is over.
pub struct Running {
    child: Child,
    /// Lines that the program writes to stdout.
    pub stdout: Lines,
    /// Lines that the program writes to stderr.
    pub stderr: Lines,
}

impl Running {
    /// Starts the program.
    ///
    /// # Panics
    /// If the program cannot be started.
    pub fn start(mut command: impl BorrowMut<Command>) -> Self {
        let command: &mut Command = command.borrow_mut();
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|e| panic!("cannot run {command:?}: {e}"));
        let stdout = child.stdout.take().map(Lines::from_stream).unwrap_or_default();
        let stderr = child.stderr.take().map(Lines::from_stream).unwrap_or_default();
        Running { child, stdout, stderr }
    }

    /// Process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Port of its metrics, as it is told on stderr.
    ///
    /// # Panics
    /// If the program serves none.
    pub fn metrics_port(&self) -> u16 {
        self.stderr.find(0, "the metrics' address", |line| {
            line.strip_prefix("metrics: http://")?.strip_suffix("/metrics")?.rsplit(':').next()?.parse().ok()
        })
    }

    /// Whether the program still runs.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Sends the program a signal, named as for `kill -s`.
    ///
    /// # Panics
    /// If `kill` is not installed.
    pub fn signal(&self, name: &str) {
        let status = Command::new("kill").args(["-s", name, &self.id().to_string()]).status();
        assert!(status.is_ok_and(|status| status.success()), "kill -s {name}");
    }

    /// Waits for the end of the program and for all of its output.
    ///
    /// # Panics
    /// If the program does not end.
    pub fn wait(&mut self) -> ExitStatus {
        let status = wait_for("the program's end", || self.child.try_wait().ok().flatten());
        // The reading threads need a moment for the rest of the pipes' content.
        std::thread::sleep(Duration::from_millis(200));
        status
    }
}

impl Drop for Running {
    /// Prints the last output of the program when the test has failed, since it may explain the failure.
    #[allow(clippy::print_stderr)]
    fn drop(&mut self) {
        let ended = self.child.try_wait();
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("process {}, {ended:?} when the test failed, last said:", self.id());
            for line in self.stdout.last(5).iter().chain(&self.stderr.last(20)) {
                eprintln!("    {line}");
            }
        }
    }
}

/// Starts an emulated board that serves a source with these options. Returns the board and its port.
///
/// # Panics
/// If the board does not start.
pub fn emulated_board(from: &Path, options: &[&str]) -> (Running, String) {
    let board = Running::start(command!("board emulate", ..options, "--from", from));
    let port = board.stdout.find(0, "the board's port", |line| Some(line.to_owned()));
    (board, port)
}

/// Kills the emulated board of a port, as if somebody pulled its plug. If the port is a link to a terminal, the link goes
/// first: the system soon gives the terminal's number to another test's board, which a client that searches for its own
/// must not open.
///
/// # Panics
/// If the link cannot be removed.
pub fn unplug(board: &Running, port: &str) {
    if Path::new(port).is_symlink() {
        std::fs::remove_file(port).unwrap_or_else(|e| panic!("{port}: {e}"));
    }
    board.signal("KILL");
}

/// Port that nothing listens on. Neither another test of this process nor an outgoing connection takes it meanwhile:
/// the kernel hands out ports above 32768.
///
/// # Panics
/// If no port is free.
pub fn free_port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    const PORTS: std::ops::Range<u16> = 20_000..32_000;
    let first = (std::process::id() % u32::from(PORTS.end - PORTS.start)) as u16;
    for _ in PORTS {
        let offset = first.wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed)) % (PORTS.end - PORTS.start);
        let port = PORTS.start + offset;
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
    panic!("no port of {PORTS:?} is free")
}
