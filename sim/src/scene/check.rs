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
pub(super) struct Fault {
    key: &'static str,
    value: String,
    expected: String,
}

impl Fault {
    /// Adds the name of the part of the scene whose value it is.
    pub(super) fn of(self, part: &str) -> Self {
        Fault { expected: format!("{} ({part})", self.expected), ..self }
    }

    pub(super) fn at(self, path: &Path, text: &str) -> SceneError {
        SceneError::Value {
            path: path.to_owned(),
            line: line_of_value(text, self.key, &self.value),
            key: self.key.to_owned(),
            value: self.value,
            expected: self.expected,
        }
    }
}

pub(super) fn fault<T>(
    key: &'static str,
    value: impl std::fmt::Debug,
    expected: impl Into<String>,
) -> Result<T, Fault> {
    Err(Fault { key, value: format!("{value:?}"), expected: expected.into() })
}

pub(super) fn within(key: &'static str, value: f64, min: f64, max: f64, unit: &str) -> Result<(), Fault> {
    if value >= min && value <= max {
        return Ok(());
    }
    // Numbers of tables and of people are whole.
    let text = format!("{value:?}");
    fault(key, format_args!("{}", text.strip_suffix(".0").unwrap_or(&text)), format!("{min} to {max} {unit}"))
}

fn interval(key: &'static str, [low, high]: [f64; 2], min: f64, max: f64, unit: &str) -> Result<(), Fault> {
    if low >= min && high <= max && low <= high {
        return Ok(());
    }
    fault(key, [low, high], format!("[least, largest] within {min} to {max} {unit}"))
}

fn probabilities<const N: usize>(all: [(&'static str, f64); N]) -> Result<(), Fault> {
    all.into_iter().try_for_each(|(key, probability)| within(key, probability, 0.0, 1.0, "(probability)"))
}

/// Refuses a place outside a room of the given size.
fn in_room(key: &'static str, place: &[f64], size: [f64; 3]) -> Result<(), Fault> {
    if place.iter().zip(size).all(|(&p, s)| p >= 0.0 && p <= s) {
        return Ok(());
    }
    fault(key, place, format!("a place in the room {size:?}"))
}

/// Refuses an index beyond the tables that exist.
fn index(key: &'static str, number: Option<usize>, table: &str, count: usize) -> Result<(), Fault> {
    match number {
        Some(number) if number >= count => {
            fault(key, number, format!("an index below the number of [[{table}]] tables, {count}"))
        }
        _ => Ok(()),
    }
}

/// The room's six surfaces, each with its key.
pub(super) fn surfaces(room: &RoomFile) -> [(&'static str, &SurfaceFile); 6] {
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
pub(super) fn check_radar_outside_furniture(file: &SceneFile) -> Result<(), Fault> {
    let room = &file.room;
    let by_rays = room.solver.map_or(room.plan.is_some() || !room.mesh.is_empty(), |s| s == SolverFile::Rays);
    if !by_rays || room.transmission {
        return Ok(());
    }
    let holds = |furniture: &&FurnitureFile| {
        let is_solid = furniture.material.as_deref().is_some_and(|material| material != OPEN);
        let is_within = |i: usize| {
            let at_m = file.radar.position_m[i] - furniture.position_m[i];
            at_m > 0.0 && at_m < furniture.size_m[i]
        };
        is_solid && (0..3).all(is_within)
    };
    file.furniture.iter().find(holds).map_or(Ok(()), |furniture| {
        fault("position_m", file.radar.position_m, format!("a place outside the furniture {:?}", furniture.name))
    })
}

/// Checks the scene's own materials and the materials of the room, before its meshes are read.
pub(super) fn check_materials(file: &SceneFile) -> Result<(), Fault> {
    file.materials.iter().try_for_each(|(name, own)| check_own_material(name, own))?;
    for furniture in &file.furniture {
        within("thickness_m", furniture.thickness_m, 0.0, 10.0, "m")?;
        furniture.material.iter().try_for_each(|name| check_material(file, "material", name))?;
    }
    let room = &file.room;
    if room.plan.is_some() && !room.mesh.is_empty() {
        return fault("plan", "given", "either [room.plan] or [[room.mesh]]");
    }
    surfaces(room).into_iter().try_for_each(|(key, surface)| check_surface(file, key, &surface.material))?;
    if !room.mesh.is_empty() && room.size_m != [0.0; 3] {
        return fault("size_m", room.size_m, "none beside [[room.mesh]]: the size comes from the meshes");
    }
    for mesh in &room.mesh {
        within("thickness_m", mesh.thickness_m, 0.0, 10.0, "m")?;
        for name in mesh.material.iter().chain(mesh.materials.values()) {
            check_material(file, "material", name)?;
        }
    }
    Ok(())
}

fn check_own_material(name: &str, own: &OwnMaterial) -> Result<(), Fault> {
    if Material::named(name).is_some() {
        return fault("materials", name, "another name: this one is the table's");
    }
    if own.permittivity.is_some() == own.p2040.is_some() {
        return fault("materials", name, "either permittivity = [real, loss] or p2040 = [a, b, c, d]");
    }
    if let Some([real, loss]) = own.permittivity {
        within("permittivity", real, 1.0, 1000.0, "(real part)")?;
        within("permittivity", loss, 0.0, 1e6, "(loss: the imaginary part, counted positive)")?;
    }
    if let Some([a, b, c, d]) = own.p2040 {
        within("p2040", a, 1.0, 1000.0, "(a)")?;
        within("p2040", b, -5.0, 5.0, "(b)")?;
        within("p2040", c, 0.0, 1e6, "(c)")?;
        within("p2040", d, -5.0, 5.0, "(d)")?;
    }
    interval("band_ghz", own.band_ghz.unwrap_or([1.0, 100.0]), 0.0, 1e4, "GHz")
}

/// Checks the material of one of the six surfaces. A box must state it; a plan or meshes must leave it out for their
/// walls.
fn check_surface(file: &SceneFile, key: &'static str, material: &str) -> Result<(), Fault> {
    let room = &file.room;
    let is_of_plan = room.plan.is_some() && !["floor", "ceiling"].contains(&key);
    match (room.mesh.is_empty() && !is_of_plan, material) {
        (true, "") => {
            let expected = "{ material = \"...\", thickness_m = ... }, or [room.plan] or [[room.mesh]] for the walls";
            fault(key, "missing", expected)
        }
        (true, material) => check_material(file, key, material),
        (false, "") => Ok(()),
        (false, _) if is_of_plan => fault(key, material, "none beside [room.plan]: upright walls come from the plan"),
        // The meshes lack this surface.
        (false, OPEN) => Ok(()),
        (false, _) => fault(key, material, "none beside [[room.mesh]]: walls come from the meshes, or are \"open\""),
    }
}

pub(super) fn check_material(file: &SceneFile, key: &'static str, name: &str) -> Result<(), Fault> {
    if Material::named(name).is_some() || file.materials.contains_key(name) {
        return Ok(());
    }
    let own: Vec<&String> = file.materials.keys().collect();
    let table = Material::NAMES.join(", ");
    fault(key, name, format!("one of {table}, or of the scene's own [materials.NAME], which are {own:?}"))
}

/// Checks a whole scene after the room's size is known.
pub(super) fn check(file: &SceneFile) -> Result<(), Fault> {
    if file.format != SCENE_FORMAT {
        return fault("format", file.format, "1, the only version that this program reads");
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
    tables.into_iter().try_for_each(|(key, count)| within(key, count as f64, 0.0, MOST_TABLES, "tables"))?;
    check_mounting(&file.radar)?;
    file.room.sway.iter().try_for_each(|sway| check_sway(sway, size))?;
    file.furniture.iter().try_for_each(|furniture| check_furniture(furniture, size))?;
    for seat in &file.seat {
        check_resting_place("seat", &seat.position_m, seat.heading_deg, seat.height_m, size)?;
        within("back_m", seat.back_m, 0.0, 0.45, "m (no more than thighs are long)")?;
    }
    for bed in &file.bed {
        check_resting_place("bed", &bed.position_m, bed.heading_deg, bed.height_m, size)?;
        within("edge_m", bed.edge_m.abs(), 0.2, 2.0, "m, to the left of the heading or, negative, to the right")?;
    }
    file.door.iter().try_for_each(|door| check_door(door, size))?;
    check_people(file)
}

fn check_room(room: &RoomFile) -> Result<(), Fault> {
    if !room.size_m.iter().all(|s| (0.5..=100.0).contains(s)) {
        return fault("size_m", room.size_m, "three lengths from 0.5 to 100 m");
    }
    if room.plan.is_some() && room.solver == Some(SolverFile::Images) {
        return fault("solver", "images", "\"rays\", or none, beside [room.plan]");
    }
    within("max_reflections", f64::from(room.max_reflections), 0.0, 6.0, "reflections")?;
    within("max_body_reflections", f64::from(room.max_body_reflections), 0.0, 3.0, "reflections")?;
    within("diffuse_share", room.diffuse_share, 0.0, 0.5, "of the power")?;
    within("diffuse_points", f64::from(room.diffuse_points), 1.0, 1024.0, "points")?;
    within("diffuse_bounces", f64::from(room.diffuse_bounces), 1.0, 16.0, "walls")?;
    let mut thicknesses_m = surfaces(room).into_iter().map(|(_, surface)| surface.thickness_m);
    thicknesses_m.try_for_each(|thickness_m| within("thickness_m", thickness_m, 0.0, 10.0, "m"))
}

/// Refuses a radar in a wall of the box around the room, or outside it.
fn check_position(radar: &RadarFile, size: [f64; 3]) -> Result<(), Fault> {
    if radar.position_m.iter().zip(size).all(|(&p, s)| p >= 0.01 && p <= s - 0.01) {
        return Ok(());
    }
    fault("position_m", radar.position_m, format!("a place in the room, 1 cm or more from its walls {size:?}"))
}

/// Checks the radar's orientation and its vibration.
fn check_mounting(radar: &RadarFile) -> Result<(), Fault> {
    within("azimuth_deg", radar.azimuth_deg, -360.0, 360.0, "degrees")?;
    within("tilt_down_deg", radar.tilt_down_deg, -90.0, 90.0, "degrees")?;
    if let Some(VibrationFile { amplitude_m, frequency_hz, bandwidth }) = radar.vibration {
        within("amplitude_m", amplitude_m, 0.0, 0.01, "m")?;
        within("frequency_hz", frequency_hz, 0.01, 200.0, "Hz")?;
        within("bandwidth", bandwidth, 0.0, 1.0, BANDWIDTH_UNIT)?;
    }
    Ok(())
}

fn check_sway(sway: &SwayFile, size: [f64; 3]) -> Result<(), Fault> {
    within("reflectors", sway.reflectors as f64, 0.0, 64.0, "reflectors")?;
    within("probability", sway.probability, 0.0, 1.0, "(probability)")?;
    within("cross_section_dbsm", sway.cross_section_dbsm, -200.0, 20.0, "dBsm")?;
    within("spread_db", sway.spread_db, 0.0, 60.0, "dB")?;
    interval("amplitude_m", sway.amplitude_m, 1e-7, 0.5, "m")?;
    interval("frequency_hz", sway.frequency_hz, 0.01, 200.0, "Hz")?;
    within("bandwidth", sway.bandwidth, 0.0, 1.0, BANDWIDTH_UNIT)?;
    sway.position_m.iter().try_for_each(|position_m| in_room("position_m", position_m, size))
}

fn check_furniture(furniture: &FurnitureFile, size: [f64; 3]) -> Result<(), Fault> {
    let FurnitureFile { name, position_m, size_m, .. } = furniture;
    let fits = (0..3).all(|i| position_m[i] >= 0.0 && size_m[i] >= 0.0 && position_m[i] + size_m[i] <= size[i] + 1e-9);
    if !fits {
        return fault("furniture", (name, position_m, size_m), format!("a box within the room {size:?}"));
    }
    within("cross_section_dbsm", furniture.cross_section_dbsm(), -100.0, 60.0, "dBsm")?;
    within("points", furniture.points as f64, 1.0, 64.0, "points")
}

/// Checks position, heading and height of a seat or a bed.
fn check_resting_place(
    key: &'static str,
    position_m: &[f64],
    heading_deg: f64,
    height_m: f64,
    size: [f64; 3],
) -> Result<(), Fault> {
    in_room(key, position_m, size)?;
    within("heading_deg", heading_deg, -360.0, 360.0, "degrees")?;
    within("height_m", height_m, 0.2, 1.0, "m")
}

fn check_door(door: &DoorFile, [width_m, depth_m, _]: [f64; 3]) -> Result<(), Fault> {
    let [x, y] = door.position_m;
    let on_x = (x.abs() < 1e-6 || (x - width_m).abs() < 1e-6) && y > 0.0 && y < depth_m;
    let on_y = (y.abs() < 1e-6 || (y - depth_m).abs() < 1e-6) && x > 0.0 && x < width_m;
    if on_x == on_y {
        let expected = format!("a place on one upright wall: x is 0 or {width_m}, or y is 0 or {depth_m}");
        return fault("door", door.position_m, expected);
    }
    within("width_m", door.width_m, 0.4, 10.0, "m")?;
    let (middle_m, length_m) = if on_x { (y, depth_m) } else { (x, width_m) };
    let most_m = 2.0 * middle_m.min(length_m - middle_m);
    if door.width_m > most_m + 1e-9 {
        // The width may not be written at all.
        if door.width_m == door_width() {
            let expected =
                format!("{:.2} m or more off the wall's ends: width_m is {}", 0.5 * door.width_m, door.width_m);
            return fault("position_m", door.position_m, expected);
        }
        return fault("width_m", door.width_m, format!("at most {most_m:.2} m: there its wall ends"));
    }
    Ok(())
}

/// Checks options that exclude an actor's file, and options that need one.
fn check_actor_file(body: BodyFile, actor: &ActorFile) -> Result<(), Fault> {
    let Some(file) = &actor.file else {
        let given = [
            ("animation", actor.animation.is_some()),
            ("cycle_s", actor.cycle_s.is_some()),
            ("unit", actor.unit.is_some()),
            ("up", actor.up.is_some()),
        ];
        return match given.iter().find(|(_, given)| *given) {
            Some((key, _)) => fault(key, "given", "none without the actor's file"),
            None => Ok(()),
        };
    };
    if file.to_lowercase().ends_with(".bvh") {
        return match (&actor.animation, actor.unit) {
            (Some(name), _) => fault("animation", name, "none for a BVH file, which holds one clip"),
            (_, Some(unit)) => fault("unit", unit, "none for a BVH file: only its angles and proportions count"),
            _ => Ok(()),
        };
    }
    if body != BodyFile::Mesh {
        let expected = "body = \"mesh\" in [people] with it: an actor from a file has a skin and no ellipsoids";
        return fault("file", file, expected);
    }
    for step in &actor.step {
        let given = [("sit_s", step.sit_s), ("squat_s", step.squat_s), ("lie_s", step.lie_s)];
        if let Some((key, _)) = given.iter().find(|(_, duration)| duration.is_some()) {
            return fault(key, "given", "walk_to_m, stand_s and face_deg: an actor from a file cannot go down");
        }
    }
    Ok(())
}

fn check_people(file: &SceneFile) -> Result<(), Fault> {
    let people = &file.people;
    let programs = [!people.actor.is_empty(), people.visits.is_some(), people.wander.is_some(), people.desk.is_some()];
    let programs = programs.into_iter().filter(|&is_given| is_given).count();
    if programs != 1 {
        let expected = "exactly one of [[people.actor]], [people.visits], [people.wander], [people.desk]";
        let hint = "\n\nhint: a scene has people, and --people 0 leaves them out";
        return fault("people", programs, format!("{expected}{}", if programs == 0 { hint } else { "" }));
    }
    within("turn_rate_deg_per_s", people.turn_rate_deg_per_s.unwrap_or(120.0), 10.0, 720.0, "degrees/s")?;
    within("keep_off_m", people.keep_off_m.unwrap_or(0.3), 0.0, 2.0, "m")?;
    interval("stride", people.stride, 0.5, 1.5, "of the average")?;
    interval("arm_swing", people.arm_swing, 0.0, 3.0, "of the average")?;
    within("actor", people.actor.len() as f64, 0.0, MOST_PEOPLE, "people")?;
    people.actor.iter().try_for_each(|actor| check_actor(file, actor))?;
    people.visits.iter().try_for_each(|visits| check_visits(file, visits))?;
    people.wander.iter().try_for_each(check_wander)?;
    if people.desk.is_some() && people.body == BodyFile::Mesh {
        return fault("body", "mesh", "\"ellipsoids\" for people at a desk: what is fitted to them there has no skin");
    }
    people.desk.iter().try_for_each(check_desk)
}

/// Checks the script of one person.
fn check_actor(file: &SceneFile, actor: &ActorFile) -> Result<(), Fault> {
    let height_m = actor.height_m.unwrap_or(1.75);
    within("height_m", height_m, 0.5, 2.5, "m")?;
    check_actor_file(file.people.body, actor)?;
    within("start_s", actor.start_s, -1e6, 1e9, "s")?;
    within("step", actor.step.len() as f64, 0.0, MOST_STEPS, "steps")?;
    let is_place = |s: &StepFile| s.walk_to_m.is_some() || s.enter_door.is_some() || s.lie_s.is_some();
    if !actor.step.first().is_some_and(is_place) {
        let expected = "a first step with walk_to_m, enter_door or lie_s: where the person begins";
        return fault("step", actor.step.len(), expected);
    }
    within("stride", actor.stride.unwrap_or(1.0), 0.5, 1.5, "of the average")?;
    within("arm_swing", actor.arm_swing.unwrap_or(1.0), 0.0, 3.0, "of the average")?;
    for (number, step) in actor.step.iter().enumerate() {
        check_step(step, height_m)?;
        index("enter_door", step.enter_door, "door", file.door.len())?;
        index("leave_door", step.leave_door, "door", file.door.len())?;
        if let Some(door) = step.enter_door.filter(|_| number > 0) {
            return fault("enter_door", door, "it in the first step only");
        }
        if let Some(door) = step.leave_door.filter(|_| number + 1 < actor.step.len()) {
            return fault("leave_door", door, "it in the last step only");
        }
        index("bed", step.lie_s.and(step.bed.or(Some(0))), "bed", file.bed.len())?;
        index("seat", step.seat, "seat", file.seat.len())?;
    }
    Ok(())
}

/// Checks one step of a script for a person of the given height, except the tables that the step names.
fn check_step(step: &StepFile, height_m: f64) -> Result<(), Fault> {
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
        return fault("step", format_args!("{found}"), expected);
    };
    for xy in step.walk_to_m.iter().flatten() {
        within("walk_to_m", *xy, -1000.0, 1000.0, "m")?;
    }
    within("speed_m_per_s", step.speed_m_per_s.unwrap_or(1.0), 0.05, 5.0, "m/s")?;
    let durations_s =
        [("stand_s", step.stand_s), ("sit_s", step.sit_s), ("squat_s", step.squat_s), ("lie_s", step.lie_s)];
    for (key, duration_s) in durations_s {
        within(key, duration_s.unwrap_or(0.0), 0.0, 1e7, "s")?;
    }
    within("face_deg", step.face_deg.unwrap_or(0.0), -360.0, 360.0, "degrees")?;
    let deepest_m = DEEPEST_SQUAT * height_m;
    within("depth_m", step.depth_m.unwrap_or(0.1), 0.0, deepest_m, "m (0.36 of the body's height)")?;
    let walks = matches!(action, "walk_to_m" | "lie_s" | "enter_door" | "leave_door") || step.seat.is_some();
    let others = [
        ("depth_m", step.depth_m.is_some(), action == "squat_s", "squat_s"),
        ("bed", step.bed.is_some(), action == "lie_s", "lie_s"),
        ("seat", step.seat.is_some(), action == "sit_s", "sit_s"),
        ("speed_m_per_s", step.speed_m_per_s.is_some(), walks, "a walk, as of walk_to_m"),
    ];
    match others.into_iter().find(|&(_, is_given, has_use, _)| is_given && !has_use) {
        Some((key, _, _, with)) => fault(key, "given", format!("none without {with}")),
        None => Ok(()),
    }
}

fn check_visits(file: &SceneFile, visits: &VisitsFile) -> Result<(), Fault> {
    let v = visits;
    if file.door.is_empty() {
        return fault("visits", "without a door", "at least one [[door]] to come in by");
    }
    within("max_people", v.max_people as f64, 0.0, MOST_PEOPLE, "people")?;
    interval("first_absence_s", v.first_absence_s, 0.0, 1e6, "s")?;
    interval("absence_s", v.absence_s, 0.1, 1e6, "s")?;
    interval("speed_m_per_s", v.speed_m_per_s, 0.05, 5.0, "m/s")?;
    interval("height_m", v.height_m, 0.5, 2.5, "m")?;
    interval("lateral_m", v.lateral_m, 0.0, 100.0, "m")?;
    interval("pause_s", v.pause_s, 0.0, 1e6, "s")?;
    interval("sit_s", v.sit_s, 0.0, 1e6, "s")?;
    interval("pace_legs", v.pace_legs, 0.0, 1000.0, "legs")?;
    probabilities([
        ("turn_probability", v.turn_probability),
        ("pause_probability", v.pause_probability),
        ("sit_probability", v.sit_probability),
        ("pace_probability", v.pace_probability),
        ("passer_by_probability", v.passer_by_probability),
    ])?;
    let size = file.room.size_m;
    let half_m = 0.5 * size[0].min(size[1]);
    if let Some(margin_m) = v.pace_margin_m.filter(|margin_m| !(0.0..half_m).contains(margin_m)) {
        return fault("pace_margin_m", margin_m, format!("0 to less than {half_m} m, half of the room's shorter side"));
    }
    within("pace_off_boresight_deg", v.pace_off_boresight_deg.unwrap_or(180.0), 1.0, 180.0, "degrees")?;
    interval("passer_by_level_db", v.passer_by_level_db, -60.0, 20.0, "dB")?;
    interval("pace_range_m", v.pace_range_m.unwrap_or([0.0, 1.0]), 0.0, 100.0, "m")?;
    match v.pace_area_m {
        Some([low, high]) if !(0..2).all(|i| low[i] >= 0.0 && low[i] <= high[i] && high[i] <= size[i]) => {
            let expected = format!("[[x_low, y_low], [x_high, y_high]] in the room {size:?}");
            fault("pace_area_m", [low, high], expected)
        }
        _ => Ok(()),
    }
}

fn check_desk(desk: &DeskFile) -> Result<(), Fault> {
    let d = desk;
    within("max_people", d.max_people as f64, 0.0, 2.0, "people (a desk has places for two)")?;
    interval("distance_m", d.distance_m, 0.05, 20.0, "m")?;
    within("off_boresight_deg", d.off_boresight_deg, 0.0, 80.0, "degrees")?;
    let stretch_m = d.distance_m[1] - d.distance_m[0];
    within("min_separation_m", d.min_separation_m, 0.0, stretch_m, "m (the stretch of distance_m)")?;
    within("max_separation_m", d.max_separation_m, d.min_separation_m, 100.0, "m (not below min_separation_m)")?;
    within("reflectivity_scatter_db", d.reflectivity_scatter_db, 0.0, 60.0, "dB")?;
    interval("reflectivity_db", d.reflectivity_db, -60.0, 60.0, "dB")?;
    interval("double_bounce_db", d.double_bounce_db.unwrap_or_default(), -200.0, 0.0, "dB")?;
    interval("double_bounce_offset_m", d.double_bounce_offset_m, -0.2, 1.0, "m")?;
    within("body_points", d.body_points as f64, 0.0, 32.0, "points")?;
    interval("body_point_dbsm", d.body_point_dbsm, -100.0, 20.0, "dBsm")?;
    interval("body_point_decay_db_per_m", d.body_point_decay_db_per_m, 0.0, 1000.0, "dB/m")?;
    interval("body_point_detour_m", d.body_point_detour_m, 0.0, 5.0, "m")?;
    interval("noise_db", d.noise_db, -60.0, 60.0, "dB")?;
    interval("leakage_jitter_factor", d.leakage_jitter_factor, 1e-3, 1e3, "(factor)")?;
    probabilities([("fidget_probability", d.fidget_probability), ("objects_probability", d.objects_probability)])?;
    interval("height_m", d.height_m, 0.5, 2.5, "m")
}

fn check_wander(wander: &WanderFile) -> Result<(), Fault> {
    let w = wander;
    within("max_people", w.max_people as f64, 0.0, 2.0, "people (the classes end at two)")?;
    probabilities([
        ("pause_probability", w.pause_probability),
        ("stand_probability", w.stand_probability),
        ("pace_probability", w.pace_probability),
        ("sit_probability", w.sit_probability),
        ("gesture_probability", w.gesture_probability),
        ("passer_by_probability", w.passer_by_probability),
    ])?;
    within("pace_probability", w.pace_probability, 0.0, 1.0 - w.stand_probability, "(1 less stand_probability)")?;
    interval("speed_m_per_s", w.speed_m_per_s, 0.05, 2.0, "m/s")?;
    within("acceleration_m_per_s2", w.acceleration_m_per_s2, 0.2, 5.0, "m/s^2")?;
    interval("height_m", w.height_m, 0.5, 2.5, "m")?;
    interval("range_m", w.range_m, 0.0, 100.0, "m")?;
    within("off_boresight_deg", w.off_boresight_deg, 1.0, 180.0, "degrees")?;
    within("nearness", w.nearness, 0.1, 10.0, "(exponent)")?;
    within("least_distance_m", w.least_distance_m, 0.45, 2.0, "m")?;
    interval("pause_s", w.pause_s, 0.1, 1e6, "s")?;
    interval("sit_s", w.sit_s, 0.1, 1e6, "s")?;
    interval("sway_m", w.sway_m, 0.0005, 0.05, "m")?;
    interval("gesture_m_per_s", w.gesture_m_per_s, 0.1, 3.0, "m/s")?;
    interval("mode_s", w.mode_s, 1.0, 1e6, "s")?;
    interval("passer_by_level_db", w.passer_by_level_db, -60.0, 20.0, "dB")?;
    let m = &w.modes;
    let weights = [
        ("independent", m.independent),
        ("together", m.together),
        ("follow", m.follow),
        ("meet", m.meet),
        ("pass", m.pass),
        ("stand_and_walk", m.stand_and_walk),
    ];
    weights.into_iter().try_for_each(|(key, weight)| within(key, weight, 0.0, 1e6, "(weight)"))
}
