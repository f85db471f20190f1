//! Eight rays at once that go much the same way: boxes are tested once for all of them, triangles for eight in one go.
//!
//! What each ray meets is what it would meet alone, bit for bit: triangles are met by the same operations, and which of them
//! are tried beside those that are met does not matter.

use glam::{UVec2, Vec3A};
use obvhs::cwbvh::node::CwBvhNode;

use super::body::{Body, Nearest};
use super::probe::Probe;
use super::triangle::Corners;

/// Rays of a packet.
pub(super) const LANES: usize = 8;
/// Rays of a packet go within this of each other: the tangent of 3 degrees. Wider ones try too much in vain.
const SPREAD: f32 = 0.05;

type Lane = [f32; LANES];

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
fn bits(lanes: &[bool; LANES]) -> u32 {
    let mut bits = 0;
    for (i, &lane) in lanes.iter().enumerate() {
        bits |= u32::from(lane) << i;
    }
    bits
}

/// All the places where some rays may be: intervals of origin and direction.
struct Bundle {
    axes: [Span; 3],
    farthest: f32,
    /// The most that any of the rays begins behind its origin.
    back: f32,
}

/// One coordinate of a bundle, mirrored where the rays go down.
#[derive(Clone, Copy, Default)]
struct Span {
    mirror: f32,
    origin: [f32; 2],
    direction: [f32; 2],
    inverse: [f32; 2],
    /// All rays go the same way, by an amount that can be divided by.
    definite: bool,
}

impl Bundle {
    #[inline(always)]
    fn new(probes: &[Probe; LANES]) -> Self {
        let mut least = (Vec3A::splat(f32::INFINITY), Vec3A::splat(f32::INFINITY));
        let mut greatest = (Vec3A::splat(f32::NEG_INFINITY), Vec3A::splat(f32::NEG_INFINITY));
        let (mut farthest, mut back) = (0.0, 0.0);
        for probe in probes {
            let origin = probe.ray.origin;
            least = (least.0.min(origin), least.1.min(probe.direction));
            greatest = (greatest.0.max(origin), greatest.1.max(probe.direction));
            farthest = higher(farthest, probe.farthest);
            back = higher(back, probe.back);
        }
        let mut axes = [Span::default(); 3];
        for (axis, span) in axes.iter_mut().enumerate() {
            let (mut origin, mut direction) = ([least.0[axis], greatest.0[axis]], [least.1[axis], greatest.1[axis]]);
            let mirror = if direction[1] < 0.0 { -1.0 } else { 1.0 };
            if mirror < 0.0 {
                origin = [-origin[1], -origin[0]];
                direction = [-direction[1], -direction[0]];
            }
            let definite = direction[0] > 1e-4;
            *span = Span { mirror, origin, direction, inverse: [1.0 / direction[1], 1.0 / direction[0]], definite };
        }
        Bundle { axes, farthest: farthest + back, back }
    }

    /// Whether any of the rays may enter a box.
    #[inline(always)]
    fn enters(&self, around: &obvhs::aabb::Aabb) -> bool {
        let mut planes = [[[0.0; LANES]; 2]; 3];
        for (axis, planes) in planes.iter_mut().enumerate() {
            *planes = [[around.min[axis]; LANES], [around.max[axis]; LANES]];
        }
        self.overlaps(&planes) & 1 != 0
    }

    /// The children of a node whose boxes some of the rays may enter, in the encoding of [`obvhs::traverse`].
    #[inline(always)]
    fn meet(&self, node: &CwBvhNode, oct_inv4: u32) -> u32 {
        let (p, step) = (node.p.to_array(), node.compute_extent().to_array());
        let least = [&node.child_min_x, &node.child_min_y, &node.child_min_z];
        let greatest = [&node.child_max_x, &node.child_max_y, &node.child_max_z];
        let mut planes = [[[0.0; LANES]; 2]; 3];
        for axis in 0..3 {
            for i in 0..LANES {
                planes[axis][0][i] = f32::from(least[axis][i]) * step[axis] + p[axis];
                planes[axis][1][i] = f32::from(greatest[axis][i]) * step[axis] + p[axis];
            }
        }
        let mut entered = self.overlaps(&planes);
        let (child_bits, bit_index) = node.get_child_and_index_bits(oct_inv4);
        let mut mask = 0;
        while entered != 0 {
            let shift = 8 * entered.trailing_zeros();
            entered &= entered - 1;
            mask |= ((child_bits >> shift) as u32 & 0xff) << ((bit_index >> shift) as u32 & 0xff);
        }
        mask
    }

    /// Boxes of eight, given by their least and greatest coordinates, that overlap the bundle, as bits.
    #[inline(always)]
    fn overlaps(&self, planes: &[[Lane; 2]; 3]) -> u32 {
        let mut enter: Lane = [0.0; LANES];
        let mut leave: Lane = [self.farthest; LANES];
        let mut overlap = [true; LANES];
        for (s, planes) in self.axes.iter().zip(planes) {
            if s.definite {
                let (nears, fars) = s.sides(planes);
                for i in 0..LANES {
                    let (near, far) = (nears[i] * s.mirror - s.origin[1], fars[i] * s.mirror - s.origin[0]);
                    enter[i] = higher(enter[i], lower(near * s.inverse[0], near * s.inverse[1]));
                    leave[i] = lower(leave[i], higher(far * s.inverse[0], far * s.inverse[1]));
                }
            }
        }
        for i in 0..LANES {
            overlap[i] = enter[i] <= leave[i];
        }
        for (s, planes) in self.axes.iter().zip(planes) {
            if !s.definite {
                // Where the rays may be by the time they leave the box along the other axes.
                let (nears, fars) = s.sides(planes);
                for i in 0..LANES {
                    let low = s.origin[0] + lower(s.direction[0] * leave[i], 0.0);
                    let high = s.origin[1] + higher(s.direction[1] * leave[i], 0.0);
                    overlap[i] &= (low <= fars[i] * s.mirror) & (high >= nears[i] * s.mirror);
                }
            }
        }
        bits(&overlap)
    }
}

impl Span {
    /// A box's sides that face the rays and the ones that they leave by.
    #[inline(always)]
    fn sides<'a>(&self, [least, greatest]: &'a [Lane; 2]) -> (&'a Lane, &'a Lane) {
        if self.mirror < 0.0 { (greatest, least) } else { (least, greatest) }
    }
}

#[inline(always)]
fn lower(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn higher(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
fn largest(lane: &Lane) -> f32 {
    lane.iter().fold(f32::NEG_INFINITY, |l, &v| higher(l, v))
}
