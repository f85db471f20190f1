//! Scene and receiver files: errors name the file, the line and the expected content.

use std::path::Path;

use radome_sim::{Receiver, Scene, SceneError, load_receiver};

use crate::common::{self, NOBODY, error_message, hall};

fn line_of(text: &str, text_in_line: &str) -> usize {
    text.lines().position(|l| l.contains(text_in_line)).expect("written") + 1
}

#[test]
fn fixture_scenes_load_and_name_their_waveform() {
    for (name, samples) in
        [("corridor", 256), ("room", 256), ("desk", 64), ("room-mesh", 256), ("bedroom", 256), ("bathroom", 256)]
    {
        let scene = common::scene(name);
        assert_eq!(scene.waveform().request.samples_per_chirp, samples);
        assert_eq!(scene.name(), name);
    }
}

#[test]
fn the_typical_receiver_file_is_the_built_in_default() {
    let file = load_receiver(&common::fixtures().join("receivers/typical.toml")).expect("fixture");
    let built_in = Receiver::typical();
    assert!((file.transmit_power_step_db - built_in.transmit_power_step_db).abs() < 1e-3);
    let same = Receiver {
        measured_from: built_in.measured_from.clone(),
        transmit_power_step_db: built_in.transmit_power_step_db,
        ..file
    };
    assert_eq!(same, built_in);
}

#[test]
fn every_receiver_fixture_loads() {
    for entry in std::fs::read_dir(common::fixtures().join("receivers")).expect("folder") {
        let path = entry.expect("entry").path();
        if path.extension().is_some_and(|e| e == "toml") {
            assert!(load_receiver(&path).is_ok(), "{}: {:?}", path.display(), load_receiver(&path).err());
        }
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn the_error_of_an_unknown_key_names_file_line_and_known_keys() {
        let text = hall(NOBODY)
            .replace("azimuth", "azimut")
            .replace("position_m = [1.0, 10.0, 1.2]", "posiiton_m = [1.0, 10.0, 1.2]");
        let message = error_message(&text);
        let line = line_of(&text, "posiiton_m");
        assert!(message.starts_with(&format!("a/b.toml:{line}: ")), "{message}");
        assert!(message.contains("posiiton_m") && message.contains("position_m"), "{message}");
    }

    #[test]
    fn invalid_values_are_refused_with_line_and_bounds() {
        let cases = [
            ("size_m = [20.0, 20.0, 3.0]", "size_m = [20.0, -2.0, 3.0]", "size_m", "0.5 to 100 m"),
            ("position_m = [1.0, 10.0, 1.2]", "position_m = [1.0, 10.0, 9.2]", "position_m", "in the room"),
            ("position_m = [1.0, 10.0, 1.2]", "position_m = [nan, 10.0, 1.2]", "position_m", "in the room"),
            ("x_low = { material = \"open\" }", "x_low = { material = \"cheese\" }", "x_low", "concrete"),
            (
                "x_low = { material = \"open\" }",
                "x_low = { material = \"wood\", thickness_m = -1.0 }",
                "thickness_m",
                "0 to 10 m",
            ),
            ("sample_rate_hz = 1e6", "sample_rate_hz = 9e6", "[waveform]", "sample_rate_hz"),
            ("sample_rate_hz = 1e6", "sample_rate_hz = \"fast\"", "sample_rate_hz", "expected a number"),
            ("max_people = 0", "max_people = 3", "max_people", "two"),
            ("adc_white_lsb = 2.0", "adc_white_lsb = -2.0", "adc_white_lsb", "physical"),
            ("format = 1\nname = \"hall\"", "format = 2\nname = \"hall\"", "format", "expected 1"),
        ];
        for (from, to, key, expected) in cases {
            let text = hall(NOBODY).replacen(from, to, 1);
            assert_ne!(text, hall(NOBODY), "{from}");
            let message = error_message(&text);
            let line = line_of(&text, key);
            assert!(message.starts_with(&format!("a/b.toml:{line}: ")), "{to}: {message} (line {line})");
            assert!(message.contains(expected), "{to}: {message}");
        }
    }

    /// Regression test: an error named the first line with the key, which may be in another table.
    #[test]
    fn an_error_names_the_line_of_the_invalid_value_or_none() {
        let bed = "[[bed]]\nposition_m = [3.0, 3.0]\nheading_deg = 0.0\nheight_m = 0.5\n";
        let text = hall(&format!("{bed}{}{NOBODY}", bed.replace("height_m = 0.5", "height_m = 3")));
        let (line, message) = (line_of(&text, "height_m = 3"), error_message(&text));
        assert!(message.starts_with(&format!("a/b.toml:{line}: height_m is 3, expected 0.2 to 1 m")), "{message}");
        let text = hall(&format!("{bed}{}{NOBODY}", bed.replace("[3.0, 3.0]", "[99.0, 3.0]")));
        assert!(error_message(&text).starts_with("a/b.toml: bed is [99.0, 3.0], expected"), "{}", error_message(&text));
        // The height of a seat may be that of a wrong bed.
        let seat = "[[seat]]\nposition_m = [3.0, 3.0]\nheading_deg = 0.0\nheight_m = 0.1\n";
        let text = hall(&format!("{}{seat}{NOBODY}", bed.replace("height_m = 0.5", "height_m = 0.1")));
        assert!(
            error_message(&text).starts_with("a/b.toml: height_m is 0.1, expected 0.2 to 1 m"),
            "{}",
            error_message(&text)
        );
    }

    #[test]
    fn messages_contain_no_names_of_rust_types() {
        for (from, to, expected) in [
            ("name = \"flat\"", "name = \"flat\"\nantenna = 5", "expected a table"),
            ("chirps_per_frame = 128", "chirps_per_frame = \"many\"", "expected a whole number"),
            ("size_m = [", "max_reflections = 5000000000\nsize_m = [", "expected a whole number from 0 to 4294967295"),
            ("max_people = 0", "max_people = 9", "max_people is 9, expected 0 to 2 people"),
        ] {
            let text = hall(NOBODY).replacen(from, to, 1);
            assert!(error_message(&text).contains(expected), "{to}: {}", error_message(&text));
        }
    }

    #[test]
    fn a_door_wider_than_its_wall_allows_is_refused() {
        let door = |keys: &str| format!("[[door]]\n{keys}\n[people.visits]\n");
        let message = error_message(&hall(&door("position_m = [0.0, 1.0]\nwidth_m = 2.5")));
        assert!(message.contains("width_m is 2.5, expected at most 2.00 m"), "{message}");
        assert!(Scene::parse(&hall(&door("position_m = [0.0, 1.0]\nwidth_m = 2.0")), Path::new("a")).is_ok());
        // A width that is not written has no line.
        let text = hall(&door("position_m = [0.0, 0.3]"));
        let (line, message) = (line_of(&text, "position_m = [0.0, 0.3]"), error_message(&text));
        let expected = "position_m is [0.0, 0.3], expected 0.45 m or more off the wall's ends: width_m is 0.9";
        assert!(message.starts_with(&format!("a/b.toml:{line}: {expected}")), "{message}");
    }

    /// Regression test: with a margin of half the room or more, all people stood in its middle.
    #[test]
    fn a_margin_of_half_the_room_is_refused() {
        let door = "[[door]]\nposition_m = [0.0, 3.0]\n";
        let visits = |margin: &str| format!("{door}[people.visits]\npace_margin_m = {margin}\n");
        assert!(Scene::parse(&hall(&visits("9.9")), Path::new("a")).is_ok());
        for margin in ["10.0", "-0.1", "nan"] {
            let message = error_message(&hall(&visits(margin)));
            let expected = "expected 0 to less than 10 m, half of the room's shorter side";
            assert!(message.contains("pace_margin_m") && message.contains(expected), "{margin}: {message}");
        }
    }

    /// Regression test: surplus values of lists were ignored.
    #[test]
    fn lists_with_too_many_values_are_refused() {
        let door = "[[door]]\nposition_m = [0.0, 3.0]\n[people.visits]\nabsence_s = [1.0, 2.0]\n";
        for (from, to, key) in [
            ("size_m = [20.0, 20.0, 3.0]", "size_m = [20.0, 20.0, 3.0, 99.0]", "room.size_m"),
            ("[1.0, 10.0, 1.2]", "[1.0, 10.0, 1.2, \"junk\"]", "radar.position_m"),
            ("absence_s = [1.0, 2.0]", "absence_s = [1.0, 2.0, 3.0]", "people.visits.absence_s"),
            ("[0.0, 3.0]", "[0.0, 3.0, 1.0]", "door.position_m"),
        ] {
            let message = error_message(&hall(door).replacen(from, to, 1));
            assert!(message.contains(&format!("`{key}`")), "{to}: {message}");
        }
        let text = hall(door).replacen("size_m = [20.0, 20.0, 3.0]", "size_m = [20.0, 20.0, 3.0, 99.0]", 1);
        let line = line_of(&text, "size_m");
        assert!(error_message(&text).starts_with(&format!("a/b.toml:{line}: ")), "{}", error_message(&text));
        let steps = "[people]\nactor = [{ step = [{ walk_to_m = [1.0, 1.0, 9.0] }] }]\n";
        assert!(error_message(&hall(steps)).contains("walk_to_m`"), "{}", error_message(&hall(steps)));
        let random = format!("{door}[random]\n\"radar.tilt_down_deg\" = {{ between = [0, 1, 2] }}\n");
        assert!(error_message(&hall(&random)).contains("between`"), "{}", error_message(&hall(&random)));
    }

    /// Regression test: the message named no limits, but a schema that has none.
    #[test]
    fn invalid_constants_of_a_receiver_are_refused_with_their_range() {
        let message = error_message(&hall(NOBODY).replace("noise_figure_db = 0.0", "noise_figure_db = 61.5"));
        assert!(message.contains("noise_figure_db is 61.5, expected a physical value, 0 to 60"), "{message}");
    }

    #[test]
    fn a_scene_without_exactly_one_complete_program_is_refused() {
        for (people, expected) in [
            ("[people]\n", "[people.desk]\n\nhint: a scene has people, and --people 0 leaves them out"),
            ("[people.desk]\n[people.visits]\n", "exactly one"),
            ("[people.visits]\n", "door"),
            ("[people]\nactor = [{ step = [{ stand_s = 1.0 }] }]\n", "walk_to_m"),
            ("[people]\nactor = [{ step = [{ walk_to_m = [1.0, 1.0] }, { sit_s = 3.0, seat = 2 }] }]\n", "[[seat]]"),
            ("[[door]]\nposition_m = [3.0, 3.0]\n[people.visits]\n", "wall"),
        ] {
            let message = error_message(&hall(people));
            assert!(message.contains(expected), "{people}: {message}");
        }
    }

    /// Scene in a folder of its own, which names a receiver, a mesh or an actor.
    fn load_in_folder(folder: &Path, receiver: &str, mesh: &str, actor: &str) -> Result<Scene, SceneError> {
        let (_, text) = common::fixture("room-mesh");
        let people = if actor.is_empty() { "" } else { "[people]\nbody = \"mesh\"\n" };
        let text = text
            .replace("../receivers/paper-mesh.toml", receiver)
            .replace("room-mesh.obj", mesh)
            .replace("[[people.actor]]\n", &format!("{people}[[people.actor]]\n{actor}"));
        let path = folder.join("scene.toml");
        std::fs::write(&path, text).expect("written");
        Scene::load(&path)
    }

    #[test]
    fn a_file_outside_the_folder_of_a_scene_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let (scene_folder, receivers) = (folder.path().join("scenes"), folder.path().join("receivers"));
        for created in [&scene_folder, &receivers] {
            std::fs::create_dir(created).expect("made");
        }
        let copy = |name: &str, to: std::path::PathBuf| {
            std::fs::copy(common::fixtures().join(name), to).expect("copied");
        };
        copy("receivers/paper-mesh.toml", receivers.join("r.toml"));
        copy("receivers/paper-mesh.toml", scene_folder.join("r.toml"));
        copy("receivers/paper-mesh.toml", folder.path().join("r.toml"));
        copy("scenes/room-mesh.obj", scene_folder.join("room.obj"));
        copy("scenes/room-mesh.obj", receivers.join("room.obj"));
        for receiver in ["r.toml", "../receivers/r.toml", "../r.toml"] {
            assert!(load_in_folder(&scene_folder, receiver, "room.obj", "").is_ok(), "{receiver}");
        }
        let assert_load_refused = |receiver: &str, mesh: &str, actor: &str, expected: &[&str]| {
            common::assert_refused(load_in_folder(&scene_folder, receiver, mesh, actor), expected);
        };
        let outside = &["leads out of the folder", "RADOME_PATH", "hint: "];
        for name in ["/etc/hostname", "/dev/zero", "../../../../../../../etc/hostname", "../receivers/room.obj"] {
            if scene_folder.join(name).exists() {
                assert_load_refused(name, "room.obj", "", outside);
                assert_load_refused("r.toml", "room.obj", &format!("file = {name:?}\n"), outside);
            }
        }
        assert_load_refused("r.toml", "../receivers/room.obj", "", outside);
        assert_load_refused(".", "room.obj", "", &["not a regular file"]);
        assert_load_refused("r.toml", "room.obj", "file = \".\"\n", &["not a regular file"]);
        assert_load_refused("none.toml", "room.obj", "", &["none.toml", "cannot be read"]);
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink("/dev/zero", scene_folder.join("link.obj")).expect("linked");
            assert_load_refused("r.toml", "link.obj", "", outside);
        }
    }

    #[test]
    fn oversized_and_truncated_scene_files_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("scene.toml");
        let assert_load_refused = |bytes: &[u8], expected: &[&str]| {
            std::fs::write(&path, bytes).expect("written");
            common::assert_refused(Scene::load(&path), expected);
        };
        let valid = hall(NOBODY);
        assert_load_refused(&vec![b'#'; (1 << 20) + 1], &["scene.toml", "1048577 bytes", "at most 1048576", "hint: "]);
        assert_load_refused(&[valid.as_bytes(), &[0xFF]].concat(), &["scene.toml", "cannot be read"]);
        assert_load_refused(format!("a = {}", "[".repeat(100_000)).as_bytes(), &["scene.toml:1: "]);
        assert_load_refused(format!("a = {}1", "{ a = ".repeat(100_000)).as_bytes(), &["scene.toml:1: "]);
        let shelf = "[[furniture]]\nname = \"a\"\nposition_m = [1, 1, 0]\nsize_m = [1, 1, 1]\n".repeat(1001);
        assert_load_refused(format!("{valid}\n{shelf}").as_bytes(), &["furniture", "0 to 1000 tables"]);
        let one = shelf.lines().take(4).collect::<Vec<_>>().join("\n");
        assert_load_refused(format!("{valid}\n{one}\npoints = 18446744073709551615\n").as_bytes(), &["scene.toml:"]);
        assert_load_refused(format!("{valid}\n{one}\npoints = 1000000000\n").as_bytes(), &["points", "1 to 64"]);
        let frames = valid.replace("chirps_per_frame = 128", "chirps_per_frame = 1000000000");
        assert_load_refused(frames.as_bytes(), &["chirps_per_frame"]);
        assert_ne!(frames, valid);
        // A file that is cut off anywhere gives a scene or an error with a place.
        for end in 0..valid.len() {
            if let Err(error) = Scene::parse(&valid[..end], &path) {
                assert!(error.to_string().contains("scene.toml:"), "{end}: {error}");
            }
        }
    }

    #[test]
    fn the_error_of_a_missing_file_names_it() {
        let error = Scene::load(Path::new("/nowhere/scene.toml")).map(|_| ()).expect_err("missing");
        assert!(matches!(error, SceneError::Read { .. }) && error.to_string().contains("/nowhere/scene.toml"));
        let text = hall(NOBODY);
        let from = text.find("[receiver]").expect("receiver");
        let to = text.find("[room]").expect("room");
        let text = format!("{}{}", &text[..from], &text[to..])
            .replace("name = \"hall\"", "name = \"hall\"\nreceiver = \"none.toml\"");
        assert!(error_message(&text).contains("a/none.toml"), "{}", error_message(&text));
        assert!(error_message("").contains("a/b.toml:1"));
        assert!(error_message("\u{0}\u{1}[[[").contains("a/b.toml:1"));
    }
}
