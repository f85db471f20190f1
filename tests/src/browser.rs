//! Headless Chromium, driven over the DevTools protocol: <https://chromedevtools.github.io/devtools-protocol>.

use std::borrow::BorrowMut;
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use crate::running::{PATIENCE, Running};
use crate::skip;

/// WebSocket connection of a page to the program.
pub type Socket = WebSocket<MaybeTlsStream<TcpStream>>;

/// Connects to the page's stream without a browser; the socket delivers the messages that the program sends to the
/// page.
///
/// # Panics
/// If there is no page at this address.
pub fn page(address: &str) -> Socket {
    connect(&format!("ws://{address}/stream"))
}

fn connect(url: &str) -> Socket {
    let (socket, _) = tungstenite::connect(url).unwrap_or_else(|e| panic!("{url}: {e}"));
    if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    }
    socket
}

/// Browser with one page, closed when dropped.
pub struct Browser {
    child: Child,
    socket: Socket,
    session: String,
    next_id: u64,
    /// Errors that scripts of the page threw or logged.
    pub faults: Vec<String>,
    _profile: tempfile::TempDir,
}

impl Browser {
    /// Opens a page. Returns `None` and counts the test as skipped where Chromium is not installed.
    ///
    /// # Panics
    /// If Chromium is installed but does not answer as expected. This holds for all other methods too.
    pub fn open(url: &str, width: u32, height: u32) -> Option<Browser> {
        let program = std::env::var_os("RADOME_CHROMIUM").unwrap_or_else(|| "chromium".into());
        let profile = tempfile::tempdir().expect("a folder");
        let spawned = Command::new(program)
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
            .args(["--disable-dev-shm-usage", "--enable-precise-memory-info", "--js-flags=--expose-gc"])
            .args(["--remote-debugging-port=0", "--remote-allow-origins=*"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        let Ok(mut child) = spawned else {
            skip("chromium", "tests/run installs it, RADOME_CHROMIUM names another");
            return None;
        };
        let mut said = BufReader::new(child.stderr.take().expect("piped")).lines();
        let endpoint = said
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| line.strip_prefix("DevTools listening on ").map(str::to_owned))
            .expect("Chromium starts and names its DevTools");
        // Drains the browser's stderr, so that its pipe never fills up.
        std::thread::spawn(move || said.count());
        let socket = connect(&endpoint);
        let mut browser =
            Browser { child, socket, session: String::new(), next_id: 0, faults: Vec::new(), _profile: profile };
        let target = browser.call("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        browser.session = browser.call("Target.attachToTarget", attach)["sessionId"].as_str().expect("one").to_owned();
        browser.call("Page.enable", json!({}));
        browser.call("Runtime.enable", json!({}));
        browser.call("Log.enable", json!({}));
        browser.resize(width, height, 1.0);
        browser.call("Page.navigate", json!({ "url": url }));
        Some(browser)
    }

    /// Calls one method of the protocol.
    ///
    /// # Panics
    /// If the browser answers with an error or not at all.
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.next_id += 1;
        let id = self.next_id;
        let mut message = json!({ "id": id, "method": method, "params": parameters });
        if !self.session.is_empty() && !method.starts_with("Target.") && !method.starts_with("Browser.") {
            message["sessionId"] = self.session.clone().into();
        }
        self.socket.send(Message::text(message.to_string())).expect("Chromium listens");
        loop {
            let answer = self.socket.read().expect("Chromium answers");
            let Ok(text) = answer.to_text() else { continue };
            let Ok(answer) = serde_json::from_str::<Value>(text) else { continue };
            match answer["method"].as_str() {
                Some("Runtime.exceptionThrown") => {
                    self.faults.push(answer["params"]["exceptionDetails"].to_string());
                }
                Some("Log.entryAdded") if answer["params"]["entry"]["level"] == "error" => {
                    self.faults.push(answer["params"]["entry"].to_string());
                }
                _ => {}
            }
            if answer["id"] == id {
                assert!(answer.get("error").is_none(), "{method}: {answer}");
                return answer["result"].clone();
            }
        }
    }

    /// Sets the size of the page, CSS pixels, and the number of device pixels per CSS pixel.
    pub fn resize(&mut self, width: u32, height: u32, scale: f64) {
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": scale, "mobile": width < 600 });
        self.call("Emulation.setDeviceMetricsOverride", metrics);
    }

    /// Evaluates an expression in the page and returns its value.
    ///
    /// # Panics
    /// If the expression throws, or the browser does not answer.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let result = self.call("Runtime.evaluate", parameters);
        assert!(result.get("exceptionDetails").is_none(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until an expression holds.
    ///
    /// # Panics
    /// If the expression does not hold in time.
    pub fn wait_until(&mut self, expression: &str) {
        let end = Instant::now() + PATIENCE;
        while self.evaluate(&format!("Boolean({expression})")) != Value::Bool(true) {
            let header = "JSON.stringify([radome.header?.answer, radome.labels, radome.playback, radome.state])";
            assert!(Instant::now() < end, "never: {expression}; {}", self.evaluate(header));
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Presses a key: a character, or a name such as `ArrowLeft`.
    pub fn key(&mut self, key: &str) {
        let code = match key {
            " " => 32,
            "Tab" => 9,
            "Enter" => 13,
            "Escape" => 27,
            "End" => 35,
            "Home" => 36,
            "ArrowLeft" => 37,
            "ArrowUp" => 38,
            "ArrowRight" => 39,
            "ArrowDown" => 40,
            _ => 0,
        };
        let mut down = json!({ "type": "keyDown", "key": key, "windowsVirtualKeyCode": code });
        if key.chars().count() == 1 || key == "Enter" {
            down["text"] = if key == "Enter" { "\r".into() } else { key.into() };
        }
        self.call("Input.dispatchKeyEvent", down);
        self.call("Input.dispatchKeyEvent", json!({ "type": "keyUp", "key": key, "windowsVirtualKeyCode": code }));
    }

    /// Drags the mouse from one position of the page to another.
    pub fn drag(&mut self, from: (f64, f64), to: (f64, f64)) {
        let mut mouse = |kind: &str, (x, y): (f64, f64), buttons: u32| {
            self.call(
                "Input.dispatchMouseEvent",
                json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": 1 }),
            );
        };
        mouse("mouseMoved", from, 0);
        mouse("mousePressed", from, 1);
        mouse("mouseMoved", (0.5 * (from.0 + to.0), 0.5 * (from.1 + to.1)), 1);
        mouse("mouseMoved", to, 1);
        mouse("mouseReleased", to, 0);
    }

    /// Saves a screenshot of the page as PNG.
    ///
    /// # Panics
    /// If the browser does not answer, or the file cannot be written.
    pub fn screenshot(&mut self, path: &Path) {
        let picture = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        let text = picture["data"].as_str().expect("base64");
        std::fs::write(path, BASE64_STANDARD.decode(text).expect("base64")).expect("writable");
    }

    /// Size of the page's JavaScript heap after garbage collection, bytes.
    ///
    /// # Panics
    /// If the browser does not answer.
    pub fn heap_bytes(&mut self) -> f64 {
        self.call("HeapProfiler.collectGarbage", json!({}));
        self.call("Runtime.getHeapUsage", json!({}))["usedSize"].as_f64().expect("bytes")
    }

    /// Process id of the browser.
    pub fn id(&self) -> u32 {
        self.child.id()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let close = json!({ "id": u32::MAX, "method": "Browser.close" });
        let asked = self.socket.send(Message::text(close.to_string())).is_ok();
        let end = Instant::now() + Duration::from_secs(10);
        while asked && Instant::now() < end && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Running program that serves a page, killed when dropped.
pub struct Served {
    /// The program.
    pub program: Running,
    /// Local address of the page, whatever other addresses it is served at: `127.0.0.1:PORT`.
    pub address: String,
    /// Token in the link that the program prints, if there is one.
    pub token: Option<String>,
}

impl Served {
    /// Starts a command, to which it adds `--view` and an address that only this machine reaches.
    ///
    /// # Panics
    /// If the program serves no page.
    pub fn start(command: impl BorrowMut<Command>) -> Served {
        Served::start_at("127.0.0.1:0", command)
    }

    /// Starts a command, to which it adds `--view` and the address `listen`.
    ///
    /// # Panics
    /// If the program serves no page.
    pub fn start_at(listen: &str, mut command: impl BorrowMut<Command>) -> Served {
        let program = Running::start(command.borrow_mut().args(["--view", "--listen", listen]));
        let link = |line: &str| line.strip_prefix("live page: http://").map(str::to_owned);
        let link = program.stderr.find(0, "the page's address", link);
        let (host, path) = link.split_once('/').unwrap_or((&link, ""));
        let port = host.rsplit(':').next().unwrap_or_default();
        let token = path.strip_prefix("?token=").filter(|token| !token.contains(' ')).map(str::to_owned);
        Served { program, address: format!("127.0.0.1:{port}"), token }
    }

    /// URL of the page for browsers.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Interrupts the program, waits for its end and returns whether it ended successfully.
    ///
    /// # Panics
    /// If the program does not end.
    pub fn stop(mut self) -> bool {
        self.program.signal("INT");
        self.program.wait().success()
    }
}
