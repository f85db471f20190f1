//! Output of a calibration, and the receiver file.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use radome_sim::receiver::Receiver;
use radome_sim::receiver::calibration::gain::{GainFit, LEAST_BINS, LEAST_RANGE_M};
use serde::Serialize;

use super::arguments::Arguments;
use super::difference::{Channel, Figures};
use super::line::{CopyLines, Lines};
use super::still::Clutter;
use crate::{files, output, shell};

#[derive(Serialize)]
pub struct Answer<'a> {
    pub receiver: Option<&'a Path>,
    pub frames_fitted: u64,
    pub frames_judged: u64,
    pub copies: u64,
    pub fit_residual_lsb: Vec<f64>,
    /// Drift of static echoes; `None` where there are too few.
    pub clutter: Option<Clutter>,
    /// Level of the echoes.
    pub gain: Option<GainFit>,
    /// Units that were resampled for the intervals.
    pub resampled: &'static str,
    pub between_real: Vec<Figures>,
    pub before: Vec<Channel>,
    pub after: Vec<Channel>,
    pub line: Option<Lines>,
}

/// Rounds fitted values to the significant digits of the measurement, so that files stay readable.
pub fn round(receiver: &mut Receiver) {
    let digits = |value: &mut f64, digits: i32| {
        if *value != 0.0 && value.is_finite() {
            let scale = 10f64.powi(digits - 1 - value.abs().log10().floor() as i32);
            // Dividing by a power of ten gives the shortest decimal; multiplying by its inverse does not.
            *value = if scale < 1.0 {
                (*value * scale).round() * (1.0 / scale).round()
            } else {
                (*value * scale).round() / scale
            };
        }
    };
    for rx in &mut receiver.rx {
        digits(&mut rx.dc_code, 6);
        rx.psd_lsb2.iter_mut().flatten().for_each(|density| digits(density, 4));
        for leakage in &mut rx.leakage {
            digits(&mut leakage.delay_s, 6);
            digits(&mut leakage.amplitude_lsb, 5);
            digits(&mut leakage.phase_rad, 5);
        }
        rx.transient.iter_mut().for_each(|transient| digits(&mut transient.amplitude_lsb, 5));
    }
    receiver.noise.psd_lsb2.iter_mut().flatten().for_each(|density| digits(density, 4));
    let (clutter, drift) = (&mut receiver.clutter, &mut receiver.drift);
    for value in [
        &mut receiver.gain_correction_db,
        &mut clutter.phase_jitter_rad,
        &mut clutter.phase_drift_rad_per_10s,
        &mut clutter.amplitude_jitter,
        &mut clutter.leakage_jitter,
        &mut clutter.leakage_drift_per_10s,
        &mut drift.dc_lsb_per_s,
        &mut drift.dc_jitter_lsb,
    ] {
        digits(value, 3);
    }
}

/// Writes the fitted receiver, with the command that reproduces it.
///
/// # Errors
/// The file cannot be written.
pub fn write_receiver(path: &Path, receiver: &Receiver, arguments: &Arguments) -> anyhow::Result<()> {
    let text = toml::to_string(receiver).context("the receiver as TOML")?;
    // Folders of the input files mean nothing to other users, so only file names are written.
    let file_name = |path: &Path| shell::word(&path.file_name().unwrap_or_default().to_string_lossy());
    let mut command = "radome scene calibrate".to_owned();
    arguments.recordings.iter().for_each(|recording| command += &format!(" {}", file_name(recording)));
    if let Some(base) = &arguments.base {
        command += &format!(" --base {}", file_name(base));
    }
    if let Some(scene) = &arguments.scene {
        command += &format!(" --scene {} --seed {}", file_name(scene), arguments.seed);
    }
    if let Some(people) = arguments.people {
        command += &format!(" --people {people}");
    }
    if let Some(name) = &arguments.name {
        command += &format!(" --name {}", shell::word(name));
    }
    command += &format!(" --copies {} --part {} -o {}", arguments.copies, arguments.part, file_name(path));
    let command = shell::comment(&command);
    let header = format!(
        "# A BGT60TR13C as recordings show it. Made by:\n#     {command}\n# Schema: sim/src/receiver/file.rs.\n"
    );
    files::write_output(path, arguments.overwrite.existing(), |file| {
        file.write_all((header + &text).as_bytes()).context("writing")
    })
}

/// Prints one JSON object, or text.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(answer: &Answer, is_json: bool) -> anyhow::Result<()> {
    if is_json {
        return output::json_line(answer);
    }
    output::text_line(&format!(
        "fitted to {} frames, compared with {} others by {} simulated copies",
        answer.frames_fitted, answer.frames_judged, answer.copies
    ))?;
    print_channels(answer)?;
    print_static_echoes(answer)?;
    if let Some(lines) = &answer.line {
        print_slow_time(lines)?;
    }
    let residuals: Vec<String> = answer.fit_residual_lsb.iter().map(|r| format!("{r:.1}")).collect();
    output::text_line(&format!("the fit leaves {} LSB rms of the mean chirps", residuals.join(", ")))?;
    match answer.receiver {
        Some(path) => output::text_line(&format!("{} written", path.display())),
        None => Ok(()),
    }
}

/// Prints the table of receivers, simulated and real.
fn print_channels(answer: &Answer) -> anyhow::Result<()> {
    output::text_line(&format!(
        "{:>9} {:>3} {:>16} {:>9} {:>14} {:>12} {:>23} {:>6} {:>6} {:>11} {:>12} {:>7} {:>6}",
        "receiver",
        "RX",
        "noise worst/mean",
        "leakage",
        "mean real/sim",
        "sigma",
        "raised real/sim",
        "KS",
        "W1 dB",
        "95 %",
        "W1 who/still",
        "m/s",
        "m"
    ))?;
    for (which, channels) in [("before", &answer.before), ("fitted", &answer.after)] {
        for channel in channels {
            let receiver = format!(
                "{:>7.2}/{:>5.2} dB {:>7.1} %",
                channel.noise_worst_db,
                channel.noise_mean_db,
                100.0 * channel.leakage_error
            );
            let [low, high] = channel.interval.get("wasserstein_db").copied().unwrap_or_default();
            let figures = format_figures(&channel.figures, &format!("{low:.2}..{high:.2}"));
            output::text_line(&format!("{which:>9} {:>3} {receiver} {figures}", channel.rx))?;
        }
    }
    for (rx, between) in answer.between_real.iter().enumerate() {
        output::text_line(&format!("{:>9} {:>3} {:>26} {}", "real", rx + 1, "", format_figures(between, "")))?;
    }
    let resampled = answer.resampled;
    output::text_line(&format!(
        "intervals: bootstrap with {resampled} samples; real: between the recordings, or between the two parts of one"
    ))
}

/// Prints the jitter and the level of static echoes.
fn print_static_echoes(answer: &Answer) -> anyhow::Result<()> {
    output::text_line(&match &answer.clutter {
        Some(clutter) => format!(
            "clutter jitters by {:.0} mrad and {:.1} % and drifts by {:.2} rad in ten seconds, from {} bins that stand still",
            1e3 * clutter.phase_jitter_rad,
            100.0 * clutter.amplitude_jitter,
            clutter.phase_drift_rad_per_10s,
            clutter.bins
        ),
        None => "clutter jitter is that of the base receiver: too little stands still".to_owned(),
    })?;
    let Some(GainFit { gain_db, error_db, bins, of }) = &answer.gain else { return Ok(()) };
    output::text_line(&match (gain_db, error_db) {
        (Some(db), Some(error)) => {
            format!("echoes {db:+.1} dB +- {error:.1}, from {bins} bins of {of} that stand still")
        }
        _ => format!(
            "gain is that of the base receiver: {bins} bins of {of} beyond {LEAST_RANGE_M} m stand still in both and above noise, \
             {LEAST_BINS} are needed"
        ),
    })
}

/// Formats the columns of map figures.
fn format_figures(figures: &Figures, interval: &str) -> String {
    let get = |name: &str| figures.get(name).copied();
    let pair = |a: &str, b: &str| match (get(a), get(b)) {
        (Some(a), Some(b)) => format!("{a:.2}/{b:.2}"),
        _ => "-".to_owned(),
    };
    let number = |name: &str, decimals: usize| output::or_dash(get(name), decimals);
    let raised = |which: &str| match get(&format!("raised_fraction_{which}")).filter(|fraction| *fraction > 0.0) {
        Some(fraction) => {
            let level = get(&format!("raised_level_{which}_db")).unwrap_or_default();
            format!("{:.1}% by {level:.1}", 100.0 * fraction)
        }
        None => "none".to_owned(),
    };
    format!(
        "{:>14} {:>12} {:>23} {:>6} {:>6} {:>11} {:>12} {:>7} {:>6}",
        pair("mean_real_db", "mean_simulated_db"),
        pair("sigma_real_db", "sigma_simulated_db"),
        format!("{}/{}", raised("real"), raised("simulated")),
        number("kolmogorov_smirnov", 3),
        number("wasserstein_db", 2),
        interval,
        pair("target_wasserstein_db", "zero_doppler_wasserstein_db"),
        number("doppler_m_per_s", 3),
        number("range_m", 2),
    )
}

/// Prints the slow-time lines of moving people.
fn print_slow_time(lines: &Lines) -> anyhow::Result<()> {
    let breath = |hz: Option<f64>| hz.map_or(String::new(), |hz| format!(", {hz:.2} Hz"));
    output::text_line(&match &lines.real {
        Some(real) => format!(
            "slow time    real: {:.1} dBFS at {:.3} m{}, {} windows of ten seconds",
            real.level_dbfs,
            real.range_m,
            breath(real.breath_hz),
            real.windows
        ),
        None => "slow time    real: nothing stands out".to_owned(),
    })?;
    for (which, many) in [("before", &lines.before), ("fitted", &lines.after)] {
        let Some(CopyLines { level_dbfs, level_quartiles_dbfs: [low, high], range_m, copies, .. }) = many else {
            output::text_line(&format!("{which:>17}: nothing stands out"))?;
            continue;
        };
        let [near, far] = many.as_ref().map(|many| many.range_quartiles_m).unwrap_or_default();
        output::text_line(&format!(
            "{which:>17}: {level_dbfs:.1} dBFS (half of them {low:.1}..{high:.1}) at {range_m:.3} m ({near:.3}..{far:.3}){}, \
             {copies} copies",
            breath(many.as_ref().and_then(|many| many.breath_hz))
        ))?;
    }
    Ok(())
}
