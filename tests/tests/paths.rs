//! Compares the list of `radome scene paths` with mirror images computed by hand.

use radome_tests::{
    command, fails_with, failure, fixture, json_lines, subcommand, success, write_file, wrong_use_with,
};
use serde_json::Value;

/// Speed of light, m/s.
const C: f64 = 299_792_458.0;

/// Writes a scene of a metal room with the radar off its middle and a person in front of the radar.
fn scene(folder: &std::path::Path) -> std::path::PathBuf {
    let wall = r#"{ material = "metal" }"#;
    let sides =
        ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"].map(|side| format!("{side} = {wall}\n")).concat();
    let text = std::fs::read_to_string(fixture("scenes/room.toml")).expect("readable");
    let waveform =
        text.split("[waveform]").nth(1).and_then(|rest| rest.split("[[furniture]]").next()).expect("a waveform");
    let scene = format!(
        "format = 1\nname = \"metal\"\n\n[room]\nsize_m = [7.0, 5.0, 2.6]\nmax_reflections = 1\n{sides}\n\
         [radar]\nposition_m = [1.5, 2.0, 1.1]\nazimuth_deg = 0.0\ntilt_down_deg = 0.0\n\n[waveform]{waveform}\n\
         [[people.actor]]\nstep = [{{ walk_to_m = [3.0, 2.0] }}, {{ stand_s = 600.0 }}]\n"
    );
    write_file(folder, "metal.toml", scene)
}

fn list_paths(scene: &std::path::Path, arguments: &[&str]) -> Value {
    json_lines(command!("scene paths --json", scene, "--margin-db 60", ..arguments)).remove(0)
}

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

fn corners(path: &Value) -> Vec<[f64; 3]> {
    let corner = |p: &Value| std::array::from_fn(|i| number(&p[i]));
    path["points_m"].as_array().expect("corners").iter().map(corner).collect()
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// Asserts the lengths of single reflections: the distance to the antenna's mirror image behind each wall.
#[test]
fn first_reflections_are_as_long_as_mirrors_say() {
    let folder = tempfile::tempdir().expect("a folder");
    let list = list_paths(&scene(folder.path()), &["--people", "0"]);
    let (size, frequency_hz) = ([7.0, 5.0, 2.6], number(&list["frequency_hz"]));
    let walls = ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"];
    let mut seen = 0;
    for path in list["paths"].as_array().expect("paths") {
        let points = corners(path);
        assert_eq!((points.len(), path["surfaces"].as_array().map(Vec::len)), (3, Some(1)), "{path}");
        let (antenna, receiver) = (points[0], points[2]);
        let wall = walls.iter().position(|name| path["surfaces"][0] == *name).expect("a wall");
        let plane = if wall % 2 == 0 { 0.0 } else { size[wall / 2] };
        let mut mirrored = antenna;
        mirrored[wall / 2] = 2.0 * plane - antenna[wall / 2];
        let length_m = distance(mirrored, receiver);
        assert!((number(&path["length_m"]) - length_m).abs() < 1e-9, "{path}: {length_m}");
        assert!((number(&path["delay_s"]) - length_m / C).abs() < 1e-17, "{path}");
        assert!((points[1][wall / 2] - plane).abs() < 1e-9, "{path}");
        assert_eq!(number(&path["doppler_hz"]), 0.0);
        // Metal reflects without loss and antennas have one main direction, so that free space bounds the gain.
        let free_db = 20.0 * (C / frequency_hz / (4.0 * std::f64::consts::PI * length_m)).log10();
        assert!(number(&path["gain_db"]) <= free_db + 1e-6, "{path}: {free_db}");
        seen += 1;
    }
    // Three receivers see at least four walls each. Vertically polarised antennas have a null towards the floor and
    // ceiling directly below and above.
    assert!(seen >= 12, "{seen} paths");
}

#[test]
fn paths_by_somebody_are_as_long_as_their_corners_are_apart() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = scene(folder.path());
    let list = list_paths(&scene, &["--time", "0.5", "--person", "0"]);
    let paths = list["paths"].as_array().expect("paths");
    assert!(paths.len() > 10, "{} paths", paths.len());
    for path in paths {
        assert_eq!(path["person"], 0);
        let apart: f64 = corners(path).windows(2).map(|w| distance(w[0], w[1])).sum();
        assert!((number(&path["length_m"]) - apart).abs() < 1e-6, "{path}: {apart}");
    }
    let direct = paths.iter().filter(|path| path["surfaces"] == serde_json::json!(["person 0 chest"]));
    let lengths: Vec<f64> = direct.map(|path| number(&path["length_m"])).collect();
    // The person stands 1.5 m ahead; half a chest depth is subtracted.
    assert!(!lengths.is_empty() && lengths.iter().all(|l| (2.5..3.1).contains(l)), "{lengths:?}");
}

#[test]
fn the_list_is_drawn_and_printed_as_text() {
    let folder = tempfile::tempdir().expect("a folder");
    let picture = folder.path().join("paths.png");
    let (told, _) = success(command!("scene paths", fixture("scenes/corridor.toml"), "--time 3 --preview", &picture));
    assert!(told.contains("length/m") && told.contains("x_high"), "{told}");
    assert!(std::fs::metadata(&picture).expect("a picture").len() > 1000);
}

mod hard_cases {
    use super::*;

    #[test]
    fn an_absent_person_and_an_invalid_time_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = fixture("scenes/corridor.toml");
        for command in ["scene paths", "scene preview"] {
            let picture = folder.path().join("people.png");
            let said = failure(subcommand(command).arg(&scene).args(["--people", "5", "-o"]).arg(&picture));
            assert!(said.contains("room for at most") && !picture.exists(), "{said}");
        }
        fails_with(command!("scene paths", &scene, "--person 7"), &["person 7", "hint"]);
    }

    /// Pictures named `.jpg` were PNG files.
    #[test]
    fn a_picture_has_the_format_that_its_name_says() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = fixture("scenes/corridor.toml");
        for command in ["scene paths", "scene preview"] {
            let [jpg, svg] = ["jpg", "svg"].map(|ending| folder.path().join(command).with_extension(ending));
            wrong_use_with(
                subcommand(command).arg(&scene).arg("-o").arg(&jpg),
                &["hint: end the picture's name in .png or .svg"],
            );
            success(subcommand(command).arg(&scene).arg("-o").arg(&svg));
            assert!(!jpg.exists() && std::fs::read(&svg).is_ok_and(|bytes| bytes.starts_with(b"<svg ")));
        }
    }
}
