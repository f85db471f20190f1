//! Reports of simulated frames.

use glam::DVec3;

/// Place of a person in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonState {
    /// Slot: the same person keeps it over a visit.
    pub slot: usize,
    /// Middle of the chest, m, in the room.
    pub position: DVec3,
    /// Its velocity, m/s.
    pub velocity: DVec3,
    /// Distance from the radar, m.
    pub range_m: f64,
    /// Radial speed, positive receding, m/s.
    pub radial_speed_m_per_s: f64,
    /// Whether any part is in the room.
    pub in_room: bool,
}

/// Cost of making a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameReport {
    /// Static paths.
    pub static_paths: usize,
    /// Moving paths that were evaluated at the keys.
    pub traced_paths: usize,
    /// Those of them that are strong enough to be heard, and so were synthesised.
    pub moving_paths: usize,
    /// Key times, of the path that took the most.
    pub keys: usize,
    /// Estimated error of interpolation between keys, relative to the echoes, rms by power.
    pub between_keys: f64,
    /// Estimated error of the strongest way's echoes where people have skins, dB; `None` where they are ellipsoids, whose
    /// specular points are closed forms.
    pub estimate_db: Option<f64>,
    /// Amplitudes clamped because an antenna was nearer than 10 cm, or inside a body.
    pub clamped: usize,
    /// Codes at either end of the ADC.
    pub clipped: usize,
}
