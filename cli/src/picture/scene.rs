//! Picture of a scene before anything is simulated, from above and from the side: furniture, the radar's beam, and the
//! trajectories of people.

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use radome_sim::Scene;
use radome_sim::em::specular::Ellipsoid;
use radome_sim::people::skin::EDGE_M;
use radome_sim::people::walking_mesh::WalkingMesh;
use radome_sim::scene_file::{BodyFile, FurnitureFile};

use super::canvas::{Canvas, Labels, Letters, Line, Pixel};
use super::legend::{draw_symbol, legend, legend_rows};
use super::palette::{BEAM, GREY, INK, LEFT, MOVING, NO_MATERIAL, STATIC, circle, material_ink};
use super::room::{WALL, draw_room};
use super::theme::Theme;
use super::trajectories::{Trajectory, draw_trajectory, label_times, trajectories};
use super::view::View;

/// Space below, above and to the right of each view, pixels. Numbers and the name of the axis are below it.
const BELOW: f64 = 62.0;
const TOP: f64 = 64.0;
const RIGHT: f64 = 30.0;
/// Largest scale, pixels per metre. The scale is otherwise such that the views fill this width, or one of them this height,
/// pixels.
const MOST_PIXELS_PER_M: f64 = 200.0;
const WIDTH: f64 = 1480.0;
const HEIGHT: f64 = 860.0;
/// Ratio of length to width above which a room has its views one above the other.
const LONG_RATIO: f64 = 2.2;

/// Scene and options of its picture.
pub struct Preview<'a> {
    /// The scene as its seed drew it.
    pub scene: &'a Scene,
    pub seed: u64,
    /// Number of people; the scene's own number if `None`.
    pub people: Option<usize>,
    /// Time up to which trajectories are drawn, s.
    pub until_s: f64,
    /// Propagation paths to draw.
    pub paths: &'a [DrawnPath],
}

/// Propagation path in a picture.
pub struct DrawnPath {
    /// Corners, m.
    pub points: Vec<DVec3>,
    /// Whether people affect it: it then has another colour.
    pub is_moving: bool,
    /// Opacity of its line, from 0 for the faintest to 1.
    pub strength: f64,
}

/// Draws a scene.
///
/// # Errors
/// The picture is too large, or the file cannot be written.
pub fn draw(preview: &Preview, path: &Path) -> anyhow::Result<()> {
    let scene = preview.scene;
    let views = views(scene);
    let trajectories = trajectories(scene, preview.seed, preview.people, preview.until_s);
    let people: Vec<(usize, f64)> =
        trajectories.iter().map(|trajectory| (trajectory.slot, trajectory.motion.person.build.height_m)).collect();
    let legend = legend(scene, &people);
    let [right, below] = [0, 1].map(|axis| views.iter().map(|view| view.bounds()[1][axis]).fold(0.0, f64::max));
    let width = (right + RIGHT).max(900.0);
    let rows = legend_rows(&legend, width);
    let below = below + BELOW;
    let mut canvas = Canvas::new(width, below + 22.0 * rows.len() as f64 + 12.0, Theme::LIGHT.background);

    let (seed, note) = (format!(", seed {}", preview.seed), format!("0 to {:.0} s", preview.until_s));
    let (left, seed_width) = (LEFT - WALL, Letters::Title.size(&seed)[0] + 24.0);
    let name_width = width - RIGHT - left - seed_width - Letters::Small.size(&note)[0];
    let title = Letters::Title.shortened(scene.name(), name_width) + &seed;
    canvas.text([left, 10.0], &title, Letters::Title, INK);
    canvas.text([left + Letters::Title.size(&title)[0] + 24.0, 16.0], &note, Letters::Small, GREY);
    for view in &views {
        draw_view(&mut canvas, view, preview, &trajectories);
    }
    let mut y = below;
    for row in rows {
        let mut x = LEFT - WALL;
        for (symbol, name) in row {
            draw_symbol(&mut canvas, [x, y], symbol);
            canvas.text([x + 30.0, y], name, Letters::Small, INK);
            x += 30.0 + Letters::Small.size(name)[0] + 26.0;
        }
        y += 22.0;
    }
    canvas.save(path)
}

/// Computes the view from above and the view from the side.
fn views(scene: &Scene) -> [View; 2] {
    let size_m = scene.room().size_m;
    // Seen along the horizontal axis that is across the boresight.
    let ahead = scene.radar_from_world().transpose() * DVec3::X;
    let across = if ahead.x.abs() >= ahead.y.abs() { 0 } else { 1 };
    let is_long = size_m.x > LONG_RATIO * size_m.y;
    let widths_m = if is_long { size_m.x.max(size_m[across]) } else { size_m.x + size_m[across] };
    let views = if is_long { 1.0 } else { 2.0 };
    let per_m =
        ((WIDTH - views * (LEFT + RIGHT)) / widths_m).min(HEIGHT / size_m.y.max(size_m.z)).min(MOST_PIXELS_PER_M);
    let view = |across, up, corner| View { across, up, corner, per_m, size_m };
    // Both views have the same lower edge.
    let top = |lower_m: f64| TOP + lower_m.max(0.0) * per_m;
    let plan = view(0, 1, [LEFT, if is_long { TOP } else { top(size_m.z - size_m.y) }]);
    let beside = match is_long {
        true => [LEFT, TOP + plan.height() + BELOW + 12.0],
        false => [LEFT + plan.width() + RIGHT + LEFT, top(size_m.y - size_m.z)],
    };
    [plan, view(across, 2, beside)]
}

/// Draws everything in a view, from back to front.
fn draw_view(canvas: &mut Canvas, view: &View, preview: &Preview, trajectories: &[Trajectory]) {
    let scene = preview.scene;
    let mut labels = Labels::default();
    draw_room(canvas, view, scene);
    draw_beam(canvas, view, scene);
    draw_furniture(canvas, view, scene);
    trajectories.iter().for_each(|trajectory| draw_bodies(canvas, view, scene, trajectory));
    trajectories.iter().for_each(|trajectory| draw_trajectory(canvas, view, trajectory));
    preview.paths.iter().for_each(|path| draw_path(canvas, view, path));
    draw_radar(canvas, view, scene, &mut labels);
    trajectories.iter().for_each(|trajectory| label_times(canvas, view, trajectory, &mut labels));
    // Names of furniture must not cover bodies.
    for (trajectory, &time_s) in
        trajectories.iter().filter_map(|trajectory| Some((trajectory, trajectory.bodies.first()?)))
    {
        for part in trajectory.motion.body(time_s) {
            let (low, high) = bounds(&silhouette(view, &part));
            labels.reserve(low, high);
        }
    }
    label_furniture(canvas, view, scene, &mut labels);
    draw_axes(canvas, view);
}

/// Directions of the beam in the plane of a view through the boresight, in which the power pattern is at least half its maximum.
/// They are in coordinates of the room.
fn beam(view: &View, scene: &Scene) -> Vec<DVec3> {
    /// Steps of the angle, rad.
    const STEP_RAD: f64 = 0.005;
    let (transmitter, _) = scene.elements();
    let cut = |angle: f64| {
        let (sine, cosine) = angle.sin_cos();
        if view.is_plan() { DVec3::new(cosine, sine, 0.0) } else { DVec3::new(cosine, 0.0, sine) }
    };
    let is_strong = |angle: &f64| transmitter.pattern.field(cut(*angle)).powi(2) >= 0.5;
    let half = (0..).map(|i| f64::from(i) * STEP_RAD).take_while(|a| *a < 1.55 && is_strong(a)).last().unwrap_or(0.0);
    let world_from_radar = scene.radar_from_world().transpose();
    let steps = 400;
    (0..=steps).map(|i| world_from_radar * cut(half * (2.0 * f64::from(i) / f64::from(steps) - 1.0))).collect()
}

/// Point where a ray from a point in the room meets a wall.
fn to_wall(from: DVec3, direction: DVec3, size: DVec3) -> DVec3 {
    let length = (0..3)
        .filter(|&i| direction[i].abs() > 1e-9)
        .map(|i| (if direction[i] > 0.0 { size[i] - from[i] } else { -from[i] }) / direction[i])
        .fold(f64::INFINITY, f64::min);
    from + direction * length.clamp(0.0, 200.0)
}

fn draw_beam(canvas: &mut Canvas, view: &View, scene: &Scene) {
    let radar = scene.radar_position();
    let directions = beam(view, scene);
    let mut fan = vec![view.project(radar)];
    fan.extend(directions.iter().map(|&d| view.project(to_wall(radar, d, view.size_m))));
    let edge = Line { ink: BEAM.darker(0.15), width: 1.4, is_dashed: true };
    for end in [fan.get(1), fan.last()].into_iter().flatten() {
        canvas.line(&[fan[0], *end], &edge);
    }
    canvas.fill(&[fan], BEAM.faint(0.20));
}

fn draw_path(canvas: &mut Canvas, view: &View, path: &DrawnPath) {
    let ink = if path.is_moving { MOVING } else { STATIC };
    let line = Line { ink: ink.faint(0.15 + 0.75 * path.strength), width: 1.2, is_dashed: false };
    let places: Vec<Pixel> = path.points.iter().map(|p| view.project(*p)).collect();
    canvas.line(&places, &line);
}

fn draw_radar(canvas: &mut Canvas, view: &View, scene: &Scene, labels: &mut Labels) {
    /// Size of the sign, pixels.
    const SIZE: f64 = 11.0;
    let ahead = scene.radar_from_world().transpose() * DVec3::X;
    let center = view.project(scene.radar_position());
    let (dx, dy) = (ahead[view.across], -ahead[view.up]);
    let length = dx.hypot(dy);
    let (dx, dy) = if length > 0.05 { (dx / length, dy / length) } else { (0.0, 1.0) };
    let place = |along: f64, across: f64| [center[0] + along * dx - across * dy, center[1] + along * dy + across * dx];
    let arrow = vec![place(SIZE, 0.0), place(-0.6 * SIZE, 0.75 * SIZE), place(-0.6 * SIZE, -0.75 * SIZE)];
    canvas.fill(std::slice::from_ref(&arrow), BEAM);
    canvas.outline(&[arrow], &Line { ink: INK, width: 1.6, is_dashed: false });
    labels.reserve([center[0] - SIZE, center[1] - SIZE], [center[0] + SIZE, center[1] + SIZE]);
}

/// Furniture without the walls of meshes, whose outlines are drawn instead.
fn furniture(scene: &Scene) -> impl Iterator<Item = &FurnitureFile> {
    let all = scene.file().furniture.iter().enumerate();
    all.filter(move |(number, _)| !scene.is_wall_of_mesh(*number)).map(|(_, furniture)| furniture)
}

fn draw_furniture(canvas: &mut Canvas, view: &View, scene: &Scene) {
    // Furniture that is nearer to the viewer is drawn last, so that it partly covers the rest.
    let mut all: Vec<_> = furniture(scene).collect();
    let depth = if view.is_plan() { 2 } else { 1 - view.across };
    let sign = if view.is_plan() || view.across == 1 { 1.0 } else { -1.0 };
    all.sort_by(|a, b| {
        (sign * (a.position_m[depth] + a.size_m[depth])).total_cmp(&(sign * (b.position_m[depth] + b.size_m[depth])))
    });
    for furniture in all {
        let low = DVec3::from_array(furniture.position_m);
        let area = view.rectangle(low, low + DVec3::from_array(furniture.size_m));
        let ink = furniture.material.as_deref().map_or(NO_MATERIAL, |material| material_ink(scene, material));
        canvas.fill(std::slice::from_ref(&area), ink.faint(0.45));
        canvas.outline(&[area], &Line { ink: ink.darker(0.35), width: 1.6, is_dashed: false });
    }
    let places = scene.file().seat.iter().map(|s| (s.position_m, s.heading_deg, s.height_m));
    let places = places.chain(scene.file().bed.iter().map(|b| (b.position_m, b.heading_deg, b.height_m)));
    for ([x, y], heading_deg, height_m) in places {
        // A circle for the hips, and a line in the direction of view or of the feet.
        let (sine, cosine) = heading_deg.to_radians().sin_cos();
        let hips = DVec3::new(x, y, height_m);
        let mark = Line { ink: INK.faint(0.75), width: 1.6, is_dashed: false };
        canvas.outline(&[circle(view.project(hips), 4.0)], &mark);
        canvas.line(&[view.project(hips), view.project(hips + DVec3::new(cosine, sine, 0.0) * 0.22)], &mark);
    }
}

fn label_furniture(canvas: &mut Canvas, view: &View, scene: &Scene, labels: &mut Labels) {
    for furniture in furniture(scene) {
        let low = DVec3::from_array(furniture.position_m);
        let area = view.rectangle(low, low + DVec3::from_array(furniture.size_m));
        let ([x0, y0], [x1, y1]) = (area[0], area[2]);
        let [width, height] = Letters::Small.size(&furniture.name);
        let (x, y) = (0.5 * (x0 + x1 - width), 0.5 * (y0 + y1 - height));
        let mut places = vec![[x, y], [x, y0 + 2.0], [x, y1 - height - 2.0]];
        // A name that is wider than its furniture is placed beside it.
        if width > x1 - x0 - 4.0 || height > y1 - y0 {
            places =
                vec![[x1 + 4.0, y], [x0 - width - 4.0, y], [x, y1 + 3.0], [x, y0 - height - 3.0], [x1 + 4.0, y0 + 3.0]];
        }
        if let Some(corner) = labels.find([width, height], &places, view.bounds()) {
            canvas.text(corner, &furniture.name, Letters::Small, INK);
        }
    }
}

fn bounds(area: &[Pixel]) -> (Pixel, Pixel) {
    area.iter().fold(([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]), |(low, high), p| {
        ([low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])])
    })
}

/// Outline of an ellipsoid in orthographic projection.
fn silhouette(view: &View, e: &Ellipsoid) -> Vec<Pixel> {
    let columns = [e.axes.x_axis * e.semi_axes_m.x, e.axes.y_axis * e.semi_axes_m.y, e.axes.z_axis * e.semi_axes_m.z];
    let covariance = |i: usize, j: usize| columns.iter().map(|c| c[i] * c[j]).sum::<f64>();
    // The outline is the ellipse of a Cholesky factor of the projected covariance.
    let a = covariance(view.across, view.across).sqrt();
    let b = covariance(view.across, view.up) / a.max(1e-12);
    let c = (covariance(view.up, view.up) - b * b).max(0.0).sqrt();
    let centre = view.project(e.centre);
    let place = |(sine, cosine): (f64, f64)| {
        [centre[0] + a * cosine * view.per_m, centre[1] - (b * cosine + c * sine) * view.per_m]
    };
    (0..40).map(|i| place((f64::from(i) * std::f64::consts::TAU / 40.0).sin_cos())).collect()
}

fn draw_bodies(canvas: &mut Canvas, view: &View, scene: &Scene, trajectory: &Trajectory) {
    let is_mesh = scene.file().people.body == BodyFile::Mesh;
    let mesh = is_mesh.then(|| WalkingMesh::new(Arc::clone(&trajectory.motion), 1.5 * EDGE_M));
    for (i, &time_s) in trajectory.bodies.iter().enumerate().rev() {
        let opacity = if i == 0 { 0.80 } else { 0.26 };
        if let Some(mesh) = &mesh {
            let mesh = mesh.mesh_at(time_s);
            let corners = |t: usize| mesh.corners(t).map(|c| c.map(|p| view.project(p)).to_vec());
            let triangles: Vec<Vec<Pixel>> = (0..mesh.triangles.len()).filter_map(corners).collect();
            canvas.fill(&triangles, trajectory.ink.faint(opacity));
        } else {
            let parts: Vec<Vec<Pixel>> = trajectory.motion.body(time_s).iter().map(|e| silhouette(view, e)).collect();
            canvas.fill(&parts, trajectory.ink.faint(opacity));
            let line = Line {
                ink: trajectory.ink.darker(0.4).faint(if i == 0 { 0.55 } else { 0.2 }),
                width: 1.0,
                is_dashed: false,
            };
            canvas.outline(&parts, &line);
        }
    }
}

fn draw_axes(canvas: &mut Canvas, view: &View) {
    let [[x0, _], [_, y1]] = view.bounds();
    let line = Line { ink: INK, width: 1.2, is_dashed: false };
    let step = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0].into_iter().find(|step| step * view.per_m >= 48.0).unwrap_or(50.0);
    let digits = usize::from(step < 1.0);
    let ticks = |length: f64| (0..=(length / step + 1e-9) as usize).map(move |i| i as f64 * step);
    for tick in ticks(view.size_m[view.across]) {
        let x = x0 + tick * view.per_m;
        canvas.line(&[[x, y1 + WALL], [x, y1 + WALL + 5.0]], &line);
        let text = format!("{tick:.digits$}");
        canvas.text([x - 0.5 * Letters::Small.size(&text)[0], y1 + WALL + 7.0], &text, Letters::Small, INK);
    }
    for tick in ticks(view.size_m[view.up]) {
        let y = y1 - tick * view.per_m;
        canvas.line(&[[x0 - WALL - 5.0, y], [x0 - WALL, y]], &line);
        let text = format!("{tick:.digits$}");
        let [width, height] = Letters::Small.size(&text);
        canvas.text([x0 - WALL - 8.0 - width, y - 0.5 * height], &text, Letters::Small, INK);
    }
    let name = |axis: usize| ["x / m", "y / m", "z / m"][axis];
    let (across, up) = (name(view.across), name(view.up));
    let middle = x0 + 0.5 * (view.width() - Letters::Small.size(across)[0]);
    canvas.text([middle, y1 + WALL + 25.0], across, Letters::Small, INK);
    let what = if view.is_plan() { "from above" } else { "from the side" };
    let top = view.corner[1] - WALL - 20.0;
    canvas.text([x0 - WALL - 50.0, top], up, Letters::Small, INK);
    canvas.text([x0 + 12.0, top], what, Letters::Small, GREY);
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::files;

    fn view() -> View {
        View { across: 0, up: 2, corner: [10.0, 20.0], per_m: 50.0, size_m: DVec3::new(4.0, 3.0, 2.5) }
    }

    fn scene(name: &str) -> Scene {
        Scene::load(&files::fixture(&format!("scenes/{name}.toml")).expect("a fixture")).expect("a scene")
    }

    /// A metre has the same length in both directions, and up is up.
    #[test]
    fn the_scale_is_the_same_in_both_directions() {
        let view = view();
        let [x, y] = view.project(DVec3::ZERO);
        assert_eq!((x, y), (10.0, 20.0 + 125.0));
        assert_eq!(view.project(DVec3::new(1.0, 9.0, 1.0)), [x + 50.0, y - 50.0]);
    }

    /// The outline of a rotated ellipsoid has the ellipsoid's extent.
    #[test]
    fn outlines_of_ellipsoids_are_their_projections() {
        let axes = DMat3::from_rotation_y(0.7) * DMat3::from_rotation_z(0.4) * DMat3::from_rotation_x(1.1);
        let e = Ellipsoid { centre: DVec3::new(2.0, 1.0, 1.2), axes, semi_axes_m: DVec3::new(0.1, 0.2, 0.6) };
        let half = radome_sim::people::body::half_extent(&e) * 50.0;
        let (low, high) = bounds(&silhouette(&view(), &e));
        assert!((high[0] - low[0] - 2.0 * half.x).abs() < 0.02 * half.x, "{} {}", high[0] - low[0], half.x);
        assert!((high[1] - low[1] - 2.0 * half.z).abs() < 0.02 * half.z, "{} {}", high[1] - low[1], half.z);
    }

    /// Width and pixels of a PNG.
    fn rgb_of(file: &Path) -> (usize, Vec<[u8; 3]>) {
        let bytes = std::io::BufReader::new(std::fs::File::open(file).expect("a file"));
        let mut reader = png::Decoder::new(bytes).read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let image = reader.next_frame(&mut pixels).expect("an image");
        assert_eq!((image.color_type, image.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
        (image.width as usize, pixels.as_chunks().0.to_vec())
    }

    /// Every shipped scene gives a picture that is not blank.
    #[test]
    fn every_shipped_scene_is_drawn() {
        let folder = files::fixture("scenes").expect("a fixture");
        let file = tempfile::NamedTempFile::new().expect("a file");
        let mut drawn = 0;
        for entry in std::fs::read_dir(folder).expect("folder") {
            let path = entry.expect("entry").path();
            if path.extension().is_none_or(|e| e != "toml") {
                continue;
            }
            let scene = Scene::load(&path).and_then(|scene| scene.drawn(3)).expect("a scene");
            let preview = Preview { scene: &scene, seed: 3, people: None, until_s: 20.0, paths: &[] };
            draw(&preview, file.path()).expect("a picture");
            let (_, pixels) = rgb_of(file.path());
            let inked = pixels.iter().filter(|pixel| **pixel != [255; 3]).count();
            assert!(inked as f64 > 0.1 * pixels.len() as f64, "{}", path.display());
            drawn += 1;
        }
        assert!(drawn >= 8);
    }

    /// A partition is drawn beside its doorway and not in it, where the leaf stands open.
    #[test]
    fn openings_are_gaps_in_the_plan() {
        let scene = scene("half-open-door");
        let file = tempfile::NamedTempFile::new().expect("a file");
        let preview = Preview { scene: &scene, seed: 3, people: None, until_s: 0.1, paths: &[] };
        draw(&preview, file.path()).expect("a picture");
        let (width, pixels) = rgb_of(file.path());
        let [plan, _] = views(&scene);
        let differ = |a: [f64; 2], b: [f64; 2]| {
            let [a, b] = [a, b].map(|[x, y]| plan.project(DVec3::new(x, y, 0.0)));
            let [a, b] = [a, b].map(|[x, y]| pixels[y as usize * width + x as usize]);
            (0..3).map(|i| a[i].abs_diff(b[i])).max() > Some(20)
        };
        assert!(differ([3.5, 3.6], [3.6, 3.6]));
        assert!(!differ([3.5, 2.2], [3.6, 2.2]));
        assert!(differ([3.182, 1.818], [3.6, 2.2]));
    }

    /// Regression test: floor and thick walls filled the box around a plan, all in the material of `walls`.
    #[test]
    fn plans_are_drawn_with_their_own_walls() {
        let path = files::fixture("scenes/l-corridor.toml").expect("a fixture");
        let text = std::fs::read_to_string(&path).expect("text");
        let wall = "[[room.plan.wall]]\nindex = 1\nmaterial = \"metal\"\n\n[radar]";
        let scene = Scene::parse(&text.replacen("[radar]", wall, 1), &path).expect("a scene");
        let file = tempfile::NamedTempFile::new().expect("a file");
        let preview = Preview { scene: &scene, seed: 3, people: None, until_s: 0.1, paths: &[] };
        draw(&preview, file.path()).expect("a picture");
        let (width, pixels) = rgb_of(file.path());
        let [plan, beside] = views(&scene);
        let is = |view: &View, place_m: [f64; 3], off: Pixel, rgb: [u8; 3]| {
            let [x, y] = view.project(DVec3::from_array(place_m));
            let found = pixels[(y + off[1]) as usize * width + (x + off[0]) as usize];
            assert!((0..3).all(|i| found[i].abs_diff(rgb[i]) <= 3), "{place_m:?}: {found:?}, expected {rgb:?}");
        };
        let (concrete, metal) = ([128, 132, 138], [62, 78, 104]);
        is(&plan, [5.0, 4.0, 0.0], [0.0, 0.0], [255; 3]);
        is(&plan, [8.0, 5.0, 0.0], [0.5 * WALL, 0.0], [255; 3]);
        is(&plan, [5.0, 2.0, 0.0], [0.0, -0.5 * WALL], concrete);
        is(&plan, [2.0, 4.0, 0.0], [0.5 * WALL, 0.0], concrete);
        is(&plan, [8.0, 1.5, 0.0], [0.5 * WALL, 0.0], metal);
        is(&beside, [8.0, 0.0, 2.0], [0.5 * WALL, 0.0], metal);
        is(&beside, [0.0, 0.0, 2.0], [-0.5 * WALL, 0.0], concrete);
    }

    /// Returns whether the plans of two scenes differ at a place of the room, m.
    fn differ(scenes: [&Scene; 2], place_m: [f64; 2]) -> bool {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let [a, b] = scenes.map(|scene| {
            let preview = Preview { scene, seed: 3, people: None, until_s: 0.1, paths: &[] };
            draw(&preview, file.path()).expect("a picture");
            let (width, pixels) = rgb_of(file.path());
            let [plan, _] = views(scene);
            let [x, y] = plan.project(DVec3::new(place_m[0], place_m[1], 0.0));
            pixels[y as usize * width + x as usize]
        });
        a != b
    }

    /// Regression test: two walls of a file at a right angle were drawn as furniture on the floor between them.
    #[test]
    fn inner_walls_of_meshes_leave_the_floor_free() {
        let folder = tempfile::tempdir().expect("a folder");
        let [text, mesh] = ["room-mesh.toml", "room-mesh.obj"]
            .map(|name| std::fs::read_to_string(files::fixture("scenes").expect("a folder").join(name)).expect("text"));
        // A scene may name files beside it.
        let receiver = files::fixture("receivers").expect("a folder").join("paper-mesh.toml");
        std::fs::copy(receiver, folder.path().join("paper-mesh.toml")).expect("a copy");
        let text = text.replace("../receivers/", "");
        let walls = "o inner\nusemtl plaster\nv -2 0 0\nv -2 0 2.6\nv 0 0 0\nv 0 0 2.6\nv 0 -2 0\nv 0 -2 2.6\n\
                     f -6 -5 -3 -4\nf -4 -3 -1 -2\n";
        let [without, with] = ["", walls].map(|walls| {
            std::fs::write(folder.path().join("room-mesh.obj"), format!("{mesh}{walls}")).expect("written");
            Scene::parse(&text, &folder.path().join("scene.toml")).expect("a scene")
        });
        assert!(differ([&without, &with], [3.0, 1.0]), "no wall");
        assert!(!differ([&without, &with], [1.5, 0.5]), "the floor between the walls");
    }

    /// The beam ends where the power pattern is half its maximum.
    #[test]
    fn beams_have_the_width_of_the_antenna_pattern() {
        let scene = scene("corridor");
        for (view, width_deg) in [
            (View { up: 1, ..view() }, scene.receiver().antenna.azimuth_beamwidth_deg),
            (view(), scene.receiver().antenna.elevation_beamwidth_deg),
        ] {
            let all = beam(&view, &scene);
            let (first, last) = (all[0], all[all.len() - 1]);
            assert!((first.angle_between(last).to_degrees() - width_deg).abs() < 1.0, "{width_deg} degrees");
        }
    }
}
