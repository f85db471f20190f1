//! Tests of passwords for the MQTT broker: their permitted sources, and that no output shows them.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Stdio};

use radome_tests::running::Running;
use radome_tests::{fixture, live_command, outcome, radome, write_file};

/// Command that simulates the corridor in real time until stopped, with the most detailed log.
fn watch_command(url: &str) -> Command {
    let mut command = live_command(fixture("scenes/corridor.toml"), "--speed 1 --json --mqtt");
    command.arg(url);
    command.env_remove("RADOME_MQTT_USER").env_remove("RADOME_MQTT_PASSWORD").env("RADOME_LOG", "trace");
    command
}

#[test]
fn a_password_in_the_address_is_refused_and_not_echoed() {
    for url in [
        "mqtt://radar:hunter2@127.0.0.1",
        "mqtt://radar:hunter2@127.0.0.1:x",
        "mqtt://radar:p@hunter2@127.0.0.1:1",
        "mqtt://radar:p/hunter2#?@[::1]:1",
        "mqtt://radar:%68%25hunter2@127.0.0.1",
        "mqtt://radar:hunter2",
        "mqtt:/radar:hunter2@127.0.0.1",
        "hunter2://127.0.0.1",
    ] {
        let (status, _, said) = outcome(watch_command(url));
        assert!(matches!(status, Some(1 | 2)), "{url}: {status:?}: {said}");
        assert!(said.contains("hint:") && !said.contains("hunter2"), "{url}: {said}");
    }
}

/// Asserts that the password of the file reaches the broker. This broker sends back everything that it receives,
/// including the login. Neither must appear in the most detailed log.
#[test]
fn what_a_broker_sends_back_is_not_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = write_file(folder.path(), "password", "hunter2\n");
    std::fs::set_permissions(&file, PermissionsExt::from_mode(0o600)).expect("settable");
    let broker = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = broker.local_addr().expect("bound").port();
    let mut live = watch_command(&format!("mqtt://radar@127.0.0.1:{port}"));
    // The file takes precedence over the environment.
    live.arg("--mqtt-password-file").arg(&file).env("RADOME_MQTT_PASSWORD", "of-the-environment");
    let mut live = Running::start(&mut live);
    let (mut socket, _) = broker.accept().expect("a connection");
    let mut received = [0; 4096];
    let count = socket.read(&mut received).expect("a first packet");
    let has = |secret: &str| received[..count].windows(secret.len()).any(|bytes| bytes == secret.as_bytes());
    assert!(has("radar") && has("hunter2") && !has("of-the-environment"));
    socket.write_all(&received[..count]).expect("sent back");
    live.stderr.find(0, "the failed connection", |line| line.contains("does not answer in MQTT").then_some(()));
    live.signal("TERM");
    live.wait();
    for line in live.stderr.all().iter().chain(&live.stdout.all()) {
        assert!(!line.contains("hunter2"), "{line}");
    }
}

/// Regression test: the file of the password was read twice, and a pipe is empty the second time.
#[test]
fn a_password_can_be_read_from_a_pipe() {
    let mut live = radome();
    live.arg("live").arg(fixture("scenes/corridor.toml")).args(["--frames", "2", "--mqtt", "mqtt://radar@127.0.0.1:1"]);
    live.args(["--mqtt-password-file", "/dev/stdin"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    let mut run = live.spawn().expect("runs");
    run.stdin.take().expect("a pipe").write_all(b"hunter2\n").expect("written");
    let ended = run.wait_with_output().expect("ends");
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
}
