//! `fmcw_scene`: a configuration by metrics, from which the vendor's SDK derives a waveform.
//!
//! The SDK derives a bandwidth of `c / 2 range_resolution_m` about the centre and a chirp interval of
//! `lambda / 4 max_speed_m_s`. It derives `2 max_range_m / range_resolution_m` samples and
//! `2 max_speed_m_s / speed_resolution_m_s` chirps. Its recorder rounds both counts up to powers of two, other tools do
//! not; the data beside the file show which. Sample rate and centre may be left to the SDK. The file does not hold the
//! derived values, so that the reader logs that they were derived again.

use radome_dsp::{FrameShape, SPEED_OF_LIGHT_M_PER_S, WaveformRequest};

use super::RecordingError;
use super::vendor_fields::Fields;

/// ADC rate of the SDK for metrics that state none, Hz.
const SAMPLE_RATE_HZ: f64 = 1e6;
/// Centre frequency of the SDK for metrics that state none, Hz: the middle of the chip's band, 58 to 63.5 GHz.
const CENTRE_HZ: f64 = 60.75e9;
/// Filters that the SDK sets for metrics.
const HIGH_PASS_HZ: f64 = 80e3;
const ANTI_ALIAS_HZ: f64 = 500e3;

/// Derives the waveform of metrics, with the numbers of samples and chirps of the data if rounding allows them. The
/// caller has to compare the shapes and refuse data that no rounding explains.
pub(super) fn request(fields: &Fields, data: Option<FrameShape>) -> Result<WaveformRequest, RecordingError> {
    let positive = |field: &str| -> Result<f64, RecordingError> {
        let value = fields.number(field, None)?;
        // The negated form also refuses NaN.
        if !(value > 0.0 && value.is_finite()) {
            return Err(fields.error(field, format!("is {value}, expected more than zero")));
        }
        Ok(value)
    };
    let range_resolution_m = positive("range_resolution_m")?;
    let max_speed_m_per_s = positive("max_speed_m_s")?;
    let samples = 2.0 * positive("max_range_m")? / range_resolution_m;
    let chirps = 2.0 * max_speed_m_per_s / positive("speed_resolution_m_s")?;
    let sample_rate_hz = fields.optional("sample_rate_Hz")?.filter(|hz| *hz != 0.0);
    let centre_hz = fields.optional("center_frequency_Hz")?.filter(|hz| *hz != 0.0);
    let bandwidth_hz = 0.5 * SPEED_OF_LIGHT_M_PER_S / range_resolution_m;
    let centre = centre_hz.unwrap_or(CENTRE_HZ);
    let request = WaveformRequest {
        start_frequency_hz: centre - 0.5 * bandwidth_hz,
        end_frequency_hz: centre + 0.5 * bandwidth_hz,
        samples_per_chirp: count(samples, data.map(|data| data.samples)),
        chirps_per_frame: count(chirps, data.map(|data| data.chirps)),
        sample_rate_hz: sample_rate_hz.unwrap_or(SAMPLE_RATE_HZ),
        chirp_interval_s: SPEED_OF_LIGHT_M_PER_S / centre / (4.0 * max_speed_m_per_s),
        frame_interval_s: positive("frame_repetition_time_s")?,
        rx_antennas: fields.antennas()?,
        tx_power_level: fields.number("tx_power_level", None)?.clamp(0.0, 255.0) as u8,
        if_gain_db: fields.number("if_gain_dB", None)?,
        high_pass_cutoff_hz: HIGH_PASS_HZ,
        anti_alias_cutoff_hz: ANTI_ALIAS_HZ,
    };
    let mut assumed = String::new();
    if sample_rate_hz.is_none() {
        assumed += "; the sample rate is the SDK's own, 1 MHz";
    }
    if centre_hz.is_none() {
        assumed += "; the centre is that of the chip's band, 60.75 GHz";
    }
    tracing::warn!(
        "{}: configured by metrics: {:.4} to {:.4} GHz and a chirp every {:.1} us are what they make, not what was written down{assumed}",
        fields.path.display(),
        1e-9 * request.start_frequency_hz,
        1e-9 * request.end_frequency_hz,
        1e6 * request.chirp_interval_s,
    );
    Ok(request)
}

/// Derives a number of samples or chirps: the data's if some rounding gives it, otherwise the power of two.
fn count(exact: f64, data: Option<usize>) -> usize {
    // The limit is beyond any waveform; such a waveform is refused later.
    let exact = exact.min(1e6);
    // 4.8 m over 0.15 m are 64 samples, not 65.
    let rounded_up = (exact - 1e-6).ceil().max(1.0) as usize;
    let roundings = [rounded_up.next_power_of_two(), rounded_up, exact.round().max(1.0) as usize];
    data.filter(|data| roundings.contains(data)).unwrap_or(roundings[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_show_how_a_number_was_rounded() {
        // The SDK's own metrics, and those of its examples.
        let samples = 2.0 * 9.59 / 0.15;
        assert_eq!([count(samples, None), count(samples, Some(128)), count(samples, Some(127))], [128, 128, 128]);
        let chirps = 2.0 * 2.45 / 0.2;
        assert_eq!(
            [None, Some(25), Some(32), Some(24), Some(16)].map(|data| count(chirps, data)),
            [32, 25, 32, 32, 32]
        );
        assert_eq!(count(2.0 * 4.8 / 0.15, None), 64);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn absurd_numbers_do_not_overflow() {
            for exact in [0.0, 1e-300, 1e300, f64::INFINITY] {
                assert!((1..=1 << 20).contains(&count(exact, Some(usize::MAX))), "{exact}");
            }
        }
    }
}
