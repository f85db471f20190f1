//! Who may connect, to what, and how much of it. The page can be reached by whatever runs in a browser on this machine, so
//! every request names its host and, where it has one, its origin, and both must be ours: otherwise any site could watch
//! through its visitors' browsers (cross-site sockets, rebound names). Whatever is refused is counted, and costs the pipeline nothing.

use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::serve::Listener;
use radome_driver::recording::label_text;
use serde_json::json;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Sleep;

use super::{Shared, control};

/// Connections at a time; a browser opens six.
const MOST_CONNECTIONS: usize = 128;
/// Pages at a time.
const MOST_PAGES: usize = 16;
/// Longest message of a page, bytes. Its own are below 200.
const LONGEST_MESSAGE: usize = 4096;
/// Messages of a page in a second; a picture is answered by one, a held key makes thirty.
const MOST_MESSAGES: u32 = 200;
/// Malformed messages after which a page is none.
const MOST_MALFORMED: u32 = 20;
/// A connection that says nothing for so long is dropped. Pages answer pings.
const SILENCE: Duration = Duration::from_secs(30);
/// How often pages are pinged.
const PING: Duration = Duration::from_secs(10);
/// A page that takes a message in for longer is given up.
const SLOWEST_SEND: Duration = Duration::from_secs(10);
/// How often a page is told what has changed beside pictures.
const TICK: Duration = Duration::from_millis(100);
/// Longest wait for pages at the end of a run.
const FAREWELL: Duration = Duration::from_secs(1);

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const JS: &str = "text/javascript; charset=utf-8";

/// Everything that the page is made of.
const FILES: [(&str, &str, &str); 12] = [
    ("", HTML, include_str!("page/index.html")),
    ("style.css", CSS, include_str!("page/style.css")),
    ("main.js", JS, include_str!("page/main.js")),
    ("link.js", JS, include_str!("page/link.js")),
    ("plot.js", JS, include_str!("page/plot.js")),
    ("map.js", JS, include_str!("page/map.js")),
    ("profile.js", JS, include_str!("page/profile.js")),
    ("doppler.js", JS, include_str!("page/doppler.js")),
    ("chirps.js", JS, include_str!("page/chirps.js")),
    ("timeline.js", JS, include_str!("page/timeline.js")),
    ("labels.js", JS, include_str!("page/labels.js")),
    ("health.js", JS, include_str!("page/health.js")),
];

/// Why somebody was not let in, or thrown out.
#[derive(Debug, Clone, Copy)]
enum Refusal {
    Connection,
    Host,
    Origin,
    Method,
    Path,
    Page,
    Message,
    Oversized,
    Flood,
}

const REFUSALS: [&str; 9] =
    ["connections", "host", "origin", "method", "path", "pages", "messages", "oversized", "flood"];

/// Who may come in, and how many were not let in.
pub struct Doors {
    port: u16,
    /// Set where the page is for this machine alone.
    is_loopback: bool,
    names: Vec<String>,
    refused: [AtomicU64; REFUSALS.len()],
    connections: Arc<Semaphore>,
}

impl Doors {
    /// Doors at an address, open also to those who call it by other names.
    pub fn new(address: SocketAddr, allowed: &[String]) -> Self {
        let mut names: Vec<String> = allowed.iter().map(|name| name.to_ascii_lowercase()).collect();
        let is_loopback = address.ip().is_loopback();
        names.push(format!("localhost:{}", address.port()));
        if !is_loopback && let Ok(name) = std::fs::read_to_string("/proc/sys/kernel/hostname") {
            let name = name.trim().to_ascii_lowercase();
            names.push(format!("{name}:{}", address.port()));
            names.push(format!("{name}.local:{}", address.port()));
        }
        Doors {
            port: address.port(),
            is_loopback,
            names,
            refused: Default::default(),
            connections: Arc::new(Semaphore::new(MOST_CONNECTIONS)),
        }
    }

    /// Whether a `Host` means this page: one of its names, or an address. An address cannot be rebound as names can; that of
    /// another machine does not lead here.
    fn knows_host(&self, host: &str) -> bool {
        let host = host.to_ascii_lowercase();
        if self.names.contains(&host) {
            return true;
        }
        // Browsers leave out the port that is http's own.
        let with_port = if self.port == 80 && host.parse::<IpAddr>().is_ok() { format!("{host}:80") } else { host };
        let Ok(address) = with_port.parse::<SocketAddr>() else { return false };
        address.port() == self.port && (!self.is_loopback || address.ip().is_loopback())
    }

    fn count(&self, refusal: Refusal) {
        if let Some(counter) = self.refused.get(refusal as usize) {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn open_connections(&self) -> usize {
        MOST_CONNECTIONS - self.connections.available_permits()
    }

    fn told(&self) -> serde_json::Value {
        let refused =
            REFUSALS.iter().zip(&self.refused).map(|(name, n)| ((*name).to_owned(), n.load(Ordering::Relaxed).into()));
        refused.collect::<serde_json::Map<String, serde_json::Value>>().into()
    }
}

/// Waits a little until pages have heard that the run is over, and gone.
pub fn wait_for_farewells(shared: &Shared) {
    let end = Instant::now() + FAREWELL;
    while shared.feed.pages() > 0 && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Serves for ever.
pub async fn serve(listener: TcpListener, shared: Arc<Shared>) -> std::io::Result<()> {
    let router = Router::new()
        .route("/", get(|| async { file("") }))
        .route("/stream", get(stream))
        .route("/health.json", get(health))
        .route("/labels.json", get(labels_json))
        .route("/labels.txt", get(labels_audacity))
        .route("/labels.label", get(labels_deepcraft))
        .route("/{file}", get(named))
        .fallback(|| async { StatusCode::NOT_FOUND })
        .layer(middleware::from_fn_with_state(shared.clone(), guard))
        .with_state(shared.clone());
    axum::serve(Door { listener, shared }, router).await
}

/// Takes connections in, as many as there may be.
struct Door {
    listener: TcpListener,
    shared: Arc<Shared>,
}

impl Listener for Door {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            let (stream, address) = Listener::accept(&mut self.listener).await;
            let doors = &self.shared.doors;
            // Whoever is one too many is gone before a byte is read.
            let Ok(permit) = doors.connections.clone().try_acquire_owned() else {
                doors.count(Refusal::Connection);
                continue;
            };
            let _ = stream.set_nodelay(true);
            let silence = Box::pin(tokio::time::sleep(SILENCE));
            return (Connection { stream, silence, _permit: permit }, address);
        }
    }

    fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// A connection that may not be silent for long.
struct Connection {
    stream: TcpStream,
    silence: Pin<Box<Sleep>>,
    _permit: OwnedSemaphorePermit,
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_read(cx, buffer);
        if polled.is_ready() {
            self.silence.as_mut().reset(tokio::time::Instant::now() + SILENCE);
            return polled;
        }
        match self.silence.as_mut().poll(cx) {
            Poll::Ready(()) => Poll::Ready(Err(std::io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// Lets nothing pass that is not from this page, and tells browsers to load nothing that is not of it.
async fn guard(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    if let Some(refused) = refuse(&shared.doors, &request) {
        return refused;
    }
    let mut response = next.run(request).await;
    if response.status() == StatusCode::NOT_FOUND {
        shared.doors.count(Refusal::Path);
    }
    let headers = response.headers_mut();
    for (name, value) in [
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; base-uri 'none'; \
             form-action 'none'; frame-ancestors 'self'",
        ),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-cache"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

fn refuse(doors: &Doors, request: &Request) -> Option<Response> {
    let text = |name| request.headers().get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let host = text(header::HOST).unwrap_or("");
    let refuse = |refusal, status, why: &'static str| {
        doors.count(refusal);
        Some((status, why).into_response())
    };
    if !doors.knows_host(host) {
        let why = "this page is not called by that name; --allow-host NAME:PORT gives it one more\n";
        return refuse(Refusal::Host, StatusCode::FORBIDDEN, why);
    }
    // Only browsers name an origin; what they send from another site is not this page's.
    if request.headers().contains_key(header::ORIGIN) {
        let origin = text(header::ORIGIN).unwrap_or("").to_ascii_lowercase();
        let of = origin.strip_prefix("http://").or(origin.strip_prefix("https://")).unwrap_or("");
        if of != host.to_ascii_lowercase() {
            return refuse(Refusal::Origin, StatusCode::FORBIDDEN, "another site may not use this page\n");
        }
    }
    if request.method() != Method::GET && request.method() != Method::HEAD {
        return refuse(Refusal::Method, StatusCode::METHOD_NOT_ALLOWED, "this page is only read\n");
    }
    None
}

fn file(name: &str) -> Response {
    match FILES.iter().find(|(file, ..)| *file == name) {
        Some((_, kind, text)) => ([(header::CONTENT_TYPE, *kind)], Body::from(*text)).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn named(Path(name): Path<String>) -> Response {
    file(&name)
}

async fn health(State(shared): State<Arc<Shared>>) -> Response {
    let told = json!({
        "pages": shared.feed.pages(),
        "connections": shared.doors.open_connections(),
        "refused": shared.doors.told(),
    });
    ([(header::CONTENT_TYPE, "application/json")], told.to_string()).into_response()
}

fn download(name: &'static str, kind: &'static str, text: String) -> Response {
    let mut headers = HeaderMap::new();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    headers.insert(header::CONTENT_DISPOSITION, HeaderValue::from_static(name));
    (headers, text).into_response()
}

async fn labels_json(State(shared): State<Arc<Shared>>) -> Response {
    let text = json!(shared.labels.labels()).to_string();
    download("attachment; filename=\"labels.json\"", "application/json", text)
}

async fn labels_audacity(State(shared): State<Arc<Shared>>) -> Response {
    let text = label_text::to_audacity(&shared.labels.labels());
    download("attachment; filename=\"labels.txt\"", "text/plain; charset=utf-8", text)
}

async fn labels_deepcraft(State(shared): State<Arc<Shared>>) -> Response {
    let text = label_text::to_deepcraft(&shared.labels.labels());
    download("attachment; filename=\"labels.label\"", "text/csv; charset=utf-8", text)
}

async fn stream(upgrade: WebSocketUpgrade, State(shared): State<Arc<Shared>>) -> Response {
    if shared.feed.pages() >= MOST_PAGES {
        shared.doors.count(Refusal::Page);
        return (StatusCode::SERVICE_UNAVAILABLE, "too many pages are open\n").into_response();
    }
    let upgrade = upgrade.max_message_size(LONGEST_MESSAGE).max_frame_size(LONGEST_MESSAGE);
    upgrade.on_upgrade(move |socket| async move {
        let (page, pictures) = shared.feed.join();
        converse(socket, &shared, page, pictures).await;
        shared.feed.leave(page);
    })
}

/// What a page has been told beside pictures.
#[derive(Default)]
struct Told {
    labels: Option<u64>,
    playback: Option<radome_driver::player::Playback>,
    refused: Option<serde_json::Value>,
}

/// Until the page goes, is thrown out, or the run is over.
async fn converse(
    mut socket: WebSocket,
    shared: &Shared,
    page: super::feed::PageId,
    mut pictures: tokio::sync::mpsc::Receiver<axum::body::Bytes>,
) {
    let mut told = Told::default();
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut pinged = Instant::now();
    let (mut second, mut messages, mut malformed) = (Instant::now(), 0, 0);
    if !say(&mut socket, shared.about.hello()).await {
        return;
    }
    loop {
        tokio::select! {
            said = socket.recv() => match said {
                None => return,
                Some(Err(error)) => {
                    let is_size = std::error::Error::source(&error).is_some_and(|e| e.to_string().contains("too long"))
                        || error.to_string().contains("too long");
                    shared.doors.count(if is_size { Refusal::Oversized } else { Refusal::Message });
                    return;
                }
                Some(Ok(Message::Close(_))) => return,
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                Some(Ok(message)) => {
                    if second.elapsed() >= Duration::from_secs(1) {
                        (second, messages) = (Instant::now(), 0);
                    }
                    messages += 1;
                    if messages > MOST_MESSAGES {
                        shared.doors.count(Refusal::Flood);
                        return throw_out(&mut socket, "too many messages").await;
                    }
                    let obeyed = match &message {
                        Message::Text(text) => control::obey(shared, page, text.as_str()),
                        _ => Err(anyhow::anyhow!("that is no message of this page")),
                    };
                    if let Err(error) = obeyed {
                        if error.downcast_ref::<serde_json::Error>().is_some() || matches!(message, Message::Binary(_)) {
                            shared.doors.count(Refusal::Message);
                            malformed += 1;
                            if malformed > MOST_MALFORMED {
                                return throw_out(&mut socket, "too many malformed messages").await;
                            }
                        }
                        if !say(&mut socket, json!({ "refused": crate::output::chain(&error) })).await {
                            return;
                        }
                    }
                }
            },
            picture = pictures.recv() => match picture {
                Some(picture) => {
                    if !send(&mut socket, Message::Binary(picture)).await {
                        return;
                    }
                }
                None => return,
            },
            _ = tick.tick() => {
                if !news(&mut socket, shared, &mut told).await {
                    return;
                }
                let over = shared.over().clone();
                if let Some(over) = over {
                    say(&mut socket, over).await;
                    return throw_out(&mut socket, "the run is over").await;
                }
                if pinged.elapsed() > PING {
                    pinged = Instant::now();
                    if !send(&mut socket, Message::Ping(axum::body::Bytes::new())).await {
                        return;
                    }
                }
            }
        }
    }
}

/// What has changed beside pictures.
async fn news(socket: &mut WebSocket, shared: &Shared, told: &mut Told) -> bool {
    let labels = shared.labels.told_count();
    if told.labels != Some(labels) {
        told.labels = Some(labels);
        if !say(socket, shared.labels.told()).await {
            return false;
        }
    }
    if let Some(tape) = &shared.about.tape {
        let playback = tape.transport.playback();
        // Where it is, pictures say, unless it stands.
        let is_news = told.playback.is_none_or(|told| {
            (told.playing, told.speed, told.at_end) != (playback.playing, playback.speed, playback.at_end)
        });
        if is_news {
            told.playback = Some(playback);
            let playback = json!({ "playing": playback.playing, "speed": playback.speed, "at_end": playback.at_end });
            if !say(socket, json!({ "playback": playback })).await {
                return false;
            }
        }
    }
    let refused = shared.doors.told();
    if told.refused.as_ref() != Some(&refused) {
        let pages = shared.feed.pages();
        if !say(socket, json!({ "doors": { "refused": refused, "pages": pages } })).await {
            return false;
        }
        told.refused = Some(refused);
    }
    true
}

async fn say(socket: &mut WebSocket, value: serde_json::Value) -> bool {
    send(socket, Message::Text(value.to_string().into())).await
}

/// Whether the page has taken it.
async fn send(socket: &mut WebSocket, message: Message) -> bool {
    matches!(tokio::time::timeout(SLOWEST_SEND, socket.send(message)).await, Ok(Ok(())))
}

async fn throw_out(socket: &mut WebSocket, why: &'static str) {
    send(socket, Message::Close(Some(CloseFrame { code: 1008, reason: why.into() }))).await;
}

#[cfg(test)]
mod tests {
    use super::*;

    mod hard_cases {
        use super::*;

        #[test]
        fn names_that_are_not_ours_are_not_known() {
            let here = Doors::new("127.0.0.1:8060".parse().expect("an address"), &["Radar.example".into()]);
            for host in ["127.0.0.1:8060", "localhost:8060", "LOCALHOST:8060", "[::1]:8060", "radar.example"] {
                assert!(here.knows_host(host), "{host}");
            }
            for host in [
                "",
                "localhost",
                "localhost:8061",
                "127.0.0.1",
                "127.0.0.1:80600",
                "evil.example:8060",
                "192.168.0.4:8060",
                "localhost.evil.example:8060",
                "127.0.0.1.evil.example:8060",
                "radar.example:8060",
                "[::1]",
                "127.1:8060",
            ] {
                assert!(!here.knows_host(host), "{host}");
            }
            let open = Doors::new("0.0.0.0:80".parse().expect("an address"), &[]);
            for host in ["192.168.0.4:80", "192.168.0.4", "[fe80::1]:80"] {
                assert!(open.knows_host(host), "{host}");
            }
            assert!(!open.knows_host("evil.example") && !open.knows_host("evil.example:80"));
        }
    }
}
