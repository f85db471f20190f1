//! Bounds of rays that go much the same way: boxes are tested once for all of them.

use glam::Vec3A;
use obvhs::cwbvh::node::CwBvhNode;

use super::probe::Probe;

/// Rays of a packet, and boxes of a node.
pub(super) const LANES: usize = 8;

/// One number for each ray or box.
pub(super) type Lane = [f32; LANES];

/// All the places where some rays may be: intervals of origin and direction.
pub(super) struct Bundle {
    axes: [Span; 3],
    pub farthest: f32,
    /// The most that any of the rays begins behind its origin.
    pub back: f32,
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
    pub fn new(probes: &[Probe; LANES]) -> Self {
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

    /// All rays parallel to one, within a distance of it.
    pub fn around(probe: &Probe, reach: f32) -> Self {
        let mut bundle = Bundle::new(&[*probe; LANES]);
        for span in &mut bundle.axes {
            span.origin = [span.origin[0] - reach, span.origin[1] + reach];
        }
        bundle
    }

    /// Whether any of the rays may enter a box.
    #[inline(always)]
    pub fn enters(&self, around: &obvhs::aabb::Aabb) -> bool {
        let mut planes = [[[0.0; LANES]; 2]; 3];
        for (axis, planes) in planes.iter_mut().enumerate() {
            *planes = [[around.min[axis]; LANES], [around.max[axis]; LANES]];
        }
        self.overlaps(&planes) & 1 != 0
    }

    /// The children of a node whose boxes some of the rays may enter, in the encoding of [`obvhs::traverse`].
    #[inline(always)]
    pub fn meet(&self, node: &CwBvhNode, oct_inv4: u32) -> u32 {
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

/// Lanes that are set, as bits.
#[inline(always)]
pub(super) fn bits(lanes: &[bool; LANES]) -> u32 {
    let mut bits = 0;
    for (i, &lane) in lanes.iter().enumerate() {
        bits |= u32::from(lane) << i;
    }
    bits
}

#[inline(always)]
pub(super) fn lower(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
pub(super) fn higher(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}
