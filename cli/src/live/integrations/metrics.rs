//! A run in Prometheus' text format, version 0.0.4.

use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering};

use radome_dsp::Occupancy;

use super::latest::Latest;

/// Upper bounds of the latency's buckets, s.
const BOUNDS_S: [f64; 10] = [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5, 1.0];

/// All metrics.
pub fn text(latest: &Latest) -> String {
    let newest = latest.newest();
    let health = &newest.health;
    let counters = &latest.counters;
    let said = latest.said();
    let mut page = Page(String::with_capacity(4096));

    page.metric("radome_build_info", "gauge", "The program.");
    page.sample("radome_build_info", &[("version", env!("CARGO_PKG_VERSION"))], 1.0);
    page.metric("radome_up", "gauge", "Whether frames come and are labelled.");
    page.sample("radome_up", &[], if said.is_some() { 1.0 } else { 0.0 });
    page.metric("radome_uptime_seconds", "gauge", "Since the start of the program.");
    page.sample("radome_uptime_seconds", &[], health.started.elapsed().as_secs_f64());

    page.metric("radome_occupied", "gauge", "Whether the room counts as occupied, after delays; absent while unknown.");
    if let Some(said) = said {
        page.sample("radome_occupied", &[], if said.people > 0 { 1.0 } else { 0.0 });
    }
    page.metric("radome_people", "gauge", "People that the room counts as holding, after delays.");
    if let Some(said) = said {
        page.sample("radome_people", &[], said.people as f64);
    }
    page.metric("radome_probability", "gauge", "Probability of each class.");
    if let Some(said) = said {
        for class in Occupancy::ALL {
            let probability = said.probabilities.get(class.index()).copied().unwrap_or(0.0);
            page.sample("radome_probability", &[("label", class.name())], f64::from(probability));
        }
    }

    page.metric("radome_frames_total", "counter", "Frames judged.");
    page.sample("radome_frames_total", &[], health.frames as f64);
    page.metric("radome_labels_total", "counter", "How often each label was given.");
    for class in Occupancy::ALL {
        let labels = health.labels.get(class.index()).copied().unwrap_or(0);
        page.sample("radome_labels_total", &[("label", class.name())], labels as f64);
    }
    page.metric("radome_frames_dropped_total", "counter", "Frames lost, by reason.");
    for (reason, frames) in &health.dropped {
        page.sample("radome_frames_dropped_total", &[("reason", reason.name())], *frames as f64);
    }
    page.metric("radome_saturated_samples_total", "counter", "Samples at either end of the ADC.");
    page.sample("radome_saturated_samples_total", &[], health.saturated_samples as f64);
    page.metric("radome_frame_rate_hertz", "gauge", "Frames in a second, over the newest.");
    page.sample("radome_frame_rate_hertz", &[], health.frames_per_s());
    page.metric(
        "radome_chip_temperature_celsius",
        "gauge",
        "Temperature of the radar chip; absent where none is known.",
    );
    if let Some(temperature) = health.temperature_millicelsius {
        page.sample("radome_chip_temperature_celsius", &[], f64::from(temperature) * 1e-3);
    }

    let name = "radome_latency_seconds";
    page.metric(name, "histogram", "From a frame's last byte to its label.");
    for bound_s in BOUNDS_S {
        let count = health.latency.count_up_to(bound_s);
        page.sample("radome_latency_seconds_bucket", &[("le", &bound_s.to_string())], count as f64);
    }
    page.sample("radome_latency_seconds_bucket", &[("le", "+Inf")], health.latency.count() as f64);
    page.sample("radome_latency_seconds_sum", &[], health.latency.sum_s());
    page.sample("radome_latency_seconds_count", &[], health.latency.count() as f64);

    let connected = counters.mqtt_connected.load(Ordering::Relaxed);
    page.metric("radome_mqtt_connected", "gauge", "Whether the MQTT broker listens.");
    page.sample("radome_mqtt_connected", &[], if connected { 1.0 } else { 0.0 });
    for (name, help, counter) in [
        ("radome_mqtt_connections_total", "Connections to the broker.", &counters.mqtt_connections),
        ("radome_mqtt_published_total", "Messages sent to the broker.", &counters.mqtt_published),
        ("radome_mqtt_refused_total", "Messages of others that were not obeyed.", &counters.mqtt_refused),
        ("radome_http_turned_away_total", "Connections that gave way to newer ones.", &counters.http_turned_away),
        (
            "radome_http_refused_total",
            "Requests that were malformed, too long, too slow or without the token.",
            &counters.http_refused,
        ),
        ("radome_reports_kept_total", "Reports of wrong answers that were saved.", &counters.reports_kept),
        ("radome_reports_refused_total", "Reports that were not.", &counters.reports_refused),
    ] {
        page.counter(name, help, counter);
    }
    page.0
}

struct Page(String);

impl Page {
    fn metric(&mut self, name: &str, kind: &str, help: &str) {
        // Writing to a string does not fail.
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }

    /// Values of labels are names of our own: nothing in them needs escaping.
    fn sample(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        self.0.push_str(name);
        for (i, (label, text)) in labels.iter().enumerate() {
            let _ = write!(self.0, "{}{label}=\"{text}\"", if i == 0 { '{' } else { ',' });
        }
        let _ = writeln!(self.0, "{} {value}", if labels.is_empty() { "" } else { "}" });
    }

    fn counter(&mut self, name: &str, help: &str, counter: &AtomicU64) {
        self.metric(name, "counter", help);
        self.sample(name, &[], counter.load(Ordering::Relaxed) as f64);
    }
}
