//! Metrics of a run in the Prometheus text format, version 0.0.4.

use std::fmt::Write;
use std::sync::atomic::Ordering;

use radome_dsp::Occupancy;

use super::latest::{Counters, Latest, SettledAnswer};
use crate::live::health::{Health, LatencyHistogram};

/// Upper bounds of the latency's buckets, s.
const BOUNDS_S: [f64; 10] = [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5, 1.0];

pub fn text(latest: &Latest) -> String {
    let health = latest.newest().health;
    let answer = latest.answer();
    let mut page = Page(String::with_capacity(4096));
    page.metric("radome_build_info", "gauge", "The program.");
    page.sample("radome_build_info", &[("version", env!("CARGO_PKG_VERSION"))], 1.0);
    page.gauge("radome_up", "Whether frames come and the answer is settled.", Some(f64::from(answer.is_some())));
    page.gauge(
        "radome_uptime_seconds",
        "Since the start of the program.",
        Some(health.started.elapsed().as_secs_f64()),
    );
    page.answer(answer);
    page.frames(&health, latest.frames_per_s());
    page.latency(&health.latency);
    page.connections(&latest.counters);
    page.0
}

/// Metrics page under construction.
struct Page(String);

impl Page {
    fn metric(&mut self, name: &str, kind: &str, help: &str) {
        // Writing to a string does not fail.
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }

    /// Writes a sample. Label values are internal names that need no escaping.
    fn sample(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        self.0.push_str(name);
        for (i, (label, text)) in labels.iter().enumerate() {
            let _ = write!(self.0, "{}{label}=\"{text}\"", if i == 0 { '{' } else { ',' });
        }
        let _ = writeln!(self.0, "{} {value}", if labels.is_empty() { "" } else { "}" });
    }

    /// Writes a metric with one value; omitted while the value is unknown.
    fn gauge(&mut self, name: &str, help: &str, value: Option<f64>) {
        self.metric(name, "gauge", help);
        if let Some(value) = value {
            self.sample(name, &[], value);
        }
    }

    fn counter(&mut self, name: &str, help: &str, value: u64) {
        self.metric(name, "counter", help);
        self.sample(name, &[], value as f64);
    }

    fn answer(&mut self, answer: Option<SettledAnswer>) {
        let help = "Whether the room counts as occupied, after delays; absent while unknown.";
        self.gauge("radome_occupied", help, answer.map(|answer| f64::from(answer.people > 0)));
        let help = "People that the room counts as holding, after delays.";
        self.gauge("radome_people", help, answer.map(|answer| answer.people as f64));
        self.metric("radome_probability", "gauge", "Probability of each class.");
        for class in Occupancy::ALL {
            if let Some(answer) = answer {
                let probability = answer.probabilities.get(class.index()).copied().unwrap_or(0.0);
                self.sample("radome_probability", &[("label", class.name())], f64::from(probability));
            }
        }
    }

    fn frames(&mut self, health: &Health, frames_per_s: f64) {
        self.counter("radome_frames_total", "Frames judged.", health.frames);
        self.metric("radome_labels_total", "counter", "How often each label was given.");
        for class in Occupancy::ALL {
            let labels = health.labels.get(class.index()).copied().unwrap_or(0);
            self.sample("radome_labels_total", &[("label", class.name())], labels as f64);
        }
        self.metric("radome_frames_dropped_total", "counter", "Frames lost, by reason.");
        for (reason, frames) in &health.dropped {
            self.sample("radome_frames_dropped_total", &[("reason", reason.name())], *frames as f64);
        }
        self.counter("radome_saturated_samples_total", "Samples at either end of the ADC.", health.saturated_samples);
        let help = "Frames in a second, over the newest; 0 while none come.";
        self.gauge("radome_frame_rate_hertz", help, Some(frames_per_s));
        let help = "Temperature of the radar chip; absent where none is known.";
        let celsius = health.temperature_millicelsius.map(|temperature| f64::from(temperature) * 1e-3);
        self.gauge("radome_chip_temperature_celsius", help, celsius);
    }

    fn latency(&mut self, latency: &LatencyHistogram) {
        self.metric("radome_latency_seconds", "histogram", "From a frame's last byte to its label.");
        for bound_s in BOUNDS_S {
            let count = latency.count_up_to(bound_s);
            self.sample("radome_latency_seconds_bucket", &[("le", &bound_s.to_string())], count as f64);
        }
        self.sample("radome_latency_seconds_bucket", &[("le", "+Inf")], latency.total as f64);
        self.sample("radome_latency_seconds_sum", &[], latency.sum_s);
        self.sample("radome_latency_seconds_count", &[], latency.total as f64);
    }

    fn connections(&mut self, counters: &Counters) {
        let connected = f64::from(counters.mqtt_connected.load(Ordering::Relaxed));
        self.gauge("radome_mqtt_connected", "Whether the MQTT broker listens.", Some(connected));
        for (name, help, counter) in [
            ("radome_mqtt_connections_total", "Connections to the broker.", &counters.mqtt_connections),
            ("radome_mqtt_published_total", "Messages sent to the broker.", &counters.mqtt_published),
            (
                "radome_mqtt_rejected_total",
                "Publications and subscriptions that the broker rejected.",
                &counters.mqtt_rejected,
            ),
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
            self.counter(name, help, counter.load(Ordering::Relaxed));
        }
    }
}
