//! Labels go into a recording and come out of it in the formats of other tools; frames stay as they are.

use radome_tests::{failure, fixture, json_lines, radome};

#[test]
fn labels_travel_through_a_recording_and_leave_its_frames_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    json_lines(
        radome()
            .arg("simulate")
            .arg(fixture("scenes/desk.toml"))
            .args(["--frames", "40", "--json", "-o"])
            .arg(path("run.mcap")),
    );
    let maps = |name: &str| {
        json_lines(radome().arg("rdm").arg(path("run.mcap")).arg("--json").arg("-o").arg(path(name)));
        std::fs::read(path(name)).expect("maps")
    };
    let before = maps("before.npy");
    std::fs::write(path("track.txt"), "0.500000\t1.250000\tempty\n1.250000\t3.000000\tone\n").expect("writable");
    let import = ["--who", "a test", "--json", "--import"];
    let spans = json_lines(radome().arg("labels").arg(path("run.mcap")).args(import).arg(path("track.txt"))).remove(0);
    assert_eq!((spans[0]["label"].as_str(), spans[1]["end_s"].as_f64()), (Some("empty"), Some(3.0)));
    assert_eq!(spans[1]["who"], "a test");
    json_lines(radome().arg("labels").arg(path("run.mcap")).args(["--json", "--export"]).arg(path("out.label")));
    let text = std::fs::read_to_string(path("out.label")).expect("written");
    assert!(text.starts_with("Time(Seconds),Length(Seconds),") && text.contains("1.250000,1.750000,one,"), "{text}");
    assert_eq!(maps("after.npy"), before);

    std::fs::write(path("bad.txt"), "0.5\tempty\n").expect("writable");
    let said = failure(radome().arg("labels").arg(path("run.mcap")).arg("--import").arg(path("bad.txt")));
    assert!(said.contains("bad.txt") && said.contains("line 1"), "{said}");
}
