//! Notifications for systemd with `Type=notify`: ready, watchdog while frames arrive, stopping.

use std::sync::Arc;
use std::time::{Duration, Instant};

use sd_notify::NotifyState;
use tokio::sync::watch;

use super::latest::Latest;

/// Interval of the checks, unless the watchdog needs a shorter one.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);
/// Interval between lines of status.
const STATUS_INTERVAL: Duration = Duration::from_secs(5);

/// Returns whether systemd expects notifications.
pub fn is_wanted() -> bool {
    std::env::var_os("NOTIFY_SOCKET").is_some()
}

/// Sends notifications until `stop` is set.
pub async fn run(latest: Arc<Latest>, mut stop: watch::Receiver<bool>) {
    let watchdog = sd_notify::watchdog_enabled();
    let mut check = tokio::time::interval(watchdog.map_or(CHECK_INTERVAL, |period| (period / 4).min(CHECK_INTERVAL)));
    let mut is_ready = false;
    let mut last_status: Option<Instant> = None;
    let mut frames_before = 0;
    loop {
        tokio::select! {
            _ = stop.changed() => break,
            _ = check.tick() => {}
        }
        let (frames, _) = latest.frames();
        let has_new_frames = frames > std::mem::replace(&mut frames_before, frames);
        if !is_ready && latest.answer().is_some() {
            is_ready = true;
            notify(&[NotifyState::Ready]);
        }
        // The watchdog is notified only while frames arrive, so that it also detects a dead board.
        if has_new_frames && watchdog.is_some() {
            notify(&[NotifyState::Watchdog]);
        }
        if last_status.is_none_or(|last_status| last_status.elapsed() >= STATUS_INTERVAL) {
            last_status = Some(Instant::now());
            notify(&[NotifyState::Status(&status(&latest))]);
        }
    }
    notify(&[NotifyState::Stopping]);
}

fn status(latest: &Latest) -> String {
    let newest = latest.newest();
    let health = &newest.health;
    let room = match latest.answer() {
        Some(answer) => match answer.people {
            0 => "empty",
            1 => "occupied, one person",
            _ => "occupied, two people or more",
        },
        None => "no answer",
    };
    format!(
        "{room}; {} frames, {:.1}/s, {} dropped, label after {:.1} ms",
        health.frames,
        latest.frames_per_s(),
        health.dropped_total(),
        health.latency.quantile_s(0.5) * 1e3
    )
}

fn notify(state: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!("systemd does not listen: {error}");
    }
}
