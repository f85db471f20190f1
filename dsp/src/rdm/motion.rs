//! Motion of echoes over the last frames, as numbers.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Motion of echoes over the last frames.
///
/// The first six quantities are averages of comparisons of frames, with weights that fall exponentially with age. The last one is change
/// nearer than the motion, which is held for a while. All are 0, the default, where nothing has moved.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// Change of the distances between echoes: angle between the autocorrelations of two range profiles as vectors, 0 to pi/2 rad.
    pub spacing_change_rad: f32,
    /// Difference between the shift of the range profile and the way by the Doppler of the strongest cells, m.
    pub shift_error_m: f32,
    /// Difference between the way of the nearest echo and that by its Doppler, m.
    pub nearest_error_m: f32,
    /// Change of the distance between the nearest echo and the strongest one behind it, m.
    pub separation_change_m: f32,
    /// Share of the frames that have an echo behind the nearest one, 0 to 1.
    pub second_share: f32,
    /// Difference between the velocities of the nearest echo and the strongest one behind it, m/s; 0 in frames with one echo.
    pub velocity_difference_m_per_s: f32,
    /// Change nearer than the motion, as of somebody who sits while another person walks behind, 0 to 1: the largest of the last frames,
    /// where earlier ones count less. 0 in maps without change.
    pub nearer_change: f32,
}

impl Motion {
    /// Number of quantities.
    pub const QUANTITIES: usize = 7;

    /// The quantities in the order of their declaration.
    pub fn to_array(self) -> [f32; Self::QUANTITIES] {
        [
            self.spacing_change_rad,
            self.shift_error_m,
            self.nearest_error_m,
            self.separation_change_m,
            self.second_share,
            self.velocity_difference_m_per_s,
            self.nearer_change,
        ]
    }

    /// The inverse of [`Motion::to_array`].
    pub fn from_array(quantities: [f32; Self::QUANTITIES]) -> Self {
        let [
            spacing_change_rad,
            shift_error_m,
            nearest_error_m,
            separation_change_m,
            second_share,
            velocity_difference_m_per_s,
            nearer_change,
        ] = quantities;
        Motion {
            spacing_change_rad,
            shift_error_m,
            nearest_error_m,
            separation_change_m,
            second_share,
            velocity_difference_m_per_s,
            nearer_change,
        }
    }
}
