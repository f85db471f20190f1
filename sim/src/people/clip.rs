//! Captured steps on the parametric body: the joints of a BVH clip rotate the thirteen segments. The segments keep the
//! body's own lengths.
//!
//! Only directions are taken from the clip: thighs from hips to knees, the trunk from hips to shoulders, and so on. The
//! sway of the hips about their mean motion is taken in proportion to the length of the legs. The unit and the
//! proportions of the clip's skeleton therefore do not matter. One cycle of two steps is cut out of the clip and made
//! periodic. Its phase advances with the ground covered.

use glam::{DMat3, DVec3};

use super::body::{Build, Frames, Posture, SEGMENTS};
use super::bvh::{Bvh, parse_bvh};
use super::cycle::{Cycle, FootSliding, SAY_CYCLE, Stance, Walk, best_cycle};
use super::skin::Map;
use crate::em::specular::Ellipsoid;
use crate::file_error::FileError;
use crate::geometry::import::UpAxis;

/// Time between samples to which clips of a higher frame rate are thinned, s.
const SAMPLE_S: f64 = 1.0 / 60.0;
/// Shortest and longest cycle that is searched for, s.
const CYCLE_S: [f64; 2] = [0.7, 2.0];
/// Least number of samples of a cycle.
const FEWEST: usize = 16;
/// Upper limit of joints times samples. The time of the search for a cycle grows with this product.
const MOST_PLACES: usize = 1_000_000;
/// Least ground covered in a cycle, as a part of the legs' length. A clip with less does not walk.
const LEAST_TRAVEL: f64 = 0.3;
/// Number of parts of a body with an orientation, which are the cycle's bones.
const FRAMES: usize = 14;

/// Joint names that programs use, for each part of the body, without blanks, punctuation, and "left" or "right".
const THIGH: &[&str] = &["upleg", "thigh", "upperleg", "femur", "hip"];
const SHANK: &[&str] = &["leg", "shin", "calf", "lowerleg", "loleg", "tibia", "knee"];
const FOOT: &[&str] = &["foot", "ankle"];
const TOE: &[&str] = &["toebase", "toe", "toes", "ball"];
const UPPER_ARM: &[&str] = &["arm", "upperarm", "uparm", "humerus", "shoulder"];
const FOREARM: &[&str] = &["forearm", "lowerarm", "loarm", "radius", "elbow"];
const HAND: &[&str] = &["wrist", "hand"];

/// One cycle of captured steps.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyClip {
    /// Orientations of the parts. The position of the first one is that of the hips. The body faces +x; the unit is the
    /// length of the legs.
    cycle: Cycle,
    /// Ground covered in a cycle, in units of the legs' length.
    travel: f64,
    /// Foot contact of a walking body of 1.75 m.
    walked: Stance,
    /// Begin and end of the cycle in the file, s.
    pub span_s: [f64; 2],
}

/// Indices of the joints on one side of the body.
struct Side {
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
        let sides = [side(&bvh, "left", "l")?, side(&bvh, "right", "r")?];
        let rest = upright(&bvh, up, None);
        let length = |a: usize, b: usize| rest[a].distance(rest[b]);
        let legs: [f64; 2] =
            [0, 1].map(|s| length(sides[s].thigh, sides[s].shank) + length(sides[s].shank, sides[s].foot));
        let leg = 0.5 * (legs[0] + legs[1]);
        if !(leg > 1e-6 && leg.is_finite()) {
            let hint = "check the OFFSETs of the joints of the legs: the skeleton may have been scaled to nothing";
            return Err(FileError::new("HIERARCHY", format!("its legs are {leg} long, expected a length"), hint));
        }
        let (places, step_s) = sampled(&bvh, up)?;
        let [begin, end] = span(&places, step_s, cycle_s)?;
        let count = end - begin;
        let rest_pitch = sides.each_ref().map(|s| pitch(rest[s.toe] - rest[s.foot]));
        let mut poses = closed(&places[begin..=end], &sides, rest_pitch, leg);
        // Contact is computed on a body of 1.75 m, in units of the length of its legs.
        let build = Build { height_m: 1.75, girth: 1.0 };
        let unit_m = leg_m(&build);
        let points = |cycle: &Cycle, count: usize| -> Vec<Vec<DVec3>> {
            (0..count).map(|k| soles(&build, &from_maps(&cycle.at(k as f64 / count as f64), unit_m, 0.0))).collect()
        };
        let stance = Stance::of(&points(&Cycle::through(&poses), count), build.height_m);
        if stance.travel_m.length() < LEAST_TRAVEL * unit_m {
            let problem = format!("feet push {:.2} m in the cycle, expected a walk", stance.travel_m.length());
            return Err(FileError::new("MOTION", problem, SAY_CYCLE));
        }
        // The body faces +x, and the soles rest on the floor.
        let ahead = DMat3::from_rotation_z(-stance.travel_m.y.atan2(stance.travel_m.x));
        for (pose, surge_m) in poses.iter_mut().zip(stance.surge_m()) {
            pose.iter_mut().for_each(|m| *m = Map { centre: ahead * m.centre, interval: ahead * m.interval });
            if let Some(hips) = pose.first_mut() {
                hips.centre += (ahead * surge_m - DVec3::Z * stance.floor_m) / unit_m;
            }
        }
        for pose in &mut poses {
            lift_toes(&build, pose, unit_m);
        }
        let cycle = Cycle::through(&poses);
        let walked = Stance::of(&points(&cycle, 4 * count), build.height_m);
        Ok(BodyClip {
            cycle,
            travel: stance.travel_m.length() / unit_m,
            walked: walked.over(DVec3::X * stance.travel_m.length()),
            span_s: [begin as f64 * step_s, end as f64 * step_s],
        })
    }

    /// Ground covered in a cycle of steps, m, by a body with this height of the hips.
    pub fn cycle_m(&self, hip_height_m: f64) -> f64 {
        self.travel * hip_height_m * LEG_OF_HIP_HEIGHT
    }

    /// Returns how much the feet slide over the floor at a walking speed.
    pub fn foot_sliding(&self, speed_m_per_s: f64) -> FootSliding {
        self.walked.sliding(speed_m_per_s)
    }

    /// Returns the ellipsoids of a walking body. `standing` is its posture when it stands at the same place.
    pub(super) fn body(&self, build: &Build, standing: &Posture, walk: &Walk) -> [Ellipsoid; SEGMENTS] {
        let standing = standing.frames();
        if walk.vigour <= 0.0 {
            return build.hang(&standing);
        }
        let mut frames = from_maps(&self.cycle.at(walk.phase), leg_m(build), standing.chest_m);
        let heading = DMat3::from_rotation_z(walk.heading_rad);
        frames = frames.turned(heading);
        frames.hips += DVec3::new(walk.position_m[0], walk.position_m[1], 0.0);
        build.hang(&standing.towards(&frames, walk.vigour))
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
fn soles(build: &Build, frames: &Frames) -> Vec<DVec3> {
    let body = build.hang(frames);
    let under = (-8..=BALL).map(|i| (SOLE_RAD * f64::from(i)).sin_cos()).map(|(s, c)| DVec3::new(s, 0.0, -c));
    under.flat_map(|u| [body[11].surface(u), body[12].surface(u)]).collect()
}

/// Rotates feet about the ankle until the toes are not below the floor, as real feet bend there.
fn lift_toes(build: &Build, pose: &mut [Map], unit_m: f64) {
    for side in 0..2 {
        let turned = |pose: &[Map], angle: f64| {
            let mut frames = from_maps(pose, unit_m, 0.0);
            frames.foot[side] *= DMat3::from_rotation_y(-angle);
            frames
        };
        let lowest = |angle: f64| {
            let foot = build.hang(&turned(pose, angle))[11 + side];
            let under = (-8..=8).map(|i| (SOLE_RAD * f64::from(i)).sin_cos());
            under.map(|(s, c)| foot.surface(DVec3::new(s, 0.0, -c)).z).fold(f64::INFINITY, f64::min)
        };
        // The smallest rotation that lifts the foot off the floor, or that lifts it most.
        let angles = (0..=MOST_LIFTS).map(|i| LIFT_RAD * f64::from(i));
        let best = angles.max_by(|&a, &b| {
            let (free_a, free_b) = (lowest(a).min(0.0), lowest(b).min(0.0));
            free_a.total_cmp(&free_b).then(b.total_cmp(&a))
        });
        let frames = turned(pose, best.unwrap_or(0.0));
        if let Some(foot) = pose.get_mut(12 + side) {
            foot.interval = frames.foot[side];
        }
    }
}

/// Step of that rotation, rad, and the largest number of steps.
const LIFT_RAD: f64 = 0.02;
const MOST_LIFTS: u32 = 40;

/// Returns the positions of the joints in a frame, z up. Without a frame, returns the rest pose.
fn upright(bvh: &Bvh, up: UpAxis, frame: Option<usize>) -> Vec<DVec3> {
    bvh.places(frame).into_iter().map(|p| up.to_z_up(p)).collect()
}

/// Returns the positions of the joints over a clip, and the time between samples, s.
fn sampled(bvh: &Bvh, up: UpAxis) -> Result<(Vec<Vec<DVec3>>, f64), FileError> {
    let step = (SAMPLE_S / bvh.frame_time_s).floor().max(1.0) as usize;
    let (samples, joints) = (bvh.frames.len().div_ceil(step), bvh.joints.len());
    if samples.saturating_mul(joints) > MOST_PLACES {
        let problem = format!("{joints} joints over {samples} samples, expected {MOST_PLACES} places at most");
        return Err(FileError::new("MOTION", problem, "cut the clip to a minute in which somebody walks"));
    }
    let places = (0..bvh.frames.len()).step_by(step).map(|f| upright(bvh, up, Some(f))).collect();
    Ok((places, step as f64 * bvh.frame_time_s))
}

/// Returns the maps of the parts over a cycle, from its first sample to the last but one. The mean motion of the hips
/// is removed. The difference between both ends of the cycle is distributed over all samples.
fn closed(places: &[Vec<DVec3>], sides: &[Side; 2], rest_pitch: [f64; 2], leg: f64) -> Vec<Vec<Map>> {
    let hips = |p: &[DVec3]| 0.5 * (p[sides[0].thigh] + p[sides[1].thigh]);
    let count = places.len() - 1;
    let level = DVec3::new(1.0, 1.0, 0.0);
    let drift = (hips(&places[count]) - hips(&places[0])) * level;
    let phase = |k: usize| k as f64 / count as f64;
    let sway = |k: usize| hips(&places[k]) - drift * phase(k);
    let centre = (0..count).map(sway).sum::<DVec3>() / count as f64 * level;
    let pose = |k: usize| -> Vec<Map> {
        let mut frames = frames(&places[k], sides, rest_pitch);
        frames.hips = (sway(k) - centre) / leg;
        to_maps(&frames)
    };
    let mut poses: Vec<Vec<Map>> = (0..count).map(pose).collect();
    let seam: Vec<Map> = pose(count).iter().zip(&poses[0]).map(|(&b, &a)| b - a).collect();
    for (k, pose) in poses.iter_mut().enumerate() {
        pose.iter_mut().zip(&seam).for_each(|(m, &s)| *m = *m - s * phase(k));
    }
    poses
}

/// Returns the first and last sample of a cycle.
fn span(places: &[Vec<DVec3>], step_s: f64, asked: Option<[f64; 2]>) -> Result<[usize; 2], FileError> {
    let lasts_s = places.len().saturating_sub(1) as f64 * step_s;
    if let Some([a, b]) = asked {
        let [begin, end] = [a, b].map(|t| (t / step_s).round().max(0.0) as usize);
        if a >= 0.0 && b <= lasts_s + 0.5 * step_s && end < places.len() && end >= begin.saturating_add(FEWEST) {
            return Ok([begin, end]);
        }
        let problem =
            format!("cycle_s is {asked:?}, expected a part of 0 to {lasts_s:.2} s of at least {FEWEST} samples");
        return Err(FileError::new("MOTION", problem, SAY_CYCLE));
    }
    let [shortest, longest] = CYCLE_S.map(|s| (s / step_s).round() as usize);
    match best_cycle(places, shortest.max(FEWEST), longest) {
        Some((a, b, cost)) if cost < 1.0 => Ok([a, b]),
        _ => {
            let problem = format!("no cycle of steps was found in its {lasts_s:.2} s");
            Err(FileError::new("MOTION", problem, SAY_CYCLE))
        }
    }
}

fn side(bvh: &Bvh, word: &str, letter: &str) -> Result<Side, FileError> {
    let plain = |name: &str| -> String {
        let last = name.rsplit(':').next().unwrap_or(name);
        last.chars().filter(|c| c.is_alphanumeric()).collect::<String>().to_lowercase()
    };
    let names: Vec<String> = bvh.joints.iter().map(|j| plain(&j.name)).collect();
    let find = |what: &str, aliases: &[&str]| {
        let of_alias = |alias: &&str| {
            let written = [word, letter].into_iter().flat_map(|s| [format!("{s}{alias}"), format!("{alias}{s}")]);
            written.into_iter().find_map(|w| names.iter().position(|n| *n == w))
        };
        aliases.iter().find_map(of_alias).ok_or_else(|| {
            let named: Vec<&str> = bvh.joints.iter().map(|j| j.name.as_str()).filter(|n| !n.is_empty()).collect();
            let problem = format!("no joint is the {word} {what}, expected one called like {aliases:?}");
            FileError::new("HIERARCHY", problem, format!("rename the joints of the clip, which are {named:?}"))
        })
    };
    let foot = find("foot", FOOT)?;
    let toe = find("toe", TOE).or_else(|fault| bvh.joints.iter().position(|j| j.parent == Some(foot)).ok_or(fault))?;
    Ok(Side {
        thigh: find("thigh", THIGH)?,
        shank: find("shank", SHANK)?,
        foot,
        toe,
        upper_arm: find("upper arm", UPPER_ARM)?,
        forearm: find("forearm", FOREARM)?,
        hand: find("hand", HAND)?,
    })
}

/// Angle of a direction above the horizontal, rad.
fn pitch(v: DVec3) -> f64 {
    v.normalize_or_zero().z.clamp(-1.0, 1.0).asin()
}

/// Returns axes with this z, and with y as close as possible to `left`.
fn upward(z: DVec3, left: DVec3) -> DMat3 {
    let z = z.normalize_or(DVec3::Z);
    let y = left.reject_from_normalized(z).normalize_or(z.any_orthonormal_vector());
    DMat3::from_cols(y.cross(z), y, z)
}

/// Returns the orientations of the parts in a pose. The hips stay at the origin.
fn frames(p: &[DVec3], sides: &[Side; 2], rest_pitch: [f64; 2]) -> Frames {
    let [l, r] = sides;
    let hips = 0.5 * (p[l.thigh] + p[r.thigh]);
    let shoulders = 0.5 * (p[l.upper_arm] + p[r.upper_arm]);
    let (across_hips, across_shoulders) = (p[l.thigh] - p[r.thigh], p[l.upper_arm] - p[r.upper_arm]);
    let pelvis_left = across_hips.normalize_or(DVec3::Y);
    let forward = pelvis_left.cross(DVec3::Z).normalize_or(DVec3::X);
    let pelvis = DMat3::from_cols(forward, pelvis_left, forward.cross(pelvis_left));
    let trunk = upward(shoulders - hips, across_hips);
    let chest = upward(shoulders - hips, across_shoulders);
    let limb = |from: usize, to: usize, left: DVec3| upward(p[from] - p[to], left);
    let foot = |side: usize| {
        let s = &sides[side];
        let toes = (p[s.toe] - p[s.foot]).normalize_or(forward);
        let left = pelvis_left.reject_from_normalized(toes).normalize_or(pelvis_left);
        // The foot is as level as the skeleton's foot in the rest pose.
        DMat3::from_cols(toes, left, toes.cross(left)) * DMat3::from_rotation_y(rest_pitch[side])
    };
    let each = |of: &dyn Fn(&Side) -> DMat3| [of(l), of(r)];
    Frames {
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

fn to_maps(f: &Frames) -> Vec<Map> {
    let mut maps = f.parts().map(|interval| Map { centre: DVec3::ZERO, interval });
    maps[0].centre = f.hips;
    maps.to_vec()
}

fn from_maps(maps: &[Map], unit_m: f64, chest_m: f64) -> Frames {
    let hips = maps.first().map_or(DVec3::ZERO, |m| m.centre * unit_m);
    let part = |i: usize| maps.get(i).map_or(DMat3::IDENTITY, |m| rigid(m.interval));
    Frames::of_parts(hips, chest_m, std::array::from_fn(part))
}

/// Returns the rotation closest to a matrix that rounding or blending has distorted. Only its z and y axes are used.
fn rigid(m: DMat3) -> DMat3 {
    upward(m.z_axis, m.y_axis)
}

impl Frames {
    /// Orientations of the parts: pelvis, trunk, chest and head, then the limbs from the arms to the feet.
    fn parts(&self) -> [DMat3; FRAMES] {
        let [[a, b], [c, d], [e, f], [g, h], [i, j]] =
            [self.upper_arm, self.forearm, self.thigh, self.shank, self.foot];
        [self.pelvis, self.trunk, self.chest, self.head, a, b, c, d, e, f, g, h, i, j]
    }

    /// Frames with these orientations, in the order of [`Frames::parts`].
    fn of_parts(hips: DVec3, chest_m: f64, parts: [DMat3; FRAMES]) -> Frames {
        let [pelvis, trunk, chest, head, a, b, c, d, e, f, g, h, i, j] = parts;
        let [upper_arm, forearm, thigh, shank, foot] = [[a, b], [c, d], [e, f], [g, h], [i, j]];
        Frames { hips, pelvis, trunk, chest, head, upper_arm, forearm, thigh, shank, foot, chest_m }
    }

    /// Rotates all parts about the origin.
    fn turned(&self, by: DMat3) -> Frames {
        Frames::of_parts(by * self.hips, self.chest_m, self.parts().map(|part| by * part))
    }

    /// Interpolates towards other frames by a fraction.
    fn towards(&self, other: &Frames, part: f64) -> Frames {
        let (from, to) = (self.parts(), other.parts());
        let blended = std::array::from_fn(|i| rigid(from[i] * (1.0 - part) + to[i] * part));
        Frames::of_parts(self.hips.lerp(other.hips, part), self.chest_m, blended)
    }
}
