//! Checks of a scene file beyond its types.

use std::path::Path;

use super::{SceneError, line_of_value};
use crate::material::{Material, OPEN, OwnMaterial};
use crate::people::postures::DEEPEST_SQUAT;
use crate::scene_file::{
    ActorFile, BodyFile, DeskFile, DoorFile, FurnitureFile, RadarFile, RoomFile, SCENE_FORMAT, SceneFile, SolverFile,
    StepFile, SurfaceFile, SwayFile, VibrationFile, VisitsFile, WanderFile, door_width,
};

/// Upper limit of tables of one kind (furniture, seats, beds, doors). Each takes memory for every image of the
/// antennas.
const MOST_TABLES: f64 = 1000.0;
/// Upper limit of people with scripts or visits. Labels end at two, which stands for two or more.
const MOST_PEOPLE: f64 = 8.0;
/// Upper limit of steps in one person's script.
const MOST_STEPS: f64 = 10_000.0;
/// Unit of a spread of frequencies.
const BANDWIDTH_UNIT: &str = "(standard deviation of the frequencies' logarithm)";

/// A value that is not allowed.
pub(super) struct InvalidValue {
    key: &'static str,
    value: String,
    expected: String,
}

impl InvalidValue {
    /// Adds the name of the part of the scene whose value it is.
    pub(super) fn in_part(self, part: &str) -> Self {
        InvalidValue { expected: format!("{} ({part})", self.expected), ..self }
    }

    /// Makes the error of a scene file with a path and a text.
    pub(super) fn into_scene_error(self, path: &Path, text: &str) -> SceneError {
        SceneError::Value {
            path: path.to_owned(),
            line: line_of_value(text, self.key, &self.value),
            key: self.key.to_owned(),
            value: self.value,
            expected: self.expected,
        }
    }
}

/// Returns the error of a value that is not allowed.
pub(super) fn invalid<T>(
    key: &'static str,
    value: impl std::fmt::Debug,
    expected: impl Into<String>,
) -> Result<T, InvalidValue> {
    Err(InvalidValue { key, value: format!("{value:?}"), expected: expected.into() })
}

/// Refuses a value outside an interval.
pub(super) fn check_range(key: &'static str, value: f64, min: f64, max: f64, unit: &str) -> Result<(), InvalidValue> {
    if value >= min && value <= max {
        return Ok(());
    }
    // Numbers of tables and of people are whole.
    let text = format!("{value:?}");
    invalid(key, format_args!("{}", text.strip_suffix(".0").unwrap_or(&text)), format!("{min} to {max} {unit}"))
}

/// Refuses an interval that is reversed or not within bounds.
fn check_interval(
    key: &'static str,
    [low, high]: [f64; 2],
    min: f64,
    max: f64,
    unit: &str,
) -> Result<(), InvalidValue> {
    if low >= min && high <= max && low <= high {
        return Ok(());
    }
    invalid(key, [low, high], format!("[least, largest] within {min} to {max} {unit}"))
}

/// Refuses probabilities outside 0 to 1.
fn check_probabilities<const N: usize>(all: [(&'static str, f64); N]) -> Result<(), InvalidValue> {
    all.into_iter().try_for_each(|(key, probability)| check_range(key, probability, 0.0, 1.0, "(probability)"))
}

/// Refuses a place outside a room of the given size.
fn check_in_room(key: &'static str, place: &[f64], size: [f64; 3]) -> Result<(), InvalidValue> {
    if place.iter().zip(size).all(|(&p, s)| p >= 0.0 && p <= s) {
        return Ok(());
    }
    invalid(key, place, format!("a place in the room {size:?}"))
}

/// Refuses an index beyond the tables that exist.
fn check_index(key: &'static str, number: Option<usize>, table: &str, count: usize) -> Result<(), InvalidValue> {
    match number {
        Some(number) if number >= count => {
            invalid(key, number, format!("an index below the number of [[{table}]] tables, {count}"))
        }
        _ => Ok(()),
    }
}

/// The room's six surfaces, each with its key.
pub(super) fn room_surfaces(room: &RoomFile) -> [(&'static str, &SurfaceFile); 6] {
    [
        ("x_low", &room.x_low),
        ("x_high", &room.x_high),
        ("y_low", &room.y_low),
        ("y_high", &room.y_high),
        ("floor", &room.floor),
        ("ceiling", &room.ceiling),
    ]
}

/// Refuses a radar within a piece of furniture whose faces hide everything else, before the room's meshes are read. Scenes
/// with `transmission` are not checked: there a box may be the radar's cover.
pub(super) fn check_radar_outside_furniture(file: &SceneFile) -> Result<(), InvalidValue> {
    let room = &file.room;
    let uses_rays = room.solver.map_or(room.plan.is_some() || !room.mesh.is_empty(), |s| s == SolverFile::Rays);
    if !uses_rays || room.transmission {
        return Ok(());
    }
    let contains_radar = |furniture: &&FurnitureFile| {
        let is_solid = furniture.material.as_deref().is_some_and(|material| material != OPEN);
        let is_within = |i: usize| {
            let offset_m = file.radar.position_m[i] - furniture.position_m[i];
            offset_m > 0.0 && offset_m < furniture.size_m[i]
        };
        is_solid && (0..3).all(is_within)
    };
    file.furniture.iter().find(contains_radar).map_or(Ok(()), |furniture| {
        invalid("position_m", file.radar.position_m, format!("a place outside the furniture {:?}", furniture.name))
    })
}

/// Checks the scene's own materials and the materials of the room, before its meshes are read.
pub(super) fn check_materials(file: &SceneFile) -> Result<(), InvalidValue> {
    file.materials.iter().try_for_each(|(name, own)| check_own_material(name, own))?;
    for furniture in &file.furniture {
        check_range("thickness_m", furniture.thickness_m, 0.0, 10.0, "m")?;
        furniture.material.iter().try_for_each(|name| check_material(file, "material", name))?;
    }
    let room = &file.room;
    if room.plan.is_some() && !room.mesh.is_empty() {
        return invalid("plan", "given", "either [room.plan] or [[room.mesh]]");
    }
    room_surfaces(room).into_iter().try_for_each(|(key, surface)| check_surface(file, key, &surface.material))?;
    if !room.mesh.is_empty() && room.size_m != [0.0; 3] {
        return invalid("size_m", room.size_m, "none beside [[room.mesh]]: the size comes from the meshes");
    }
    for mesh in &room.mesh {
        check_range("thickness_m", mesh.thickness_m, 0.0, 10.0, "m")?;
        for name in mesh.material.iter().chain(mesh.materials.values()) {
            check_material(file, "material", name)?;
        }
    }
    Ok(())
}

fn check_own_material(name: &str, own: &OwnMaterial) -> Result<(), InvalidValue> {
    if Material::named(name).is_some() {
        return invalid("materials", name, "another name: this one is the table's");
    }
    if own.permittivity.is_some() == own.p2040.is_some() {
        return invalid("materials", name, "either permittivity = [real, loss] or p2040 = [a, b, c, d]");
    }
    if let Some([real, loss]) = own.permittivity {
        check_range("permittivity", real, 1.0, 1000.0, "(real part)")?;
        check_range("permittivity", loss, 0.0, 1e6, "(loss: the imaginary part, counted positive)")?;
    }
    if let Some([a, b, c, d]) = own.p2040 {
        check_range("p2040", a, 1.0, 1000.0, "(a)")?;
        check_range("p2040", b, -5.0, 5.0, "(b)")?;
        check_range("p2040", c, 0.0, 1e6, "(c)")?;
        check_range("p2040", d, -5.0, 5.0, "(d)")?;
    }
    check_interval("band_ghz", own.band_ghz.unwrap_or([1.0, 100.0]), 0.0, 1e4, "GHz")
}

/// Checks the material of one of the six surfaces. A box must state it; a plan or meshes must leave it out for their
/// walls.
fn check_surface(file: &SceneFile, key: &'static str, material: &str) -> Result<(), InvalidValue> {
    let room = &file.room;
    let is_of_plan = room.plan.is_some() && !["floor", "ceiling"].contains(&key);
    match (room.mesh.is_empty() && !is_of_plan, material) {
        (true, "") => {
            let expected = "{ material = \"...\", thickness_m = ... }, or [room.plan] or [[room.mesh]] for the walls";
            invalid(key, "missing", expected)
        }
        (true, material) => check_material(file, key, material),
        (false, "") => Ok(()),
        (false, _) if is_of_plan => invalid(key, material, "none beside [room.plan]: upright walls come from the plan"),
        // The meshes lack this surface.
        (false, OPEN) => Ok(()),
        (false, _) => invalid(key, material, "none beside [[room.mesh]]: walls come from the meshes, or are \"open\""),
    }
}

pub(super) fn check_material(file: &SceneFile, key: &'static str, name: &str) -> Result<(), InvalidValue> {
    if Material::named(name).is_some() || file.materials.contains_key(name) {
        return Ok(());
    }
    let own: Vec<&String> = file.materials.keys().collect();
    let table = Material::NAMES.join(", ");
    invalid(key, name, format!("one of {table}, or of the scene's own [materials.NAME], which are {own:?}"))
}

/// Checks a whole scene after the room's size is known.
pub(super) fn check(file: &SceneFile) -> Result<(), InvalidValue> {
    if file.format != SCENE_FORMAT {
        return invalid("format", file.format, "1, the only version that this program reads");
    }
    let size = file.room.size_m;
    check_room(&file.room)?;
    check_position(&file.radar, size)?;
    let tables = [
        ("furniture", file.furniture.len()),
        ("sway", file.room.sway.len()),
        ("seat", file.seat.len()),
        ("bed", file.bed.len()),
        ("door", file.door.len()),
    ];
    tables.into_iter().try_for_each(|(key, count)| check_range(key, count as f64, 0.0, MOST_TABLES, "tables"))?;
    check_mounting(&file.radar)?;
    file.room.sway.iter().try_for_each(|sway| check_sway(sway, size))?;
    file.furniture.iter().try_for_each(|furniture| check_furniture(furniture, size))?;
    for seat in &file.seat {
        check_resting_place("seat", &seat.position_m, seat.heading_deg, seat.height_m, size)?;
        check_range("back_m", seat.back_m, 0.0, 0.45, "m (no more than thighs are long)")?;
    }
    for bed in &file.bed {
        check_resting_place("bed", &bed.position_m, bed.heading_deg, bed.height_m, size)?;
        check_range("edge_m", bed.edge_m.abs(), 0.2, 2.0, "m, to the left of the heading or, negative, to the right")?;
    }
    file.door.iter().try_for_each(|door| check_door(door, size))?;
    check_people(file)
}

fn check_room(room: &RoomFile) -> Result<(), InvalidValue> {
    if !room.size_m.iter().all(|s| (0.5..=100.0).contains(s)) {
        return invalid("size_m", room.size_m, "three lengths from 0.5 to 100 m");
    }
    if room.plan.is_some() && room.solver == Some(SolverFile::Images) {
        return invalid("solver", "images", "\"rays\", or none, beside [room.plan]");
    }
    check_range("max_reflections", f64::from(room.max_reflections), 0.0, 6.0, "reflections")?;
    check_range("max_body_reflections", f64::from(room.max_body_reflections), 0.0, 3.0, "reflections")?;
    check_range("diffuse_share", room.diffuse_share, 0.0, 0.5, "of the power")?;
    check_range("diffuse_points", f64::from(room.diffuse_points), 1.0, 1024.0, "points")?;
    check_range("diffuse_bounces", f64::from(room.diffuse_bounces), 1.0, 16.0, "walls")?;
    let mut thicknesses_m = room_surfaces(room).into_iter().map(|(_, surface)| surface.thickness_m);
    thicknesses_m.try_for_each(|thickness_m| check_range("thickness_m", thickness_m, 0.0, 10.0, "m"))
}

/// Refuses a radar in a wall of the box around the room, or outside it.
fn check_position(radar: &RadarFile, size: [f64; 3]) -> Result<(), InvalidValue> {
    if radar.position_m.iter().zip(size).all(|(&p, s)| p >= 0.01 && p <= s - 0.01) {
        return Ok(());
    }
    invalid("position_m", radar.position_m, format!("a place in the room, 1 cm or more from its walls {size:?}"))
}

/// Checks the radar's orientation and its vibration.
fn check_mounting(radar: &RadarFile) -> Result<(), InvalidValue> {
    check_range("azimuth_deg", radar.azimuth_deg, -360.0, 360.0, "degrees")?;
    check_range("tilt_down_deg", radar.tilt_down_deg, -90.0, 90.0, "degrees")?;
    if let Some(VibrationFile { amplitude_m, frequency_hz, bandwidth }) = radar.vibration {
        check_range("amplitude_m", amplitude_m, 0.0, 0.01, "m")?;
        check_range("frequency_hz", frequency_hz, 0.01, 200.0, "Hz")?;
        check_range("bandwidth", bandwidth, 0.0, 1.0, BANDWIDTH_UNIT)?;
    }
    Ok(())
}

fn check_sway(sway: &SwayFile, size: [f64; 3]) -> Result<(), InvalidValue> {
    check_range("reflectors", sway.reflectors as f64, 0.0, 64.0, "reflectors")?;
    check_range("probability", sway.probability, 0.0, 1.0, "(probability)")?;
    check_range("cross_section_dbsm", sway.cross_section_dbsm, -200.0, 20.0, "dBsm")?;
    check_range("spread_db", sway.spread_db, 0.0, 60.0, "dB")?;
    check_interval("amplitude_m", sway.amplitude_m, 1e-7, 0.5, "m")?;
    check_interval("frequency_hz", sway.frequency_hz, 0.01, 200.0, "Hz")?;
    check_range("bandwidth", sway.bandwidth, 0.0, 1.0, BANDWIDTH_UNIT)?;
    sway.position_m.iter().try_for_each(|position_m| check_in_room("position_m", position_m, size))
}

fn check_furniture(furniture: &FurnitureFile, size: [f64; 3]) -> Result<(), InvalidValue> {
    let FurnitureFile { name, position_m, size_m, .. } = furniture;
    let fits = (0..3).all(|i| position_m[i] >= 0.0 && size_m[i] >= 0.0 && position_m[i] + size_m[i] <= size[i] + 1e-9);
    if !fits {
        return invalid("furniture", (name, position_m, size_m), format!("a box within the room {size:?}"));
    }
    check_range("cross_section_dbsm", furniture.cross_section_dbsm(), -100.0, 60.0, "dBsm")?;
    check_range("points", furniture.points as f64, 1.0, 64.0, "points")
}

/// Checks position, heading and height of a seat or a bed.
fn check_resting_place(
    key: &'static str,
    position_m: &[f64],
    heading_deg: f64,
    height_m: f64,
    size: [f64; 3],
) -> Result<(), InvalidValue> {
    check_in_room(key, position_m, size)?;
    check_range("heading_deg", heading_deg, -360.0, 360.0, "degrees")?;
    check_range("height_m", height_m, 0.2, 1.0, "m")
}

fn check_door(door: &DoorFile, [width_m, depth_m, _]: [f64; 3]) -> Result<(), InvalidValue> {
    let [x, y] = door.position_m;
    let on_x = (x.abs() < 1e-6 || (x - width_m).abs() < 1e-6) && y > 0.0 && y < depth_m;
    let on_y = (y.abs() < 1e-6 || (y - depth_m).abs() < 1e-6) && x > 0.0 && x < width_m;
    if on_x == on_y {
        let expected = format!("a place on one upright wall: x is 0 or {width_m}, or y is 0 or {depth_m}");
        return invalid("door", door.position_m, expected);
    }
    check_range("width_m", door.width_m, 0.4, 10.0, "m")?;
    let (middle_m, length_m) = if on_x { (y, depth_m) } else { (x, width_m) };
    let most_m = 2.0 * middle_m.min(length_m - middle_m);
    if door.width_m > most_m + 1e-9 {
        // The width may not be written at all.
        if door.width_m == door_width() {
            let expected =
                format!("{:.2} m or more off the wall's ends: width_m is {}", 0.5 * door.width_m, door.width_m);
            return invalid("position_m", door.position_m, expected);
        }
        return invalid("width_m", door.width_m, format!("at most {most_m:.2} m: there its wall ends"));
    }
    Ok(())
}

/// Checks options that exclude an actor's file, and options that need one.
fn check_actor_file(body: BodyFile, actor: &ActorFile) -> Result<(), InvalidValue> {
    let Some(file) = &actor.file else {
        let given = [
            ("animation", actor.animation.is_some()),
            ("cycle_s", actor.cycle_s.is_some()),
            ("unit", actor.unit.is_some()),
            ("up", actor.up.is_some()),
        ];
        return match given.iter().find(|(_, given)| *given) {
            Some((key, _)) => invalid(key, "given", "none without the actor's file"),
            None => Ok(()),
        };
    };
    if file.to_lowercase().ends_with(".bvh") {
        return match (&actor.animation, actor.unit) {
            (Some(name), _) => invalid("animation", name, "none for a BVH file, which holds one clip"),
            (_, Some(unit)) => invalid("unit", unit, "none for a BVH file: only its angles and proportions count"),
            _ => Ok(()),
        };
    }
    if body != BodyFile::Mesh {
        let expected = "body = \"mesh\" in [people] with it: an actor from a file has a skin and no ellipsoids";
        return invalid("file", file, expected);
    }
    for step in &actor.step {
        let given = [("sit_s", step.sit_s), ("squat_s", step.squat_s), ("lie_s", step.lie_s)];
        if let Some((key, _)) = given.iter().find(|(_, duration)| duration.is_some()) {
            return invalid(key, "given", "walk_to_m, stand_s and face_deg: an actor from a file cannot go down");
        }
    }
    Ok(())
}

fn check_people(file: &SceneFile) -> Result<(), InvalidValue> {
    let people = &file.people;
    let scenarios = [!people.actor.is_empty(), people.visits.is_some(), people.wander.is_some(), people.desk.is_some()];
    let scenario_count = scenarios.into_iter().filter(|&is_given| is_given).count();
    if scenario_count != 1 {
        let expected = "exactly one of [[people.actor]], [people.visits], [people.wander], [people.desk]";
        let hint = "\n\nhint: a scene has people, and --people 0 leaves them out";
        return invalid("people", scenario_count, format!("{expected}{}", if scenario_count == 0 { hint } else { "" }));
    }
    check_range("turn_rate_deg_per_s", people.turn_rate_deg_per_s.unwrap_or(120.0), 10.0, 720.0, "degrees/s")?;
    check_range("keep_off_m", people.keep_off_m.unwrap_or(0.3), 0.0, 2.0, "m")?;
    check_interval("stride", people.stride, 0.5, 1.5, "of the average")?;
    check_interval("arm_swing", people.arm_swing, 0.0, 3.0, "of the average")?;
    check_range("actor", people.actor.len() as f64, 0.0, MOST_PEOPLE, "people")?;
    people.actor.iter().try_for_each(|actor| check_actor(file, actor))?;
    people.visits.iter().try_for_each(|visits| check_visits(file, visits))?;
    people.wander.iter().try_for_each(check_wander)?;
    if people.desk.is_some() && people.body == BodyFile::Mesh {
        return invalid(
            "body",
            "mesh",
            "\"ellipsoids\" for people at a desk: what is fitted to them there has no skin",
        );
    }
    people.desk.iter().try_for_each(check_desk)
}

/// Checks the script of one person.
fn check_actor(file: &SceneFile, actor: &ActorFile) -> Result<(), InvalidValue> {
    let height_m = actor.height_m.unwrap_or(1.75);
    check_range("height_m", height_m, 0.5, 2.5, "m")?;
    check_actor_file(file.people.body, actor)?;
    check_range("start_s", actor.start_s, -1e6, 1e9, "s")?;
    check_range("step", actor.step.len() as f64, 0.0, MOST_STEPS, "steps")?;
    let is_place = |s: &StepFile| s.walk_to_m.is_some() || s.enter_door.is_some() || s.lie_s.is_some();
    if !actor.step.first().is_some_and(is_place) {
        let expected = "a first step with walk_to_m, enter_door or lie_s: where the person begins";
        return invalid("step", actor.step.len(), expected);
    }
    check_range("stride", actor.stride.unwrap_or(1.0), 0.5, 1.5, "of the average")?;
    check_range("arm_swing", actor.arm_swing.unwrap_or(1.0), 0.0, 3.0, "of the average")?;
    for (number, step) in actor.step.iter().enumerate() {
        check_step(step, height_m)?;
        check_index("enter_door", step.enter_door, "door", file.door.len())?;
        check_index("leave_door", step.leave_door, "door", file.door.len())?;
        if let Some(door) = step.enter_door.filter(|_| number > 0) {
            return invalid("enter_door", door, "it in the first step only");
        }
        if let Some(door) = step.leave_door.filter(|_| number + 1 < actor.step.len()) {
            return invalid("leave_door", door, "it in the last step only");
        }
        check_index("bed", step.lie_s.and(step.bed.or(Some(0))), "bed", file.bed.len())?;
        check_index("seat", step.seat, "seat", file.seat.len())?;
    }
    Ok(())
}

/// Checks one step of a script for a person of the given height, except the tables that the step names.
fn check_step(step: &StepFile, height_m: f64) -> Result<(), InvalidValue> {
    let actions = [
        ("walk_to_m", step.walk_to_m.is_some()),
        ("stand_s", step.stand_s.is_some()),
        ("sit_s", step.sit_s.is_some()),
        ("squat_s", step.squat_s.is_some()),
        ("lie_s", step.lie_s.is_some()),
        ("face_deg", step.face_deg.is_some()),
        ("enter_door", step.enter_door.is_some()),
        ("leave_door", step.leave_door.is_some()),
    ];
    let given: Vec<&str> = actions.iter().filter(|(_, is_given)| *is_given).map(|(key, _)| *key).collect();
    let &[action] = given.as_slice() else {
        let found = if given.is_empty() { "without any of them".to_owned() } else { given.join(" and ") };
        let expected = format!("one of {} in each step", actions.map(|(key, _)| key).join(", "));
        return invalid("step", format_args!("{found}"), expected);
    };
    for xy in step.walk_to_m.iter().flatten() {
        check_range("walk_to_m", *xy, -1000.0, 1000.0, "m")?;
    }
    check_range("speed_m_per_s", step.speed_m_per_s.unwrap_or(1.0), 0.05, 5.0, "m/s")?;
    let durations_s =
        [("stand_s", step.stand_s), ("sit_s", step.sit_s), ("squat_s", step.squat_s), ("lie_s", step.lie_s)];
    for (key, duration_s) in durations_s {
        check_range(key, duration_s.unwrap_or(0.0), 0.0, 1e7, "s")?;
    }
    check_range("face_deg", step.face_deg.unwrap_or(0.0), -360.0, 360.0, "degrees")?;
    let deepest_m = DEEPEST_SQUAT * height_m;
    check_range("depth_m", step.depth_m.unwrap_or(0.1), 0.0, deepest_m, "m (0.36 of the body's height)")?;
    let walks = matches!(action, "walk_to_m" | "lie_s" | "enter_door" | "leave_door") || step.seat.is_some();
    // Key, whether it is given, whether the action uses it, and what it belongs to.
    let options = [
        ("depth_m", step.depth_m.is_some(), action == "squat_s", "squat_s"),
        ("bed", step.bed.is_some(), action == "lie_s", "lie_s"),
        ("seat", step.seat.is_some(), action == "sit_s", "sit_s"),
        ("speed_m_per_s", step.speed_m_per_s.is_some(), walks, "a walk, as of walk_to_m"),
    ];
    match options.into_iter().find(|&(_, is_given, is_used, _)| is_given && !is_used) {
        Some((key, _, _, owner)) => invalid(key, "given", format!("none without {owner}")),
        None => Ok(()),
    }
}

fn check_visits(file: &SceneFile, visits: &VisitsFile) -> Result<(), InvalidValue> {
    if file.door.is_empty() {
        return invalid("visits", "without a door", "at least one [[door]] to come in by");
    }
    check_range("max_people", visits.max_people as f64, 0.0, MOST_PEOPLE, "people")?;
    check_interval("first_absence_s", visits.first_absence_s, 0.0, 1e6, "s")?;
    check_interval("absence_s", visits.absence_s, 0.1, 1e6, "s")?;
    check_interval("speed_m_per_s", visits.speed_m_per_s, 0.05, 5.0, "m/s")?;
    check_interval("height_m", visits.height_m, 0.5, 2.5, "m")?;
    check_interval("lateral_m", visits.lateral_m, 0.0, 100.0, "m")?;
    check_interval("pause_s", visits.pause_s, 0.0, 1e6, "s")?;
    check_interval("sit_s", visits.sit_s, 0.0, 1e6, "s")?;
    check_interval("pace_legs", visits.pace_legs, 0.0, 1000.0, "legs")?;
    check_probabilities([
        ("turn_probability", visits.turn_probability),
        ("pause_probability", visits.pause_probability),
        ("sit_probability", visits.sit_probability),
        ("pace_probability", visits.pace_probability),
        ("passer_by_probability", visits.passer_by_probability),
    ])?;
    let size = file.room.size_m;
    let half_m = 0.5 * size[0].min(size[1]);
    if let Some(margin_m) = visits.pace_margin_m.filter(|margin_m| !(0.0..half_m).contains(margin_m)) {
        return invalid(
            "pace_margin_m",
            margin_m,
            format!("0 to less than {half_m} m, half of the room's shorter side"),
        );
    }
    check_range("pace_off_boresight_deg", visits.pace_off_boresight_deg.unwrap_or(180.0), 1.0, 180.0, "degrees")?;
    check_interval("passer_by_level_db", visits.passer_by_level_db, -60.0, 20.0, "dB")?;
    check_interval("pace_range_m", visits.pace_range_m.unwrap_or([0.0, 1.0]), 0.0, 100.0, "m")?;
    match visits.pace_area_m {
        Some([low, high]) if !(0..2).all(|i| low[i] >= 0.0 && low[i] <= high[i] && high[i] <= size[i]) => {
            let expected = format!("[[x_low, y_low], [x_high, y_high]] in the room {size:?}");
            invalid("pace_area_m", [low, high], expected)
        }
        _ => Ok(()),
    }
}

fn check_desk(desk: &DeskFile) -> Result<(), InvalidValue> {
    check_range("max_people", desk.max_people as f64, 0.0, 2.0, "people (a desk has places for two)")?;
    check_interval("distance_m", desk.distance_m, 0.05, 20.0, "m")?;
    check_range("off_boresight_deg", desk.off_boresight_deg, 0.0, 80.0, "degrees")?;
    let distance_span_m = desk.distance_m[1] - desk.distance_m[0];
    check_range("min_separation_m", desk.min_separation_m, 0.0, distance_span_m, "m (the stretch of distance_m)")?;
    check_range(
        "max_separation_m",
        desk.max_separation_m,
        desk.min_separation_m,
        100.0,
        "m (not below min_separation_m)",
    )?;
    check_range("reflectivity_scatter_db", desk.reflectivity_scatter_db, 0.0, 60.0, "dB")?;
    check_interval("reflectivity_db", desk.reflectivity_db, -60.0, 60.0, "dB")?;
    check_interval("double_bounce_db", desk.double_bounce_db.unwrap_or_default(), -200.0, 0.0, "dB")?;
    check_interval("double_bounce_offset_m", desk.double_bounce_offset_m, -0.2, 1.0, "m")?;
    check_range("body_points", desk.body_points as f64, 0.0, 32.0, "points")?;
    check_interval("body_point_dbsm", desk.body_point_dbsm, -100.0, 20.0, "dBsm")?;
    check_interval("body_point_decay_db_per_m", desk.body_point_decay_db_per_m, 0.0, 1000.0, "dB/m")?;
    check_interval("body_point_detour_m", desk.body_point_detour_m, 0.0, 5.0, "m")?;
    check_interval("noise_db", desk.noise_db, -60.0, 60.0, "dB")?;
    check_interval("leakage_jitter_factor", desk.leakage_jitter_factor, 1e-3, 1e3, "(factor)")?;
    check_probabilities([
        ("fidget_probability", desk.fidget_probability),
        ("objects_probability", desk.objects_probability),
    ])?;
    check_interval("height_m", desk.height_m, 0.5, 2.5, "m")
}

fn check_wander(wander: &WanderFile) -> Result<(), InvalidValue> {
    check_range("max_people", wander.max_people as f64, 0.0, 2.0, "people (the classes end at two)")?;
    check_probabilities([
        ("pause_probability", wander.pause_probability),
        ("stand_probability", wander.stand_probability),
        ("pace_probability", wander.pace_probability),
        ("sit_probability", wander.sit_probability),
        ("gesture_probability", wander.gesture_probability),
        ("passer_by_probability", wander.passer_by_probability),
    ])?;
    check_range(
        "pace_probability",
        wander.pace_probability,
        0.0,
        1.0 - wander.stand_probability,
        "(1 less stand_probability)",
    )?;
    check_interval("speed_m_per_s", wander.speed_m_per_s, 0.05, 2.0, "m/s")?;
    check_range("acceleration_m_per_s2", wander.acceleration_m_per_s2, 0.2, 5.0, "m/s^2")?;
    check_interval("height_m", wander.height_m, 0.5, 2.5, "m")?;
    check_interval("range_m", wander.range_m, 0.0, 100.0, "m")?;
    check_range("off_boresight_deg", wander.off_boresight_deg, 1.0, 180.0, "degrees")?;
    check_range("nearness", wander.nearness, 0.1, 10.0, "(exponent)")?;
    check_range("least_distance_m", wander.least_distance_m, 0.45, 2.0, "m")?;
    check_interval("pause_s", wander.pause_s, 0.1, 1e6, "s")?;
    check_interval("sit_s", wander.sit_s, 0.1, 1e6, "s")?;
    check_interval("sway_m", wander.sway_m, 0.0005, 0.05, "m")?;
    check_interval("gesture_m_per_s", wander.gesture_m_per_s, 0.1, 3.0, "m/s")?;
    check_interval("mode_s", wander.mode_s, 1.0, 1e6, "s")?;
    check_interval("passer_by_level_db", wander.passer_by_level_db, -60.0, 20.0, "dB")?;
    let modes = &wander.modes;
    let weights = [
        ("independent", modes.independent),
        ("together", modes.together),
        ("follow", modes.follow),
        ("meet", modes.meet),
        ("pass", modes.pass),
        ("stand_and_walk", modes.stand_and_walk),
    ];
    weights.into_iter().try_for_each(|(key, weight)| check_range(key, weight, 0.0, 1e6, "(weight)"))
}
