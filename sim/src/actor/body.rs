//! A person's body as thirteen ellipsoids hung on joint angles.

use glam::{DMat3, DVec3};

use crate::field::highlight::Ellipsoid;

/// Ellipsoids of a body.
pub const SEGMENTS: usize = 13;
/// Index of the chest.
pub const CHEST: usize = 1;
/// Index of the pelvis.
pub const PELVIS: usize = 2;
/// Names of the segments, by index. Left and right of a limb are neighbours.
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

/// Joint angles and place of a body at one time. Flexion moves a limb forward; sides are left, right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Posture {
    /// Middle of the hips on the ground plan, m.
    pub position_m: [f64; 2],
    /// Where the body faces, from +x towards +y, rad.
    pub heading_rad: f64,
    /// Height of the hip joints above the floor, m.
    pub hip_height_m: f64,
    /// Trunk forward, rad.
    pub lean_rad: f64,
    /// Shoulders turned against hips, rad.
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
    /// Chest surface outward of its mean, by breath and heart, m.
    pub chest_m: f64,
}

/// Lengths of a body, m. Proportions follow Drillis and Contini's fractions of body height.
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

    /// Upright over the origin, facing +x, limbs hanging.
    pub fn standing(&self) -> Posture {
        Posture {
            position_m: [0.0; 2],
            heading_rad: 0.0,
            hip_height_m: self.standing_hip_height_m(),
            lean_rad: 0.0,
            twist_rad: 0.0,
            shoulder_rad: [0.0; 2],
            elbow_rad: [0.0; 2],
            hip_rad: [0.0; 2],
            knee_rad: [0.0; 2],
            ankle_rad: [0.0; 2],
            chest_m: 0.0,
        }
    }

    /// Length of a thigh, m.
    pub fn thigh_m(&self) -> f64 {
        0.245 * self.height_m
    }

    /// The ellipsoids for a posture, in the room.
    pub fn segments(&self, p: &Posture) -> [Ellipsoid; SEGMENTS] {
        let (h, g) = (self.height_m, self.girth);
        let heading = DMat3::from_rotation_z(p.heading_rad);
        let hips = DVec3::new(p.position_m[0], p.position_m[1], p.hip_height_m);
        // Pitching about the body's left axis: positive angles carry what points up forward.
        let trunk = heading * DMat3::from_rotation_y(p.lean_rad);
        let chest_frame = trunk * DMat3::from_rotation_z(p.twist_rad);
        let ellipsoid =
            |centre, axes, a: f64, b: f64, c: f64| Ellipsoid { centre, axes, semi_axes_m: DVec3::new(a, b, c) };
        let neck = hips + trunk * DVec3::Z * (0.288 * h);
        let mut all = [ellipsoid(hips, heading, 0.1, 0.1, 0.1); SEGMENTS];
        all[0] = ellipsoid(neck + trunk * DVec3::new(0.01, 0.0, 0.108 * h), trunk, 0.095, 0.078, 0.068 * h);
        all[1] =
            ellipsoid(hips + trunk * DVec3::Z * (0.190 * h), chest_frame, 0.115 * g + p.chest_m, 0.165 * g, 0.125 * h);
        all[2] = ellipsoid(hips + trunk * DVec3::Z * (0.035 * h), heading, 0.110 * g, 0.165 * g, 0.085 * h);
        for side in 0..2 {
            let left = if side == 0 { 1.0 } else { -1.0 };
            // A limb hangs along -z of a frame that flexion turns about the left axis.
            let hang = |base: DMat3, flexion: f64| base * DMat3::from_rotation_y(-flexion);
            let limb = |joint: DVec3, frame: DMat3, length: f64, thick: f64| {
                let centre = joint - frame * DVec3::Z * (0.5 * length);
                (ellipsoid(centre, frame, thick, thick, 0.5 * length + 0.3 * thick), joint - frame * DVec3::Z * length)
            };
            let shoulder = neck + chest_frame * DVec3::new(0.0, left * 0.112 * h, 0.0);
            let upper = hang(chest_frame, p.shoulder_rad[side]);
            let (segment, elbow) = limb(shoulder, upper, 0.186 * h, 0.047 * g);
            all[3 + side] = segment;
            let fore = hang(upper, p.elbow_rad[side]);
            let (segment, _) = limb(elbow, fore, 0.215 * h, 0.038 * g);
            all[5 + side] = segment;
            let hip = hips + heading * DVec3::new(0.0, left * 0.052 * h, 0.0);
            let thigh = hang(heading, p.hip_rad[side]);
            let (segment, knee) = limb(hip, thigh, self.thigh_m(), 0.075 * g);
            all[7 + side] = segment;
            let shank = hang(thigh, -p.knee_rad[side]);
            let (segment, ankle) = limb(knee, shank, 0.246 * h, 0.053 * g);
            all[9 + side] = segment;
            let foot = hang(shank, p.ankle_rad[side]);
            all[11 + side] =
                ellipsoid(ankle + foot * DVec3::new(0.05, 0.0, -0.02), foot, 0.075 * h, 0.028 * h, 0.022 * h);
        }
        all
    }
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
        assert!(all[7].centre.x > 0.1 && all[10].centre.x < -0.1 && all[4].centre.x > 0.05);
        assert!(all[3].centre.y > 0.15 && all[4].centre.y < -0.15, "left is +y when facing +x");
    }
}
