//! The answer, and the receiver file.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use radome_sim::receiver::Receiver;
use radome_sim::receiver::calibration::gain::{GainFit, LEAST_BINS, LEAST_RANGE_M};
use serde::Serialize;

use super::Arguments;
use super::gap::{Channel, Figures};
use super::line::{Lines, Many};
use crate::{files, output};

/// All there is to say.
#[derive(Serialize)]
pub struct Answer<'a> {
    pub receiver: Option<&'a Path>,
    pub frames_fitted: u64,
    pub frames_judged: u64,
    pub copies: u64,
    pub fit_residual_lsb: Vec<f64>,
    pub gain: Option<Gain>,
    /// What intervals were drawn over.
    pub resampled: &'static str,
    pub between_real: Vec<Figures>,
    pub before: Vec<Channel>,
    pub after: Vec<Channel>,
    pub line: Option<Lines>,
}

/// Echoes' level.
#[derive(Serialize)]
pub struct Gain {
    pub gain_db: Option<f64>,
    pub error_db: Option<f64>,
    pub bins: usize,
    pub of: usize,
}

impl From<GainFit> for Gain {
    fn from(fit: GainFit) -> Self {
        Gain { gain_db: fit.gain_db, error_db: fit.error_db, bins: fit.bins, of: fit.of }
    }
}

/// Writes the fitted receiver, with the command that makes it again.
pub fn write_receiver(path: &Path, receiver: &Receiver, arguments: &Arguments) -> anyhow::Result<()> {
    let text = toml::to_string(receiver).context("the receiver as TOML")?;
    // Where files lay says nothing to others.
    let file_name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut command = "radome calibrate".to_owned();
    arguments.recordings.iter().for_each(|recording| command += &format!(" {}", file_name(recording)));
    if let Some(base) = &arguments.base {
        command += &format!(" --base {}", file_name(base));
    }
    if let Some(scene) = &arguments.scene {
        command += &format!(" --scene {} --seed {}", file_name(scene), arguments.seed);
    }
    if let Some(name) = &arguments.name {
        command += &format!(" --name {name}");
    }
    let header = format!(
        "# A BGT60TR13C as recordings show it. Made by:\n#     {command} --part {} -o {}\n# Schema: sim/src/receiver/file.rs.\n",
        arguments.part,
        file_name(path)
    );
    files::write_atomically(path, |file| file.write_all((header + &text).as_bytes()).context("writing"))
}

/// One object, or lines to read.
pub fn print(answer: &Answer, is_json: bool) -> anyhow::Result<()> {
    if is_json {
        return output::json_line(answer);
    }
    let line = |text: String| output::text_line(&text);
    line(format!(
        "fitted to {} frames, judged by {} others beside {} copies",
        answer.frames_fitted, answer.frames_judged, answer.copies
    ))?;
    line(format!(
        "{:>9} {:>3} {:>16} {:>9} {:>14} {:>14} {:>21} {:>6} {:>6} {:>18} {:>12} {:>7} {:>6}",
        "receiver",
        "RX",
        "noise worst/mean",
        "leakage",
        "mean real/sim",
        "sigma real/sim",
        "raised real/sim",
        "KS",
        "W1 dB",
        "95 of 100",
        "target/still",
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
            let interval = format!("{low:.2}..{high:.2} dB");
            line(format!("{which:>9} {:>3} {receiver} {}", channel.rx, figures(&channel.figures, &interval)))?;
        }
    }
    for (rx, between) in answer.between_real.iter().enumerate() {
        line(format!("{:>9} {:>3} {:>26} {}", "real", rx + 1, "", figures(between, "")))?;
    }
    line(format!("intervals: {} drawn anew; real: between them, or between the two parts of one", answer.resampled))?;
    if let Some(gain) = &answer.gain {
        line(match (gain.gain_db, gain.error_db) {
            (Some(db), Some(error)) => {
                format!("echoes {db:+.1} dB +- {error:.1}, from {} bins of {} that stand still", gain.bins, gain.of)
            }
            _ => format!(
                "echoes as the base has them: {} bins of {} beyond {LEAST_RANGE_M} m stand still in both and above noise, {LEAST_BINS} are needed",
                gain.bins, gain.of
            ),
        })?;
    }
    if let Some(lines) = &answer.line {
        slow_time(lines)?;
    }
    let residuals: Vec<String> = answer.fit_residual_lsb.iter().map(|r| format!("{r:.1}")).collect();
    line(format!("the fit leaves {} LSB rms of the mean chirps", residuals.join(", ")))?;
    match answer.receiver {
        Some(path) => line(format!("{} written", path.display())),
        None => Ok(()),
    }
}

/// The columns of maps.
fn figures(figures: &Figures, interval: &str) -> String {
    let get = |name: &str| figures.get(name).copied();
    let pair = |a: &str, b: &str| match (get(a), get(b)) {
        (Some(a), Some(b)) => format!("{a:.2}/{b:.2}"),
        _ => "-".to_owned(),
    };
    let number = |name: &str, decimals: usize| get(name).map_or("-".to_owned(), |x| format!("{x:.decimals$}"));
    let raised = |which: &str| {
        let fraction = get(&format!("raised_fraction_{which}")).unwrap_or_default();
        format!("{:.1}% {:.1}", 100.0 * fraction, get(&format!("raised_level_{which}_db")).unwrap_or_default())
    };
    format!(
        "{:>14} {:>14} {:>21} {:>6} {:>6} {:>18} {:>12} {:>7} {:>6}",
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

/// Who moves.
fn slow_time(lines: &Lines) -> anyhow::Result<()> {
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
        let Some(Many { level_dbfs, level_quartiles_dbfs: [low, high], range_m, copies, .. }) = many else {
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
