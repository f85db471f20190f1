//! Server of the page. `access.rs` decides on access; `http_server.rs` limits connections. Refusals are counted and do
//! not load the pipeline.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, Request, State};
use axum::http::{HeaderValue, Method, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Router};
use radome_driver::recording::label_text;
use serde_json::json;
use tokio::net::TcpListener;
use tokio::sync::mpsc;

use super::control;
use super::feed::PageId;
use super::policy::Refusal;
use super::shared::Shared;
use crate::live::access::{self, Access};
use crate::live::http_server::{self, Client, Event, Limits};
use crate::panics::lock;

/// Longest message of a page, bytes. The page's own messages are below 200.
const LONGEST_MESSAGE: usize = 4096;
/// Largest number of messages of a page per second. A page acknowledges each picture, and a held key sends thirty.
const MOST_MESSAGES: u32 = 200;
/// Number of malformed messages after which a page is dropped.
const MOST_MALFORMED: u32 = 20;
/// Time without a complete message after which a page is dropped. Pages answer pings.
const SILENCE: Duration = Duration::from_secs(30);
/// Interval between signs of life to pages, which give a connection up after a silence (SILENCE in link.js).
const PING: Duration = Duration::from_secs(2);
/// Time of sending a message after which a page is dropped.
const SLOWEST_SEND: Duration = Duration::from_secs(10);
/// Interval at which changes besides pictures are sent to a page.
const TICK: Duration = Duration::from_millis(100);
/// Longest wait for pages at the end of a run.
const CLOSING_WAIT: Duration = Duration::from_secs(1);

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const JS: &str = "text/javascript; charset=utf-8";

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

/// Waits for pages to receive the end of the run and disconnect, at most [`CLOSING_WAIT`].
pub fn wait_for_disconnections(shared: &Shared) {
    let end = Instant::now() + CLOSING_WAIT;
    while shared.feed.pages() > 0 && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Serves until the program ends.
pub async fn serve(listener: TcpListener, shared: Arc<Shared>) {
    let router = Router::new()
        .route("/", get(|| async { file("") }))
        .route("/stream", get(stream))
        .route("/health.json", get(health))
        .route("/{file}", get(named))
        .fallback(|| async { StatusCode::NOT_FOUND })
        .layer(middleware::from_fn_with_state(shared.clone(), guard))
        .with_state(shared.clone());
    let count = move |event: Event| match event {
        Event::Replaced => shared.policy.count(Refusal::Connection),
        Event::Failed => shared.policy.count(Refusal::Unanswered),
    };
    http_server::serve(listener, router, Limits::default(), count).await;
}

/// Rejects requests that the policy refuses, and restricts browsers to resources of this page.
async fn guard(
    State(shared): State<Arc<Shared>>,
    Extension(client): Extension<Client>,
    request: Request,
    next: Next,
) -> Response {
    let admitted = check(&shared.policy.access, &request);
    let mut response = match admitted {
        Ok(admitted) => {
            client.admit();
            match admitted {
                Admitted::ByLink => shared.policy.access.login_response(),
                Admitted::Reader => next.run(request).await,
                Admitted::Writer => {
                    shared.policy.count(Refusal::Method);
                    (StatusCode::METHOD_NOT_ALLOWED, "this page is only read\n").into_response()
                }
            }
        }
        Err(refusal) => {
            shared.policy.count(refusal.into());
            // The body is freed before the delayed response.
            drop(request);
            refusal.response().await
        }
    };
    if response.status() == StatusCode::NOT_FOUND {
        shared.policy.count(Refusal::Path);
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
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Kind of an admitted request.
enum Admitted {
    /// Client with a correct link, which receives the cookie.
    ByLink,
    /// Client that reads.
    Reader,
    /// Client that writes, which requests cannot do.
    Writer,
}

fn check(access: &Access, request: &Request) -> Result<Admitted, access::Refusal> {
    let headers = request.headers();
    access.check_source(headers)?;
    let by_link = access.check_link(request.uri());
    match by_link {
        Some(false) => return Err(access::Refusal::WrongToken),
        Some(true) => {}
        None => access.check_token(headers)?,
    }
    if request.method() != Method::GET && request.method() != Method::HEAD {
        return Ok(Admitted::Writer);
    }
    access::check_no_body(headers)?;
    Ok(if by_link.is_some() { Admitted::ByLink } else { Admitted::Reader })
}

fn file(name: &str) -> Response {
    match FILES.iter().find(|(file, ..)| *file == name) {
        Some((_, kind, text)) => ([(header::CONTENT_TYPE, *kind)], Body::from(*text)).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

/// Serves a file of the page, or the labels as a file.
async fn named(Path(name): Path<String>, State(shared): State<Arc<Shared>>) -> Response {
    let labels = || shared.labels.labels();
    let (kind, text) = match name.as_str() {
        "labels.json" => ("application/json", label_text::to_json(&labels())),
        "labels.txt" => ("text/plain; charset=utf-8", label_text::to_audacity(&labels())),
        "labels.label" => ("text/csv; charset=utf-8", label_text::to_deepcraft(&labels())),
        _ => return file(&name),
    };
    let attachment = format!("attachment; filename=\"{name}\"");
    let headers = [(header::CONTENT_TYPE, kind.to_owned()), (header::CONTENT_DISPOSITION, attachment)];
    (headers, text).into_response()
}

async fn health(State(shared): State<Arc<Shared>>) -> Response {
    let is_full = shared.policy.pages.available_permits() == 0;
    let counters = json!({ "pages": shared.feed.pages(), "is_full": is_full, "refused": shared.policy.refused() });
    ([(header::CONTENT_TYPE, "application/json")], counters.to_string()).into_response()
}

async fn stream(upgrade: WebSocketUpgrade, State(shared): State<Arc<Shared>>) -> Response {
    // Taken before the upgrade, so that simultaneous requests cannot exceed the limit of pages. A failed upgrade
    // returns it.
    let Ok(permit) = shared.policy.pages.clone().try_acquire_owned() else {
        shared.policy.count(Refusal::Page);
        return (StatusCode::SERVICE_UNAVAILABLE, "too many pages are open\n").into_response();
    };
    let upgrade = upgrade.max_message_size(LONGEST_MESSAGE).max_frame_size(LONGEST_MESSAGE);
    upgrade.on_upgrade(move |socket| async move {
        let (page, pictures) = shared.feed.join();
        run_connection(socket, &shared, page, pictures).await;
        shared.feed.leave(page);
        drop(permit);
    })
}

/// State that was sent to a page, besides pictures.
#[derive(Default)]
struct SentState {
    labels: Option<u64>,
    playback: Option<radome_driver::player::Playback>,
    /// Numbers of refused requests and of pages.
    access: Option<(serde_json::Value, usize)>,
}

/// Exchanges messages until the page disconnects, is dropped, or the run is over.
async fn run_connection(socket: WebSocket, shared: &Shared, page: PageId, mut pictures: mpsc::Receiver<Bytes>) {
    let now = Instant::now();
    let (sent, last_message, last_ping, second_start) = (SentState::default(), now, now, now);
    let mut page =
        Connection { socket, shared, page, sent, last_message, last_ping, second_start, messages: 0, malformed: 0 };
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut is_connected = send_json(&mut page.socket, shared.about.hello()).await;
    while is_connected {
        is_connected = tokio::select! {
            received = page.socket.recv() => page.handle_received(received).await,
            picture = pictures.recv() => match picture {
                Some(picture) => send(&mut page.socket, Message::Binary(picture)).await,
                None => false,
            },
            _ = tick.tick() => page.send_updates().await,
        };
    }
}

/// Connected page. Its methods return whether it stays connected.
struct Connection<'a> {
    socket: WebSocket,
    shared: &'a Shared,
    page: PageId,
    sent: SentState,
    /// Time of the page's last complete message.
    last_message: Instant,
    last_ping: Instant,
    /// Start of the second in which `messages` are counted.
    second_start: Instant,
    messages: u32,
    malformed: u32,
}

impl Connection<'_> {
    /// Handles a message, or the end of the connection.
    async fn handle_received(&mut self, received: Option<Result<Message, axum::Error>>) -> bool {
        match received {
            None | Some(Ok(Message::Close(_))) => false,
            Some(Err(error)) => {
                let is_size = std::error::Error::source(&error).is_some_and(|e| e.to_string().contains("too long"))
                    || error.to_string().contains("too long");
                self.shared.policy.count(if is_size { Refusal::Oversized } else { Refusal::Message });
                false
            }
            Some(Ok(message)) => {
                self.last_message = Instant::now();
                self.handle_request(&message).await
            }
        }
    }

    /// Executes the request in a message, unless there are too many.
    async fn handle_request(&mut self, message: &Message) -> bool {
        if self.second_start.elapsed() >= Duration::from_secs(1) {
            (self.second_start, self.messages) = (Instant::now(), 0);
        }
        self.messages += 1;
        if self.messages > MOST_MESSAGES {
            self.shared.policy.count(Refusal::Flood);
            return close(&mut self.socket, "too many messages").await;
        }
        let result = match message {
            Message::Ping(_) | Message::Pong(_) => return true,
            Message::Text(text) => control::handle(self.shared, self.page, text.as_str()),
            _ => Err(anyhow::anyhow!("this is no message of the page")),
        };
        let Err(error) = result else { return true };
        if error.downcast_ref::<serde_json::Error>().is_some() || matches!(message, Message::Binary(_)) {
            self.shared.policy.count(Refusal::Message);
            self.malformed += 1;
            if self.malformed > MOST_MALFORMED {
                return close(&mut self.socket, "too many malformed messages").await;
            }
        }
        send_json(&mut self.socket, json!({ "refused": crate::output::chain(&error) })).await
    }

    /// Sends changes and pings; drops a silent page, and sends the summary at the end of the run.
    async fn send_updates(&mut self) -> bool {
        if !send_changes(&mut self.socket, self.shared, &mut self.sent).await {
            return false;
        }
        let summary = lock(&self.shared.summary).clone();
        if let Some(summary) = summary {
            send_json(&mut self.socket, summary).await;
            return close(&mut self.socket, "the run is over").await;
        }
        if self.last_message.elapsed() > SILENCE {
            return false;
        }
        if self.last_ping.elapsed() <= PING {
            return true;
        }
        self.last_ping = Instant::now();
        // Scripts see no pings, and notice by the text that the network is gone.
        send(&mut self.socket, Message::Ping(Bytes::new())).await
            && send_json(&mut self.socket, json!({ "alive": true })).await
    }
}

/// Sends changes of labels, playback and refusals.
async fn send_changes(socket: &mut WebSocket, shared: &Shared, sent: &mut SentState) -> bool {
    let labels = shared.labels.version();
    if sent.labels != Some(labels) {
        sent.labels = Some(labels);
        if !send_json(socket, shared.labels.message()).await {
            return false;
        }
    }
    if let Some(playback) = &shared.about.playback {
        let playback = playback.transport.playback();
        // Pictures report the playback position, unless the playback is paused.
        let has_changed = sent.playback.is_none_or(|sent| {
            (sent.playing, sent.speed, sent.at_end) != (playback.playing, playback.speed, playback.at_end)
        });
        if has_changed {
            sent.playback = Some(playback);
            let playback = json!({ "playing": playback.playing, "speed": playback.speed, "at_end": playback.at_end });
            if !send_json(socket, json!({ "playback": playback })).await {
                return false;
            }
        }
    }
    let access = (shared.policy.refused(), shared.feed.pages());
    if sent.access.as_ref() != Some(&access) {
        let (refused, pages) = &access;
        if !send_json(socket, json!({ "access": { "refused": refused, "pages": pages } })).await {
            return false;
        }
        sent.access = Some(access);
    }
    true
}

async fn send_json(socket: &mut WebSocket, value: serde_json::Value) -> bool {
    send(socket, Message::Text(value.to_string().into())).await
}

/// Sends a message; returns whether the page has taken it.
async fn send(socket: &mut WebSocket, message: Message) -> bool {
    matches!(tokio::time::timeout(SLOWEST_SEND, socket.send(message)).await, Ok(Ok(())))
}

/// Closes the connection. Always returns `false`: the page is no longer connected.
async fn close(socket: &mut WebSocket, why: &'static str) -> bool {
    send(socket, Message::Close(Some(CloseFrame { code: 1008, reason: why.into() }))).await;
    false
}
