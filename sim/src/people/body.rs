//! A person's body: thirteen ellipsoids placed by joint angles.

use glam::{DMat3, DVec3};

use crate::em::specular::Ellipsoid;

/// Number of ellipsoids of a body.
pub const SEGMENTS: usize = 13;
/// Index of the head.
pub const HEAD: usize = 0;
/// Index of the chest.
pub const CHEST: usize = 1;
/// Index of the pelvis.
pub const PELVIS: usize = 2;
/// Index of the left upper arm; the right one follows.
pub const UPPER_ARM: usize = 3;
/// Index of the left forearm; the right one follows.
pub const FOREARM: usize = 5;
/// Index of the left thigh; the right one follows.
pub const THIGH: usize = 7;
/// Index of the left shank; the right one follows.
pub const SHANK: usize = 9;
/// Index of the left foot; the right one follows.
pub const FOOT: usize = 11;
/// Names of the segments, by index. The left and right segments of a limb have consecutive indices.
pub const SEGMENT_NAMES: [&str; SEGMENTS] = [
    "head",
    "chest",
    "pelvis",
    "upper_arm_left",
    "upper_arm_right",
    "forearm_left",
    "forearm_right",
    "thigh_left",
    "thigh_right",
    "shank_left",
    "shank_right",
    "foot_left",
    "foot_right",
];

/// Joint angles and position of a body at one time. Flexion moves a limb forward; arrays of two are `[left, right]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Posture {
    /// Middle of the hips on the ground plan, m.
    pub position_m: [f64; 2],
    /// Direction that the body faces, from +x towards +y, rad.
    pub heading_rad: f64,
    /// Height of the hip joints above the floor, m.
    pub hip_height_m: f64,
    /// Forward lean of the trunk, rad.
    pub lean_rad: f64,
    /// Forward tilt of the pelvis, rad. It is 0 unless the person lies.
    pub pelvis_rad: f64,
    /// Rotation of the shoulders relative to the hips, rad.
    pub twist_rad: f64,
    /// Shoulder flexion, rad.
    pub shoulder_rad: [f64; 2],
    /// Elbow flexion, rad.
    pub elbow_rad: [f64; 2],
    /// Hip flexion, rad.
    pub hip_rad: [f64; 2],
    /// Knee flexion (bends backward), rad.
    pub knee_rad: [f64; 2],
    /// Foot pitch, toes up, rad.
    pub ankle_rad: [f64; 2],
    /// Tilt of both legs to the left of the hips, rad. Only lateral sway makes it differ from 0.
    pub legs_left_rad: f64,
    /// Displacement of the chest surface outward of its mean, by breath and heart, m.
    pub chest_m: f64,
}

/// Orientations of a body's parts at one time: x forward, y left, z up in each part's frame. Limbs point along -z.
/// Arrays of two are `[left, right]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orientations {
    /// Middle of the hips, m.
    pub hips: DVec3,
    /// Orientation of the pelvis.
    pub pelvis: DMat3,
    /// Orientation of the trunk, from the hips to the neck.
    pub trunk: DMat3,
    /// Orientation of the chest: that of the trunk, rotated by the twist.
    pub chest: DMat3,
    /// Orientation of the head.
    pub head: DMat3,
    /// Orientations of the upper arms.
    pub upper_arm: [DMat3; 2],
    /// Orientations of the forearms.
    pub forearm: [DMat3; 2],
    /// Orientations of the thighs.
    pub thigh: [DMat3; 2],
    /// Orientations of the shanks.
    pub shank: [DMat3; 2],
    /// Orientations of the feet: x points towards the toes.
    pub foot: [DMat3; 2],
    /// Displacement of the chest surface outward of its mean, by breath and heart, m.
    pub chest_m: f64,
}

/// Size of a body. Proportions follow Drillis and Contini's fractions of body height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Build {
    /// Body height, m.
    pub height_m: f64,
    /// Factor on all thicknesses; 1 is average.
    pub girth: f64,
}

impl Build {
    /// Height of the hip joints when standing, m.
    pub fn standing_hip_height_m(&self) -> f64 {
        0.530 * self.height_m
    }

    /// Posture of a body that stands upright over the origin and faces +x, with hanging limbs.
    pub fn standing(&self) -> Posture {
        Posture {
            position_m: [0.0; 2],
            heading_rad: 0.0,
            hip_height_m: self.standing_hip_height_m(),
            lean_rad: 0.0,
            pelvis_rad: 0.0,
            twist_rad: 0.0,
            shoulder_rad: [0.0; 2],
            elbow_rad: [0.0; 2],
            hip_rad: [0.0; 2],
            knee_rad: [0.0; 2],
            ankle_rad: [0.0; 2],
            legs_left_rad: 0.0,
            chest_m: 0.0,
        }
    }

    /// Length of a thigh, m.
    pub fn thigh_m(&self) -> f64 {
        0.245 * self.height_m
    }

    /// Length of a shank, m.
    pub fn shank_m(&self) -> f64 {
        0.246 * self.height_m
    }

    /// Height of the ankles when standing, m.
    pub fn ankle_height_m(&self) -> f64 {
        self.standing_hip_height_m() - self.thigh_m() - self.shank_m()
    }

    /// Returns the ellipsoids for a posture, in room coordinates.
    pub fn segments(&self, posture: &Posture) -> [Ellipsoid; SEGMENTS] {
        self.ellipsoids(&posture.orientations())
    }

    /// Returns the ellipsoids for given orientations of the parts, in room coordinates.
    pub fn ellipsoids(&self, orientations: &Orientations) -> [Ellipsoid; SEGMENTS] {
        let (h, g) = (self.height_m, self.girth);
        let &Orientations { hips, pelvis, trunk, chest, .. } = orientations;
        let ellipsoid =
            |centre, axes, a: f64, b: f64, c: f64| Ellipsoid { centre, axes, semi_axes_m: DVec3::new(a, b, c) };
        let neck = hips + trunk * DVec3::Z * (0.288 * h);
        let mut ellipsoids = [ellipsoid(hips, pelvis, 0.1, 0.1, 0.1); SEGMENTS];
        ellipsoids[HEAD] = ellipsoid(
            neck + orientations.head * DVec3::new(0.01, 0.0, 0.108 * h),
            orientations.head,
            0.095,
            0.078,
            0.068 * h,
        );
        ellipsoids[CHEST] = ellipsoid(
            hips + trunk * DVec3::Z * (0.190 * h),
            chest,
            0.115 * g + orientations.chest_m,
            0.165 * g,
            0.125 * h,
        );
        ellipsoids[PELVIS] = ellipsoid(hips + trunk * DVec3::Z * (0.035 * h), pelvis, 0.110 * g, 0.165 * g, 0.085 * h);
        for side in 0..2 {
            let to_left = if side == 0 { 1.0 } else { -1.0 };
            // A limb hangs along -z of its frame.
            let limb = |joint: DVec3, frame: DMat3, length: f64, thick: f64| {
                let centre = joint - frame * DVec3::Z * (0.5 * length);
                (ellipsoid(centre, frame, thick, thick, 0.5 * length + 0.3 * thick), joint - frame * DVec3::Z * length)
            };
            let shoulder = neck + chest * DVec3::new(0.0, to_left * 0.112 * h, 0.0);
            let (segment, elbow) = limb(shoulder, orientations.upper_arm[side], 0.186 * h, 0.047 * g);
            ellipsoids[UPPER_ARM + side] = segment;
            let (segment, _) = limb(elbow, orientations.forearm[side], 0.215 * h, 0.038 * g);
            ellipsoids[FOREARM + side] = segment;
            let hip = hips + pelvis * DVec3::new(0.0, to_left * 0.052 * h, 0.0);
            let (segment, knee) = limb(hip, orientations.thigh[side], self.thigh_m(), 0.075 * g);
            ellipsoids[THIGH + side] = segment;
            let (segment, ankle) = limb(knee, orientations.shank[side], self.shank_m(), 0.053 * g);
            ellipsoids[SHANK + side] = segment;
            let foot = orientations.foot[side];
            ellipsoids[FOOT + side] =
                ellipsoid(ankle + foot * DVec3::new(0.05, 0.0, -0.02), foot, 0.075 * h, 0.028 * h, 0.022 * h);
        }
        ellipsoids
    }
}

impl Posture {
    /// Returns the orientation of every part.
    pub fn orientations(&self) -> Orientations {
        let heading = DMat3::from_rotation_z(self.heading_rad);
        // Pitch is about the body's left axis: a positive angle tilts an upward direction forward.
        let trunk = heading * DMat3::from_rotation_y(self.lean_rad);
        let chest = trunk * DMat3::from_rotation_z(self.twist_rad);
        // Flexion rotates a limb about the left axis.
        let flexed = |base: DMat3, flexion: f64| base * DMat3::from_rotation_y(-flexion);
        let upper_arm = self.shoulder_rad.map(|flexion| flexed(chest, flexion));
        let legs =
            if self.legs_left_rad == 0.0 { heading } else { heading * DMat3::from_rotation_x(self.legs_left_rad) };
        let thigh = self.hip_rad.map(|flexion| flexed(legs, flexion));
        let shank = std::array::from_fn(|side| flexed(thigh[side], -self.knee_rad[side]));
        Orientations {
            hips: DVec3::new(self.position_m[0], self.position_m[1], self.hip_height_m),
            pelvis: if self.pelvis_rad == 0.0 { heading } else { heading * DMat3::from_rotation_y(self.pelvis_rad) },
            trunk,
            chest,
            head: trunk,
            upper_arm,
            forearm: std::array::from_fn(|side| flexed(upper_arm[side], self.elbow_rad[side])),
            thigh,
            shank,
            foot: std::array::from_fn(|side| flexed(shank[side], self.ankle_rad[side])),
            chest_m: self.chest_m,
        }
    }
}

/// Half the extent of an ellipsoid along the room's axes, m.
pub fn half_extent(e: &Ellipsoid) -> DVec3 {
    let rows = (e.axes * DMat3::from_diagonal(e.semi_axes_m)).transpose();
    DVec3::new(rows.x_axis.length(), rows.y_axis.length(), rows.z_axis.length())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_standing_body_reaches_from_the_floor_to_its_height() {
        let build = Build { height_m: 1.8, girth: 1.0 };
        let all = build.segments(&build.standing());
        let top = all.iter().map(|s| s.surface(DVec3::Z).z).fold(0.0, f64::max);
        let bottom = all.iter().map(|s| s.surface(-DVec3::Z).z).fold(9.0, f64::min);
        assert!((top - 1.8).abs() < 0.06, "{top}");
        assert!(bottom.abs() < 0.06, "{bottom}");
    }

    #[test]
    fn flexion_carries_limbs_forward_and_knees_bend_backward() {
        let build = Build { height_m: 1.8, girth: 1.0 };
        let mut posture = build.standing();
        posture.hip_rad = [0.5, 0.0];
        posture.knee_rad = [0.0, 0.8];
        posture.shoulder_rad = [0.0, 0.4];
        let all = build.segments(&posture);
        assert!(all[THIGH].centre.x > 0.1 && all[SHANK + 1].centre.x < -0.1 && all[UPPER_ARM + 1].centre.x > 0.05);
        assert!(all[UPPER_ARM].centre.y > 0.15 && all[UPPER_ARM + 1].centre.y < -0.15, "left is +y when facing +x");
    }
}
