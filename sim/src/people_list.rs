//! Where people are in the frames of a scene: truth to compare trackers with.

use serde::Serialize;

use crate::simulator::{PersonState, Simulator};

/// Place and velocity of a person in a frame. They are those of the middle of the chest in the middle of the frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ListedPerson {
    /// Number of the frame.
    pub sequence: u64,
    /// Time of the frame's first sample, s.
    pub time_s: f64,
    /// Number of the person, from 0.
    pub person: usize,
    /// Whether any part of the body is in the room.
    pub in_room: bool,
    /// Place in the axes of the scene, m.
    pub position_m: [f64; 3],
    /// Velocity, m/s.
    pub velocity_m_per_s: [f64; 3],
    /// Distance from the radar, m.
    pub range_m: f64,
    /// Change of the distance, m/s.
    pub radial_velocity_m_per_s: f64,
    /// Azimuth from the radar's boresight, positive to the left, degrees.
    pub azimuth_deg: f64,
    /// Elevation from the radar's boresight plane, positive upwards, degrees.
    pub elevation_deg: f64,
}

impl Simulator {
    /// Lists the people in the middle of a frame, including people outside the room.
    pub fn listed_people(&self, frame: u64) -> Vec<ListedPerson> {
        let scene = self.scene();
        let listed = |person: PersonState| {
            let direction = scene.radar_from_world() * (person.position - scene.radar_position());
            ListedPerson {
                sequence: frame,
                time_s: frame as f64 * scene.waveform().frame_interval_s(),
                person: person.slot,
                in_room: person.in_room,
                position_m: person.position.to_array(),
                velocity_m_per_s: person.velocity.to_array(),
                range_m: person.range_m,
                radial_velocity_m_per_s: person.radial_speed_m_per_s,
                azimuth_deg: direction.y.atan2(direction.x).to_degrees(),
                elevation_deg: direction.z.atan2(direction.x.hypot(direction.y)).to_degrees(),
            }
        };
        self.people(frame).into_iter().map(listed).collect()
    }
}
