//! Reports of simulated frames.

use glam::DVec3;

/// State of a person in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonState {
    /// Slot, which a person keeps over a visit.
    pub slot: usize,
    /// Middle of the chest, m, in the room.
    pub position: DVec3,
    /// Velocity of the middle of the chest, m/s.
    pub velocity: DVec3,
    /// Distance from the radar, m.
    pub range_m: f64,
    /// Radial speed, positive receding, m/s.
    pub radial_speed_m_per_s: f64,
    /// Whether any part of the body is in the room.
    pub in_room: bool,
}

/// Counters and error estimates of a simulated frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameReport {
    /// Number of static paths.
    pub static_paths: usize,
    /// Number of moving paths that exceed the audibility threshold and were synthesised.
    pub moving_paths: usize,
    /// Estimated error of the strongest path's echoes where people have skins, dB; `None` where they are ellipsoids,
    /// whose specular points are closed forms.
    pub estimate_db: Option<f64>,
    /// Number of amplitudes clamped because an antenna was nearer than 10 cm, or inside a body.
    pub clamped: usize,
    /// Number of codes at either end of the ADC's range.
    pub clipped: usize,
}
