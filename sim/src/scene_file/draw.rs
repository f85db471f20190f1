//! Scenes that differ from seed to seed: values of any key, drawn from what the file's `[random]` table says.
//!
//! ```toml
//! [random]
//! "room.size_m" = { between = [[3.0, 3.0, 2.4], [8.0, 8.0, 3.0]] }
//! "room.floor.material" = { of = ["concrete", "floorboard"] }
//! "receiver.gain_correction_db" = { between = [-2.0, 2.0] }
//! ```
//!
//! A draw depends on the seed and on the key alone: another key in the table changes no other value.

use std::collections::BTreeMap;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::Deserialize;
use toml::{Table, Value};

use crate::random::{Purpose, generator};

/// Distribution of a key's value: exactly one of the two.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RandomFile {
    /// The least and the greatest value: numbers, each evenly drawn (whole ones where both are), or lists of as many.
    #[serde(default)]
    #[schemars(schema_with = "two_values")]
    pub between: Option<[Value; 2]>,
    /// Values of which each is as likely.
    #[serde(default)]
    #[schemars(schema_with = "values")]
    pub of: Option<Vec<Value>>,
}

fn two_values(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "minItems": 2, "maxItems": 2 })
}

fn values(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "minItems": 1 })
}

/// A key that cannot be drawn: which, what was found and what would do.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DrawError {
    pub(crate) key: String,
    pub(crate) found: String,
    pub(crate) expected: &'static str,
}

/// Choice of the place in its range at which every value is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Draw {
    /// By chance.
    Seed(u64),
    /// At the least value, or the first.
    Least,
    /// At the greatest, or the last.
    Greatest,
    /// At the least, and of listed values at the one with this index, or the last; of names of files at the first.
    Listed(usize),
}

/// Whether the values of a key are names of files, each of which takes long to read.
fn names_files(key: &str) -> bool {
    key == "receiver" || key.rsplit('.').next() == Some("file")
}

/// Number of values of the longest list of which each can be tried.
pub(crate) fn longest_list(random: &BTreeMap<String, RandomFile>) -> usize {
    let lists = random.iter().filter(|(key, _)| !names_files(key)).filter_map(|(_, from)| from.of.as_ref());
    lists.map(Vec::len).max().unwrap_or(0)
}

/// Keys that must be the same for all seeds, since frames of all of them go together.
const SAME_FOR_ALL_SEEDS: [&str; 4] = ["format", "name", "waveform", "random"];

/// A scene's table with every key of `random` drawn.
pub(crate) fn drawn(scene: &Table, random: &BTreeMap<String, RandomFile>, draw: Draw) -> Result<Table, DrawError> {
    let mut scene = scene.clone();
    scene.remove("random");
    for (key, from) in random {
        let draw_error = |found: String, expected| Err(DrawError { key: key.clone(), found, expected });
        if SAME_FOR_ALL_SEEDS.iter().any(|first_key| key.split('.').next() == Some(first_key)) {
            let expected = "a key under room, materials, radar, receiver, furniture, seat, bed, door or people";
            return draw_error(key.clone(), expected);
        }
        let seed = if let Draw::Seed(seed) = draw { seed } else { 0 };
        let mut source = ValueSource { draw, rng: generator(seed, Purpose::Scene, [hash(key), 0]) };
        let value = match (&from.between, &from.of) {
            (Some([low, high]), None) => match source.between(low, high) {
                Some(value) => value,
                None => {
                    return draw_error(
                        format!("[{low}, {high}]"),
                        "two numbers, or two lists of as many, low before high",
                    );
                }
            },
            (None, Some(values)) if !values.is_empty() => match draw {
                Draw::Listed(index) if !names_files(key) => values[index.min(values.len() - 1)].clone(),
                _ => values[source.index(values.len())].clone(),
            },
            (between, of) => {
                let found = match (between, of) {
                    (None, None) => "neither",
                    (None, Some(_)) => "of = []",
                    (Some(_), _) => "both",
                };
                return draw_error(found.to_owned(), "either `between = [low, high]` or `of = [...]`");
            }
        };
        if value_at_path(&mut scene, key).map(|place| *place = value).is_none() {
            return draw_error(
                key.clone(),
                "the path of a key, such as room.size_m or furniture.0.position_m, in a table that the file has",
            );
        }
    }
    Ok(scene)
}

/// Value to which a dotted path leads; its last key may be new.
fn value_at_path<'a>(scene: &'a mut Table, path: &str) -> Option<&'a mut Value> {
    let mut keys: Vec<&str> = path.split('.').collect();
    let last = keys.pop()?;
    let Some((&first, rest)) = keys.split_first() else {
        return scene.get_mut(last);
    };
    let mut parent = scene.get_mut(first)?;
    for key in rest {
        parent = match parent {
            Value::Array(items) => items.get_mut(key.parse::<usize>().ok()?)?,
            Value::Table(table) => table.get_mut(*key)?,
            _ => return None,
        };
    }
    match parent {
        Value::Array(items) => items.get_mut(last.parse::<usize>().ok()?),
        Value::Table(table) => Some(table.entry(last).or_insert(Value::Boolean(false))),
        _ => None,
    }
}

/// Source of the values of one key.
struct ValueSource {
    draw: Draw,
    rng: Xoshiro256PlusPlus,
}

impl ValueSource {
    /// A number of 0..1.
    fn fraction(&mut self) -> f64 {
        match self.draw {
            Draw::Seed(_) => self.rng.random(),
            Draw::Least | Draw::Listed(_) => 0.0,
            Draw::Greatest => 1.0,
        }
    }

    fn index(&mut self, count: usize) -> usize {
        ((self.fraction() * count as f64) as usize).min(count - 1)
    }

    fn between(&mut self, low: &Value, high: &Value) -> Option<Value> {
        match (low, high) {
            (Value::Integer(low), Value::Integer(high)) if low <= high => {
                let count = usize::try_from(high.checked_sub(*low)?.checked_add(1)?).ok()?;
                Some(Value::Integer(low + self.index(count) as i64))
            }
            (Value::Array(low), Value::Array(high)) if low.len() == high.len() => {
                low.iter().zip(high).map(|(low, high)| self.between(low, high)).collect::<Option<_>>().map(Value::Array)
            }
            _ => {
                let (low, high) = (finite_number(low)?, finite_number(high)?);
                (low <= high).then(|| Value::Float(low + (high - low) * self.fraction()))
            }
        }
    }
}

fn finite_number(value: &Value) -> Option<f64> {
    match value {
        Value::Float(number) => Some(*number).filter(|number| number.is_finite()),
        Value::Integer(number) => Some(*number as f64),
        _ => None,
    }
}

/// FNV-1a: the same on every machine and in every version.
fn hash(key: &str) -> u64 {
    key.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::{BTreeMap, Draw, RandomFile, drawn, longest_list};
    use crate::scene::{Scene, SceneError};

    const SCENE: &str = concat!(
        r#"
format = 1
name = "hall"

[room]
size_m = [4.0, 4.0, 2.5]
"#,
        include_str!("../scene/test_room.toml"),
        r#"
[radar]
position_m = [0.1, 1.5, 1.2]

[[furniture]]
name = "shelf"
position_m = [2.0, 0.1, 0.0]
size_m = [0.8, 0.3, 1.5]

[people]
[[people.actor]]
step = [{ walk_to_m = [2.0, 2.0] }]
"#
    );

    fn scene(random: &str) -> Result<Scene, SceneError> {
        Scene::parse(&format!("{SCENE}\n[random]\n{random}"), Path::new("hall.toml"))
    }

    #[test]
    fn a_seed_draws_the_same_values_within_the_ranges_every_time() {
        let all = scene(
            r#"
"room.size_m" = { between = [[3.0, 3.0, 2.4], [8.0, 8.0, 3.0]] }
"room.floor.material" = { of = ["concrete", "glass", "wood"] }
"furniture.0.points" = { between = [2, 5] }
"furniture.0.cross_section_dbsm" = { between = [-20, -5] }
"#,
        )
        .expect("a scene");
        let mut points = std::collections::BTreeSet::new();
        let mut floors = std::collections::BTreeSet::new();
        for seed in 0..200 {
            let drawn = all.drawn(seed).expect("a draw");
            let size = drawn.file().room.size_m;
            assert!((3.0..=8.0).contains(&size[0]) && (2.4..=3.0).contains(&size[2]) && size[0] != size[1]);
            assert_eq!(size, all.drawn(seed).expect("the same").file().room.size_m);
            let shelf = &drawn.file().furniture[0];
            assert!((-20.0..=-5.0).contains(&shelf.cross_section_dbsm()));
            points.insert(shelf.points);
            floors.insert(format!("{:?}", drawn.file().room.floor.material));
        }
        assert_eq!(points.into_iter().collect::<Vec<_>>(), [2, 3, 4, 5]);
        assert_eq!(floors.len(), 3);
        // Another key changes no other draw.
        let one = scene(r#""room.size_m" = { between = [[3.0, 3.0, 2.4], [8.0, 8.0, 3.0]] }"#).expect("a scene");
        assert_eq!(one.drawn(7).expect("one").file().room.size_m, all.drawn(7).expect("all").file().room.size_m);
    }

    /// Regression test: each reading of a scene read every file of a list.
    #[test]
    fn files_in_the_middle_of_a_list_are_not_read_in_advance() {
        let random = r#""receiver" = { of = ["none.toml", "absent.toml", "lost.toml"] }
"radar.tilt_down_deg" = { of = [0.0, 1.0, 2.0, 3.0] }"#;
        let random: BTreeMap<String, RandomFile> = toml::from_str(random).expect("a table");
        assert_eq!(longest_list(&random), 4);
        let mut table = toml::Table::new();
        table.insert("receiver".to_owned(), toml::Value::String("none.toml".to_owned()));
        table.insert("radar".to_owned(), toml::Value::Table(toml::Table::new()));
        let drawn = drawn(&table, &random, Draw::Listed(1)).expect("a draw");
        assert_eq!(drawn["receiver"].as_str(), Some("none.toml"));
        assert_eq!(drawn["radar"]["tilt_down_deg"].as_float(), Some(1.0));
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn an_invalid_draw_is_an_error_that_names_the_key_or_value() {
            let cases = [
                (r#""room.sise_m.0" = { between = [3.0, 8.0] }"#, "room.sise_m.0"),
                (r#""room.size_m" = { between = [[3.0, 3.0], [8.0, 8.0, 3.0]] }"#, "lists of as many"),
                (r#""room.size_m" = { between = [[8.0, 3.0, 3.0], [3.0, 8.0, 3.0]] }"#, "low before high"),
                (r#""radar.tilt_down_deg" = { of = [1.0], between = [0.0, 1.0] }"#, "either"),
                (r#""furniture.3.points" = { between = [1, 2] }"#, "furniture.3.points"),
                (r#""room.floor.material" = { of = ["concrete", "cheese"] }"#, "cheese"),
                (r#""room.floor.colour" = { of = ["red"] }"#, "colour"),
                (r#""room.floor.material" = { of = ["concrete", "cheese", "wood"] }"#, "cheese"),
                (
                    r#""room.floor.material" = { of = ["wood", "wood", "wood", "cheese", "wood"] }"#,
                    "number 4 of each list",
                ),
                (r#""radar.tilt_down_deg" = { of = [] }"#, "found of = [], expected either `between"),
                (
                    r#""waveform.if_gain_db" = { of = [30.0] }"#,
                    "a key under room, materials, radar, receiver, furniture, seat, bed",
                ),
                (r#""radar.position_m" = { between = [[0.1, 1.0, 1.0], [0.1, 9.0, 1.0]] }"#, "all the greatest"),
                (r#""radar.tilt_down_deg" = { between = [nan, 1.0] }"#, "numbers"),
            ];
            for (random, expected) in cases {
                let error = scene(random).expect_err(random).to_string();
                assert!(error.contains(expected) && error.starts_with("hall.toml"), "{random}: {error}");
            }
        }
    }
}
