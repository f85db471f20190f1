//! Echoes of people with skins, compared with dense physical optics in every chirp.

use num_complex::Complex64;
use radome_sim::{SimulateOptions, Simulator};
use rayon::iter::{IntoParallelIterator, ParallelIterator};

use crate::common::{error_message, on_threads, parse, range_profiles, simulator};

/// Hall without walls, with few chirps and one receiver. Dense integration takes seconds for it.
const HALL: &str = r#"
format = 1
name = "hall"
[room]
size_m = [12.0, 6.0, 4.0]
max_body_reflections = 0
max_reflections = 0
x_low = { material = "open" }
x_high = { material = "open" }
y_low = { material = "open" }
y_high = { material = "open" }
floor = { material = "open" }
ceiling = { material = "open" }
[radar]
position_m = [0.3, 3.0, 1.5]
[waveform]
start_frequency_hz = 59.558825e9
end_frequency_hz = 60.441175e9
samples_per_chirp = 256
chirps_per_frame = 32
sample_rate_hz = 1e6
chirp_interval_s = 1e-3
frame_interval_s = 0.1
rx_antennas = [1]
tx_power_level = 31
if_gain_db = 43.0
high_pass_cutoff_hz = 20e3
anti_alias_cutoff_hz = 500e3
[people]
body = "mesh"
[[people.actor]]
height_m = 1.75
step = [{ walk_to_m = [8.0, 3.3] }, { walk_to_m = [1.5, 3.3], speed_m_per_s = 1.2 }]
"#;

/// Simulator of the hall at a tolerance.
fn hall_simulator(tolerance_db: f64) -> Simulator {
    Simulator::new(&parse(HALL), SimulateOptions { seed: 3, tolerance_db, ..SimulateOptions::default() })
        .expect("valid options")
}

fn relative_error(exact: &[Complex64], found: &[Complex64]) -> f64 {
    let difference: f64 = exact.iter().zip(found).map(|(a, b)| (a - b).norm_sqr()).sum();
    let power: f64 = exact.iter().map(Complex64::norm_sqr).sum();
    (difference / power).sqrt()
}

/// Phase and amplitude agree in every chirp and range, not only on average: 2 percent is 0.17 dB.
#[test]
fn skin_echoes_agree_with_dense_physical_optics_in_every_chirp() {
    let frame = 12;
    let simulator = hall_simulator(0.5);
    let shape = simulator.frame(frame).shape;
    let chirps: Vec<Vec<Vec<f64>>> =
        (0..shape.chirps).into_par_iter().map(|chirp| simulator.dense_echo_chirp(frame, chirp, 10.0)).collect();
    let samples: Vec<f64> =
        (0..shape.rx).flat_map(|rx| chirps.iter().flat_map(move |chirp| chirp[rx].clone())).collect();
    let exact = range_profiles(&samples, 256).concat();
    let (mut previous, mut previous_estimate_db) = (f64::INFINITY, f64::INFINITY);
    for (tolerance_db, most_error) in [(2.0, 0.03), (0.5, 0.016), (0.2, 0.012)] {
        let simulator = hall_simulator(tolerance_db);
        let samples: Vec<f64> = simulator.echo_samples(frame).into_iter().map(f64::from).collect();
        let error = relative_error(&exact, &range_profiles(&samples, 256).concat());
        let estimate_db = simulator.frame_with_report(frame).1.estimate_db.expect("a skin has an estimate");
        assert!(error < most_error, "{tolerance_db} dB: {error}");
        assert!(
            error < previous && estimate_db < previous_estimate_db,
            "error and estimate decrease with the tolerance: {error} {estimate_db} dB"
        );
        assert!((0.2..5.0).contains(&(20.0 * error.ln_1p() / 10f64.ln() / estimate_db)), "{error}, {estimate_db} dB");
        (previous, previous_estimate_db) = (error, estimate_db);
    }
}

/// Numerical errors do not change the echo of a standing person.
#[test]
fn the_echo_of_a_standing_person_changes_by_breath_and_sway_only() {
    let still = HALL.replace(", { walk_to_m = [1.5, 3.3], speed_m_per_s = 1.2 }", "");
    let simulator = simulator(&parse(&still), 3, None);
    let samples: Vec<f64> = simulator.echo_samples(5).into_iter().map(f64::from).collect();
    let chirps = range_profiles(&samples, 256);
    // Breath and sway stay below 10 mm/s: less than a radian over the frame.
    let (first, last) = (&chirps[0], &chirps[chirps.len() - 1]);
    let strongest = (0..128).max_by(|&a, &b| first[a].norm().total_cmp(&first[b].norm())).expect("bins");
    let phase_change_rad = (last[strongest] * first[strongest].conj()).arg().abs();
    assert!(phase_change_rad < 1.0, "{phase_change_rad} rad");
    assert!((last[strongest].norm() / first[strongest].norm() - 1.0).abs() < 0.2);
}

#[test]
fn frames_of_skins_are_the_same_on_any_number_of_threads() {
    let frames = || {
        let simulator = hall_simulator(0.5);
        [3u64, 4].map(|i| simulator.frame(i).codes)
    };
    assert_eq!(on_threads(1, frames), on_threads(3, frames));
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_skin_around_the_radar_has_finite_echoes_and_is_counted() {
        let through = HALL
            .replace("{ walk_to_m = [8.0, 3.3] }", "{ walk_to_m = [0.9, 3.0] }")
            .replace("[1.5, 3.3]", "[0.2, 3.0]");
        let simulator = Simulator::new(&parse(&through), SimulateOptions::default()).expect("valid options");
        for frame in [0, 4, 8, 12] {
            assert!(simulator.echo_samples(frame).iter().all(|x| x.is_finite()), "frame {frame}");
        }
        let clamped: usize = [4, 5, 6, 7, 8].map(|i| simulator.frame_with_report(i).1.clamped).iter().sum();
        assert!(clamped > 0, "who walks through the radar comes nearer than 10 cm");
    }

    #[test]
    fn a_desk_scene_with_skins_is_an_error() {
        let begin = HALL.find("[people]").expect("people");
        let desk = format!("{}[people]\nbody = \"mesh\"\n[people.desk]\n", &HALL[..begin]);
        let message = error_message(&desk);
        assert!(message.contains("body") && message.contains("desk"), "{message}");
    }
}
