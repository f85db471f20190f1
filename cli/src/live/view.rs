//! The live page: the newest map and answer in a browser. It never slows the pipeline: it shows what is newest.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::Context;
use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::response::{Html, IntoResponse};
use axum::routing::get;
use radome_dsp::{Gap, Rdm};
use serde::Serialize;
use tokio::sync::watch;

use super::classify::Answer;
use super::health::Health;
use super::sink::{Moment, Sink};

/// Options of the page.
#[derive(clap::Args)]
pub struct Arguments {
    /// Serve a live page on this machine
    #[arg(long)]
    view: bool,
    /// Address of the page
    #[arg(long, default_value = "127.0.0.1:8060")]
    listen: SocketAddr,
}

/// The page's server, on a thread of its own.
pub struct Page {
    newest: watch::Sender<Bytes>,
}

/// What the browser gets before the cells of the map.
#[derive(Serialize)]
struct Header<'a> {
    answer: &'a Answer,
    doppler: usize,
    range: usize,
    range_step_m: f64,
    velocity_step_m_per_s: f64,
    /// dB of a cell is `low_db + cell * step_db`.
    low_db: f32,
    step_db: f32,
}

impl Page {
    /// Starts serving if the page is wanted.
    pub fn open(arguments: &Arguments) -> anyhow::Result<Option<Page>> {
        if !arguments.view {
            return Ok(None);
        }
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let listener = runtime.block_on(tokio::net::TcpListener::bind(arguments.listen)).with_context(|| {
            format!(
                "cannot serve the page on {}\n\nhint: choose another with --listen 127.0.0.1:PORT",
                arguments.listen
            )
        })?;
        eprintln!("live page: http://{}", listener.local_addr()?);
        let (newest, receiver) = watch::channel(Bytes::new());
        let router = Router::new()
            .route("/", get(|| async { Html(include_str!("page.html")) }))
            .route("/stream", get(stream))
            .with_state(receiver);
        std::thread::spawn(move || {
            if let Err(error) = runtime.block_on(async { axum::serve(listener, router).await }) {
                tracing::error!("live page: {error}");
            }
        });
        Ok(Some(Page { newest }))
    }
}

impl Sink for Page {
    fn answer(&mut self, moment: &Moment) -> anyhow::Result<()> {
        if self.newest.receiver_count() > 0
            && let Some(message) = message(moment.answer, moment.map)
        {
            self.newest.send_replace(message);
        }
        Ok(())
    }

    fn gap(&mut self, _gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        Ok(())
    }
}

/// Length of the header in four bytes, the header in JSON, then one byte a cell of the first channel, `[doppler][range]`.
fn message(answer: &Answer, map: &Rdm) -> Option<Bytes> {
    let cells = &map.db[..map.shape.doppler * map.shape.range];
    // From just under the noise, and over 40 dB at least: an empty room is dark and does not flicker.
    let mut finite: Vec<f32> = cells.iter().copied().filter(|v| v.is_finite()).collect();
    let high_db = finite.iter().copied().fold(f32::MIN, f32::max);
    let middle = finite.len() / 2;
    let low_db = match finite.get(middle) {
        Some(_) => *finite.select_nth_unstable_by(middle, f32::total_cmp).1 - 3.0,
        None => 0.0,
    };
    let step_db = (high_db - low_db).max(40.0) / 254.0;
    let header = Header {
        answer,
        doppler: map.shape.doppler,
        range: map.shape.range,
        range_step_m: map.range_step_m,
        velocity_step_m_per_s: map.velocity_step_m_per_s,
        low_db,
        step_db,
    };
    let header = serde_json::to_vec(&header).ok()?;
    let mut bytes = Vec::with_capacity(4 + header.len() + cells.len());
    bytes.extend_from_slice(&(header.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&header);
    // 255 marks what is no number.
    bytes.extend(
        cells.iter().map(|v| if v.is_finite() { ((v - low_db) / step_db).clamp(0.0, 254.0) as u8 } else { 255 }),
    );
    Some(bytes.into())
}

async fn stream(upgrade: WebSocketUpgrade, State(newest): State<watch::Receiver<Bytes>>) -> impl IntoResponse {
    upgrade.on_upgrade(move |socket| send(socket, newest))
}

async fn send(mut socket: WebSocket, mut newest: watch::Receiver<Bytes>) {
    while newest.changed().await.is_ok() {
        let message = newest.borrow_and_update().clone();
        if socket.send(Message::Binary(message)).await.is_err() {
            return;
        }
        // Thirty pictures a second are enough for eyes.
        tokio::time::sleep(Duration::from_millis(33)).await;
    }
}
