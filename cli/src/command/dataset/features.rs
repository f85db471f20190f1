//! Table of `radome dataset stats --features`.

use crate::dataset::features::Row;
use crate::output;

/// Prints features of maps with their measured ranges. `has_frames` is whether frames were given too.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(rows: &[Row], has_frames: bool, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return output::json_line(&rows);
    }
    let width = rows.iter().map(|row| row.measured.name.chars().count()).max().unwrap_or(0);
    output::text_line(&format!("{:<width$} {:>13} {:>8} {:>15}", "feature", "measured", "here", "10 to 90 %"))?;
    for row in rows {
        let [least, most] = row.measured.measured.map(short);
        let range = if least == most { least } else { format!("{least} to {most}") };
        let spread = row.spread.map_or_else(String::new, |[low, high]| format!("{} to {}", short(low), short(high)));
        let mark = match row.holds {
            Some(false) => "  differs",
            None => "  not measured",
            Some(true) => "",
        };
        let found = row.found.map_or_else(|| "-".to_owned(), short);
        output::text_line(&format!("{:<width$} {range:>13} {found:>8} {spread:>15}{mark}", row.measured.name))?;
    }
    if !has_frames {
        message!("clutter is measured in frames only: name recordings of an empty room, or a scene, with --frames");
    }
    Ok(())
}

fn short(value: f64) -> String {
    let digits = if value.abs() >= 9.95 {
        0
    } else if value.abs() >= 0.995 {
        1
    } else {
        3
    };
    format!("{value:.digits$}")
}
