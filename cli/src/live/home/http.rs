//! The metrics' server: short answers to short requests, and little patience with anything else.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{ConnectInfo, Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use radome_dsp::Occupancy;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use super::keep::{Report, Reports};
use super::latest::{Latest, count};
use super::metrics;

/// Connections at a time; more are closed at once.
const MOST_CONNECTIONS: usize = 64;
/// A request must be there within this.
const HEAD_DEADLINE: Duration = Duration::from_secs(2);
/// And answered within this.
const DEADLINE: Duration = Duration::from_secs(5);
/// Longest request line and headers.
const MOST_HEAD_BYTES: usize = 8192;
const MOST_HEADERS: usize = 48;

#[derive(Clone)]
struct Served {
    latest: Arc<Latest>,
    reports: Option<Reports>,
}

/// Serves until the program ends.
pub async fn serve(listener: TcpListener, latest: Arc<Latest>, reports: Option<Reports>) {
    let router = Router::new()
        .route("/metrics", get(show_metrics))
        .route("/health", get(show_health))
        .route("/report/{truth}", post(report))
        .layer(middleware::from_fn_with_state(latest.clone(), count_refused))
        .with_state(Served { latest: latest.clone(), reports });
    let free = Arc::new(Semaphore::new(MOST_CONNECTIONS));
    loop {
        let (socket, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                // Out of file descriptors, say: those that are open must close first.
                tracing::debug!("metrics: {error}");
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let Ok(permit) = free.clone().try_acquire_owned() else {
            count(&latest.counters.http_turned_away);
            continue;
        };
        let service = TowerToHyperService::new(router.clone().layer(Extension(ConnectInfo(peer))));
        let latest = latest.clone();
        tokio::spawn(async move {
            let connection = http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEAD_DEADLINE)
                .max_buf_size(MOST_HEAD_BYTES)
                .max_headers(MOST_HEADERS)
                .keep_alive(false)
                .serve_connection(TokioIo::new(socket), service);
            if !matches!(tokio::time::timeout(DEADLINE, connection).await, Ok(Ok(()))) {
                count(&latest.counters.http_refused);
            }
            drop(permit);
        });
    }
}

async fn count_refused(State(latest): State<Arc<Latest>>, request: axum::extract::Request, next: Next) -> Response {
    let response = next.run(request).await;
    if response.status().is_client_error() {
        count(&latest.counters.http_refused);
    }
    response
}

async fn show_metrics(State(served): State<Served>) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], metrics::text(&served.latest))
}

/// 200 while frames are labelled, 503 otherwise.
async fn show_health(State(served): State<Served>) -> impl IntoResponse {
    match served.latest.said() {
        Some(_) => (StatusCode::OK, "frames are labelled\n"),
        None => (StatusCode::SERVICE_UNAVAILABLE, "no frame has been labelled for a while\n"),
    }
}

/// Saves the last minute: asked by this machine, and by no page in a browser on it.
async fn report(
    State(served): State<Served>,
    Extension(ConnectInfo(peer)): Extension<ConnectInfo<SocketAddr>>,
    headers: HeaderMap,
    Path(truth): Path<String>,
) -> (StatusCode, &'static str) {
    if !peer.ip().is_loopback() || headers.contains_key(header::ORIGIN) {
        return (StatusCode::FORBIDDEN, "reports are taken from programs on this machine\n");
    }
    let Some(truth) = Occupancy::from_name(&truth) else {
        return (StatusCode::NOT_FOUND, "report what is true: empty, one or two\n");
    };
    match &served.reports {
        None => (StatusCode::NOT_FOUND, "nothing is kept: start with --keep-to FOLDER\n"),
        Some(reports) if reports.send(Report { truth, by: "http" }) => (StatusCode::ACCEPTED, "kept\n"),
        Some(_) => {
            count(&served.latest.counters.reports_refused);
            (StatusCode::TOO_MANY_REQUESTS, "another report is being saved\n")
        }
    }
}
