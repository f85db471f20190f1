//! Hostile clients of the page: host names, tokens, many connections, upgrades and messages.

use super::*;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Barrier};
use std::time::{Duration, Instant};

use radome_tests::browser::{Socket, page};
use radome_tests::failure;
use radome_tests::running::{PATIENCE, send_request, wait_for};
use tungstenite::Message;
use tungstenite::client::IntoClientRequest;

/// HTTP status of the answer to these bytes; 0 without an answer.
fn status(address: &str, request: &str) -> u16 {
    let mut stream = TcpStream::connect(address).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    let _ = stream.write_all(request.as_bytes());
    let mut answer = [0; 12];
    match stream.read_exact(&mut answer) {
        Ok(()) => String::from_utf8_lossy(&answer)[9..].parse().unwrap_or(0),
        Err(_) => 0,
    }
}

fn get(address: &str, path: &str, headers: &str) -> u16 {
    status(address, &format!("GET {path} HTTP/1.1\r\nConnection: close\r\n{headers}\r\n"))
}

/// Reads until a message satisfies `holds` (returns `true`) or the server closes the connection (returns `false`).
fn read_until(socket: &mut Socket, holds: impl Fn(&str) -> bool) -> bool {
    let end = Instant::now() + PATIENCE;
    while Instant::now() < end {
        match socket.read() {
            Ok(Message::Text(text)) if holds(&text) => return true,
            Ok(Message::Close(_)) | Err(_) => return false,
            Ok(_) => {}
        }
    }
    panic!("neither said nor closed");
}

/// Health report of the program, requested with additional headers.
fn health(address: &str, headers: &str) -> Value {
    let request = format!("GET /health.json HTTP/1.1\r\nHost: {address}\r\n{headers}\r\n");
    let text = send_request(address, &request);
    let body = text.split_once("\r\n\r\n").expect("a body").1;
    serde_json::from_str(body).expect("JSON")
}

fn refused_counts(address: &str) -> Value {
    health(address, "")["refused"].clone()
}

/// Value of a header of an answer.
fn header<'a>(answer: &'a str, name: &str) -> Option<&'a str> {
    let head = answer.split("\r\n\r\n").next()?;
    head.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        key.eq_ignore_ascii_case(name).then(|| value.trim())
    })
}

/// Opens a page with one additional header, such as a cookie.
fn page_with(address: &str, name: &'static str, value: &str) -> Result<Socket, String> {
    let mut request = format!("ws://{address}/stream").into_client_request().expect("a request");
    request.headers_mut().insert(name, value.parse().expect("a header"));
    tungstenite::connect(request).map(|(socket, _)| socket).map_err(|error| error.to_string())
}

/// All paths that the page's port serves.
const ROUTES: [&str; 18] = [
    "/",
    "/style.css",
    "/main.js",
    "/link.js",
    "/plot.js",
    "/map.js",
    "/profile.js",
    "/doppler.js",
    "/chirps.js",
    "/timeline.js",
    "/labels.js",
    "/health.js",
    "/health.json",
    "/labels.json",
    "/labels.txt",
    "/labels.label",
    "/stream",
    "/nothing",
];

/// Headers of a WebSocket upgrade where the path is a stream.
fn upgrade(path: &str) -> &'static str {
    match path {
        "/stream" => {
            "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        }
        _ => "",
    }
}

#[test]
fn off_loopback_nothing_is_served_without_the_token() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 4.0, 20);
    let served = Served::start_at("0.0.0.0:0", &mut replay_command(&recording, "0"));
    let address = served.address.clone();
    let token = served.token.clone().expect("a token in the link");
    assert!(token.len() >= 22, "128 bits: {token}");
    let port = address.rsplit(':').next().expect("a port");
    let asked = |method: &str, path: &str, headers: &str| {
        let upgrade = upgrade(path);
        send_request(&address, format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\n{upgrade}{headers}\r\n"))
    };

    let wrong_bearer = "Authorization: Bearer 00000000000000000000000000000000\r\n";
    let wrong_cookie = format!("Cookie: radome_{port}={token}\r\n");
    // The server delays answers to wrong tokens by a second. Requests run in parallel, but below the connection limit.
    for paths in ROUTES.chunks(4) {
        std::thread::scope(|scope| {
            for &path in paths {
                for method in ["GET", "HEAD", "POST", "DELETE"] {
                    for headers in ["", wrong_bearer, wrong_cookie.as_str()] {
                        let asked = &asked;
                        scope.spawn(move || {
                            let answer = asked(method, path, headers);
                            assert!(answer.starts_with("HTTP/1.1 401 "), "{method} {path}, {headers}: {answer}");
                            assert_eq!(header(&answer, "referrer-policy"), Some("no-referrer"), "{answer}");
                            let body = answer.split_once("\r\n\r\n").expect("a head").1;
                            for served in ["script", "import", "pages", "[]", "label", "{"] {
                                assert!(!body.contains(served), "{method} {path}, {headers}: {body}");
                            }
                        });
                    }
                }
            }
        });
    }
    for path in ["/labels.json?token=", "/stream?token="] {
        assert!(asked("GET", &format!("{path}{token}"), "").starts_with("HTTP/1.1 401 "), "only the link opens");
    }
    let wrong = asked("GET", "/?token=wrong", "");
    assert!(wrong.starts_with("HTTP/1.1 401 ") && header(&wrong, "set-cookie").is_none(), "{wrong}");
    assert!(wrong.contains("?token="), "says what to do: {wrong}");

    // Programs send the token in a header.
    let bearer = format!("Authorization: Bearer {token}\r\n");
    for path in ROUTES.into_iter().filter(|path| *path != "/stream") {
        let status = if path == "/nothing" { "HTTP/1.1 404 " } else { "HTTP/1.1 200 " };
        let answer = asked("GET", path, &bearer);
        assert!(answer.starts_with(status), "{path}: {answer}");
    }
    assert!(page_with(&address, "Authorization", "Bearer wrong-wrong-wrong").is_err());
    let mut socket = page_with(&address, "Authorization", &format!("Bearer {token}")).expect("a page");
    assert!(read_until(&mut socket, |said| said.contains("\"hello\"")));

    // Browsers exchange the link's token for a cookie, and a redirect removes the token from the address.
    let answer = asked("GET", &format!("/?token={token}"), "");
    assert!(answer.starts_with("HTTP/1.1 303 "), "{answer}");
    assert_eq!(header(&answer, "location"), Some("./"));
    assert!(!answer.contains(&token), "{answer}");
    let cookie = header(&answer, "set-cookie").expect("a cookie");
    for part in ["HttpOnly", "SameSite=Strict", "Path=/"] {
        assert!(cookie.contains(part), "{cookie}");
    }
    assert!(cookie.starts_with(&format!("radome_{port}=")), "cookies ignore ports: {cookie}");
    let cookie = cookie.split(';').next().expect("a value");
    let with_cookie = format!("Cookie: other=1; {cookie}\r\n");
    for path in ["/", "/main.js", "/labels.json"] {
        assert!(asked("GET", path, &with_cookie).starts_with("HTTP/1.1 200 "), "{path}");
    }
    let mut socket = page_with(&address, "Cookie", cookie).expect("a page");
    assert!(read_until(&mut socket, |said| said.contains("\"hello\"")));
    // A valid token does not permit another host or site.
    assert_eq!(get(&address, "/", &format!("Host: evil.example:{port}\r\n{bearer}")), 403);
    assert_eq!(get(&address, "/", &format!("Host: {address}\r\nOrigin: http://evil.example\r\n{bearer}")), 403);

    let counted = health(&address, &bearer)["refused"].clone();
    for (what, least) in [("no_token", 72), ("wrong_token", 144), ("host", 1), ("origin", 1)] {
        assert!(counted[what].as_u64().expect("a number") >= least, "{what}: {counted}");
    }
    assert!(served.stop(), "an orderly end");
}

#[test]
fn a_token_file_protects_loopback_too_and_is_its_owners_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 4.0, 20);
    let file = folder.path().join("token");
    let start = || {
        let served = Served::start(replay_command(&recording, "0").args(["-vv", "--token-file"]).arg(&file));
        (served.program, served.address)
    };
    let (mut running, address) = start();
    let token = std::fs::read_to_string(&file).expect("made").trim().to_owned();
    assert_eq!(std::fs::metadata(&file).expect("made").permissions().mode() & 0o777, 0o600);
    assert!(token.len() >= 22);
    assert_eq!(get(&address, "/", &format!("Host: {address}\r\n")), 401);
    assert_eq!(get(&address, "/", &format!("Host: {address}\r\nAuthorization: Bearer {token}\r\n")), 200);
    assert_eq!(get(&address, "/?token=wrong-secret-wrong", &format!("Host: {address}\r\n")), 401);
    assert_eq!(get(&address, &format!("/?token={token}"), &format!("Host: {address}\r\n")), 303);
    running.signal("INT");
    running.wait();
    // stderr is no terminal here and may be a journal. Neither the right nor a wrong token may appear in it.
    let said = running.stderr.all().join("\n");
    assert!(!said.contains(&token) && !said.contains("wrong-secret"), "{said}");
    assert!(said.contains(&file.display().to_string()), "{said}");

    // The next start uses the same token.
    let (running, address) = start();
    assert_eq!(get(&address, "/", &format!("Host: {address}\r\nAuthorization: Bearer {token}\r\n")), 200);
    drop(running);

    let with_file = || {
        let mut command = replay_command(&recording, "0");
        command.args(["--view", "--listen", "127.0.0.1:0", "--token-file"]).arg(&file);
        command
    };
    for mode in [0o644, 0o640, 0o606] {
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).expect("settable");
        let said = failure(with_file());
        assert!(said.contains("chmod 600") && !said.contains(&token), "{said}");
    }
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o600)).expect("settable");
    std::fs::write(&file, "short-secret\n").expect("writable");
    let said = failure(with_file());
    assert!(said.contains("hint:") && !said.contains("short-secret"), "{said}");
}

#[test]
fn labels_that_are_read_only_are_watched_and_downloaded_but_not_changed() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 4.0, 20);
    let track = write_file(folder.path(), "track.txt", "0.1\t0.5\tempty\n");
    json_lines(command!("recording labels --json", &recording, "--import", &track));
    let served = Served::start(replay_command(&recording, "0").arg("--read-only-labels"));
    let mut socket = page(&served.address);
    assert!(read_until(&mut socket, |said| said.contains("\"read_only_labels\":true")));
    assert!(read_until(&mut socket, |said| said.contains("\"label\":\"empty\"")), "pages see labels");
    for edit in [
        "{\"do\":\"label\",\"occupancy\":\"one\"}",
        "{\"do\":\"stop\"}",
        "{\"do\":\"move\",\"id\":0,\"start_s\":0.2,\"end_s\":0.4}",
        "{\"do\":\"relabel\",\"id\":0,\"occupancy\":\"two\"}",
        "{\"do\":\"add\",\"start_s\":1,\"end_s\":1.5,\"occupancy\":\"one\"}",
        "{\"do\":\"delete\",\"id\":0}",
        "{\"do\":\"undo\"}",
        "{\"do\":\"redo\"}",
    ] {
        socket.send(Message::text(edit)).expect("sent");
        assert!(read_until(&mut socket, |said| said.contains("read-only")), "{edit}");
    }
    // Viewing still works.
    socket.send(Message::text("{\"do\":\"seek_frame\",\"sequence\":3}")).expect("sent");
    let text = send_request(&served.address, format!("GET /labels.txt HTTP/1.1\r\nHost: {}\r\n\r\n", served.address));
    assert!(text.ends_with("\tempty\n"), "{text}");
    drop(socket);
    assert!(served.stop(), "an orderly end");
    assert_eq!(read_labels(&recording), [(0.1, 0.5, "empty".to_owned())]);
}

#[test]
fn many_slow_connections_do_not_block_the_page_for_others() {
    const CROWD: usize = 130;
    let folder = tempfile::tempdir().expect("a folder");
    let served = replay(&simulate_walk(folder.path(), 2.0, 4.0, 20), "0");
    let address = served.address.clone();
    // This page was open before and stays open until the end of the run.
    let mut socket = page(&address);
    let before = std::thread::spawn(move || read_until(&mut socket, |said| said.contains("\"over\"")));
    let is_over = Arc::new(AtomicBool::new(false));
    let came = Arc::new(AtomicUsize::new(0));
    let crowd = {
        let (address, is_over, came) = (address.clone(), is_over.clone(), came.clone());
        std::thread::spawn(move || {
            let mut crowd: Vec<TcpStream> = Vec::new();
            while !is_over.load(Ordering::Relaxed) {
                // Each connection sends a byte before its silence would time out. Connections that were closed are
                // opened again.
                crowd.retain_mut(|stream| stream.write_all(b"G").is_ok());
                while crowd.len() < CROWD {
                    crowd.push(TcpStream::connect(&address).expect("a connection"));
                    came.fetch_add(1, Ordering::Relaxed);
                }
                std::thread::sleep(Duration::from_millis(500));
            }
        })
    };
    wait_for("the crowd", || (came.load(Ordering::Relaxed) >= CROWD).then_some(()));
    for _ in 0..10 {
        wait_for("the page beside the crowd", || {
            (get(&address, "/", &format!("Host: {address}\r\n")) == 200).then_some(())
        });
        wait_for("a stream beside the crowd", || tungstenite::connect(format!("ws://{address}/stream")).ok());
    }
    is_over.store(true, Ordering::Relaxed);
    crowd.join().expect("an end");
    let counted = refused_counts(&address);
    assert!(counted["connections"].as_u64().expect("a number") >= 1, "{counted}");
    assert!(served.stop(), "an orderly end");
    assert!(before.join().expect("an end"), "the page that was there before is not");
}

#[test]
fn two_hundred_upgrades_at_once_open_sixteen_pages() {
    const UPGRADES: usize = 200;
    let folder = tempfile::tempdir().expect("a folder");
    let served = replay(&simulate_walk(folder.path(), 2.0, 4.0, 20), "0");
    let address = served.address.clone();
    for _ in 0..3 {
        let barrier = Arc::new(Barrier::new(UPGRADES));
        let tries: Vec<_> = (0..UPGRADES)
            .map(|_| {
                let (barrier, address) = (barrier.clone(), address.clone());
                std::thread::spawn(move || {
                    barrier.wait();
                    tungstenite::connect(format!("ws://{address}/stream")).ok()
                })
            })
            .collect();
        let tries: Vec<_> = tries.into_iter().map(|upgrade| upgrade.join().expect("an end")).collect();
        assert_eq!(tries.iter().flatten().count(), 16);
        let one_more = tungstenite::connect(format!("ws://{address}/stream"));
        let said = one_more.err().map(|error| error.to_string()).unwrap_or_default();
        assert!(said.contains("503"), "{said}");
        assert!(health(&address, "")["pages"].as_u64().is_some_and(|pages| pages <= 16));
        // Closed connections free their slots.
        drop(tries);
        wait_for("a later page", || tungstenite::connect(format!("ws://{address}/stream")).ok());
        wait_for("the end of all pages", || (health(&address, "")["pages"] == 0).then_some(()));
    }
    assert!(served.stop(), "an orderly end");
}

#[test]
fn a_page_that_requests_pictures_and_reads_none_is_closed() {
    let folder = tempfile::tempdir().expect("a folder");
    let served = replay(&simulate_walk(folder.path(), 2.0, 4.0, 20), "0");
    let mut socket = page(&served.address);
    assert!(read_until(&mut socket, |said| said.contains("\"at_end\":true")));
    let start = Instant::now();
    // The client acknowledges pictures but reads nothing, so that the kernel's socket buffer fills up.
    for turn in 0.. {
        let look = format!("{{\"do\":\"look\",\"chirp\":{}}}", turn % 2);
        let is_gone =
            socket.send(Message::text(look)).is_err() || socket.send(Message::text("{\"do\":\"seen\"}")).is_err();
        if is_gone || turn % 20 == 19 && health(&served.address, "")["pages"] == 0 {
            break;
        }
        assert!(start.elapsed() < PATIENCE, "still a page");
        std::thread::sleep(Duration::from_millis(35));
    }
    wait_for("its end", || (health(&served.address, "")["pages"] == 0).then_some(()));
    let mut socket = page(&served.address);
    assert!(read_until(&mut socket, |said| said.contains("\"hello\"")));
    drop(socket);
    assert!(served.stop(), "an orderly end");
}

#[test]
fn malicious_requests_are_refused_and_counted_and_the_pipeline_loses_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    // The source is a file and waits for a slow machine. Lost frames would therefore be the page's fault.
    let frames = 60;
    let recording = simulate_walk(folder.path(), 2.0, 8.0, frames);
    let served = Served::start(live_command(recording, "--speed 4 --json"));
    let answers = served.program.stdout.clone();
    let address = served.address.clone();
    let ours = format!("Host: {address}\r\n");
    let port = address.rsplit(':').next().expect("a port").to_owned();
    assert_eq!(get(&address, "/", &ours), 200);

    // Host names that resolve to this machine but are not the page's, and origins of other sites.
    for host in ["evil.example", &format!("evil.example:{port}"), "127.0.0.1:1", &format!("127.0.0.1.nip.io:{port}")] {
        assert_eq!(get(&address, "/", &format!("Host: {host}\r\n")), 403, "{host}");
    }
    assert_eq!(get(&address, "/labels.json", ""), 403, "no host");
    for origin in [
        "http://evil.example",
        "null",
        &format!("http://localhost:{port}.evil.example"),
        &format!("http://127.0.0.1:{}0", port),
    ] {
        assert_eq!(get(&address, "/labels.json", &format!("{ours}Origin: {origin}\r\n")), 403, "{origin}");
        let mut request = format!("ws://{address}/stream").into_client_request().expect("a request");
        request.headers_mut().insert("Origin", origin.parse().expect("a header"));
        assert!(tungstenite::connect(request).is_err(), "{origin}");
    }
    assert_eq!(get(&address, "/labels.json", &format!("{ours}Origin: http://{address}\r\n")), 200);

    // Invalid paths and methods.
    for path in [
        "/../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/page/main.js",
        "/main.js/",
        "/.git/config",
        "//etc/passwd",
        "/main.js%00.html",
    ] {
        assert!(matches!(get(&address, path, &ours), 400 | 404), "{path}");
    }
    let long = format!("/{}", "a".repeat(100_000));
    assert!(matches!(get(&address, &long, &ours), 0 | 400 | 404 | 414 | 431));
    assert_eq!(
        status(
            &address,
            &format!("POST /labels.json HTTP/1.1\r\n{ours}Content-Length: 99999999999\r\nConnection: close\r\n\r\n")
        ),
        405
    );
    for garbage in ["\0\0\0\0\r\n\r\n", "GET\r\n\r\n", "GET / HTTP/9.9\r\n\r\n", "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"] {
        assert!(matches!(status(&address, garbage), 0 | 400 | 403 | 505), "{garbage:?}");
    }

    // Invalid messages.
    let mut socket = page(&address);
    for text in [
        "",
        "{",
        "[]",
        "null",
        "{\"do\":\"format\"}",
        "{\"do\":\"label\"}",
        "{\"do\":\"seek\",\"time_s\":1e999}",
        "{\"do\":\"label\",\"occupancy\":\"three\"}",
        "{\"do\":\"look\",\"channel\":{\"rx\":-1}}",
        "{\"do\":\"look\",\"channel\":{\"rx\":99}}",
        "{\"do\":\"look\",\"chirp\":4000000000}",
        "{\"do\":\"move\",\"id\":7,\"start_s\":1,\"end_s\":2}",
        "{\"do\":\"undo\"}",
        "{\"do\":\"undo\",\"more\":1}",
        &format!("{{\"do\":\"label\",\"occupancy\":\"one\",\"who\":\"{}\"}}", "x".repeat(61)),
    ] {
        socket.send(Message::text(text)).expect("sent");
        assert!(read_until(&mut socket, |said| said.contains("\"refused\":\"")), "{text}");
    }
    // The page still works.
    socket.send(Message::text("{\"do\":\"label\",\"occupancy\":\"one\",\"who\":null}")).expect("sent");
    assert!(read_until(&mut socket, |said| said.contains("\"label\":\"one\"")));
    for _ in 0..30 {
        let _ = socket.send(Message::binary(vec![0xff; 100]));
    }
    assert!(!read_until(&mut socket, |_| false), "thrown out");
    let mut socket = page(&address);
    let _ = socket.send(Message::text("x".repeat(5_000_000)));
    assert!(!read_until(&mut socket, |_| false), "thrown out");
    let mut socket = page(&address);
    for _ in 0..2_000 {
        let _ = socket.send(Message::text("{\"do\":\"seen\"}"));
    }
    assert!(!read_until(&mut socket, |_| false), "thrown out");
    // Frames that break the WebSocket protocol: unmasked, of an unknown kind, or longer than memory.
    for bytes in [
        &[0x81u8, 0x02, b'h', b'i'][..],
        &[0x8f, 0x80, 0, 0, 0, 0],
        &[0x81, 0xff, 0x7f, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 1, 2, 3, 4],
    ] {
        let mut socket = page(&address);
        if let tungstenite::stream::MaybeTlsStream::Plain(stream) = socket.get_mut() {
            stream.write_all(bytes).expect("sent");
        }
        assert!(!read_until(&mut socket, |_| false), "thrown out: {bytes:x?}");
    }

    // More pages than the limit.
    let pages: Vec<_> = (0..30).map(|_| tungstenite::connect(format!("ws://{address}/stream"))).collect();
    let open = pages.iter().filter(|page| page.is_ok()).count();
    assert!((1..=16).contains(&open), "{open}");
    drop(pages);
    // Thousands of connections, some of which send half a request.
    for round in 0..6 {
        let crowd: Vec<TcpStream> = (0..500).filter_map(|_| TcpStream::connect(&address).ok()).collect();
        for mut stream in crowd.iter().skip(round) {
            let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: ");
        }
    }
    // After they have closed, the page is served again.
    let end = Instant::now() + PATIENCE;
    while get(&address, "/", &ours) != 200 {
        assert!(Instant::now() < end, "the page does not come back");
        std::thread::sleep(Duration::from_millis(50));
    }
    let counted = refused_counts(&address);
    for (what, least) in [
        ("host", 5),
        ("origin", 8),
        ("method", 1),
        ("path", 4),
        ("messages", 20),
        ("oversized", 2),
        ("flood", 1),
        ("pages", 14),
        ("connections", 1000),
    ] {
        assert!(counted[what].as_u64().expect("a number") >= least, "{what}: {counted}");
    }

    let mut socket = page(&address);
    assert!(read_until(&mut socket, |said| said.contains("\"at_end\":true")));
    drop(socket);
    assert!(served.stop(), "an orderly end");
    let lines: Vec<Value> = answers.all().iter().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(lines.len(), frames as usize + 1);
    let summary = &lines[frames as usize]["summary"];
    assert_eq!((&summary["frames"], &summary["dropped"]), (&json!(frames), &json!(0)), "{summary}");
}

/// A step back behind the start of the open label discarded it without a word.
#[test]
fn a_step_back_ends_the_open_label_as_a_seek_does() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 4.0, 20);
    let served = replay(&recording, "0");
    let mut socket = page(&served.address);
    assert!(read_until(&mut socket, |said| said.contains("\"at_end\":true")));
    socket.send(Message::text("{\"do\":\"label\",\"occupancy\":\"one\"}")).expect("sent");
    assert!(read_until(&mut socket, |said| said.contains("\"open\":{")));
    socket.send(Message::text("{\"do\":\"step\",\"frames\":-10}")).expect("sent");
    assert!(read_until(&mut socket, |said| said.contains("\"at_end\":false")));
    drop(socket);
    assert!(served.stop(), "an orderly end");
    let kept = read_labels(&recording);
    assert!(kept.len() == 1 && kept[0].2 == "one", "{kept:?}");
}

/// A page whose network stalled shows an old frame. Its request used to begin a label at the newest frame, up to 10 s later than
/// the user saw.
#[test]
fn labels_begin_at_the_frame_that_the_page_shows_and_not_long_before_the_newest() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 9.0, 80);
    let served = replay(&recording, "1");
    let mut socket = page(&served.address);
    assert!(read_until(&mut socket, |said| said.contains("\"at_end\":true")), "it plays to its end");
    let newest_s = 7.9;
    let press = |socket: &mut Socket, text: String| socket.send(Message::text(text)).expect("sent");
    for shown_s in [newest_s - 4.0, newest_s + 4.0] {
        press(&mut socket, format!("{{\"do\":\"label\",\"occupancy\":\"one\",\"shown_s\":{shown_s}}}"));
        assert!(read_until(&mut socket, |said| said.contains("up to date")), "{shown_s} s");
    }
    press(&mut socket, "{\"do\":\"label\",\"occupancy\":\"one\",\"shown_s\":6.0}".to_owned());
    assert!(read_until(&mut socket, |said| said.contains("\"open\":{")));
    press(&mut socket, "{\"do\":\"stop\",\"shown_s\":7.5}".to_owned());
    assert!(read_until(&mut socket, |said| said.contains("\"open\":null")));
    drop(socket);
    assert!(served.stop(), "an orderly end");
    assert_eq!(read_labels(&recording), [(6.0, 7.5, "one".to_owned())]);
}

#[test]
fn labels_that_another_program_has_changed_are_not_overwritten() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 4.0, 20);
    let served = replay(&recording, "0");
    let mut socket = page(&served.address);
    assert!(read_until(&mut socket, |said| said.contains("\"at_end\":true")));
    let track = write_file(folder.path(), "track.txt", "0.1\t0.5\tempty\n");
    json_lines(command!("recording labels --json", &recording, "--import", &track));
    socket.send(Message::text("{\"do\":\"add\",\"start_s\":1,\"end_s\":1.5,\"occupancy\":\"one\"}")).expect("sent");
    assert!(read_until(&mut socket, |said| said.contains("another program")));
    drop(socket);
    assert!(!served.stop(), "what was not saved is a failure");
    assert_eq!(read_labels(&recording), [(0.1, 0.5, "empty".to_owned())]);
}

/// A step within 0.2 s after two seeks was counted from the first one and lost to the second one, which was sent later.
#[test]
fn a_step_soon_after_seeks_starts_at_the_target_of_the_last_seek() {
    let folder = tempfile::tempdir().expect("a folder");
    let served = replay(&simulate_walk(folder.path(), 2.0, 4.0, 20), SLOW);
    let Some(mut browser) = Browser::open(&served.url(), 1280, 900) else { return };
    pause_playback(&mut browser);
    browser.evaluate(
        "['Home', 'End', 'ArrowLeft'].forEach(key => \
         document.body.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true })))",
    );
    browser.wait_until("radome.header.answer.sequence === 18");
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
}
