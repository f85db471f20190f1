//! Colours and shapes that a picture of a scene and its legend share.

use radome_sim::Scene;
use radome_sim::material::Material;

use super::canvas::{Ink, Pixel};

/// Colour of text and outlines.
pub(super) const INK: Ink = Ink::solid([40, 44, 52]);
/// Colour of notes and axes.
pub(super) const GREY: Ink = Ink::solid([120, 126, 136]);
/// Colour of the radar and its beam.
pub(super) const BEAM: Ink = Ink::solid([240, 180, 30]);
/// Colours of people, by their slots.
const PEOPLE: [Ink; 8] = [
    Ink::solid([31, 90, 180]),
    Ink::solid([196, 58, 58]),
    Ink::solid([34, 128, 84]),
    Ink::solid([132, 70, 160]),
    Ink::solid([0, 140, 160]),
    Ink::solid([170, 100, 20]),
    Ink::solid([214, 96, 160]),
    Ink::solid([110, 125, 30]),
];
/// Colours of paths that people affect, and of other paths.
pub(super) const MOVING: Ink = Ink::solid([200, 30, 90]);
pub(super) const STATIC: Ink = Ink::solid([60, 70, 90]);
/// Colour of furniture that has no material.
pub(super) const NO_MATERIAL: Ink = Ink::solid([176, 180, 188]);

/// Colours of materials that a scene defines.
const CUSTOM_MATERIALS: [[u8; 3]; 5] =
    [[134, 180, 92], [222, 128, 160], [110, 190, 180], [230, 160, 70], [150, 130, 210]];

/// Margin to the left of each view, for numbers, pixels.
pub(super) const LEFT: f64 = 66.0;

/// Colour of a built-in material; `None` for an open side.
fn colour(material: Material) -> Option<[u8; 3]> {
    Some(match material {
        Material::Concrete => [128, 132, 138],
        Material::Brick => [178, 84, 62],
        Material::Plasterboard => [214, 200, 172],
        Material::Wood => [166, 112, 58],
        Material::Glass => [98, 184, 222],
        Material::CeilingBoard => [190, 178, 222],
        Material::Chipboard => [204, 158, 92],
        Material::Plywood => [224, 186, 120],
        Material::Marble => [160, 196, 186],
        Material::Floorboard => [126, 84, 44],
        Material::Metal => [62, 78, 104],
        Material::Open => return None,
    })
}

pub(super) fn material_ink(scene: &Scene, material: &str) -> Ink {
    if let Some(rgb) = Material::named(material).and_then(colour) {
        return Ink::solid(rgb);
    }
    let own = scene.file().materials.keys().position(|name| name == material).unwrap_or(0);
    Ink::solid(CUSTOM_MATERIALS[own % CUSTOM_MATERIALS.len()])
}

/// Colour of the person with this slot.
pub(super) fn person_ink(slot: usize) -> Ink {
    PEOPLE[slot % PEOPLE.len()]
}

/// Approximates a circle by a polygon, pixels.
pub(super) fn circle([x, y]: Pixel, radius: f64) -> Vec<Pixel> {
    (0..24)
        .map(|i| (f64::from(i) * std::f64::consts::TAU / 24.0).sin_cos())
        .map(|(s, c)| [x + radius * c, y + radius * s])
        .collect()
}
