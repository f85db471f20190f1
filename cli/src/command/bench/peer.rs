//! Peer program that runs the same network, through `cli/bench/networks.py`.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde::Deserialize;

const SCRIPT: &str = include_str!("../../../bench/networks.py");

/// Network in a peer program, prepared and waiting for its turns.
pub struct Peer {
    /// Name; empty before its first turn.
    pub name: String,
    child: Child,
    /// Input of the peer; each line starts a turn.
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

#[derive(Deserialize)]
struct Turn {
    peer: String,
    milliseconds: Vec<f64>,
}

impl Peer {
    /// Prepares a network in PyTorch, or in onnxruntime if a folder with its file is given. Returns `None` where that
    /// fails. The reason is printed unless there is no Python at all.
    pub fn start(
        python: Option<&Path>,
        what: &str,
        network: &str,
        threads: usize,
        batch: usize,
        repeats: usize,
        onnx: Option<&Path>,
    ) -> Option<Self> {
        let mut command = Command::new(python.map_or_else(|| PathBuf::from("python3"), Path::to_owned));
        // The script is embedded in the program, so it is found from any working directory.
        command.args(["-c", SCRIPT, what, network, "--turns", "--threads", &threads.to_string()]);
        command.args(["--batch", &batch.to_string(), "--repeats", &repeats.to_string()]);
        if let Some(folder) = onnx {
            command.arg("--onnx").arg(folder);
        }
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().ok()?;
        let (input, output) = (child.stdin.take(), child.stdout.take()?);
        let mut peer = Peer { name: String::new(), child, input, output: BufReader::new(output) };
        let mut ready = String::new();
        if peer.output.read_line(&mut ready).is_ok_and(|length| length > 0) {
            return Some(peer);
        }
        let stderr = peer.child.stderr.take().map(BufReader::new);
        let last_line = stderr.and_then(|stderr| stderr.lines().map_while(Result::ok).last());
        message!("no peer for {network}: {}", last_line.as_deref().unwrap_or("it failed without a message"));
        None
    }

    /// Runs a turn and returns the time of each run, ms; empty if it failed.
    pub fn turn(&mut self) -> Vec<f64> {
        let mut line = String::new();
        let is_requested =
            self.input.as_mut().is_some_and(|input| input.write_all(b"\n").and_then(|()| input.flush()).is_ok());
        if !is_requested || self.output.read_line(&mut line).is_err() {
            return Vec::new();
        }
        let Ok(turn) = serde_json::from_str::<Turn>(&line) else { return Vec::new() };
        self.name = turn.peer;
        turn.milliseconds
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // The peer exits at the end of its input.
        drop(self.input.take());
        let _ = self.child.wait();
    }
}
