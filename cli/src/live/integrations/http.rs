//! Server of the metrics: Prometheus metrics, health checks, and reports of wrong answers.

use std::sync::Arc;

use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use radome_dsp::Occupancy;
use tokio::net::TcpListener;

use super::latest::{Latest, count};
use super::metrics;
use super::report_buffer::{Report, ReportSender};
use crate::live::access::{self, Access};
use crate::live::http_server::{self, Client, Event, Limits};

/// Largest number of simultaneous connections; a scraper needs one.
const MOST_CONNECTIONS: usize = 64;

#[derive(Clone)]
struct HttpState {
    latest: Arc<Latest>,
    reports: Option<ReportSender>,
}

/// Serves until the program ends.
pub async fn serve(listener: TcpListener, access: Access, latest: Arc<Latest>, reports: Option<ReportSender>) {
    let router = Router::new()
        .route("/metrics", get(show_metrics))
        .route("/health", get(show_health))
        .route("/report/{truth}", post(report))
        .layer(middleware::from_fn_with_state(Arc::new(access), guard))
        .layer(middleware::from_fn_with_state(latest.clone(), count_refused))
        .with_state(HttpState { latest: latest.clone(), reports });
    let limits = Limits { connections: MOST_CONNECTIONS, ..Limits::default() };
    http_server::serve(listener, router, limits, move |event: Event| match event {
        Event::Replaced => count(&latest.counters.http_turned_away),
        Event::Failed => count(&latest.counters.http_refused),
    })
    .await;
}

/// Refuses requests that name another host, come from another site, or lack the token.
async fn guard(
    State(access): State<Arc<Access>>,
    Extension(client): Extension<Client>,
    request: Request,
    next: Next,
) -> Response {
    let admitted = check(&access, request.headers());
    match admitted {
        Ok(()) => {
            client.admit();
            next.run(request).await
        }
        Err(refusal) => {
            drop(request);
            refusal.response().await
        }
    }
}

fn check(access: &Access, headers: &HeaderMap) -> Result<(), access::Refusal> {
    access.check_source(headers)?;
    access.check_token(headers)?;
    access::check_no_body(headers)
}

async fn count_refused(State(latest): State<Arc<Latest>>, request: Request, next: Next) -> Response {
    let response = next.run(request).await;
    if response.status().is_client_error() {
        count(&latest.counters.http_refused);
    }
    response
}

async fn show_metrics(State(state): State<HttpState>) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], metrics::text(&state.latest))
}

/// Returns 200 while there is a settled answer, 503 otherwise.
async fn show_health(State(state): State<HttpState>) -> impl IntoResponse {
    match state.latest.answer() {
        Some(_) => (StatusCode::OK, "frames are labelled\n"),
        None => (
            StatusCode::SERVICE_UNAVAILABLE,
            "there is no answer: no frames come, their receivers give no signal, or those since the start or the last outage are too \
             few\n",
        ),
    }
}

/// Saves the last minute. Accepts requests from this machine only, and none from a page in a browser.
async fn report(
    State(state): State<HttpState>,
    Extension(client): Extension<Client>,
    headers: HeaderMap,
    Path(truth): Path<String>,
) -> (StatusCode, &'static str) {
    // A proxy on this machine passes on what others send.
    let is_forwarded = ["forwarded", "x-forwarded-for"].into_iter().any(|name| headers.contains_key(name));
    if !client.address.ip().to_canonical().is_loopback() || is_forwarded || headers.contains_key(header::ORIGIN) {
        return (StatusCode::FORBIDDEN, "reports are taken from programs on this machine\n");
    }
    let Some(truth) = Occupancy::from_name(&truth) else {
        return (StatusCode::NOT_FOUND, "report what is true: empty, one or two\n");
    };
    match &state.reports {
        None => (StatusCode::NOT_FOUND, "nothing is kept: start with --keep-to DIR\n"),
        Some(reports) if reports.send(Report { truth, channel: "http" }) => {
            (StatusCode::ACCEPTED, "accepted; the log says whether it is kept\n")
        }
        Some(_) => (StatusCode::TOO_MANY_REQUESTS, "another report is being saved\n"),
    }
}
