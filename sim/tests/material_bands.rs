//! Materials outside their bands. Alone in its process: what one thread listens to depends on the others of the same one.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use radome_sim::Scene;

const SCENE: &str = r#"
format = 1
name = "box"

[materials.screed]
permittivity = [4.0, 0.1]
band_ghz = [50, 70]

[room]
size_m = [4.0, 4.0, 2.5]
x_low = { material = "plasterboard" }
x_high = { material = "plasterboard" }
y_low = { material = "plasterboard" }
y_high = { material = "plasterboard" }
floor = { material = "screed" }
ceiling = { material = "concrete" }

[radar]
position_m = [0.1, 1.5, 1.2]

[waveform]
start_frequency_hz = 60.5e9
end_frequency_hz = 61.5e9
samples_per_chirp = 128
chirps_per_frame = 64
sample_rate_hz = 2e6
chirp_interval_s = 391.55e-6
frame_interval_s = 0.1
rx_antennas = [1]
tx_power_level = 31
if_gain_db = 48.0
high_pass_cutoff_hz = 80e3
anti_alias_cutoff_hz = 500e3

[people]
[[people.actor]]
step = [{ walk_to_m = [2.0, 2.0] }]
"#;

/// Counts warnings.
struct Warnings(AtomicUsize);

impl tracing::Subscriber for &'static Warnings {
    fn enabled(&self, metadata: &tracing::Metadata<'_>) -> bool {
        *metadata.level() == tracing::Level::WARN
    }
    fn new_span(&self, _: &tracing::span::Attributes<'_>) -> tracing::span::Id {
        tracing::span::Id::from_u64(1)
    }
    fn record(&self, _: &tracing::span::Id, _: &tracing::span::Record<'_>) {}
    fn record_follows_from(&self, _: &tracing::span::Id, _: &tracing::span::Id) {}
    fn event(&self, _: &tracing::Event<'_>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
    fn enter(&self, _: &tracing::span::Id) {}
    fn exit(&self, _: &tracing::span::Id) {}
}

#[test]
fn a_material_outside_its_band_is_warned_of() {
    static WARNINGS: Warnings = Warnings(AtomicUsize::new(0));
    tracing::subscriber::set_global_default(&WARNINGS).expect("the only one");
    let warnings = |text: &str| {
        Scene::parse(text, Path::new("box.toml")).expect("a good scene");
        WARNINGS.0.swap(0, Ordering::Relaxed)
    };
    assert_eq!(warnings(SCENE), 0);
    assert_eq!(warnings(&SCENE.replace("[50, 70]", "[1, 10]")), 1, "the floor");
    // The table's brick ends at 40 GHz: four walls.
    assert_eq!(warnings(&SCENE.replace("plasterboard", "brick")), 4);
}
