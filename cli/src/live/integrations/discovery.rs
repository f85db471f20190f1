//! Messages to Home Assistant: one device with all its entities in one retained message, and the states that those
//! entities read. For its "device discovery" see <https://www.home-assistant.io/integrations/mqtt/>.

use radome_driver::BoardIdentity;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::latest::SettledAnswer;

/// Age beyond which a state counts as unknown, s.
pub const EXPIRES_AFTER_S: u64 = 30;

/// Identity of a radar without a name from the board or the user.
const UNNAMED: &str = "radome";

/// Radar as a Home Assistant device, with its topics.
#[derive(Debug, Clone)]
pub struct Device {
    /// Display name.
    name: String,
    /// Unique identity, stable across restarts: the board's own identity, or the name.
    id: String,
    /// Whether that identity is the board's own.
    pub has_uuid: bool,
    model: String,
    manufacturer: &'static str,
    firmware: Option<String>,
    discovery_prefix: String,
    /// Whether reports of wrong answers are accepted.
    accepts_reports: bool,
}

/// Buttons of the device, with which a user reports a wrong answer.
const REPORTS: [(&str, &str); 3] =
    [("empty", "Report false alarm"), ("one", "Report one person"), ("two", "Report two people")];

impl Device {
    /// Creates the device of a board, or of a name where the board has no identity.
    pub fn new(
        board: Option<&BoardIdentity>,
        name: Option<&str>,
        discovery_prefix: &str,
        accepts_reports: bool,
    ) -> Self {
        let uuid = board.map(|board| board.uuid.as_str()).filter(|uuid| uuid.contains(|c| c != '0'));
        let id = uuid.map_or_else(|| slug(name.unwrap_or(UNNAMED)), slug);
        Device {
            name: name.unwrap_or("Radar").to_owned(),
            id,
            has_uuid: uuid.is_some(),
            model: board.map_or("BGT60TR13C", |board| board.chip.as_str()).to_owned(),
            manufacturer: "Infineon",
            firmware: board.map(|board| board.firmware_version.clone()),
            discovery_prefix: discovery_prefix.trim_matches('/').to_owned(),
            accepts_reports,
        }
    }

    /// Client identifier at the broker. It is the same after a restart, so that the broker drops the previous
    /// connection.
    pub fn client_id(&self) -> String {
        format!("radome-{}", self.id)
    }

    /// Topic of the availability, `online` or `offline`, retained.
    pub fn availability_topic(&self) -> String {
        format!("radome/{}/availability", self.id)
    }

    /// Topic of [`state`], retained.
    pub fn state_topic(&self) -> String {
        format!("radome/{}/state", self.id)
    }

    /// Topic of reports; their payload is the name of the correct class.
    pub fn report_topic(&self) -> Option<String> {
        self.accepts_reports.then(|| format!("radome/{}/report", self.id))
    }

    /// Topic where the hub reports that it is online.
    pub fn hub_topic(&self) -> String {
        format!("{}/status", self.discovery_prefix)
    }

    /// Topics that the radar subscribes to.
    pub fn subscribed_topics(&self) -> Vec<String> {
        std::iter::once(self.hub_topic()).chain(self.report_topic()).collect()
    }

    /// Topic where the hub searches for devices.
    pub fn discovery_topic(&self) -> String {
        format!("{}/device/bgt60_{}/config", self.discovery_prefix, self.id)
    }

    pub fn discovery(&self) -> Value {
        let version = env!("CARGO_PKG_VERSION");
        let unique = |what: &str| format!("bgt60_{}_{what}", self.id);
        let mut components = json!({
            "occupancy": {
                "p": "binary_sensor", "name": "Occupancy", "dev_cla": "occupancy", "uniq_id": unique("occupancy"),
                "val_tpl": "{{ 'ON' if value_json.count > 0 else 'OFF' }}", "exp_aft": EXPIRES_AFTER_S,
            },
            "count": {
                "p": "sensor", "name": "People", "uniq_id": unique("count"), "stat_cla": "measurement",
                "unit_of_meas": "people", "val_tpl": "{{ value_json.count }}", "exp_aft": EXPIRES_AFTER_S,
            },
            "confidence": {
                "p": "sensor", "name": "Confidence", "ent_cat": "diagnostic", "uniq_id": unique("confidence"),
                "stat_cla": "measurement", "unit_of_meas": "%",
                "val_tpl": "{{ (value_json.confidence*100)|round(0) }}",
            },
            "dropped": {
                "p": "sensor", "name": "Dropped frames", "ent_cat": "diagnostic", "uniq_id": unique("dropped"),
                "stat_cla": "total_increasing", "val_tpl": "{{ value_json.dropped_frames }}",
            },
        });
        for (class, name) in REPORTS {
            let component = format!("report_{class}");
            components[&component] = match self.report_topic() {
                Some(topic) => json!({
                    "p": "button", "name": name, "ent_cat": "diagnostic", "uniq_id": unique(&component),
                    "cmd_t": topic, "pl_prs": class,
                }),
                // The hub removes a component of an earlier run if it is sent with its platform alone.
                None => json!({ "p": "button" }),
            };
        }
        // The hub shows `sw` as the firmware of the device, and the origin `o` as the program that publishes for it.
        let firmware = self.firmware.as_deref().unwrap_or(version);
        json!({
            "dev": {
                "ids": [format!("bgt60_{}", self.id)],
                "name": self.name, "mf": self.manufacturer, "mdl": self.model, "sw": firmware,
            },
            "o": { "name": "radome", "sw": version },
            "avty_t": self.availability_topic(),
            "stat_t": self.state_topic(),
            "cmps": components,
        })
    }
}

/// Message with the state that all entities read.
pub fn state(answer: &SettledAnswer, dropped_frames: u64) -> Value {
    json!({
        "occupancy": if answer.people > 0 { "ON" } else { "OFF" },
        "count": answer.people,
        "confidence": (f64::from(answer.confidence()) * 1e3).round() / 1e3,
        "dropped_frames": dropped_frames,
    })
}

/// Converts a text for topics and ids: lower-case letters, digits and `_`. A text with characters outside ASCII ends with a
/// hash, since these characters all become `_`.
fn slug(name: &str) -> String {
    const LONGEST: usize = 64;
    let mut text: String = name
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' })
        .take(LONGEST)
        .collect();
    if !name.is_ascii() {
        let hash = Sha256::digest(name.to_lowercase());
        let hash: String = hash.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
        text.truncate(LONGEST - 1 - hash.len());
        text += &format!("_{hash}");
    }
    if text.is_empty() { UNNAMED.to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn board(uuid: &str) -> BoardIdentity {
        BoardIdentity {
            name: "MCU7".into(),
            vendor_id: 0x058B,
            product_id: 0x0251,
            firmware_version: "2.6.0".into(),
            extended_version: String::new(),
            protocol_version: "4.0".into(),
            uuid: uuid.into(),
            chip: "BGT60TR13C".into(),
            chip_id: 0x303,
        }
    }

    #[test]
    fn a_board_is_identified_by_its_identity_and_anything_else_by_its_name() {
        let device = Device::new(Some(&board("00ab")), Some("Bedroom radar"), "homeassistant", false);
        assert_eq!(device.discovery_topic(), "homeassistant/device/bgt60_00ab/config");
        assert_eq!(device.discovery()["dev"]["name"], "Bedroom radar");
        assert_eq!(device.discovery()["dev"]["sw"], "2.6.0");
        assert_eq!(device.discovery()["o"]["sw"], env!("CARGO_PKG_VERSION"));
        assert_eq!(device.discovery()["cmps"]["report_empty"], json!({ "p": "button" }), "that of an earlier run goes");
        let device = Device::new(Some(&board("0000")), Some("Kitchen #1/+"), "homeassistant", true);
        assert_eq!(device.state_topic(), "radome/kitchen__1__/state", "no wildcard may stand in a topic");
        assert_eq!(device.discovery()["cmps"]["report_empty"]["pl_prs"], "empty");
    }

    /// Regression test: names of equal length outside ASCII had the same identity.
    #[test]
    fn names_in_any_letters_have_an_identity_each() {
        let topics =
            ["Küche", "Kôche", "寝室", "台所"].map(|name| Device::new(None, Some(name), "h", false).state_topic());
        for (index, topic) in topics.iter().enumerate() {
            assert!(!topics[..index].contains(topic), "{topics:?}");
            let id = topic.trim_start_matches("radome/").trim_end_matches("/state");
            assert!(id.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_'), "{id}");
        }
        assert!(topics[0].starts_with("radome/k_che_"), "{}", topics[0]);
        assert_eq!(slug("KÜCHE"), slug("Küche"), "letters count, and not their case");
        assert_eq!((slug(&"ü".repeat(99)).len(), slug(&"u".repeat(99)).len()), (64, 64));
    }

    #[test]
    fn occupancy_and_count_come_from_one_number() {
        let answer = |people| SettledAnswer { probabilities: [0.1, 0.7, 0.2], people };
        let state = |people| state(&answer(people), 3);
        assert_eq!(state(0)["occupancy"], "OFF");
        assert_eq!((state(1)["occupancy"].as_str(), state(1)["confidence"].as_f64()), (Some("ON"), Some(0.7)));
        assert_eq!((state(2)["count"].as_u64(), state(2)["dropped_frames"].as_u64()), (Some(2), Some(3)));
    }
}
