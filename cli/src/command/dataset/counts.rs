//! Output of the number of maps of a dataset.

use radome_dsp::Occupancy;
use serde_json::json;

use crate::dataset::build::Built;
use crate::output;
use crate::shard::Shard;

/// Prints the number of maps of a built or merged dataset.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(built: &Built, shard: Option<Shard>, as_json: bool) -> anyhow::Result<()> {
    let Built { folder, units, found, counts } = built;
    let [empty, one, two] = counts.classes;
    let maps = empty + one + two;
    let name = folder.display().to_string();
    if as_json {
        return output::json_line(&json!({
            "dataset": name, "maps": maps, "empty": empty, "one": one, "two": two, "transitions": counts.transitions,
            "shard": shard.map(|s| s.to_string()), "units": units, "units_found": found,
        }));
    }
    let classes = Occupancy::ALL.map(|class| format!("{} {class}", counts.classes[class.index()])).join(", ");
    output::text_line(&format!("{name}: {maps} maps, {classes}, {} of them in transition", counts.transitions))
}
