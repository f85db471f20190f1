//! Eight rays at once that go much the same way: boxes are tested once for all of them, triangles for eight in one go.
//!
//! What each ray meets is what it would meet alone, bit for bit: triangles are met by the same operations, and which of them
//! are tried beside those that are met does not matter.

use glam::{UVec2, Vec3A};
use obvhs::cwbvh::node::CwBvhNode;

use super::body::{Body, Nearest};
use super::bundle::{Bundle, LANES, Lane, bits, higher, lower};
use super::probe::Probe;
use super::triangle::Corners;

/// Rays of a packet go within this of each other: the tangent of 3 degrees. Wider ones try too much in vain.
const SPREAD: f32 = 0.05;

/// Eight rays.
pub(super) struct Packet {
    /// Permutation of axes that all of the rays share ([`super::triangle::Shear`]).
    axes: [usize; 3],
    /// By permuted axis.
    origin: [Lane; 3],
    shear: [Lane; 2],
    scale_z: Lane,
    nearest: Lane,
    farthest: Lane,
    bundle: Bundle,
}

/// Nearest hit of each ray so far, with the body.
pub(super) type Found = [Option<(u32, Nearest)>; LANES];

impl Packet {
    /// A packet, if the rays are enough alike.
    #[inline(always)]
    pub fn new(probes: &[Probe; LANES]) -> Option<Self> {
        let first = &probes[0];
        let mut spread = Vec3A::ZERO;
        let mut alike = true;
        for probe in probes {
            alike &= probe.shear.axes == first.shear.axes;
            spread = spread.max((probe.direction - first.direction).abs());
        }
        if !alike || spread.max_element() > SPREAD {
            return None;
        }
        let mut packet = Packet {
            axes: first.shear.axes,
            origin: [[0.0; LANES]; 3],
            shear: [[0.0; LANES]; 2],
            scale_z: [0.0; LANES],
            nearest: [0.0; LANES],
            farthest: [0.0; LANES],
            bundle: Bundle::new(probes),
        };
        for (i, probe) in probes.iter().enumerate() {
            for axis in 0..3 {
                packet.origin[axis][i] = probe.shear.origin[axis].x;
            }
            packet.shear[0][i] = probe.shear.shear_x.x;
            packet.shear[1][i] = probe.shear.shear_y.x;
            packet.scale_z[i] = probe.shear.scale_z;
            packet.nearest[i] = probe.nearest;
            packet.farthest[i] = probe.farthest;
        }
        Some(packet)
    }

    /// The nearest triangles of one more body.
    #[inline(always)]
    pub fn closest(&mut self, probes: &[Probe; LANES], number: u32, body: &Body, found: &mut Found) {
        if body.tree.nodes.is_empty() || !self.bundle.enters(&body.bounds) {
            return;
        }
        let mut state = body.tree.new_traversal(probes[0].direction);
        let mut node: &CwBvhNode;
        obvhs::traverse!(body.tree, node, state, self.bundle.meet(node, state.oct_inv4), {
            let leaf = state.primitive_id as usize;
            if let Some(corners) = body.corners.get(leaf) {
                let mut lanes = self.candidates(corners);
                while lanes != 0 {
                    let lane = lanes.trailing_zeros() as usize;
                    lanes &= lanes - 1;
                    let probe = &probes[lane & (LANES - 1)];
                    let farthest = &mut self.farthest[lane & (LANES - 1)];
                    let Some(meeting) = probe.shear.meet(corners, *farthest) else { continue };
                    let best = &mut found[lane & (LANES - 1)];
                    if let Some(nearest) = body.judge(leaf, meeting, probe, probe.except(number), number, best) {
                        *farthest = nearest.meeting.distance;
                        *best = Some((number, nearest));
                    }
                }
            }
            self.bundle.farthest = largest(&self.farthest) + self.bundle.back;
        });
    }

    /// The rays that may meet a triangle, as bits: those that have no corner's weight of another sign than the others.
    #[inline(always)]
    fn candidates(&self, corners: &Corners) -> u32 {
        let [kx, ky, kz] = self.axes;
        let (x, y, z) = (corners[kx].to_array(), corners[ky].to_array(), corners[kz].to_array());
        let mut maybe = [false; LANES];
        for (i, maybe) in maybe.iter_mut().enumerate() {
            let (oz, ox, oy) = (self.origin[2][i], self.origin[0][i], self.origin[1][i]);
            let (sx, sy, sz) = (self.shear[0][i], self.shear[1][i], self.scale_z[i]);
            let (az, bz, cz) = (z[0] - oz, z[1] - oz, z[2] - oz);
            let (ax, bx, cx) = ((x[0] - ox) - sx * az, (x[1] - ox) - sx * bz, (x[2] - ox) - sx * cz);
            let (ay, by, cy) = ((y[0] - oy) - sy * az, (y[1] - oy) - sy * bz, (y[2] - oy) - sy * cz);
            let (a, b, c) = (cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax);
            let least = lower(lower(a, b), c);
            let greatest = higher(higher(a, b), c);
            let ahead = higher(higher(az * sz, bz * sz), cz * sz);
            let before = lower(lower(az * sz, bz * sz), cz * sz);
            // The distance itself may round to a little outside of its corners'.
            let reached = (ahead >= -2.0 * self.nearest[i]) & (before * 0.999_99 <= self.farthest[i]);
            *maybe = ((least >= 0.0) | (greatest <= 0.0)) & reached;
        }
        bits(&maybe)
    }
}

#[inline(always)]
fn largest(lane: &Lane) -> f32 {
    lane.iter().fold(f32::NEG_INFINITY, |l, &v| higher(l, v))
}
