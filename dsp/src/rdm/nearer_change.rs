//! Change nearer than the motion, by which a map shows somebody who sits or stands while somebody else walks behind.

/// Level of strong change: up to the first value it does not count as that of a person, from the second on it does, dB over noise.
/// A person who has just left a place leaves weaker change.
const CHANGE_DB: [f32; 2] = [33.0, 42.0];
/// Level of the strongest moving cell, dB over noise: up to the first value it may be noise or an echo of the standing person, from the
/// second on it is the motion of another person.
const MOTION_DB: [f32; 2] = [14.0, 26.0];
/// Level of change less that of the strongest moving cell, dB: up to the first value it counts as change of the same person, from the
/// second on as that of another person.
const CHANGE_OVER_MOTION_DB: [f32; 2] = [-10.0, 0.0];

/// Returns 1 where change is that of a second person nearer than a person who walks, 0 where it is not, and values between.
///
/// `change_db` is the strongest change nearer than the strongest moving cell, and `motion_db` the level of this cell, dB over noise.
/// The levels were chosen on simulated rooms.
pub fn nearer_change(change_db: f32, motion_db: f32) -> f64 {
    ramp(CHANGE_DB, change_db) * ramp(CHANGE_OVER_MOTION_DB, change_db - motion_db) * ramp(MOTION_DB, motion_db)
}

/// 0 up to the first level, 1 from the second on, and linear between.
fn ramp([none_db, all_db]: [f32; 2], level_db: f32) -> f64 {
    f64::from(((level_db - none_db) / (all_db - none_db)).clamp(0.0, 1.0))
}
