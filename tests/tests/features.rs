//! Tests of `dataset stats --features`: features of simulated halls beside those of recordings of walking people.

use radome_tests::{command, fails_with, fixture, fixture_text, json_lines, write_file};

#[test]
fn noise_and_clutter_of_simulated_halls_are_those_of_real_frames() {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = fixture_text("datasets/halls.toml").replace("[1, 500]", "[1, 3]");
    let file = write_file(folder.path(), "halls.toml", spec);
    let set = folder.path().join("set");
    json_lines(command!("dataset build --json", &file, "-o", &set));
    let stats = |more: &[&str]| command!("dataset stats --features --json", &set, ..more);
    let rows = json_lines(stats(&[])).remove(0);
    let rows = rows.as_array().expect("a list");
    let row = |key: &str| rows.iter().find(|row| row["key"] == key).expect("a row");
    for bin in [3, 10, 20, 30, 40, 50, 60] {
        let noise = row(&format!("noise_lsb.{bin}"));
        assert_eq!(noise["holds"], true, "{noise}");
    }
    // A map of noise alone has the moving energy of an empty room; people have more.
    let found = |key: &str| row(key)["found"].as_f64().expect("a number");
    assert!((found("empty.moving_energy_db") - 13.0).abs() < 2.0);
    assert!(found("one.moving_energy_db") > 17.0);
    // Clutter levels need frames, which a dataset does not hold.
    assert!(row("clutter.level_lsb")["found"].is_null());
    let scene = fixture("scenes/hall.toml");
    let with_frames = json_lines(stats(&["--frames", scene.to_str().expect("a path")])).remove(0);
    for key in ["clutter.level_lsb", "clutter.phase_jitter_rad", "clutter.drift_rad", "clutter.amplitude_jitter"] {
        let clutter = with_frames.as_array().expect("a list").iter().find(|row| row["key"] == key).expect("a row");
        assert_eq!(clutter["holds"], true, "{clutter}");
    }
    let measured = write_file(folder.path(), "measured.toml", "[[feature]]\nkey = \"one.peak_db\"\n");
    fails_with(stats(&["--measured", measured.to_str().expect("a path")]), &["measured.toml", "name"]);
}
