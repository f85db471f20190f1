//! Tests of simulated recordings: bytes do not depend on the threads, and frames pass unchanged through board and file.

use std::path::Path;

use radome_tests::{
    command, fails_with, failure, fixture, fixture_text, frames_and_gaps, json_lines, outcome, radome, simulate,
    success, write_file, wrong_use, wrong_use_with,
};

fn simulate_bytes(folder: &Path, name: &str, threads: &str) -> Vec<u8> {
    let path = folder.join(name);
    let corridor = fixture("scenes/corridor.toml");
    let mut command = command!("scene simulate --frames 40 --seed 7 --people 2 --json", corridor, "-o", &path);
    let lines = json_lines(command.env("RAYON_NUM_THREADS", threads));
    assert_eq!(lines[0]["frames"], 40);
    assert!(lines[0]["seconds"].is_number() && lines[0]["frames_per_second"].is_number());
    std::fs::read(path).expect("written")
}

#[test]
fn a_scene_gives_the_same_bytes_twice_and_on_one_and_two_threads() {
    let folder = tempfile::tempdir().expect("a folder");
    let first = simulate_bytes(folder.path(), "a.mcap", "2");
    assert!(first == simulate_bytes(folder.path(), "b.mcap", "2"), "a second run differs");
    assert!(first == simulate_bytes(folder.path(), "c.mcap", "1"), "one thread differs from two");
}

#[test]
fn the_emulated_board_sends_the_simulated_frames() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = fixture("scenes/corridor.toml");
    let (direct, recorded) = (folder.path().join("direct.mcap"), folder.path().join("recorded.mcap"));
    simulate(&scene, "--frames 12 --seed 3", &direct);
    let emulated = format!("emulated:{}", scene.display());
    let args = ["--frames", "12", "--seed", "3", "--json", "-o"];
    let said = json_lines(command!("record", &emulated, ..args, &recorded));
    assert_eq!((&said[0]["frames"], &said[0]["dropped"]), (&12.into(), &0.into()));
    let codes = |path: &Path| -> Vec<_> {
        frames_and_gaps(path).0.into_iter().map(|frame| (frame.sequence, frame.codes, frame.truth)).collect()
    };
    let (a, b) = (codes(&direct), codes(&recorded));
    assert_eq!(a.len(), 12);
    assert!(a == b);
}

mod hard_cases {
    use super::*;

    /// Regression test: a waveform that was named was ignored for scenes, emulated or not.
    #[test]
    fn a_scene_is_simulated_in_the_waveform_that_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = "start_frequency_hz = 60e9\nend_frequency_hz = 62e9\nsamples_per_chirp = 32\nchirps_per_frame = 16\n\
                    sample_rate_hz = 1e6\nchirp_interval_s = 800e-6\nframe_interval_s = 50e-3\nrx_antennas = [1, 3]\n";
        let other = write_file(folder.path(), "other.toml", keys);
        let scene = fixture("scenes/desk.toml").display().to_string();
        let recorded = [scene.clone(), format!("emulated:{scene}")].map(|source| {
            let path = folder.path().join(format!("{}.mcap", source.len()));
            json_lines(command!("record --json", &source, "--frames 5 --waveform", &other, "-o", &path));
            frames_and_gaps(&path).0.into_iter().map(|frame| frame.codes).collect::<Vec<_>>()
        });
        assert!(recorded[0].len() == 5 && recorded[0].iter().all(|codes| codes.len() == 2 * 16 * 32));
        assert!(recorded[0] == recorded[1], "the emulated board sends something else");
    }

    /// Regression test: options that a source has no use for were ignored.
    #[test]
    fn options_without_effect_on_a_source_are_refused() {
        let (recording, board) = (fixture("formats/recording.mcap").display().to_string(), "serial:/dev/no-such-port");
        let emulated = format!("emulated:{recording}");
        let model = "fixtures/models/paper-hqnn.safetensors";
        for (source, option, value) in [
            (&*recording, "--waveform", "paper"),
            (&*emulated, "--waveform", "paper"),
            (&*recording, "--seed", "3"),
            (&*emulated, "--people", "1"),
            (board, "--seed", "3"),
            (board, "--people", "1"),
            (board, "--speed", "2"),
        ] {
            for command in [&["recording", "echoes"][..], &["live", "--model", model]] {
                let said = wrong_use(radome().args(command).args([source, option, value]));
                assert!(said.contains(&format!("{option} has no effect on {source}")), "{command:?}: {said}");
            }
        }
    }

    /// A port without `serial:` was taken for a recording, and its options were refused.
    #[test]
    fn a_device_is_no_recording() {
        let folder = tempfile::tempdir().expect("a folder");
        for source in ["/dev/null", "emulated:/dev/null"] {
            let said = failure(command!("record", source, "--waveform paper -o", folder.path().join("x.mcap")));
            assert!(said.contains("/dev/null is a device") && said.contains("serial:/dev/null"), "{said}");
        }
    }

    /// The error was ": cannot be opened".
    #[test]
    fn a_source_that_names_nothing_is_wrong_use() {
        let folder = tempfile::tempdir().expect("a folder");
        for source in ["serial:", "emulated:", "deepcraft:"] {
            let output = folder.path().join("x.mcap");
            wrong_use_with(command!("record", source, "--waveform paper -o", output), &[source, "names nothing"]);
        }
    }

    #[test]
    fn a_wrong_key_in_a_scene_names_file_line_and_key() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = std::fs::read_to_string(fixture("scenes/corridor.toml")).expect("readable");
        let scene = write_file(folder.path(), "bad.toml", text.replace("position_m", "position"));
        fails_with(command!("scene simulate", &scene, "-o", folder.path().join("x.mcap")), &["bad.toml", "position"]);
        assert!(!folder.path().join("x.mcap").exists());
    }

    /// A person went through walls and furniture without a word.
    #[test]
    fn an_unreachable_place_is_reported_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = fixture_text("scenes/corridor.toml");
        let (room, _) = text.split_once("[people.visits]").expect("a program of visits");
        let wardrobe = "[[furniture]]\nname = \"wardrobe\"\nposition_m = [6.0, 0.0, 0.0]\nsize_m = [1.0, 2.0, 2.0]\n";
        let scene = folder.path().join("scene.toml");
        for (first, goals, expected) in [
            (
                "4.0, 1.0",
                "{ walk_to_m = [5.0, 9.0] }, { walk_to_m = [5.0, 12.0] }",
                "to [5.00, 9.00] m, which lies outside the room",
            ),
            ("4.0, 1.0", "{ walk_to_m = [9.0, 1.0] }", "to [9.00, 1.00] m, which cannot be reached around"),
            ("4.0, 1.0", "{ walk_to_m = [6.5, 1.0] }", "at [6.50, 1.00] m, which lies within furniture"),
            ("5.0, -9.0", "{ stand_s = 5.0 }", "at [5.00, -9.00] m, which lies outside the room"),
        ] {
            let actor = format!("[[people.actor]]\nstep = [{{ walk_to_m = [{first}] }}, {goals}]\n");
            std::fs::write(&scene, format!("{room}{wardrobe}[people]\nkeep_off_m = 0.3\n{actor}")).expect("written");
            let (_, said) = success(command!("scene simulate --frames 1", &scene));
            assert!(said.contains(expected) && said.matches("person 0").count() == 1, "{said}");
        }
    }

    /// Goals beyond a slanted wall were accepted without a warning on the lines of the boxes that cover it, and elsewhere
    /// they were taken for furniture.
    #[test]
    fn goals_beyond_slanted_walls_lie_outside_the_room() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = folder.path().join("scene.toml");
        let text = fixture_text("scenes/l-corridor.toml");
        let (room, _) = text.split_once("[[people.actor]]").expect("an actor");
        let room = room.replace("[8.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]]", "[8.0, 2.0], [4.0, 6.0]]");
        let says = |steps: &str| {
            std::fs::write(&scene, format!("{room}[[people.actor]]\nstep = [{steps}]\n")).expect("written");
            success(command!("scene simulate --frames 1", &scene)).1
        };
        for goal in ["7.00, 4.00", "1.00, 3.00", "7.10, 4.10"] {
            let said = says(&format!("{{ walk_to_m = [6.0, 1.2] }}, {{ walk_to_m = [{goal}] }}"));
            let expected = format!("person 0 goes straight to [{goal}] m, which lies outside the room");
            assert!(said.contains(&expected), "{said}");
        }
        let said = says("{ walk_to_m = [7.0, 4.0] }, { stand_s = 9.0 }");
        assert!(said.contains("person 0 stands at [7.00, 4.00] m, which lies outside the room"), "{said}");
        let said = says("{ walk_to_m = [6.0, 1.2] }, { walk_to_m = [4.0, 4.0] }");
        assert!(!said.contains("person 0"), "{said}");
    }

    /// People stood anywhere, and inside each other, where no place fits the keys of pacing.
    #[test]
    fn visitors_without_a_place_to_pace_are_reported_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = fixture_text("scenes/corridor.toml");
        let (room, _) = text.split_once("[people.visits]").expect("a program of visits");
        for (range_m, told) in [("[90.0, 99.0]", 1), ("[0.5, 12.0]", 0)] {
            let visits = format!(
                "[people.visits]\nfirst_absence_s = [0.0, 0.1]\npace_probability = 1.0\npace_range_m = {range_m}\n"
            );
            let scene = write_file(folder.path(), "scene.toml", format!("{room}{visits}"));
            let (_, said) = success(command!("scene simulate --frames 1 --people 2", &scene));
            assert_eq!(said.matches("attempts found no place to pace").count(), told, "{said}");
        }
    }

    /// Walls that meet in a T were told of as faces that lie on each other.
    #[test]
    fn only_faces_that_lie_on_each_other_are_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = write_file(folder.path(), "scene.toml", fixture_text("scenes/room-mesh.toml"));
        let room = fixture_text("scenes/room-mesh.obj");
        let walls = "o inner\nusemtl plaster\nv 0 -1 0\nv 0 -1 2.6\nv 0 -1.5 0\nv 0 -1.5 2.6\nv -1 -1 0\nv -1 -1 2.6\n\
                     v 1 -1 0\nv 1 -1 2.6\nf -8 -7 -5 -6\nf -8 -7 -3 -4\nf -8 -7 -1 -2\n";
        let beside = "v 0.5 -1 0\nv 0.5 -1 2.6\nv 1.5 -1 0\nv 1.5 -1 2.6\nf -4 -3 -1 -2\n";
        for (mesh, is_told) in [(format!("{room}{walls}"), false), (format!("{room}{walls}{beside}"), true)] {
            write_file(folder.path(), "room-mesh.obj", mesh);
            let (_, said) = success(command!("scene paths --people 0", &scene));
            assert_eq!(said.contains("faces that lie on each other"), is_told, "{said}");
        }
    }

    /// A metal plate of 9 cm in a file lost its mirror echo without a warning.
    #[test]
    fn metal_faces_too_small_to_mirror_are_reported_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = fixture_text("scenes/room-mesh.toml").replace("plaster = ", "steel = \"metal\", plaster = ");
        let scene = write_file(folder.path(), "scene.toml", text);
        let room = fixture_text("scenes/room-mesh.obj");
        for (y_m, is_told) in [(0.09, true), (0.12, false)] {
            let plate = format!("v 1 0 1\nv 1 {y_m} 1\nv 1 {y_m} 1.09\nv 1 0 1.09\nf -4 -3 -2 -1\n");
            write_file(folder.path(), "room-mesh.obj", format!("{room}o plate\nusemtl steel\n{plate}"));
            let (_, said) = success(command!("scene paths --people 0", &scene));
            assert_eq!(said.matches("corners: 1, the largest of 0.0081 m^2").count(), usize::from(is_told), "{said}");
        }
    }

    /// A recording of MCAP bytes got a name by which it was taken for text.
    #[test]
    fn an_output_with_the_name_of_a_text_file_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        for options in ["--frames 2", "--frames 2 --shard 0/2"] {
            let (scene, text) = (fixture("scenes/corridor.toml"), folder.path().join("z.txt"));
            let simulate = command!("scene simulate", scene, ..options.split(' '), "-o", text);
            wrong_use_with(simulate, &["z", "MCAP only", "hint: "]);
        }
        assert_eq!(std::fs::read_dir(folder.path()).expect("readable").count(), 0);
    }

    #[test]
    fn a_shard_of_other_arguments_is_refused_and_its_own_is_found() {
        let folder = tempfile::tempdir().expect("a folder");
        let shard = |options: &str| {
            let (scene, output) = (fixture("scenes/corridor.toml"), folder.path().join("a.mcap"));
            command!("scene simulate --shard 1/2 --people 1 --json", scene, ..options.split(' '), "-o", output)
        };
        json_lines(shard("--frames 8 --seed 3"));
        assert_eq!(json_lines(shard("--frames 8 --seed 3"))[0]["found"], true);
        for other in ["--frames 8 --seed 4", "--frames 10 --seed 3"] {
            fails_with(shard(other), &["a-shard-00001-of-00002.mcap", "hint: --overwrite"]);
        }
        json_lines(shard("--frames 8 --seed 4 --overwrite"));
        assert_eq!(json_lines(shard("--frames 8 --seed 4"))[0]["found"], true);
    }

    #[test]
    fn a_recording_cut_short_gives_its_whole_frames_or_says_where_it_ends() {
        let folder = tempfile::tempdir().expect("a folder");
        let bytes = simulate_bytes(folder.path(), "whole.mcap", "2");
        let path = write_file(folder.path(), "cut.mcap", &bytes[..bytes.len() / 2]);
        let maps = folder.path().join("maps.npy");
        let (status, _, said) = outcome(command!("recording maps", &path, "-o", maps));
        assert!(!said.contains("panicked"), "{said}");
        assert!(status == Some(0) || said.contains("cut.mcap"), "{said}");
    }
}
