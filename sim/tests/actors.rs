//! People and rooms from files: actors walk upright, forwards and without sliding, and errors in a file are reported.

mod biped;

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use radome_sim::file_error::FileError;
use radome_sim::geometry::import::UpAxis;
use radome_sim::people::body::{CHEST, FOOT, HEAD, PELVIS, THIGH};
use radome_sim::people::clip::BodyClip;
use radome_sim::people::imported::{Actor, ActorOptions};
use radome_sim::people::motion::{Motion, MotionBuilder, Person, Steps};
use radome_sim::people::skin::EDGE_M;
use radome_sim::people::walking_mesh::WalkingMesh;
use radome_sim::random::{Purpose, generator};
use radome_skip::shared;
use rand::Rng;

use crate::common;

fn options() -> ActorOptions {
    ActorOptions { height_m: Some(1.75), ..ActorOptions::default() }
}

fn parse(bytes: &[u8], name: &str) -> Result<Actor, FileError> {
    Actor::parse(bytes, Path::new(name), &options())
}

fn gltf_actor() -> Steps {
    Steps::Actor(Arc::new(parse(&biped::gltf(1.0).bytes(), "biped.gltf").expect("a good file")))
}

fn bvh_clip() -> Steps {
    Steps::Clip(Arc::new(BodyClip::parse(&biped::bvh(), UpAxis::Y, None).expect("a good file")))
}

/// Walker straight ahead at 30 degrees to the room, at 1.2 m/s from second 0 to 5.
fn walker(steps: Steps) -> WalkingMesh {
    let mut person = Person::draw(1, [0, 0], 1.75);
    person.steps = steps;
    let ahead = DVec3::new(30f64.to_radians().cos(), 30f64.to_radians().sin(), 0.0);
    let to = DVec3::new(2.0, 2.0, 0.0) + ahead * 6.0;
    let motion: Motion = MotionBuilder::new(person, 0.0, [2.0, 2.0], 0.0).walk_to([to.x, to.y], 1.2).stand(5.0).stay();
    WalkingMesh::new(Arc::new(motion), EDGE_M)
}

/// Checks that feet on the floor do not slide, that soles and head are at their heights, that the trunk follows the
/// motion, and that velocities are the rates of vertices.
fn check_walk(walker: &WalkingMesh, most_sliding_m_per_s: f64, most_sole_m: f64) {
    let ahead = DVec3::new(30f64.to_radians().cos(), 30f64.to_radians().sin(), 0.0);
    let mut standing_speeds = Vec::new();
    for i in 0..60 {
        let time_s = 1.5 + 0.03 * f64::from(i);
        let now = walker.posed(time_s);
        let z = |v: &DVec3| v.z;
        let lowest = now.vertices.iter().map(z).fold(f64::INFINITY, f64::min);
        let highest = now.vertices.iter().map(z).fold(f64::NEG_INFINITY, f64::max);
        assert!(lowest.abs() < most_sole_m, "soles are at {lowest} m at {time_s} s");
        assert!(highest > 1.5 && highest < 1.85, "the head is at {highest} m at {time_s} s");
        let middle = now.vertices.iter().sum::<DVec3>() / now.vertices.len() as f64;
        let expected = DVec3::new(2.0, 2.0, middle.z) + ahead * (1.2 * time_s);
        assert!(middle.distance(expected) < 0.2, "{middle} at {time_s} s, expected {expected}");
        let mut speeds: Vec<f64> = now
            .vertices
            .iter()
            .zip(&now.velocities_m_per_s)
            .filter(|(v, _)| v.z < lowest + 0.006)
            .map(|(_, u)| u.truncate().length())
            .collect();
        speeds.sort_by(f64::total_cmp);
        standing_speeds.push(speeds[speeds.len() / 2]);
        let h = 1e-4;
        let (before, after) = (walker.mesh_at(time_s - h).vertices, walker.mesh_at(time_s + h).vertices);
        for ((u, a), b) in now.velocities_m_per_s.iter().zip(&before).zip(&after) {
            assert!((*u - (*b - *a) / (2.0 * h)).length() < 2e-3, "{u}");
        }
    }
    standing_speeds.sort_by(f64::total_cmp);
    let median = standing_speeds[standing_speeds.len() / 2];
    assert!(median < most_sliding_m_per_s, "feet on the floor go at {median} m/s");
}

#[test]
fn a_gltf_actor_walks_upright_ahead_and_without_sliding() {
    let Steps::Actor(actor) = gltf_actor() else { unreachable!() };
    assert_eq!(actor.open_edges, 0);
    // Legs of 0.9 m that swing by 0.4 rad either way, twice a cycle.
    assert!((1.2..1.6).contains(&actor.cycle_m), "{} m a cycle", actor.cycle_m);
    let sliding = actor.foot_sliding(1.2);
    assert!(sliding.standing_rms_m_per_s < 0.15 && sliding.standing > 0.8, "{sliding:?}");
    let walker = walker(Steps::Actor(actor));
    check_walk(&walker, 0.15, 0.04);
    // Feet are ahead of the shanks, and the left side is the left one.
    let standing = &walker.skin().rest().vertices;
    let shanks: Vec<f64> = standing.iter().filter(|v| v.z > 0.12 && v.z < 0.25).map(|v| v.x).collect();
    let ankles = shanks.iter().sum::<f64>() / shanks.len() as f64;
    let sole_offsets = || standing.iter().filter(|v| v.z < 0.05).map(|v| v.x - ankles);
    let (behind, ahead) = (sole_offsets().fold(0.0, f64::min), sole_offsets().fold(0.0, f64::max));
    assert!(ahead > -behind + 0.02, "feet from {behind} to {ahead} m");
    let body = walker.motion().body(3.0);
    let left = DVec3::new(-0.5, 30f64.to_radians().cos(), 0.0);
    assert!((body[THIGH].centre - body[THIGH + 1].centre).dot(left) > 0.1, "the left thigh is on the left");
    assert!(body[HEAD].centre.z > 1.5 && body[FOOT].centre.z < 0.3 && body[PELVIS].centre.z < body[CHEST].centre.z);
}

#[test]
fn collada_in_centimetres_and_gltf_in_inches_are_the_same_actor() {
    let exact = parse(&biped::gltf(1.0).bytes(), "a.gltf").expect("a good file");
    let file = ActorOptions::default();
    let from_collada = Actor::parse(biped::collada().as_bytes(), Path::new("a.dae"), &file).expect("a good file");
    let inches = ActorOptions { unit: Some(radome_sim::geometry::import::LengthUnit::Inch), ..file };
    let from_inches =
        Actor::parse(&biped::gltf(1.0 / 0.0254).bytes(), Path::new("a.gltf"), &inches).expect("a good file");
    for other in [&from_collada, &from_inches] {
        assert!((other.height_m - 1.75).abs() < 0.03, "{} m", other.height_m);
        let scale = exact.height_m / other.height_m;
        assert!((other.cycle_m * scale / exact.cycle_m - 1.0).abs() < 1e-3);
        let (a, b) = (exact.skin.rest(), other.skin.rest());
        assert!((b.volume_m3() * scale.powi(3) / a.volume_m3() - 1.0).abs() < 0.01);
    }
    check_walk(&walker(Steps::Actor(Arc::new(from_collada))), 0.15, 0.04);
}

#[test]
fn a_captured_clip_moves_the_built_in_body_without_sliding() {
    let Steps::Clip(clip) = bvh_clip() else { unreachable!() };
    let [begin, end] = clip.span_s;
    assert!((end - begin - 1.0).abs() < 0.05, "a cycle of {begin} to {end} s");
    // Legs of 0.86 m that swing by 0.4 rad either way, twice a cycle, and soles that roll.
    let cycle_m = clip.cycle_m(0.53 * 1.75);
    assert!((1.3..1.6).contains(&cycle_m), "{cycle_m} m a cycle");
    check_walk(&walker(Steps::Clip(clip)), 0.25, 0.05);
}

#[test]
fn the_cesium_man_and_a_captured_walk_have_echoes_in_the_corridor() {
    let (Some(man), Some(walk)) =
        (shared("data/actors/cesium-man/CesiumMan.glb"), shared("data/actors/cmu-131-walk/131_01.bvh"))
    else {
        return;
    };
    let fixtures = common::fixtures();
    let text = std::fs::read_to_string(fixtures.join("scenes/corridor-mesh.toml")).expect("fixture");
    let text = text.replace("../receivers/", "");
    // A scene names files of its own folder.
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::copy(fixtures.join("receivers/paper-mesh.toml"), folder.path().join("paper-mesh.toml")).expect("copied");
    std::fs::copy(&man, folder.path().join("man.glb")).expect("copied");
    std::fs::copy(&walk, folder.path().join("walk.bvh")).expect("copied");
    let scene_path = folder.path().join("scene.toml");
    // The man's clip is a jog, in which the feet touch down while they still swing.
    for (file, body, sliding_m_per_s) in
        [("man.glb", "mesh", 0.35), ("walk.bvh", "mesh", 0.15), ("walk.bvh", "ellipsoids", 0.15)]
    {
        let text = text
            .replace("height_m = 1.75", &format!("height_m = 1.75\nfile = {file:?}"))
            .replace("body = \"mesh\"", &format!("body = {body:?}"));
        let scene = radome_sim::Scene::parse(&text, &scene_path).expect("a good scene");
        let sliding = match &scene.steps()[0] {
            Steps::Actor(actor) => actor.foot_sliding(1.2),
            Steps::Clip(clip) => clip.foot_sliding(1.2),
            Steps::Gait => unreachable!("a file is named"),
        };
        assert!(sliding.standing_rms_m_per_s < sliding_m_per_s && sliding.standing > 0.5, "{sliding:?}");
        let simulator = common::simulator(&scene, 3, None);
        let (frame, report) = simulator.frame_with_report(40);
        assert!(report.moving_paths > 0 && report.clamped == 0, "{report:?}");
        assert_eq!(frame.truth.expect("truth").occupancy, radome_dsp::Occupancy::One);
        // The strongest cell is at the person's distance.
        let map = common::map_db(&frame, 0);
        let (_, range) = common::peak(&map, frame.shape.samples / 2);
        let found_m = range as f64 * scene.waveform().range_step_m(frame.shape.samples);
        let person = simulator.people(40)[0];
        assert!((found_m - person.range_m).abs() < 0.6, "{found_m} m, expected {} m", person.range_m);
    }
}

#[test]
fn the_cesium_man_walks_on_the_floor_without_sliding() {
    let Some(man) = shared("data/actors/cesium-man/CesiumMan.glb") else { return };
    let actor = parse(&std::fs::read(&man).expect("file"), "CesiumMan.glb").expect("a good file");
    let triangles = actor.skin.rest().triangles.len();
    assert!((8_000..30_000).contains(&triangles) && actor.open_edges == 0, "{triangles} triangles");
    check_walk(&walker(Steps::Actor(Arc::new(actor))), 0.35, 0.04);
}

mod hard_cases {
    use super::*;

    fn assert_refused_with_hint<T>(result: Result<T, FileError>, expected: &[&str]) {
        common::assert_refused(result, &[expected, &["hint: "]].concat());
    }

    /// Changes the glTF file of a person and asserts that it is refused.
    fn assert_gltf_refused(change: &dyn Fn(&mut biped::Gltf), expected: &[&str]) {
        let mut file = biped::gltf(1.0);
        change(&mut file);
        assert_refused_with_hint(parse(&file.bytes(), "a.gltf"), expected);
    }

    /// Changes the COLLADA file of a person and asserts that it is refused.
    fn assert_collada_refused(from: &str, to: &str, expected: &[&str]) {
        let good = biped::collada();
        assert!(good.contains(from), "{from}");
        assert_refused_with_hint(parse(good.replacen(from, to, 1).as_bytes(), "a.dae"), expected);
    }

    #[test]
    fn invalid_gltf_actors_are_refused_with_a_hint() {
        assert_refused_with_hint(parse(b"glTF nonsense", "a.glb"), &["glTF"]);
        assert_refused_with_hint(parse(b"", "a.fbx"), &["\"fbx\"", ".glb"]);
        assert_gltf_refused(
            &|f| drop(f.json["nodes"][7].as_object_mut().expect("node").remove("skin")),
            &["skin", "joints and weights"],
        );
        assert_gltf_refused(&|f| f.buffer[..4].copy_from_slice(&f32::NAN.to_le_bytes()), &["vertex 0", "finite"]);
        assert_gltf_refused(
            &|f| f.json["nodes"][1]["scale"] = serde_json::json!([1.0, 0.0, 1.0]),
            &["thigh_left", "scale", "not zero"],
        );
        assert_gltf_refused(&|f| f.buffer.truncate(500), &["buffer 0", "500 bytes", "cut off"]);
        assert_gltf_refused(
            &|f| f.json["accessors"][0]["count"] = serde_json::json!(90_000),
            &["accessor 0", "reaches to byte"],
        );
        // Joints are bytes after the positions, followed by the weights.
        let vertex_count = biped::vertices().len();
        assert_gltf_refused(&|f| f.buffer[12 * vertex_count] = 77, &["vertex 0", "joint 77", "has 7"]);
        assert_gltf_refused(
            &|f| f.buffer[16 * vertex_count..16 * vertex_count + 4].fill(0),
            &["weights of vertex 0", "sum to 0"],
        );
        assert_gltf_refused(
            &|f| drop(f.json.as_object_mut().expect("file").remove("animations")),
            &["animations", "walk"],
        );
        assert_gltf_refused(&|f| f.json["nodes"][2]["children"] = serde_json::json!([0]), &["their own ancestors"]);
        assert_gltf_refused(&|f| f.json["nodes"][3]["children"] = serde_json::json!([2]), &["two parents"]);
        let inverse_bind_offset = |f: &biped::Gltf| {
            let accessor = f.json["skins"][0]["inverseBindMatrices"].as_u64().expect("accessor") as usize;
            f.json["bufferViews"][accessor]["byteOffset"].as_u64().expect("offset") as usize
        };
        assert_gltf_refused(
            &|f| (inverse_bind_offset(f)..inverse_bind_offset(f) + 64).for_each(|i| f.buffer[i] = 0),
            &["joint 0", "hips", "inverted"],
        );
        // Moves the last bone of seven, an arm, far away: found by fuzzing.
        assert_gltf_refused(
            &|f| {
                let offset = inverse_bind_offset(f) + 6 * 64 + 48;
                f.buffer[offset..offset + 4].copy_from_slice(&7.5e22f32.to_le_bytes());
            },
            &["skin", "where the actor stands"],
        );
        assert_gltf_refused(
            &|f| (inverse_bind_offset(f) + 448..inverse_bind_offset(f) + 452).for_each(|i| f.buffer[i] = 0xff),
            &["key times", "ascend"],
        );
    }

    #[test]
    fn options_that_do_not_fit_an_actor_are_refused_with_a_hint() {
        let bytes = biped::gltf(1000.0).bytes();
        let parse_with = |options: ActorOptions| Actor::parse(&bytes, Path::new("a.gltf"), &options);
        // A file in millimetres is reported, unless a height or the unit is given.
        assert_refused_with_hint(
            parse_with(ActorOptions::default()),
            &["m tall", "0.5 to 2.5 m", "unit = \"mm\"", "height_m"],
        );
        assert!(parse_with(options()).is_ok());
        assert_refused_with_hint(
            parse_with(ActorOptions { animation: Some("run".to_owned()), ..options() }),
            &["\"run\"", "\"walk\""],
        );
        assert_refused_with_hint(
            parse_with(ActorOptions { cycle_s: Some([0.5, 3.0]), ..options() }),
            &["0 to 1 s", "cycle_s"],
        );
        // The feet do not move in half a frame of it, nor when the person lies on the back.
        assert_refused_with_hint(
            parse_with(ActorOptions { cycle_s: Some([0.2, 0.2]), ..options() }),
            &["at least 0.1 s"],
        );
        let mut still = biped::gltf(1.0);
        still.json["animations"][0]["channels"].as_array_mut().expect("channels").truncate(1);
        assert_refused_with_hint(parse(&still.bytes(), "a.gltf"), &["\"walk\"", "expected a walk"]);
        let mut two = biped::gltf(1.0);
        let walk = two.json["animations"][0].clone();
        two.json["animations"].as_array_mut().expect("animations").push(walk);
        assert_refused_with_hint(parse(&two.bytes(), "a.gltf"), &["which of them", "animation = "]);
    }

    #[test]
    fn invalid_collada_actors_are_refused_with_their_line() {
        assert!(parse(biped::collada().as_bytes(), "a.dae").is_ok());
        assert_refused_with_hint(parse(&[0xff, 0xfe], "a.dae"), &["line 1", "UTF-8"]);
        assert_collada_refused("</geometry>", "", &["line ", "no XML"]);
        assert_refused_with_hint(parse(b"<svg/>", "a.dae"), &["line 1", "\"svg\"", "COLLADA"]);
        assert_collada_refused("Z_UP", "X_UP", &["line 4", "X_UP", "Z_UP"]);
        assert_collada_refused("meter=\"0.01\"", "meter=\"0\"", &["line 3", "meter", "positive"]);
        assert_collada_refused("<instance_controller url=\"#skin\"/>", "", &["skin", "joints and weights"]);
        assert_collada_refused("<float_array>-18", "<float_array>NaN", &["line 6", "NaN", "finite"]);
        assert_collada_refused("<Name_array>hips", "<Name_array>pelvis", &["\"pelvis\"", "no node"]);
        assert_collada_refused(
            "</float_array></source>\n<source id=\"weights\">",
            " 1</float_array></source>\n<source id=\"weights\">",
            &["113 numbers", "16 each"],
        );
        assert_collada_refused("<p>0 2 3", "<p>0 2 999", &["triangle 0", "999", "80"]);
        assert_collada_refused("<scale>1 1 1", "<scale>1 0 1", &["hips", "scale", "not zero"]);
        assert_collada_refused("<skin source=\"#mesh\"", "<skin source=\"#mash\"", &["#mash", "nowhere"]);
        assert_collada_refused("thigh_left/turn.ANGLE", "thigh_left/spin.ANGLE", &["spin", "no transform"]);
        assert_collada_refused("<translate sid=\"at\">", "<translate sid=\"at\">1 ", &["4 numbers", "expected 3"]);
        assert_collada_refused("<vcount>1 ", "<vcount>900 ", &["vcount asks for 979 weights", "160 indices"]);
    }

    /// Regression test: unsorted keys were separated from their values, and a stepped curve beside another one became a
    /// ramp.
    #[test]
    fn collada_curves_without_an_exact_representation_are_refused() {
        let times = "<source id=\"hips-in\"><float_array>";
        assert_collada_refused(
            times,
            &times.replace("<float_array>", "<float_array>9"),
            &["line ", "key times do not ascend"],
        );
        let interpolations = |id: &str, interpolations: &str| {
            format!("<source id=\"{id}\"><Name_array>{interpolations}</Name_array></source>")
        };
        let interpolation_input = |id: &str| format!("<input semantic=\"INTERPOLATION\" source=\"#{id}\"/>");
        let sampler = "<sampler id=\"hips-sampler\">";
        let mixed =
            format!("{}{sampler}{}", interpolations("hips-kinds", "LINEAR STEP"), interpolation_input("hips-kinds"));
        assert_collada_refused(sampler, &mixed, &["line ", "STEP for some keys"]);
        let float_source =
            |id: &str, list: &str| format!("<source id=\"{id}\"><float_array>{list}</float_array></source>");
        let curve = format!(
            "<animation>{}{}{}<sampler id=\"s\"><input semantic=\"INPUT\" source=\"#s-in\"/>\
             <input semantic=\"OUTPUT\" source=\"#s-out\"/>{}</sampler>\
             <channel source=\"#s\" target=\"hips/at.X\"/></animation>\n",
            float_source("s-in", "0 1"),
            float_source("s-out", "0 0"),
            interpolations("s-kinds", "STEP STEP"),
            interpolation_input("s-kinds"),
        );
        let animation = "<animation><source id=\"hips-in\">";
        assert_collada_refused(
            animation,
            &format!("{curve}{animation}"),
            &["line ", "hips/turn.ANGLE", "another curve"],
        );
    }

    /// Regression test: offsets and counts were added up, and memory was allocated, before they were checked.
    #[test]
    fn collada_offsets_and_counts_beyond_the_lists_are_refused() {
        let most = "18446744073709551615";
        let corner = "source=\"#corners\" offset=\"0\"";
        let joint = "source=\"#joint-names\" offset=\"0\"";
        let weight = "source=\"#weights\" offset=\"1\"";
        for (input, number) in [(corner, "0"), (joint, "0"), (weight, "1")] {
            for offset in [most, "18446744073709551614", "256", "-1", "nan"] {
                let changed = input.replace(&format!("offset=\"{number}\""), &format!("offset=\"{offset}\""));
                assert_collada_refused(input, &changed, &["line ", offset, "expected 0 to 255"]);
            }
        }
        assert_collada_refused("<vcount>1 ", &format!("<vcount>{most} "), &["vcount asks for too many weights"]);
        assert_collada_refused("<vcount>1 ", "<vcount>9223372036854775807 ", &["vcount asks for 92233720368547758"]);
        assert_collada_refused("<v>0 0 ", &format!("<v>{most} 0 "), &["weights of vertex 0", "joint"]);
        assert_collada_refused("<p>0 2 3", &format!("<p>{most} 2 3"), &["triangle 0", "names vertex"]);
        let deep = format!("{}{}", "<node>".repeat(400), "</node>".repeat(400));
        assert_collada_refused(
            "<node id=\"person\">",
            &format!("{deep}<node id=\"person\">"),
            &["nested more than 256 deep"],
        );
        let wide = "<node/>".repeat(5000);
        assert_collada_refused(
            "<node id=\"person\">",
            &format!("{wide}<node id=\"person\">"),
            &["more than 4096 nodes"],
        );
        let entities = "<!DOCTYPE a [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;&a;&a;\">]>\n<COLLADA";
        assert_collada_refused("<COLLADA", entities, &["no XML"]);
    }

    #[test]
    fn gltf_buffers_outside_the_folder_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let actor_folder = folder.path().join("actor");
        std::fs::create_dir(&actor_folder).expect("made");
        let file = biped::gltf(1.0);
        for path in [folder.path().join("x.bin"), actor_folder.join("own.bin")] {
            std::fs::write(path, &file.buffer).expect("written");
        }
        let path = actor_folder.join("a.gltf");
        let with = |uri: &str| {
            let mut json = file.json.clone();
            json["buffers"][0]["uri"] = serde_json::json!(uri);
            Actor::parse(&serde_json::to_vec(&json).expect("JSON"), &path, &options())
        };
        assert!(with("own.bin").is_ok() && with("./own.bin").is_ok());
        let absolute = actor_folder.join("own.bin").display().to_string();
        for uri in ["/etc/hostname", "/dev/zero", "../x.bin", "../actor/own.bin", absolute.as_str()] {
            assert_refused_with_hint(with(uri), &["buffer 0", "beside the file", "leads out of the folder"]);
        }
        assert_refused_with_hint(with("none.bin"), &["buffer 0", "none.bin", "cannot be read"]);
        assert_refused_with_hint(with("."), &["buffer 0", "not a regular file"]);
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink("../x.bin", actor_folder.join("link.bin")).expect("linked");
            assert_refused_with_hint(with("link.bin"), &["leads out of the folder"]);
            std::os::unix::fs::symlink("/dev/zero", actor_folder.join("zero.bin")).expect("linked");
            assert_refused_with_hint(with("zero.bin"), &["leads out of the folder"]);
        }
    }

    /// The library that reads the format does not check these references and panics: found by fuzzing.
    #[test]
    fn gltf_references_beyond_the_lists_are_refused() {
        for (name, value) in [("path", serde_json::json!("turn")), ("node", serde_json::json!(99))] {
            let change = |f: &mut biped::Gltf| f.json["animations"][0]["channels"][0]["target"][name] = value.clone();
            assert_gltf_refused(&change, &["glTF", "animations[0].channels[0].target"]);
        }
        assert_gltf_refused(
            &|f| f.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = serde_json::json!(99),
            &["glTF primitive 0", "accessor 99", "out of bounds"],
        );
    }

    #[test]
    fn gltf_counts_beyond_the_file_are_refused() {
        let most = serde_json::json!(u64::MAX);
        assert_gltf_refused(&|f| f.json["accessors"][0]["count"] = most.clone(), &["accessor 0", "reaches to byte"]);
        assert_gltf_refused(
            &|f| f.json["accessors"][0]["byteOffset"] = most.clone(),
            &["accessor 0", "reaches to byte"],
        );
        assert_gltf_refused(
            &|f| f.json["bufferViews"][0]["byteOffset"] = most.clone(),
            &["accessor 0", "reaches to byte"],
        );
        assert_gltf_refused(
            &|f| f.json["bufferViews"][0]["byteLength"] = serde_json::json!(0),
            &["accessor 0", "reaches to byte"],
        );
        assert_gltf_refused(&|f| f.json["bufferViews"][0]["byteStride"] = most.clone(), &["glTF"]);
        assert_gltf_refused(&|f| f.json["buffers"][0]["byteLength"] = most.clone(), &["buffer 0", "cut off"]);
        assert_gltf_refused(
            &|f| f.json["meshes"][0]["primitives"][0]["indices"] = serde_json::json!(99),
            &["glTF", "out of bounds"],
        );
        // A joint index that is not an index: the largest float.
        assert_gltf_refused(
            &|f| {
                let joints = f.json["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"].clone();
                f.json["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"] = joints;
                let weights = f.json["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"].as_u64().expect("index");
                let view = f.json["accessors"][weights as usize]["bufferView"].as_u64().expect("index");
                let at = f.json["bufferViews"][view as usize]["byteOffset"].as_u64().expect("offset") as usize;
                f.buffer[at..at + 4].copy_from_slice(&1e30f32.to_le_bytes());
            },
            &["weights of vertex 0", "joint"],
        );
        // The same numbers are referenced many times.
        assert_gltf_refused(
            &|f| {
                let primitive = f.json["meshes"][0]["primitives"][0].clone();
                f.json["meshes"][0]["primitives"] = serde_json::json!(vec![primitive; 40_000]);
            },
            &["primitive", "450000 vertices at most"],
        );
        assert_gltf_refused(
            &|f| f.json["nodes"] = serde_json::json!(vec![serde_json::json!({}); 200_001]),
            &["objects, expected 200000 at most"],
        );
        // Lengths in the header of a binary file.
        for stated in [0u32, 11, u32::MAX] {
            let header =
                [b"glTF\x02\0\0\0".as_slice(), &stated.to_le_bytes(), &u32::MAX.to_le_bytes(), b"JSON"].concat();
            assert_refused_with_hint(parse(&header, "a.glb"), &["glTF"]);
        }
    }

    #[test]
    fn truncated_files_do_not_panic() {
        let (gltf, collada, bvh) = (biped::gltf(1.0).bytes(), biped::collada().into_bytes(), biped::bvh());
        for end in 0..gltf.len() {
            assert!(parse(&gltf[..end], "a.gltf").is_err(), "{end}");
        }
        for end in (0..collada.len()).step_by(7) {
            let _ = parse(&collada[..end], "a.dae");
        }
        for end in (0..bvh.len()).step_by(61) {
            let _ = BodyClip::parse(&bvh[..end], UpAxis::Y, None);
        }
    }

    #[test]
    fn bvh_frames_without_channels_and_endless_clips_are_refused() {
        let assert_bvh_refused =
            |text: &str, expected: &[&str]| assert_refused_with_hint(BodyClip::parse(text, UpAxis::Y, None), expected);
        let head = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 0\nEnd Site\n{\nOFFSET 0 0 0\n}\n}\nMOTION\n";
        assert_bvh_refused(&format!("{head}Frames: 18446744073709551615\nFrame Time: 0.01\n"), &["without channels"]);
        let good = biped::bvh();
        let many = good.replacen("Frames: 90", "Frames: 18446744073709551615", 1);
        assert_bvh_refused(&many, &["at most 100000000 numbers"]);
        // Seventy thousand frames of fifteen joints.
        let (head, _) = good.split_once("MOTION").expect("written");
        let frame = vec!["0"; 42].join(" ");
        let frames = format!("{frame}\n").repeat(70_000);
        let endless = format!("{head}MOTION\nFrames: 70000\nFrame Time: 0.0333333\n{frames}");
        assert_bvh_refused(&endless, &["places at most"]);
        let nested = format!("HIERARCHY\nROOT a\n{}", "{ OFFSET 0 0 0 CHANNELS 0 JOINT a ".repeat(10_000));
        assert_bvh_refused(&nested, &["at most 4096 joints"]);
        let span = BodyClip::parse(&good, UpAxis::Y, Some([f64::INFINITY, 1.0]));
        assert!(span.is_err());
    }

    #[test]
    fn invalid_bvh_clips_are_refused_with_their_line() {
        let good = biped::bvh();
        let assert_bvh_refused =
            |text: &str, expected: &[&str]| assert_refused_with_hint(BodyClip::parse(text, UpAxis::Y, None), expected);
        let assert_change_refused = |from: &str, to: &str, expected: &[&str]| {
            assert!(good.contains(from), "{from}");
            assert_bvh_refused(&good.replacen(from, to, 1), expected);
        };
        assert_bvh_refused("", &["line 1", "the file ends", "HIERARCHY"]);
        assert_change_refused("HIERARCHY", "HIERARCHIE", &["line 1", "HIERARCHIE"]);
        assert_change_refused("CHANNELS 6 Xposition", "CHANNELS 6 Wposition", &["line 5", "Wposition", "Yrotation"]);
        assert_change_refused("CHANNELS 6", "CHANNELS 7", &["line 5", "\"7\"", "at most 6"]);
        assert_change_refused("OFFSET 0 0 0", "OFFSET 0 nan 0", &["line 4", "nan", "finite"]);
        assert_change_refused("Frame Time: 0.0333333", "Frame Time: 0", &["\"0\"", "0.0001 to 1 s"]);
        assert_change_refused("Frames: 90", "Frames: 91", &["the file ends", "frame 90 of 91"]);
        assert_change_refused("Frames: 90", "Frames: 89", &["the end of the file", "89 frames"]);
        assert_change_refused("JOINT LeftLeg", "JOINT Kneeish", &["left shank", "leg", "Kneeish"]);
        assert_change_refused("MOTION", "}\nMOTION", &["found \"}\"", "MOTION"]);
        let (head, motion) = good.split_once("Frame Time: 0.0333333\n").expect("written");
        let short = motion.replacen(' ', "\n", 1);
        assert_bvh_refused(&format!("{head}Frame Time: 0.0333333\n{short}"), &["frame 0", "too few"]);
        let flat: String = head
            .lines()
            .map(|l| if l.trim_start().starts_with("OFFSET") { "OFFSET 0 0 0\n".to_owned() } else { format!("{l}\n") })
            .collect();
        assert_bvh_refused(&format!("{flat}Frame Time: 0.0333333\n{motion}"), &["legs are 0 long", "OFFSET"]);
        let first = motion.lines().next().expect("a frame");
        let still = vec![first; 90].join("\n");
        assert_bvh_refused(&format!("{head}Frame Time: 0.0333333\n{still}\n"), &["MOTION", "cycle_s"]);
    }

    proptest::proptest! {
        #![proptest_config(proptest::prelude::ProptestConfig { cases: 200, ..Default::default() })]

        /// A damaged clip is either refused or complete: every frame has a number for every channel.
        #[test]
        fn damaged_bvh_clips_are_refused_or_complete(
            damages in proptest::collection::vec((0usize..4000, 0u8..128), 1..6),
            end in 0usize..60_000,
        ) {
            let mut bytes = biped::bvh().into_bytes();
            for (at, byte) in damages {
                if let Some(damaged) = bytes.get_mut(at) {
                    *damaged = byte;
                }
            }
            bytes.truncate(end);
            let text = String::from_utf8_lossy(&bytes);
            if let Ok(bvh) = radome_sim::people::bvh::parse_bvh(&text) {
                let channel_count: usize = bvh.joints.iter().map(|j| j.channels.len()).sum();
                proptest::prop_assert!(bvh.frames.iter().all(|f| f.len() == channel_count && f.iter().all(|n| n.is_finite())));
                let parents_first = bvh.joints.iter().enumerate().all(|(i, j)| j.parent.is_none_or(|p| p < i));
                proptest::prop_assert!(parents_first && bvh.frame_time_s > 0.0);
            }
            // Further use of the clip does not panic either.
            let _ = BodyClip::parse(&text, UpAxis::Y, None);
        }
    }

    #[test]
    fn damaged_gltf_and_collada_files_do_not_panic() {
        let (gltf, collada) = (biped::gltf(1.0).bytes(), biped::collada().into_bytes());
        let mut rng = generator(7, Purpose::Build, [0, 0]);
        let mut draw = |below: usize| rng.random_range(0..below);
        for (good, name) in [(&gltf, "a.gltf"), (&collada, "a.dae")] {
            for _ in 0..60 {
                let mut bytes = good.clone();
                for _ in 0..1 + draw(4) {
                    let at = draw(bytes.len());
                    bytes[at] = draw(128) as u8;
                }
                if draw(4) == 0 {
                    bytes.truncate(draw(bytes.len()));
                }
                let _ = parse(&bytes, name);
            }
        }
    }
}
