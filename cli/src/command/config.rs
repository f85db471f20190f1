use radome_driver::chip::{ChipConfiguration, RegisterValue};
use radome_driver::protocol::strata::SliceLayout;
use radome_dsp::Waveform;
use serde::Serialize;

use crate::{output, source};

/// `radome config`
#[derive(clap::Args)]
pub struct Arguments {
    /// `paper`, a .toml file with the fields of a waveform, or a model file
    #[arg(default_value = "paper")]
    waveform: String,
    /// The register list that it compiles to, with the names of registers and fields
    #[arg(long)]
    registers: bool,
    /// One object
    #[arg(long)]
    json: bool,
}

/// A register with its name and the fields that are not zero.
#[derive(Serialize)]
struct NamedRegister {
    address: u8,
    value: u32,
    name: &'static str,
    #[serde(serialize_with = "as_map")]
    fields: Vec<(&'static str, u32)>,
}

/// Pairs as an object, in the order of the register.
fn as_map<S: serde::Serializer>(fields: &[(&'static str, u32)], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_map(fields.iter().copied())
}

impl NamedRegister {
    fn new(register: RegisterValue) -> Self {
        let (name, fields) = register.named().unwrap_or_default();
        NamedRegister { address: register.address, value: register.value, name, fields }
    }

    /// As `ADDRESS:VALUE NAME FIELD=VALUE ...`, address and value in hexadecimal.
    fn line(&self) -> String {
        let fields: String = self.fields.iter().map(|(name, value)| format!(" {name}={value}")).collect();
        format!("{:02X}:{:06X} {:9}{fields}", self.address, self.value, self.name)
    }
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
    #[serde(skip_serializing_if = "Option::is_none")]
    registers: Option<Vec<NamedRegister>>,
}

/// Checks a waveform and says what follows from it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let w = &source::waveform(&arguments.waveform)?;
    let registers = if arguments.registers {
        let slice_samples = SliceLayout::for_frame(w.shape().codes()).samples;
        let list = ChipConfiguration { waveform: w.clone(), slice_samples }.compile()?;
        Some(list.into_iter().map(NamedRegister::new).collect::<Vec<_>>())
    } else {
        None
    };
    if arguments.json {
        return output::json_line(&Derived {
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
            registers,
        });
    }
    let requested_hz = w.request.end_frequency_hz - w.request.start_frequency_hz;
    let rows = [
        ("frame", format!("{}", w.shape())),
        (
            "requested band",
            format!(
                "{:.3} to {:.3} GHz ({:.2} MHz)",
                w.request.start_frequency_hz / 1e9,
                w.request.end_frequency_hz / 1e9,
                requested_hz / 1e6
            ),
        ),
        (
            "sampled band",
            format!(
                "{:.3} to {:.3} GHz ({:.2} MHz)",
                w.sampled_start_frequency_hz / 1e9,
                (w.sampled_start_frequency_hz + w.sampled_bandwidth_hz()) / 1e9,
                w.sampled_bandwidth_hz() / 1e6
            ),
        ),
        ("slope", format!("{:.4} MHz/us", w.slope_hz_per_s / 1e12)),
        ("range resolution", format!("{:.4} m", w.range_resolution_m())),
        ("maximum range", format!("{:.3} m", w.max_range_m())),
        ("velocity resolution", format!("{:.4} m/s", w.velocity_step_m_per_s(w.request.chirps_per_frame))),
        ("maximum velocity", format!("{:.3} m/s", w.max_velocity_m_per_s())),
        ("frame rate", format!("{:.3} Hz", 1.0 / w.frame_interval_s())),
        ("data rate", format!("{:.3} Mbit/s", w.data_rate_bit_per_s() / 1e6)),
    ];
    for (name, value) in rows {
        output::text_line(&format!("{name:20} {value}"))?;
    }
    for register in registers.iter().flatten() {
        output::text_line(register.line().trim_end())?;
    }
    Ok(())
}
