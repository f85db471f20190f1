//! Tests of the home integrations from outside: a real MQTT broker, a metrics client, systemd's socket, and hostile
//! clients.

use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use radome_tests::running::{Running, emulated_board, free_port, send_request, wait_for};
use radome_tests::{
    command, emulated_corridor, fixture, installed, json_lines, labels_of, live_command, outcome, skip,
};
use serde_json::Value;

/// Id of the emulated board.
const ID: &str = "000102030405060708090a0b0c0d0e0f";

/// Private mosquitto broker.
struct Broker {
    folder: tempfile::TempDir,
    port: u16,
    process: Option<Running>,
}

impl Broker {
    /// Prepares the broker on a free port. Returns `None` and counts the test as skipped where mosquitto is not
    /// installed.
    fn prepare() -> Option<Self> {
        if ["mosquitto", "mosquitto_sub", "mosquitto_pub"].into_iter().any(|name| installed(name).is_none()) {
            skip("mosquitto", "tests/run installs mosquitto and mosquitto-clients");
            return None;
        }
        let folder = tempfile::tempdir().expect("a folder");
        let port = free_port();
        let settings = format!("listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\n");
        std::fs::write(folder.path().join("mosquitto.conf"), settings).expect("writable");
        Some(Broker { folder, port, process: None })
    }

    fn start(&mut self) {
        let mut command = Command::new(installed("mosquitto").expect("there"));
        let settings = self.folder.path().join("mosquitto.conf");
        let process = self.process.insert(Running::start(command.arg("-c").arg(settings)));
        wait_for("the broker", || TcpStream::connect(("127.0.0.1", self.port)).ok());
        assert!(process.is_running(), "something else listens on port {}", self.port);
    }

    fn url(&self) -> String {
        format!("mqtt://127.0.0.1:{}", self.port)
    }

    /// Subscribes to all messages, including retained ones.
    fn listen(&self) -> Running {
        let mut command = Command::new(installed("mosquitto_sub").expect("there"));
        let hub = Running::start(command.args(["-p", &self.port.to_string(), "-d", "-v", "-t", "#"]));
        hub.stdout.find(0, "the subscription", |line| line.contains("SUBACK").then_some(()));
        hub
    }

    fn publish(&self, topic: &str, options: &[&str]) {
        let mut command = Command::new(installed("mosquitto_pub").expect("there"));
        command.args(["-p", &self.port.to_string(), "-q", "1", "-t", topic]).args(options);
        assert!(command.status().expect("runs").success(), "{command:?}");
    }
}

/// Command that watches the corridor through an emulated board in real time, until stopped.
fn watch_command() -> Command {
    live_command(emulated_corridor(), "--speed 1 --json")
}

/// Terminates the program and returns its summary. Asserts that every frame was judged, except those that the emulated
/// board reports as lost on a busy machine.
fn stop_and_count(mut live: Running) -> Value {
    live.signal("TERM");
    assert!(live.wait().success(), "{:?}", live.stderr.all());
    let lines = live.stdout.all();
    let (last, lines) = lines.split_last().expect("some lines");
    let mut next = 0;
    for line in lines {
        let line: Value = serde_json::from_str(line).expect("JSON");
        match line["gap"]["frames"].as_u64() {
            Some(lost) => next += lost,
            None => {
                assert_eq!(line["sequence"], next, "a frame is missing");
                next += 1;
            }
        }
    }
    let summary: Value = serde_json::from_str(last).expect("a summary");
    let late = &summary["summary"]["dropped_by_reason"]["queue_full"];
    assert!(late.is_null(), "the classifier was held up: {summary}");
    summary["summary"].clone()
}

fn message_of_topic(line: &str, topic: &str) -> Option<String> {
    line.strip_prefix(topic)?.strip_prefix(' ').map(str::to_owned)
}

fn discovery_topic() -> String {
    format!("homeassistant/device/bgt60_{ID}/config")
}

fn count_messages(lines: &[String], topic: &str) -> usize {
    lines.iter().filter(|line| message_of_topic(line, topic).is_some()).count()
}

#[test]
fn the_hub_discovers_the_radar_and_receives_its_answers_and_its_end() {
    let Some(mut broker) = Broker::prepare() else { return };
    broker.start();
    let live = Running::start(watch_command().args(["--mqtt", &broker.url(), "--mqtt-name", "Corridor radar"]));
    let hub = broker.listen();
    let availability = format!("radome/{ID}/availability");
    let state = format!("radome/{ID}/state");
    live.stderr.find(0, "the topic", |line| line.ends_with(&format!("connected; answers go to {state}")).then_some(()));

    let found = hub.stdout.find(0, "discovery", |line| message_of_topic(line, &discovery_topic()));
    let found: Value = serde_json::from_str(&found).expect("JSON");
    assert_eq!((&found["dev"]["name"], &found["dev"]["mdl"]), (&"Corridor radar".into(), &"BGT60TR13C".into()));
    assert_eq!(found["dev"]["ids"], serde_json::json!([format!("bgt60_{ID}")]));
    assert_eq!((&found["avty_t"], &found["stat_t"]), (&availability.as_str().into(), &state.as_str().into()));
    assert!(found["o"]["name"] == "radome" && found["dev"]["sw"] != found["o"]["sw"], "{found}");
    let mut components = found["cmps"].as_object().expect("components").clone();
    // The hub removes a button that is sent with its platform alone, such as one of an earlier run.
    for button in ["report_empty", "report_one", "report_two"] {
        assert_eq!(components.remove(button), Some(serde_json::json!({ "p": "button" })), "{button}");
    }
    let names: Vec<&str> = components.keys().map(String::as_str).collect();
    assert_eq!(names, ["confidence", "count", "dropped", "occupancy"], "no buttons where nothing is kept");
    assert_eq!(components["occupancy"]["dev_cla"], "occupancy");
    let mut ids: Vec<_> = components.values().map(|c| c["uniq_id"].as_str().expect("an id")).collect();
    ids.dedup();
    assert_eq!(ids.len(), 4);

    hub.stdout.find(0, "online", |line| message_of_topic(line, &availability).filter(|m| m == "online"));
    let is_occupied = |line: &str| {
        let state: Value = serde_json::from_str(&message_of_topic(line, &state)?).ok()?;
        (state["occupancy"] == "ON").then_some(state)
    };
    let said = hub.stdout.find(0, "somebody", is_occupied);
    assert!(said["count"].as_u64().is_some_and(|count| count >= 1), "{said}");
    assert!(said["confidence"].as_f64().is_some_and(|c| (0.0..=1.0).contains(&c)) && said["dropped_frames"] == 0);

    // A later subscriber receives all of it as retained messages.
    let late = broker.listen();
    for topic in [&discovery_topic(), &availability, &state] {
        late.stdout.find(0, topic, |line| message_of_topic(line, topic));
    }

    // The hub restarts.
    let before = hub.stdout.all().len();
    broker.publish("homeassistant/status", &["-m", "online"]);
    hub.stdout.find(before, "a second announcement", |line| message_of_topic(line, &discovery_topic()));
    hub.stdout.find(before, "its state", |line| message_of_topic(line, &state));

    let before = hub.stdout.all().len();
    live.signal("KILL");
    let last = hub
        .stdout
        .find(before, "the last will", |line| message_of_topic(line, &availability).filter(|m| m == "offline"));
    assert_eq!(last, "offline");
}

#[test]
fn frames_are_classified_while_the_broker_is_away_and_answers_published_when_it_comes() {
    let Some(mut broker) = Broker::prepare() else { return };
    let live = Running::start(watch_command().args(["--mqtt", &broker.url()]));
    live.stderr.find(0, "a word about the broker", |line| line.contains("MQTT broker").then_some(()));
    let answers = || live.stdout.all().len();
    let wait_for_more = || {
        let before = answers();
        wait_for("twenty more answers", || (answers() >= before + 20).then_some(()));
    };
    wait_for_more();
    for _ in 0..2 {
        broker.start();
        let hub = broker.listen();
        hub.stdout.find(0, "discovery", |line| message_of_topic(line, &discovery_topic()));
        let availability = format!("radome/{ID}/availability");
        hub.stdout.find(0, "online", |line| message_of_topic(line, &availability).filter(|m| m == "online"));
        broker.process = None;
        wait_for_more();
    }
    // Whoever reads the log learns that each connection came back, not only that it was lost.
    let connected = live.stderr.all().iter().filter(|line| line.contains(": connected; ")).count();
    assert!(connected >= 2, "{connected} connections reported");
    let summary = stop_and_count(live);
    assert!(summary["frames"].as_u64().is_some_and(|frames| frames >= 60), "{summary}");
}

#[test]
fn an_orderly_end_publishes_offline() {
    let Some(mut broker) = Broker::prepare() else { return };
    broker.start();
    let live = Running::start(watch_command().args(["--mqtt", &broker.url()]));
    let hub = broker.listen();
    let availability = format!("radome/{ID}/availability");
    hub.stdout.find(0, "online", |line| message_of_topic(line, &availability).filter(|m| m == "online"));
    stop_and_count(live);
    wait_for("offline", || {
        let messages: Vec<String> =
            hub.stdout.all().iter().filter_map(|line| message_of_topic(line, &availability)).collect();
        messages.last().filter(|last| *last == "offline").map(drop)
    });
}

/// Regression test: nothing was said of messages that the broker's access rules reject.
#[test]
fn a_broker_that_rejects_messages_is_reported() {
    let Some(mut broker) = Broker::prepare() else { return };
    let folder = broker.folder.path().to_owned();
    let (rules, settings) = (folder.join("rules"), folder.join("mosquitto.conf"));
    std::fs::write(&rules, "topic write radome/#\n").expect("writable");
    // mosquitto drops root's privileges before it reads the rules.
    for (path, mode) in [(&folder, 0o755), (&rules, 0o644)] {
        std::fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(mode)).expect("settable");
    }
    let others = std::fs::read_to_string(&settings).expect("written");
    std::fs::write(&settings, format!("{others}acl_file {}\n", rules.display())).expect("writable");
    broker.start();
    let live = Running::start(watch_command().args(["--mqtt", &broker.url(), "--metrics", "127.0.0.1:0"]));
    let is_rejection =
        |line: &str| line.contains("it rejects what is published: NotAuthorized").then(|| line.to_owned());
    let said = live.stderr.find(0, "the rejection", is_rejection);
    assert!(said.contains(&format!("needs to write {}, ", discovery_topic())), "{said}");
    scrape_until(live.metrics_port(), |page| metric_value(page, "radome_mqtt_rejected_total") >= 1.0);
    stop_and_count(live);
}

/// Runs openssl in a folder; returns `false` if it is not installed.
fn openssl(folder: &Path, arguments: &str) -> bool {
    let output = Command::new("openssl").args(arguments.split(' ')).current_dir(folder).output();
    output.is_ok_and(|output| output.status.success())
}

#[test]
fn an_encrypted_broker_gets_messages_if_its_authority_is_trusted_and_the_login_is_right() {
    let Some(mut broker) = Broker::prepare() else { return };
    let folder = broker.folder.path().to_owned();
    std::fs::write(folder.join("names"), "subjectAltName=DNS:localhost\n").expect("writable");
    let is_made =
        openssl(&folder, "req -x509 -newkey rsa:2048 -nodes -keyout ca.key -out ca.pem -days 30 -subj /CN=authority")
            && openssl(&folder, "req -newkey rsa:2048 -nodes -keyout hub.key -out hub.csr -subj /CN=localhost")
            && openssl(
                &folder,
                "x509 -req -in hub.csr -CA ca.pem -CAkey ca.key -CAcreateserial -out hub.pem -days 30 -extfile names",
            );
    let hashed =
        Command::new("mosquitto_passwd").args(["-b", "-c", "logins", "radar", "secret"]).current_dir(&folder).status();
    if !is_made || !hashed.is_ok_and(|status| status.success()) {
        skip("openssl", "openssl or mosquitto_passwd is absent; tests/run installs openssl and mosquitto");
        return;
    }
    // mosquitto drops root's privileges before it reads these files.
    for name in ["ca.pem", "hub.pem", "hub.key", "logins"] {
        let open = std::os::unix::fs::PermissionsExt::from_mode(0o644);
        std::fs::set_permissions(folder.join(name), open).expect("settable");
    }
    std::fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o755)).expect("settable");
    let (at, port, plain) = (|name: &str| folder.join(name).display().to_string(), broker.port, free_port());
    let settings = format!(
        "per_listener_settings true\nlistener {port} 127.0.0.1\ncafile {}\ncertfile {}\nkeyfile {}\npassword_file {}\n\
         allow_anonymous false\nlistener {plain} 127.0.0.1\nallow_anonymous true\npersistence false\n",
        at("ca.pem"),
        at("hub.pem"),
        at("hub.key"),
        at("logins")
    );
    std::fs::write(folder.join("mosquitto.conf"), settings).expect("writable");
    broker.start();
    let with_login = |mut command: Command, password: &str, authority: bool| {
        command.args(["--mqtt", &format!("mqtts://radar@localhost:{port}")]).env("RADOME_MQTT_PASSWORD", password);
        if authority {
            command.arg("--mqtt-ca").arg(folder.join("ca.pem"));
        }
        command
    };
    let told = |password: &str, authority: bool| Running::start(with_login(watch_command(), password, authority));
    let examined = |password: &str, authority: bool| {
        let (_, told, said) = outcome(with_login(command!("doctor --json --record-to", &folder), password, authority));
        let mut checks = told.lines().map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
        checks.find(|check| check["check"] == "mqtt").unwrap_or_else(|| panic!("{said}"))
    };
    for (password, authority, word) in [("wrong", true, "refuses the login"), ("secret", false, "UnknownIssuer")] {
        let live = told(password, authority);
        let said = live.stderr.find(0, word, |line| line.contains(word).then(|| line.to_owned()));
        assert!(!said.contains("secret") && !said.contains("wrong:"), "{said}");
        stop_and_count(live);
        let check = examined(password, authority);
        assert!(check["verdict"] == "fail" && check["found"].to_string().contains(word), "{check}");
    }
    assert_eq!(examined("secret", true)["verdict"], "ok");
    let live = told("secret", true);
    broker.port = plain;
    broker.listen().stdout.find(0, "discovery", |line| message_of_topic(line, &discovery_topic()));
    stop_and_count(live);
}

fn get(port: u16, path: &str) -> String {
    get_with_headers(port, path, &format!("127.0.0.1:{port}"), "")
}

/// Requests a path under this host name, with additional headers.
fn get_with_headers(port: u16, path: &str, host: &str, headers: &str) -> String {
    send_request(("127.0.0.1", port), format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n{headers}\r\n"))
}

/// Reports the true class.
fn report_truth(port: u16, truth: &str) -> String {
    send_request(("127.0.0.1", port), format!("POST /report/{truth} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"))
}

fn metric_value(page: &str, name: &str) -> f64 {
    let value = page.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    value.and_then(|value| value.parse().ok()).unwrap_or_else(|| panic!("no {name} in {page}"))
}

/// Requests the metrics until they satisfy `until`; the server may answer otherwise while it is busy.
fn scrape_until(port: u16, until: impl Fn(&str) -> bool) -> String {
    wait_for("metrics", || Some(get(port, "/metrics")).filter(|page| page.starts_with("HTTP/1.1 200") && until(page)))
}

#[test]
fn prometheus_reads_counters_gauges_and_a_histogram() {
    let live = Running::start(watch_command().args(["--metrics", "127.0.0.1:0"]));
    let port = live.metrics_port();
    let page = scrape_until(port, |page| page.contains("\nradome_up 1\n"));
    assert!(page.contains("text/plain; version=0.0.4"), "{page}");
    let body = page.split("\r\n\r\n").nth(1).expect("a body");
    let mut types = std::collections::BTreeMap::new();
    for line in body.lines() {
        if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').expect("name and kind");
            assert!(types.insert(name, kind).is_none(), "{name} twice");
        } else if !line.starts_with('#') {
            let (name, value) = line.rsplit_once(' ').expect("a sample");
            assert!(value.parse::<f64>().is_ok_and(f64::is_finite), "{line}");
            let family = name.split('{').next().expect("a name");
            let of =
                |suffix: &str| family.strip_suffix(suffix).is_some_and(|name| types.get(name) == Some(&"histogram"));
            assert!(types.contains_key(family) || of("_bucket") || of("_sum") || of("_count"), "{line} has no type");
        }
    }
    let buckets: Vec<f64> = body
        .lines()
        .filter(|line| line.starts_with("radome_latency_seconds_bucket"))
        .map(|line| line.rsplit_once(' ').and_then(|(_, n)| n.parse().ok()).expect("a number"))
        .collect();
    assert!(buckets.is_sorted() && buckets.len() == 11, "{buckets:?}");
    assert_eq!(buckets.last(), Some(&metric_value(body, "radome_latency_seconds_count")));
    assert!(get(port, "/health").starts_with("HTTP/1.1 200"));
    let frames = metric_value(&scrape_until(port, |_| true), "radome_frames_total");
    let summary = stop_and_count(live);
    assert!(summary["frames"].as_f64().is_some_and(|all| all >= frames));
}

/// Socket that receives the notifications for systemd.
struct Ear {
    socket: UnixDatagram,
    folder: tempfile::TempDir,
}

impl Ear {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = UnixDatagram::bind(folder.path().join("notify")).expect("a socket");
        socket.set_read_timeout(Some(Duration::from_millis(100))).expect("settable");
        Ear { socket, folder }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("notify")
    }

    /// Notifications that arrive within this time.
    fn hear(&self, time: Duration) -> Vec<String> {
        let (start, mut heard, mut bytes) = (Instant::now(), Vec::new(), [0; 4096]);
        while start.elapsed() < time {
            if let Ok(length) = self.socket.recv(&mut bytes) {
                heard.extend(String::from_utf8_lossy(&bytes[..length]).lines().map(str::to_owned));
            }
        }
        heard
    }

    fn wait_for(&self, what: &str) {
        wait_for(what, || {
            self.hear(Duration::from_millis(100)).iter().any(|line| line.starts_with(what)).then_some(())
        });
    }
}

#[test]
fn systemd_is_notified_after_the_first_label_and_the_watchdog_only_while_frames_come() {
    let ear = Ear::new();
    // The board is another process, so that a signal can stop it.
    let (board, port) = emulated_board(&fixture("scenes/corridor.toml"), &["--speed", "1"]);
    let mut live = live_command(format!("serial:{port}"), "--json --metrics 127.0.0.1:0");
    live.env("NOTIFY_SOCKET", ear.path()).env("WATCHDOG_USEC", "2000000");
    let mut live = Running::start(&mut live);
    ear.wait_for("READY=1");
    let labelled = live.stdout.all().iter().filter(|line| line.contains("\"label\":\"")).count();
    assert!(labelled > 0, "ready before the first label");
    ear.wait_for("WATCHDOG=1");
    ear.wait_for("STATUS=");
    board.signal("STOP");
    // Frames in transit may still arrive.
    ear.hear(Duration::from_secs(2));
    let heard = ear.hear(Duration::from_secs(4));
    assert!(!heard.iter().any(|line| line == "WATCHDOG=1"), "content with a dead board: {heard:?}");
    // Regression test: the frame rate stayed at that of the last frames.
    let page = scrape_until(live.metrics_port(), |page| page.contains("\nradome_up 0\n"));
    assert_eq!(metric_value(&page, "radome_frame_rate_hertz"), 0.0, "{page}");
    board.signal("CONT");
    ear.wait_for("WATCHDOG=1");
    live.signal("TERM");
    ear.wait_for("STOPPING=1");
    assert!(live.wait().success());
}

#[test]
fn reports_keep_the_last_minute_with_labels_and_answers() {
    let Some(mut broker) = Broker::prepare() else { return };
    broker.start();
    let folder = tempfile::tempdir().expect("a folder");
    let mut command = watch_command();
    command.args(["--mqtt", &broker.url(), "--metrics", "127.0.0.1:0", "--keep-last-s", "3", "--keep-to"]);
    let live = Running::start(command.arg(folder.path().join("reports")));
    let port = live.metrics_port();
    let hub = broker.listen();
    let found = hub.stdout.find(0, "discovery", |line| message_of_topic(line, &discovery_topic()));
    let found: Value = serde_json::from_str(&found).expect("JSON");
    let button = &found["cmps"]["report_empty"];
    assert_eq!((&button["p"], &button["pl_prs"]), (&"button".into(), &"empty".into()));
    wait_for("more than is kept", || (live.stdout.all().len() > 50).then_some(()));

    let kept = |n: usize| {
        wait_for("a report", || {
            let files = std::fs::read_dir(folder.path().join("reports")).expect("a folder");
            let files: Vec<PathBuf> = files.map(|file| file.expect("a file").path()).collect();
            let is_whole = |path: &PathBuf| path.extension().is_some_and(|e| e == "mcap");
            let mut whole: Vec<PathBuf> = files.into_iter().filter(is_whole).collect();
            whole.sort();
            (whole.len() == n).then_some(whole)
        })
    };
    // A retained report is out of date, and an unknown class is no report.
    let topic = button["cmd_t"].as_str().expect("a topic");
    broker.publish(topic, &["-m", "three"]);
    broker.publish(topic, &["-m", button["pl_prs"].as_str().expect("a payload")]);
    let first = kept(1);
    // A report within five seconds of another is refused.
    assert!(report_truth(port, "one").starts_with("HTTP/1.1 202"));
    scrape_until(port, |page| metric_value(page, "radome_reports_refused_total") >= 1.0);
    std::thread::sleep(Duration::from_secs(5));
    assert!(report_truth(port, "one").starts_with("HTTP/1.1 202"));
    let second = kept(2);
    std::thread::sleep(Duration::from_secs(5));
    live.signal("USR1");
    let third = kept(3);
    // A report is counted once its file is complete.
    let page = scrape_until(port, |page| metric_value(page, "radome_reports_kept_total") >= 3.0);
    assert_eq!(
        (metric_value(&page, "radome_reports_kept_total"), metric_value(&page, "radome_mqtt_refused_total")),
        (3.0, 1.0)
    );
    stop_and_count(live);

    let (first, rest): (Vec<_>, Vec<_>) = third.iter().partition(|path| first.contains(path));
    assert_eq!((first.len(), second.len(), rest.len()), (1, 2, 2));
    let mut labels = Vec::new();
    for path in &third {
        let answers = json_lines(command!("recording answers --json", path));
        let times: Vec<u64> = answers.iter().map(|answer| answer["time_ns"].as_u64().expect("a time")).collect();
        // Each report covers three seconds, less the frames that the board lost on a busy machine.
        let span_s = (times[times.len() - 1] - times[0]) as f64 * 1e-9;
        assert!((2.0..3.05).contains(&span_s), "{span_s} s");
        let found = labels_of(path);
        assert_eq!(found.len(), 1, "{found:?}");
        labels.push(found[0]["label"].as_str().expect("a label").to_owned());
        let frames = json_lines(live_command(path, "--json"));
        let judged = frames.iter().filter(|line| line["sequence"].is_u64()).count();
        assert_eq!(judged, answers.len(), "as many frames as answers");
    }
    labels.sort();
    assert_eq!(labels, ["empty", "empty", "one"]);
}

mod hard_cases {
    use super::*;

    #[test]
    fn malicious_messages_of_a_broker_are_refused_and_counted() {
        let Some(mut broker) = Broker::prepare() else { return };
        broker.start();
        let folder = tempfile::tempdir().expect("a folder");
        let (large, topic) = (folder.path().join("large"), format!("radome/{ID}/report"));
        std::fs::write(&large, vec![b'x'; 3_000_000]).expect("writable");
        let large = large.to_str().expect("text");
        // Retained messages that precede the radar: it receives them as soon as it subscribes.
        broker.publish("homeassistant/status", &["-r", "-f", large]);
        broker.publish(&topic, &["-r", "-m", "empty"]);
        let mut command = watch_command();
        command.args(["--mqtt", &broker.url(), "--metrics", "127.0.0.1:0", "--keep-to"]);
        let live = Running::start(command.arg(folder.path().join("reports")));
        let port = live.metrics_port();
        let hub = broker.listen();
        hub.stdout.find(0, "discovery", |line| message_of_topic(line, &discovery_topic()));
        scrape_until(port, |page| {
            metric_value(page, "radome_mqtt_refused_total") >= 1.0 && page.contains("\nradome_up 1\n")
        });
        // Messages that arrive while it is subscribed.
        broker.publish(&topic, &["-f", large]);
        broker.publish("homeassistant/status", &["-m", "offline"]);
        broker.publish("homeassistant/status", &["-m", "../../etc/passwd"]);
        broker.publish(&topic, &["-m", "\u{1}\u{ffff}"]);
        let flood: String = (0..3000).map(|_| "online\n").collect();
        let mut command = Command::new(installed("mosquitto_pub").expect("there"));
        command.args(["-p", &broker.port.to_string(), "-t", "homeassistant/status", "-l"]);
        let mut child = command.stdin(Stdio::piped()).spawn().expect("runs");
        child.stdin.take().expect("piped").write_all(flood.as_bytes()).expect("takes it");
        assert!(child.wait().expect("ends").success());
        let page = scrape_until(port, |page| metric_value(page, "radome_mqtt_refused_total") >= 3.0);
        assert_eq!(metric_value(&page, "radome_mqtt_connected"), 1.0, "{page}");
        assert_eq!(metric_value(&page, "radome_mqtt_connections_total"), 1.0, "it was never thrown out");
        // Three thousand birth messages of hubs cause at most one announcement a second.
        assert!(count_messages(&hub.stdout.all(), &discovery_topic()) < 60);
        assert_eq!(metric_value(&page, "radome_reports_kept_total"), 0.0);
        stop_and_count(live);
    }

    #[test]
    fn too_many_connections_to_the_metrics_are_refused_and_frames_go_on() {
        let live = Running::start(watch_command().args(["--metrics", "127.0.0.1:0"]));
        let port = live.metrics_port();
        scrape_until(port, |page| page.contains("\nradome_up 1\n"));
        // Ten times two hundred connections that send nothing.
        for _ in 0..10 {
            let crowd: Vec<_> = (0..200).map(|_| TcpStream::connect(("127.0.0.1", port))).collect();
            assert!(crowd.iter().filter(|socket| socket.is_ok()).count() > 0);
        }
        let idle: Vec<_> = (0..200).filter_map(|_| TcpStream::connect(("127.0.0.1", port)).ok()).collect();
        // Accepted connections that send nothing time out, so that other clients are served again.
        let page = scrape_until(port, |page| metric_value(page, "radome_http_turned_away_total") >= 100.0);
        assert!(metric_value(&page, "radome_frames_total") > 0.0);
        drop(idle);
        stop_and_count(live);
    }

    #[test]
    fn malformed_requests_and_strange_paths_are_refused_and_counted() {
        let live = Running::start(watch_command().args(["--metrics", "127.0.0.1:0"]));
        let port = live.metrics_port();
        let before =
            metric_value(&scrape_until(port, |page| page.contains("\nradome_up 1\n")), "radome_http_refused_total");
        let mut refused = 0.0;
        let of_files = "/ /metrics/ /../../etc/passwd /metrics/../../etc/passwd /%2e%2e/%2e%2e/etc/passwd //etc/passwd";
        for path in of_files.split(' ').chain(["/metrics%00", "/report/empty", "/report/../metrics"]) {
            let answer = get(port, path);
            assert!(answer.starts_with("HTTP/1.1 4"), "{path}: {answer}");
            assert!(!answer.contains("root:"), "{path}");
            refused += 1.0;
        }
        let host = format!("Host: 127.0.0.1:{port}\r\n");
        let long = format!("GET /metrics HTTP/1.1\r\n{host}X: {}\r\n\r\n", "x".repeat(100_000));
        let many: String = (0..500).map(|i| format!("H{i}: x\r\n")).collect();
        let many = format!("GET /metrics HTTP/1.1\r\n{host}{many}\r\n");
        let slow = b"GET /metrics HTTP/1.1\r\nHost: ra";
        for request in
            [long.as_bytes(), many.as_bytes(), slow, b"\x16\x03\x01\x02\x00\x01\x00", b"BREW /pot\r\n\r\n", &[0; 5000]]
        {
            let answer = send_request(("127.0.0.1", port), request);
            assert!(!answer.starts_with("HTTP/1.1 200"), "{answer}");
            refused += 1.0;
        }
        for (request, status) in [
            (format!("POST /metrics HTTP/1.1\r\n{host}\r\n"), "405"),
            (format!("GET /metrics HTTP/1.1\r\n{host}Content-Length: 3\r\n\r\n"), "413"),
            (format!("POST /report/empty HTTP/1.1\r\n{host}Origin: http://evil\r\n\r\n"), "403"),
            (format!("POST /report/empty HTTP/1.1\r\n{host}Origin: http://127.0.0.1:{port}\r\n\r\n"), "403"),
        ] {
            let answer = send_request(("127.0.0.1", port), request);
            assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{answer}");
            refused += 1.0;
        }
        let after = metric_value(&scrape_until(port, |_| true), "radome_http_refused_total");
        assert!(after - before >= refused, "{after} - {before} counted of {refused}");
        stop_and_count(live);
    }

    /// Asserts that a foreign host name that resolves to this machine's address cannot read the metrics through a
    /// browser.
    #[test]
    fn metrics_are_not_served_under_names_that_are_not_theirs() {
        let live =
            Running::start(watch_command().args(["--metrics", "127.0.0.1:0", "--allow-host", "Radar.example:9100"]));
        let port = live.metrics_port();
        scrape_until(port, |page| page.contains("\nradome_up 1\n"));
        for host in ["radar.example:9100", &format!("localhost:{port}"), &format!("[::1]:{port}")] {
            assert!(get_with_headers(port, "/metrics", host, "").starts_with("HTTP/1.1 200"), "{host}");
        }
        for path in ["/metrics", "/health", "/nothing"] {
            for host in [
                "evil.example",
                &format!("evil.example:{port}"),
                "127.0.0.1",
                "127.0.0.1:1",
                "radar.example",
                &format!("192.168.0.4:{port}"),
            ] {
                let answer = get_with_headers(port, path, host, "");
                assert!(answer.starts_with("HTTP/1.1 403"), "{path} at {host}: {answer}");
                assert!(!answer.contains("radome_") && !answer.contains("labelled"), "{path} at {host}: {answer}");
            }
            let nameless = send_request(("127.0.0.1", port), format!("GET {path} HTTP/1.1\r\n\r\n"));
            assert!(nameless.starts_with("HTTP/1.1 403"), "{path}: {nameless}");
            let host = format!("127.0.0.1:{port}");
            let answer = get_with_headers(port, path, &host, "Origin: http://evil.example\r\n");
            assert!(answer.starts_with("HTTP/1.1 403"), "{path}: {answer}");
        }
        let request = format!("POST /report/one HTTP/1.1\r\nHost: evil.example:{port}\r\n\r\n");
        let answer = send_request(("127.0.0.1", port), request);
        assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
        stop_and_count(live);
    }

    #[test]
    fn metrics_off_loopback_need_a_token_and_show_nothing_without() {
        let said = radome_tests::wrong_use(watch_command().args(["--metrics", "0.0.0.0:0"]));
        assert!(said.contains("--token-file") && said.contains("hint:"), "{said}");
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("token");
        for listen in ["0.0.0.0:0", "127.0.0.1:0"] {
            let live = Running::start(watch_command().args(["--metrics", listen, "--token-file"]).arg(&file));
            let port = live.metrics_port();
            let said = live.stderr.all();
            assert!(!said.iter().any(|line| line.contains("http://0.0.0.0")), "nobody reaches that: {said:?}");
            let token = std::fs::read_to_string(&file).expect("made").trim().to_owned();
            let (host, bearer) = (format!("127.0.0.1:{port}"), format!("Authorization: Bearer {token}\r\n"));
            wait_for("metrics", || {
                Some(get_with_headers(port, "/metrics", &host, &bearer)).filter(|page| page.contains("\nradome_up 1\n"))
            });
            assert!(get_with_headers(port, "/health", &host, &bearer).starts_with("HTTP/1.1 200"));
            for path in ["/metrics", "/health", "/report/one", "/nothing", &format!("/?token={token}")] {
                for headers in ["", "Authorization: Bearer wrong-wrong-wrong\r\n", "Cookie: radome=1\r\n"] {
                    let answer = get_with_headers(port, path, &host, headers);
                    assert!(answer.starts_with("HTTP/1.1 401"), "{path}, {headers}: {answer}");
                    assert!(!answer.contains("radome_") && !answer.contains("labelled"), "{path}: {answer}");
                }
            }
            let unproven = report_truth(port, "one");
            assert!(unproven.starts_with("HTTP/1.1 401"), "{unproven}");
            assert!(live.stderr.all().iter().all(|line| !line.contains(&token)));
            stop_and_count(live);
        }
    }

    #[test]
    fn addresses_that_are_none_and_ports_that_are_taken_are_named() {
        let said = |options: &[&str]| radome_tests::failure(watch_command().args(options));
        let wrong = |options: &[&str]| {
            let (status, _, text) = radome_tests::outcome(watch_command().args(options));
            assert_eq!(status, Some(2), "{options:?}: {text}");
            text
        };
        let text = wrong(&["--mqtt", "http://hub"]);
        // The address is not repeated in the error, since it may hold a password.
        assert!(text.contains("does not begin with mqtt://") && text.contains("hint:"), "{text}");
        let text = wrong(&["--mqtt", "mqtt://:secret@hub:bad"]);
        assert!(!text.contains("secret") && text.contains("hint:"), "{text}");
        for prefix in ["", "/", "home/#", "+/home"] {
            let text = wrong(&["--mqtt", "mqtt://127.0.0.1:1", "--mqtt-discovery-prefix", prefix]);
            assert!(text.contains("--mqtt-discovery-prefix") && text.contains("hint:"), "{text}");
        }
        let taken = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = taken.local_addr().expect("bound").to_string();
        let text = said(&["--metrics", &address]);
        assert!(text.contains(&address) && text.contains("hint:"), "{text}");
        let text = said(&["--keep-to", "/proc/nowhere"]);
        assert!(text.contains("/proc/nowhere") && text.contains("hint:"), "{text}");
    }
}
