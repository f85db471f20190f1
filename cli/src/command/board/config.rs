use anyhow::Context;
use radome_driver::chip::{ChipConfiguration, RegisterValue};
use radome_driver::protocol::mcu7::SliceLayout;
use radome_dsp::{Waveform, WaveformRequest};
use serde::Serialize;

use crate::{output, source};

/// `radome board config`
#[derive(clap::Args)]
pub struct Arguments {
    /// paper, room-hqnn, a .toml file with the fields of a waveform, a model file, or a recording
    #[arg(default_value = "paper", value_hint = clap::ValueHint::AnyPath)]
    waveform: String,
    /// Also show the compiled register list, with the names of registers and fields
    #[arg(long)]
    registers: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Register with its name and its non-zero fields.
#[derive(Serialize)]
struct NamedRegister {
    address: u8,
    value: u32,
    name: &'static str,
    #[serde(serialize_with = "as_map")]
    fields: Vec<(&'static str, u32)>,
}

/// Serialises pairs as an object, in the order of the register.
fn as_map<S: serde::Serializer>(fields: &[(&'static str, u32)], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_map(fields.iter().copied())
}

impl NamedRegister {
    fn new(register: RegisterValue) -> Self {
        let (name, fields) = register.named().unwrap_or_default();
        NamedRegister { address: register.address, value: register.value, name, fields }
    }

    /// Formats the register as `ADDRESS:VALUE NAME FIELD=VALUE ...`, address and value in hexadecimal.
    fn line(&self) -> String {
        let fields: String = self.fields.iter().map(|(name, value)| format!(" {name}={value}")).collect();
        format!("{:02X}:{:06X} {:9}{fields}", self.address, self.value, self.name)
    }
}

/// Quantity that the registers quantise.
#[derive(Serialize)]
struct Nearest {
    name: &'static str,
    unit: &'static str,
    requested: f64,
    realised: f64,
}

/// Slices in which the board sends a frame.
#[derive(Serialize)]
struct SlicePlan {
    samples: usize,
    bytes: usize,
    packets: usize,
    slices_per_frame: f64,
    slices_per_second: f64,
}

#[derive(Serialize)]
struct Derived<'a> {
    waveform: &'a Waveform,
    sampled_bandwidth_hz: f64,
    centre_frequency_hz: f64,
    range_resolution_m: f64,
    max_range_m: f64,
    velocity_resolution_m_per_s: f64,
    max_velocity_m_per_s: f64,
    frame_rate_hz: f64,
    samples_per_frame: usize,
    data_rate_bit_per_s: f64,
    supply_current_a: f64,
    slice: SlicePlan,
    nearest: Vec<Nearest>,
    #[serde(skip_serializing_if = "Option::is_none")]
    registers: Option<Vec<NamedRegister>>,
}

impl<'a> Derived<'a> {
    fn new(w: &'a Waveform, with_registers: bool) -> anyhow::Result<Self> {
        let slice = SliceLayout::for_frame(w.shape().codes());
        let chip = ChipConfiguration { waveform: w.clone(), slice_samples: slice.samples };
        let list = chip.compile()?;
        let slices_per_frame = w.shape().codes() as f64 / slice.samples as f64;
        Ok(Derived {
            waveform: w,
            sampled_bandwidth_hz: w.sampled_bandwidth_hz(),
            centre_frequency_hz: w.centre_frequency_hz(),
            range_resolution_m: w.range_resolution_m(),
            max_range_m: w.max_range_m(),
            velocity_resolution_m_per_s: w.velocity_step_m_per_s(w.request.chirps_per_frame),
            max_velocity_m_per_s: w.max_velocity_m_per_s(),
            frame_rate_hz: 1.0 / w.frame_interval_s(),
            samples_per_frame: w.shape().codes(),
            data_rate_bit_per_s: w.data_rate_bit_per_s(),
            supply_current_a: chip.supply_current_a()?,
            slice: SlicePlan {
                samples: slice.samples,
                bytes: slice.data_bytes(),
                packets: slice.packets(),
                slices_per_frame,
                slices_per_second: slices_per_frame / w.frame_interval_s(),
            },
            nearest: nearest(&w.request, &chip.realised()?.request),
            registers: with_registers.then(|| list.into_iter().map(NamedRegister::new).collect()),
        })
    }

    /// Names and values of the plan, as text.
    fn rows(&self) -> Vec<(&'static str, String)> {
        let w = self.waveform;
        let band = |start: f64, width: f64| {
            format!("{:.3} to {:.3} GHz ({:.2} MHz)", start / 1e9, (start + width) / 1e9, width / 1e6)
        };
        let requested_hz = w.request.end_frequency_hz - w.request.start_frequency_hz;
        let slice = &self.slice;
        vec![
            ("frame", w.shape().to_string()),
            ("requested band", band(w.request.start_frequency_hz, requested_hz)),
            ("sampled band", band(w.sampled_start_frequency_hz, self.sampled_bandwidth_hz)),
            ("slope", format!("{:.4} MHz/us", w.slope_hz_per_s / 1e12)),
            ("range resolution", format!("{:.4} m", self.range_resolution_m)),
            ("maximum range", format!("{:.3} m", self.max_range_m)),
            ("velocity resolution", format!("{:.4} m/s", self.velocity_resolution_m_per_s)),
            ("maximum velocity", format!("{:.3} m/s", self.max_velocity_m_per_s)),
            ("frame rate", format!("{:.3} Hz", self.frame_rate_hz)),
            ("data rate", format!("{:.3} Mbit/s", self.data_rate_bit_per_s / 1e6)),
            ("supply current", format!("{:.2} mA on average (chip alone, typical)", 1e3 * self.supply_current_a)),
            (
                "slices",
                format!(
                    "{} samples in {} packets, {} bytes; {:.3} a frame, {:.1} a second",
                    slice.samples, slice.packets, slice.bytes, slice.slices_per_frame, slice.slices_per_second
                ),
            ),
        ]
    }
}

/// Quantities whose realised value differs from the requested one by more than a millionth. The end of the band follows from
/// slope and time.
fn nearest(requested: &WaveformRequest, realised: &WaveformRequest) -> Vec<Nearest> {
    let pairs = [
        ("start frequency", "GHz", 1e-9, requested.start_frequency_hz, realised.start_frequency_hz),
        ("end frequency", "GHz", 1e-9, requested.end_frequency_hz, realised.end_frequency_hz),
        ("sample rate", "MHz", 1e-6, requested.sample_rate_hz, realised.sample_rate_hz),
        ("chirp interval", "us", 1e6, requested.chirp_interval_s, realised.chirp_interval_s),
        ("frame interval", "ms", 1e3, requested.frame_interval_s, realised.frame_interval_s),
        ("IF gain", "dB", 1.0, requested.if_gain_db, realised.if_gain_db),
        ("high-pass", "kHz", 1e-3, requested.high_pass_cutoff_hz, realised.high_pass_cutoff_hz),
        ("anti-alias filter", "kHz", 1e-3, requested.anti_alias_cutoff_hz, realised.anti_alias_cutoff_hz),
    ];
    let differs = |a: f64, b: f64| (a / b - 1.0).abs() > 1e-6;
    let differing = pairs.into_iter().filter(|(.., requested, realised)| differs(*requested, *realised));
    differing
        .map(|(name, unit, scale, requested, realised)| Nearest {
            name,
            unit,
            requested: requested * scale,
            realised: realised * scale,
        })
        .collect()
}

/// Checks a waveform and prints what follows from it.
///
/// # Errors
/// The waveform cannot be read, or the chip cannot produce it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let waveform = source::waveform(&arguments.waveform)?;
    let derived = Derived::new(&waveform, arguments.registers)
        .with_context(|| format!("{} is no waveform of this chip", arguments.waveform))?;
    if arguments.json {
        return output::json_line(&derived);
    }
    for (name, value) in derived.rows() {
        output::text_line(&format!("{name:20} {value}"))?;
    }
    if !derived.nearest.is_empty() {
        output::text_line("the registers hold other values than requested:")?;
    }
    for Nearest { name, unit, requested, realised } in &derived.nearest {
        output::text_line(&format!("  {name:18} {realised:.4} {unit}, requested {requested:.4}"))?;
    }
    for register in derived.registers.iter().flatten() {
        output::text_line(register.line().trim_end())?;
    }
    Ok(())
}
