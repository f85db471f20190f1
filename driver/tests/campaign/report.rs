//! Report of all faults, as a table and as JSON.

use std::collections::BTreeMap;

use serde_json::json;

use crate::draw::Job;
use crate::play::Outcome;

#[derive(Debug, Default)]
pub struct Report {
    /// Rows by the names of the board and of the kind of fault.
    rows: BTreeMap<(&'static str, &'static str), Outcome>,
}

impl Report {
    pub fn add(&mut self, job: &Job, outcome: Outcome) {
        let row = self.rows.entry(job.names).or_default();
        row.add(&outcome);
        let (board, kind) = job.names;
        let name = format!("{board} {kind} (seed {:#x}, {})", job.seed, job.waveform.shape());
        row.failures.extend(outcome.failures.into_iter().map(|what| format!("{name}: {what}")));
    }

    pub fn injected(&self) -> u64 {
        self.rows.values().map(|row| row.injected).sum()
    }

    pub fn failures(&self) -> Vec<&str> {
        self.rows.values().flat_map(|row| &row.failures).map(String::as_str).collect()
    }

    pub fn table(&self) -> String {
        let mut text = format!(
            "{:<8} {:<14} {:>8} {:>10} {:>9} {:>7} {:>13} {:>12}\n",
            "protocol", "fault", "injected", "delivered", "lost", "wrong", "undetectable", "not resumed"
        );
        let mut line = |protocol: &str, kind: &str, row: &Outcome| {
            text += &format!(
                "{protocol:<8} {kind:<14} {:>8} {:>10} {:>9} {:>7} {:>13} {:>12}\n",
                row.injected, row.delivered, row.lost, row.wrong, row.undetectable, row.not_resumed
            );
        };
        let mut total = Outcome::default();
        for ((protocol, kind), row) in &self.rows {
            line(protocol, kind, row);
            total.add(row);
        }
        line("all", "", &total);
        text
    }

    pub fn json(&self, seed: u64) -> serde_json::Value {
        let row = |((protocol, kind), row): (&(&str, &str), &Outcome)| {
            json!({
                "protocol": protocol,
                "fault": kind,
                "injected": row.injected,
                "frames_delivered": row.delivered,
                "frames_lost": row.lost,
                "wrong_samples_delivered": row.wrong,
                "undetectable_by_design": row.undetectable,
                "not_resumed": row.not_resumed,
                "failures": row.failures,
            })
        };
        json!({ "seed": seed, "faults": self.injected(), "rows": self.rows.iter().map(row).collect::<Vec<_>>() })
    }
}
