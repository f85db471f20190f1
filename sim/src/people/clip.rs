//! Captured steps on the parametric body: the joints of a BVH clip rotate the thirteen segments. The segments keep the
//! body's own lengths.
//!
//! Only directions are taken from the clip: thighs from hips to knees, the trunk from hips to shoulders, and so on. The
//! sway of the hips about their mean motion is taken in proportion to the length of the legs. The unit and the
//! proportions of the clip's skeleton therefore do not matter. One cycle of two steps is cut out of the clip and made
//! periodic. Its phase advances with the ground covered.

use glam::{DMat3, DVec3};

use super::body::{Build, FOOT, Orientations, Posture, SEGMENTS};
use super::bvh::{Bvh, parse_bvh};
use super::cycle::{CYCLE_HINT, Cycle, FootSliding, Stance, Walk, best_cycle};
use super::skin::BoneMap;
use crate::em::specular::Ellipsoid;
use crate::file_error::FileError;
use crate::geometry::import::UpAxis;

/// Time between samples to which clips of a higher frame rate are thinned, s.
const SAMPLE_S: f64 = 1.0 / 60.0;
/// Shortest and longest cycle that is searched for, s.
const CYCLE_S: [f64; 2] = [0.7, 2.0];
/// Least number of samples of a cycle.
const LEAST_SAMPLES: usize = 16;
/// Upper limit of joints times samples. The time of the search for a cycle grows with this product.
const MOST_POSITIONS: usize = 1_000_000;
/// Least ground covered in a cycle, as a part of the legs' length. A clip with less does not walk.
const LEAST_TRAVEL: f64 = 0.3;
/// Number of parts of a body that have an orientation. They are the bones of the cycle.
const PARTS: usize = 14;
/// Index of the left foot among the parts; the right one follows.
const FOOT_PART: usize = 12;

/// Joint names that programs use, for each part of the body, without blanks, punctuation, and "left" or "right".
const THIGH_NAMES: &[&str] = &["upleg", "thigh", "upperleg", "femur", "hip"];
const SHANK_NAMES: &[&str] = &["leg", "shin", "calf", "lowerleg", "loleg", "tibia", "knee"];
const FOOT_NAMES: &[&str] = &["foot", "ankle"];
const TOE_NAMES: &[&str] = &["toebase", "toe", "toes", "ball"];
const UPPER_ARM_NAMES: &[&str] = &["arm", "upperarm", "uparm", "humerus", "shoulder"];
const FOREARM_NAMES: &[&str] = &["forearm", "lowerarm", "loarm", "radius", "elbow"];
const HAND_NAMES: &[&str] = &["wrist", "hand"];

/// One cycle of captured steps.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyClip {
    /// Orientations of the parts. The position of the first one is that of the hips. The body faces +x; the unit is the
    /// length of the legs.
    cycle: Cycle,
    /// Ground covered in a cycle, in units of the legs' length.
    travel: f64,
    /// Foot contact of a walking body of 1.75 m.
    stance: Stance,
    /// Begin and end of the cycle in the file, s.
    pub span_s: [f64; 2],
}

/// Indices of the joints on one side of the body.
struct SideJoints {
    thigh: usize,
    shank: usize,
    foot: usize,
    toe: usize,
    upper_arm: usize,
    forearm: usize,
    hand: usize,
}

impl BodyClip {
    /// Makes a clip from the text of a BVH file. `cycle_s` is the part of it that is one cycle of two steps; the cycle
    /// is searched for if absent. `up` is the axis that points up.
    ///
    /// # Errors
    /// [`FileError`] if the text is no BVH file, its skeleton has no two legs, or it holds no cycle of steps.
    pub fn parse(text: &str, up: UpAxis, cycle_s: Option<[f64; 2]>) -> Result<Self, FileError> {
        let bvh = parse_bvh(text)?;
        let sides = [side_joints(&bvh, "left", "l")?, side_joints(&bvh, "right", "r")?];
        let rest = positions_z_up(&bvh, up, None);
        let length = |a: usize, b: usize| rest[a].distance(rest[b]);
        let legs: [f64; 2] =
            [0, 1].map(|s| length(sides[s].thigh, sides[s].shank) + length(sides[s].shank, sides[s].foot));
        let leg = 0.5 * (legs[0] + legs[1]);
        if !(leg > 1e-6 && leg.is_finite()) {
            let hint = "check the OFFSETs of the joints of the legs: the skeleton may have been scaled to nothing";
            return Err(FileError::new("HIERARCHY", format!("its legs are {leg} long, expected a length"), hint));
        }
        let (positions, step_s) = sampled_positions(&bvh, up)?;
        let [begin, end] = find_cycle(&positions, step_s, cycle_s)?;
        let count = end - begin;
        let rest_pitch = sides.each_ref().map(|s| pitch(rest[s.toe] - rest[s.foot]));
        let mut poses = periodic_poses(&positions[begin..=end], &sides, rest_pitch, leg);
        // Contact is computed on a body of 1.75 m, in units of the length of its legs.
        let build = Build { height_m: 1.75, girth: 1.0 };
        let unit_m = leg_m(&build);
        let points = |cycle: &Cycle, count: usize| -> Vec<Vec<DVec3>> {
            (0..count)
                .map(|k| sole_points(&build, &from_maps(&cycle.at(k as f64 / count as f64), unit_m, 0.0)))
                .collect()
        };
        let stance = Stance::of(&points(&Cycle::through(&poses), count), build.height_m);
        if stance.travel_m.length() < LEAST_TRAVEL * unit_m {
            let problem = format!("feet push {:.2} m in the cycle, expected a walk", stance.travel_m.length());
            return Err(FileError::new("MOTION", problem, CYCLE_HINT));
        }
        // The body faces +x, and the soles rest on the floor.
        let ahead = DMat3::from_rotation_z(-stance.travel_m.y.atan2(stance.travel_m.x));
        for (pose, surge_m) in poses.iter_mut().zip(stance.surge_m()) {
            pose.iter_mut().for_each(|m| *m = BoneMap { centre: ahead * m.centre, linear: ahead * m.linear });
            if let Some(hips) = pose.first_mut() {
                hips.centre += (ahead * surge_m - DVec3::Z * stance.floor_m) / unit_m;
            }
        }
        for pose in &mut poses {
            lift_toes(&build, pose, unit_m);
        }
        let cycle = Cycle::through(&poses);
        let final_stance = Stance::of(&points(&cycle, 4 * count), build.height_m);
        Ok(BodyClip {
            cycle,
            travel: stance.travel_m.length() / unit_m,
            stance: final_stance.with_travel(DVec3::X * stance.travel_m.length()),
            span_s: [begin as f64 * step_s, end as f64 * step_s],
        })
    }

    /// Ground covered in a cycle of steps, m, by a body with this height of the hips.
    pub fn cycle_m(&self, hip_height_m: f64) -> f64 {
        self.travel * hip_height_m * LEG_OF_HIP_HEIGHT
    }

    /// Returns how much the feet slide over the floor at a walking speed.
    pub fn foot_sliding(&self, speed_m_per_s: f64) -> FootSliding {
        self.stance.sliding(speed_m_per_s)
    }

    /// Returns the ellipsoids of a walking body. `standing` is its posture when it stands at the same place.
    pub(super) fn body(&self, build: &Build, standing: &Posture, walk: &Walk) -> [Ellipsoid; SEGMENTS] {
        let standing = standing.orientations();
        if walk.intensity <= 0.0 {
            return build.ellipsoids(&standing);
        }
        let heading = DMat3::from_rotation_z(walk.heading_rad);
        let mut walking = from_maps(&self.cycle.at(walk.phase), leg_m(build), standing.chest_m).rotated(heading);
        walking.hips += DVec3::new(walk.position_m[0], walk.position_m[1], 0.0);
        build.ellipsoids(&standing.interpolated(&walking, walk.intensity))
    }
}

/// Length of the legs over the height of the hip joints: [`Build`]'s thigh plus shank over its hip height.
const LEG_OF_HIP_HEIGHT: f64 = (0.245 + 0.246) / 0.530;

fn leg_m(build: &Build) -> f64 {
    build.standing_hip_height_m() * LEG_OF_HIP_HEIGHT
}

/// Angular step between points on the underside of a foot, and index of the last point, at the ball of the foot. The
/// toes bend and are left out.
const SOLE_RAD: f64 = 0.17;
const BALL: i32 = 3;

/// Points of the soles that may touch the floor: along the underside of both feet, from the heel to the ball.
fn sole_points(build: &Build, orientations: &Orientations) -> Vec<DVec3> {
    let body = build.ellipsoids(orientations);
    let directions = (-8..=BALL).map(|i| (SOLE_RAD * f64::from(i)).sin_cos()).map(|(s, c)| DVec3::new(s, 0.0, -c));
    directions.flat_map(|direction| [body[FOOT].surface(direction), body[FOOT + 1].surface(direction)]).collect()
}

/// Rotates feet about the ankle until the toes are not below the floor, as real feet bend there.
fn lift_toes(build: &Build, pose: &mut [BoneMap], unit_m: f64) {
    for side in 0..2 {
        let rotated = |pose: &[BoneMap], angle: f64| {
            let mut orientations = from_maps(pose, unit_m, 0.0);
            orientations.foot[side] *= DMat3::from_rotation_y(-angle);
            orientations
        };
        let lowest_m = |angle: f64| {
            let foot = build.ellipsoids(&rotated(pose, angle))[FOOT + side];
            let directions = (-8..=8).map(|i| (SOLE_RAD * f64::from(i)).sin_cos());
            directions.map(|(s, c)| foot.surface(DVec3::new(s, 0.0, -c)).z).fold(f64::INFINITY, f64::min)
        };
        // The smallest rotation that lifts the foot off the floor, or that lifts it most.
        let angles = (0..=MOST_LIFTS).map(|i| LIFT_RAD * f64::from(i));
        let best = angles.max_by(|&a, &b| {
            let (below_a, below_b) = (lowest_m(a).min(0.0), lowest_m(b).min(0.0));
            below_a.total_cmp(&below_b).then(b.total_cmp(&a))
        });
        let orientations = rotated(pose, best.unwrap_or(0.0));
        if let Some(foot) = pose.get_mut(FOOT_PART + side) {
            foot.linear = orientations.foot[side];
        }
    }
}

/// Step of the rotation that lifts the toes, rad, and the largest number of steps.
const LIFT_RAD: f64 = 0.02;
const MOST_LIFTS: u32 = 40;

/// Returns the positions of the joints in a frame, z up. Without a frame, returns the rest pose.
fn positions_z_up(bvh: &Bvh, up: UpAxis, frame: Option<usize>) -> Vec<DVec3> {
    bvh.joint_positions(frame).into_iter().map(|p| up.to_z_up(p)).collect()
}

/// Returns the positions of the joints over a clip, and the time between samples, s.
fn sampled_positions(bvh: &Bvh, up: UpAxis) -> Result<(Vec<Vec<DVec3>>, f64), FileError> {
    let step = (SAMPLE_S / bvh.frame_time_s).floor().max(1.0) as usize;
    let (samples, joints) = (bvh.frames.len().div_ceil(step), bvh.joints.len());
    if samples.saturating_mul(joints) > MOST_POSITIONS {
        let problem = format!("{joints} joints over {samples} samples, expected {MOST_POSITIONS} places at most");
        return Err(FileError::new("MOTION", problem, "cut the clip to a minute in which somebody walks"));
    }
    let positions = (0..bvh.frames.len()).step_by(step).map(|f| positions_z_up(bvh, up, Some(f))).collect();
    Ok((positions, step as f64 * bvh.frame_time_s))
}

/// Returns the maps of the parts over a cycle, from its first sample to the last but one. The mean motion of the hips
/// is removed. The difference between both ends of the cycle is distributed over all samples.
fn periodic_poses(
    positions: &[Vec<DVec3>],
    sides: &[SideJoints; 2],
    rest_pitch: [f64; 2],
    leg: f64,
) -> Vec<Vec<BoneMap>> {
    let hips = |p: &[DVec3]| 0.5 * (p[sides[0].thigh] + p[sides[1].thigh]);
    let count = positions.len() - 1;
    let horizontal = DVec3::new(1.0, 1.0, 0.0);
    let drift = (hips(&positions[count]) - hips(&positions[0])) * horizontal;
    let phase = |k: usize| k as f64 / count as f64;
    let sway = |k: usize| hips(&positions[k]) - drift * phase(k);
    let centre = (0..count).map(sway).sum::<DVec3>() / count as f64 * horizontal;
    let pose = |k: usize| -> Vec<BoneMap> {
        let mut pose = orientations(&positions[k], sides, rest_pitch);
        pose.hips = (sway(k) - centre) / leg;
        to_maps(&pose)
    };
    let mut poses: Vec<Vec<BoneMap>> = (0..count).map(pose).collect();
    let end_difference: Vec<BoneMap> = pose(count).iter().zip(&poses[0]).map(|(&b, &a)| b - a).collect();
    for (k, pose) in poses.iter_mut().enumerate() {
        pose.iter_mut().zip(&end_difference).for_each(|(m, &s)| *m = *m - s * phase(k));
    }
    poses
}

/// Returns the first and last sample of the requested cycle, or of the cycle that is found.
fn find_cycle(positions: &[Vec<DVec3>], step_s: f64, requested: Option<[f64; 2]>) -> Result<[usize; 2], FileError> {
    let duration_s = positions.len().saturating_sub(1) as f64 * step_s;
    if let Some([a, b]) = requested {
        let [begin, end] = [a, b].map(|t| (t / step_s).round().max(0.0) as usize);
        if a >= 0.0
            && b <= duration_s + 0.5 * step_s
            && end < positions.len()
            && end >= begin.saturating_add(LEAST_SAMPLES)
        {
            return Ok([begin, end]);
        }
        let problem = format!(
            "cycle_s is {requested:?}, expected a part of 0 to {duration_s:.2} s of at least {LEAST_SAMPLES} samples"
        );
        return Err(FileError::new("MOTION", problem, CYCLE_HINT));
    }
    let [shortest, longest] = CYCLE_S.map(|s| (s / step_s).round() as usize);
    match best_cycle(positions, shortest.max(LEAST_SAMPLES), longest) {
        Some((a, b, cost)) if cost < 1.0 => Ok([a, b]),
        _ => {
            let problem = format!("no cycle of steps was found in its {duration_s:.2} s");
            Err(FileError::new("MOTION", problem, CYCLE_HINT))
        }
    }
}

/// Finds the joints of one side by their names. `side_word` and `side_letter` are spellings of the side.
fn side_joints(bvh: &Bvh, side_word: &str, side_letter: &str) -> Result<SideJoints, FileError> {
    let normalised = |name: &str| -> String {
        let last = name.rsplit(':').next().unwrap_or(name);
        last.chars().filter(|c| c.is_alphanumeric()).collect::<String>().to_lowercase()
    };
    let names: Vec<String> = bvh.joints.iter().map(|j| normalised(&j.name)).collect();
    let find = |part: &str, aliases: &[&str]| {
        let with_alias = |alias: &&str| {
            let spellings =
                [side_word, side_letter].into_iter().flat_map(|s| [format!("{s}{alias}"), format!("{alias}{s}")]);
            spellings.into_iter().find_map(|w| names.iter().position(|n| *n == w))
        };
        aliases.iter().find_map(with_alias).ok_or_else(|| {
            let named: Vec<&str> = bvh.joints.iter().map(|j| j.name.as_str()).filter(|n| !n.is_empty()).collect();
            let problem = format!("no joint is the {side_word} {part}, expected one called like {aliases:?}");
            FileError::new("HIERARCHY", problem, format!("rename the joints of the clip, which are {named:?}"))
        })
    };
    let foot = find("foot", FOOT_NAMES)?;
    let toe =
        find("toe", TOE_NAMES).or_else(|error| bvh.joints.iter().position(|j| j.parent == Some(foot)).ok_or(error))?;
    Ok(SideJoints {
        thigh: find("thigh", THIGH_NAMES)?,
        shank: find("shank", SHANK_NAMES)?,
        foot,
        toe,
        upper_arm: find("upper arm", UPPER_ARM_NAMES)?,
        forearm: find("forearm", FOREARM_NAMES)?,
        hand: find("hand", HAND_NAMES)?,
    })
}

/// Angle of a direction above the horizontal, rad.
fn pitch(v: DVec3) -> f64 {
    v.normalize_or_zero().z.clamp(-1.0, 1.0).asin()
}

/// Returns axes with this z, and with y as close as possible to `left`.
fn axes_along_z(z: DVec3, left: DVec3) -> DMat3 {
    let z = z.normalize_or(DVec3::Z);
    let y = left.reject_from_normalized(z).normalize_or(z.any_orthonormal_vector());
    DMat3::from_cols(y.cross(z), y, z)
}

/// Returns the orientations of the parts in a pose. The hips stay at the origin.
fn orientations(positions: &[DVec3], sides: &[SideJoints; 2], rest_pitch: [f64; 2]) -> Orientations {
    let [l, r] = sides;
    let hips = 0.5 * (positions[l.thigh] + positions[r.thigh]);
    let shoulders = 0.5 * (positions[l.upper_arm] + positions[r.upper_arm]);
    let (across_hips, across_shoulders) =
        (positions[l.thigh] - positions[r.thigh], positions[l.upper_arm] - positions[r.upper_arm]);
    let pelvis_left = across_hips.normalize_or(DVec3::Y);
    let forward = pelvis_left.cross(DVec3::Z).normalize_or(DVec3::X);
    let pelvis = DMat3::from_cols(forward, pelvis_left, forward.cross(pelvis_left));
    let trunk = axes_along_z(shoulders - hips, across_hips);
    let chest = axes_along_z(shoulders - hips, across_shoulders);
    let limb = |from: usize, to: usize, left: DVec3| axes_along_z(positions[from] - positions[to], left);
    let foot = |side: usize| {
        let s = &sides[side];
        let toes = (positions[s.toe] - positions[s.foot]).normalize_or(forward);
        let left = pelvis_left.reject_from_normalized(toes).normalize_or(pelvis_left);
        // The foot is as level as the skeleton's foot in the rest pose.
        DMat3::from_cols(toes, left, toes.cross(left)) * DMat3::from_rotation_y(rest_pitch[side])
    };
    let each = |of: &dyn Fn(&SideJoints) -> DMat3| [of(l), of(r)];
    Orientations {
        hips: DVec3::ZERO,
        pelvis,
        trunk,
        chest,
        head: chest,
        upper_arm: each(&|s| limb(s.upper_arm, s.forearm, chest.y_axis)),
        forearm: each(&|s| limb(s.forearm, s.hand, chest.y_axis)),
        thigh: each(&|s| limb(s.thigh, s.shank, pelvis_left)),
        shank: each(&|s| limb(s.shank, s.foot, pelvis_left)),
        foot: [foot(0), foot(1)],
        chest_m: 0.0,
    }
}

fn to_maps(orientations: &Orientations) -> Vec<BoneMap> {
    let mut maps = orientations.parts().map(|linear| BoneMap { centre: DVec3::ZERO, linear });
    maps[0].centre = orientations.hips;
    maps.to_vec()
}

fn from_maps(maps: &[BoneMap], unit_m: f64, chest_m: f64) -> Orientations {
    let hips = maps.first().map_or(DVec3::ZERO, |m| m.centre * unit_m);
    let part = |i: usize| maps.get(i).map_or(DMat3::IDENTITY, |m| rigid(m.linear));
    Orientations::from_parts(hips, chest_m, std::array::from_fn(part))
}

/// Returns the rotation closest to a matrix that rounding or blending has distorted. Only its z and y axes are used.
fn rigid(m: DMat3) -> DMat3 {
    axes_along_z(m.z_axis, m.y_axis)
}

impl Orientations {
    /// Orientations of the parts: pelvis, trunk, chest and head, then the limbs from the arms to the feet.
    fn parts(&self) -> [DMat3; PARTS] {
        let [[a, b], [c, d], [e, f], [g, h], [i, j]] =
            [self.upper_arm, self.forearm, self.thigh, self.shank, self.foot];
        [self.pelvis, self.trunk, self.chest, self.head, a, b, c, d, e, f, g, h, i, j]
    }

    /// Orientations in the order of [`Orientations::parts`].
    fn from_parts(hips: DVec3, chest_m: f64, parts: [DMat3; PARTS]) -> Orientations {
        let [pelvis, trunk, chest, head, a, b, c, d, e, f, g, h, i, j] = parts;
        let [upper_arm, forearm, thigh, shank, foot] = [[a, b], [c, d], [e, f], [g, h], [i, j]];
        Orientations { hips, pelvis, trunk, chest, head, upper_arm, forearm, thigh, shank, foot, chest_m }
    }

    /// Rotates all parts about the origin.
    fn rotated(&self, rotation: DMat3) -> Orientations {
        Orientations::from_parts(rotation * self.hips, self.chest_m, self.parts().map(|part| rotation * part))
    }

    /// Interpolates towards other orientations by a fraction.
    fn interpolated(&self, target: &Orientations, fraction: f64) -> Orientations {
        let (from, to) = (self.parts(), target.parts());
        let blended = std::array::from_fn(|i| rigid(from[i] * (1.0 - fraction) + to[i] * fraction));
        Orientations::from_parts(self.hips.lerp(target.hips, fraction), self.chest_m, blended)
    }
}
