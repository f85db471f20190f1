//! Legend of the picture of a scene: symbols and their names.

use std::collections::BTreeMap;

use radome_sim::Scene;

use super::canvas::{Canvas, Ink, Letters, Line, Pixel};
use super::palette::{BEAM, GREY, INK, LEFT, NO_MATERIAL, circle, material_ink, person_ink};

/// Symbol in the legend.
pub(super) enum Symbol {
    Area(Ink),
    Open,
    Beam,
    Radar,
    Trajectory(Ink),
    Rest,
}

/// Symbols of a picture with their names. `people` has slot and height, m, of each person; several visitors may share a slot.
pub(super) fn legend(scene: &Scene, people: &[(usize, f64)]) -> Vec<(Symbol, String)> {
    let file = scene.file();
    let room = &file.room;
    let walls = [&room.x_low, &room.x_high, &room.y_low, &room.y_high, &room.floor, &room.ceiling];
    let mut names: Vec<&str> = walls.iter().map(|s| s.material.as_str()).collect();
    names.extend(file.furniture.iter().filter_map(|f| f.material.as_deref()));
    names.extend(room.plan.iter().flat_map(|plan| &plan.wall).map(|wall| wall.material.as_str()));
    names.extend(scene.outlines().iter().map(|o| o.material.as_str()));
    names.sort_unstable();
    names.dedup();
    let mut all = vec![(Symbol::Radar, "radar".to_owned()), (Symbol::Beam, "its beam to -3 dB, one way".to_owned())];
    for name in names {
        let symbol = if name == "open" { Symbol::Open } else { Symbol::Area(material_ink(scene, name)) };
        all.push((symbol, name.replace('_', " ")));
    }
    if file.furniture.iter().any(|f| f.material.is_none()) {
        all.push((Symbol::Area(NO_MATERIAL), "furniture by its cross-section".to_owned()));
    }
    if !(file.seat.is_empty() && file.bed.is_empty()) {
        all.push((Symbol::Rest, "place to sit or lie".to_owned()));
    }
    let mut heights_m: BTreeMap<usize, [f64; 2]> = BTreeMap::new();
    for &(slot, height_m) in people {
        let [least, most] = heights_m.entry(slot).or_insert([height_m; 2]);
        (*least, *most) = (least.min(height_m), most.max(height_m));
    }
    for (slot, heights_m) in heights_m {
        let [least, most] = heights_m.map(|height_m| format!("{height_m:.2}"));
        let tall = if least == most { most } else { format!("{least} to {most}") };
        all.push((Symbol::Trajectory(person_ink(slot)), format!("person {slot}, {tall} m tall")));
    }
    all
}

/// Splits the legend into rows of a width, pixels.
pub(super) fn legend_rows(legend: &[(Symbol, String)], width: f64) -> Vec<Vec<(&Symbol, &str)>> {
    let mut rows: Vec<Vec<(&Symbol, &str)>> = vec![Vec::new()];
    let mut x = LEFT;
    for (symbol, name) in legend {
        let needed = 30.0 + Letters::Small.size(name)[0] + 26.0;
        if x + needed > width && rows.last().is_some_and(|row| !row.is_empty()) {
            rows.push(Vec::new());
            x = LEFT;
        }
        if let Some(row) = rows.last_mut() {
            row.push((symbol, name.as_str()));
        }
        x += needed;
    }
    rows
}

/// Draws a symbol with its upper left corner at `[x, y]`.
pub(super) fn draw_symbol(canvas: &mut Canvas, [x, y]: Pixel, symbol: &Symbol) {
    let area = vec![[x, y + 2.0], [x + 22.0, y + 2.0], [x + 22.0, y + 14.0], [x, y + 14.0]];
    let line = |ink: Ink, width: f64, is_dashed: bool| Line { ink, width, is_dashed };
    match symbol {
        Symbol::Area(ink) => canvas.fill(&[area], *ink),
        Symbol::Open => canvas.outline(&[area], &line(GREY, 1.0, true)),
        Symbol::Beam => {
            canvas.fill(&[vec![[x, y + 8.0], [x + 22.0, y + 1.0], [x + 22.0, y + 15.0]]], BEAM.faint(0.35));
            canvas.line(&[[x, y + 8.0], [x + 22.0, y + 1.0]], &line(BEAM.darker(0.15), 1.4, true));
            canvas.line(&[[x, y + 8.0], [x + 22.0, y + 15.0]], &line(BEAM.darker(0.15), 1.4, true));
        }
        Symbol::Radar => {
            let arrow = vec![[x + 20.0, y + 8.0], [x + 4.0, y + 1.0], [x + 4.0, y + 15.0]];
            canvas.fill(std::slice::from_ref(&arrow), BEAM);
            canvas.outline(&[arrow], &line(INK, 1.6, false));
        }
        Symbol::Trajectory(ink) => {
            canvas.line(&[[x, y + 8.0], [x + 22.0, y + 8.0]], &line(*ink, 2.0, false));
            canvas.fill(&[vec![[x + 18.0, y + 8.0], [x + 8.0, y + 3.0], [x + 8.0, y + 13.0]]], *ink);
        }
        Symbol::Rest => {
            canvas.outline(&[circle([x + 6.0, y + 8.0], 4.0)], &line(INK, 1.6, false));
            canvas.line(&[[x + 6.0, y + 8.0], [x + 20.0, y + 8.0]], &line(INK, 1.6, false));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files;

    /// Regression test: numbers were those of arrival and not those of `scene paths`, and the fifth person had none.
    #[test]
    fn people_have_their_slots_as_numbers() {
        let scene = Scene::load(&files::fixture("scenes/corridor.toml").expect("a fixture")).expect("a scene");
        let people = [(5, 1.8), (2, 1.75), (0, 1.8), (1, 1.7), (0, 1.624), (3, 1.5)];
        let names: Vec<String> = legend(&scene, &people).into_iter().map(|(_, name)| name).collect();
        let expected = ["0, 1.62 to 1.80", "1, 1.70", "2, 1.75", "3, 1.50", "5, 1.80"];
        assert!(names.ends_with(&expected.map(|person| format!("person {person} m tall"))), "{names:?}");
    }
}
