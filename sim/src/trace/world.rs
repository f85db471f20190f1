//! All bodies together: the two-level query.

use glam::DVec3;

use super::body::{Body, Nearest};
use super::ray::{Crossings, Hit, Probe, Ray, Surface};
use super::triangle::Shear;

const NONE: u32 = u32::MAX;

/// Bodies that rays are traced among. Index 0 is best the static room: it ends most rays.
#[derive(Debug, Clone, Default)]
pub struct World {
    bodies: Vec<Body>,
}

impl World {
    /// A world of bodies.
    pub fn new(bodies: Vec<Body>) -> Self {
        World { bodies }
    }

    /// The bodies.
    pub fn bodies(&self) -> &[Body] {
        &self.bodies
    }

    /// One of the bodies, to refit it.
    pub fn body_mut(&mut self, body: u32) -> Option<&mut Body> {
        self.bodies.get_mut(body as usize)
    }

    /// The surface of a hit: what the next ray excludes.
    pub fn surface(&self, hit: &Hit) -> Option<Surface> {
        let group = self.bodies.get(hit.body as usize)?.group(hit.triangle)?;
        Some(Surface { body: hit.body, group })
    }

    /// The nearest triangle that a ray meets; of several at the same distance the one of the lowest (body, triangle).
    #[inline]
    pub fn closest(&self, ray: &Ray) -> Option<Hit> {
        let mut hit = None;
        self.closest_each(std::slice::from_ref(ray), |_, h| hit = h);
        hit
    }

    /// [`Self::closest`] of many rays: calls back with index and hit.
    pub fn closest_each(&self, rays: &[Ray], mut answer: impl FnMut(usize, Option<Hit>)) {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2. Without contraction to fused operations it computes the same as portable code.
            unsafe { closest_avx2(self, rays, &mut answer) };
            return;
        }
        closest_body(self, rays, &mut answer);
    }

    /// Whether anything lies on a ray.
    #[inline]
    pub fn blocked(&self, ray: &Ray) -> bool {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: as above.
            return unsafe { blocked_avx2(self, ray) };
        }
        blocked_body(self, ray)
    }

    /// All triangles of one body that a ray meets, nearest first.
    pub fn all(&self, body: u32, ray: &Ray) -> Vec<Hit> {
        let Some((probe, start)) = self.probe(ray) else { return Vec::new() };
        let shear = Shear::new(&probe);
        let all = self.bodies.get(body as usize).map(|b| b.all(&probe, &shear, probe.farthest)).unwrap_or_default();
        all.iter().map(|n| hit(body, n, start)).collect()
    }

    /// How often a ray enters and leaves a body: equally often where the body is closed and the ray begins and ends outside.
    pub fn crossings(&self, body: u32, ray: &Ray) -> Crossings {
        let Some((probe, _)) = self.probe(ray) else { return Crossings::default() };
        let shear = Shear::new(&probe);
        self.bodies.get(body as usize).map(|b| b.crossings(&probe, &shear, probe.farthest)).unwrap_or_default()
    }

    /// The point of a hit in f64, m: on the triangle to the last bit, beside the ray by what f32 rounded of its weights.
    pub fn point(&self, hit: &Hit) -> Option<DVec3> {
        let [a, b, c] = self.bodies.get(hit.body as usize)?.mesh().corners(hit.triangle as usize)?;
        let [wa, wb, wc] = hit.barycentric.map(f64::from);
        Some((a * wa + b * wb + c * wc) / (wa + wb + wc))
    }

    /// Where a ray meets the plane of a hit's triangle in f64: distance, m, and weights of the corners. `None` where it runs
    /// along the plane.
    pub fn exact(&self, ray: &Ray, hit: &Hit) -> Option<(f64, [f64; 3])> {
        let corners = self.bodies.get(hit.body as usize)?.mesh().corners(hit.triangle as usize)?;
        super::reference::plane(ray, corners)
    }

    /// The ray in f32, and how far along the ray that begins: rays from far away begin a metre before the first body, where
    /// f32 still tells small things apart.
    #[inline(always)]
    fn probe(&self, ray: &Ray) -> Option<(Probe, f64)> {
        let mut start = 0.0;
        if ray.origin.abs().max_element() > 30.0 {
            start = self.approach(ray);
        }
        let origin = ray.at(start);
        if !(origin.is_finite() && ray.direction.is_finite() && ray.direction != DVec3::ZERO) {
            return None;
        }
        let farthest = (ray.length_m - start) as f32;
        let nearest = if start > 0.0 { 0.0 } else { ray.nearest_m() as f32 };
        let probe = Probe { origin: origin.as_vec3a(), direction: ray.direction.as_vec3a(), nearest, farthest };
        // Between two surfaces what is nearest to either is alike: its own edge, not something in between.
        let farthest = if ray.except[1].is_some() { farthest - nearest } else { farthest };
        Some((Probe { farthest, ..probe }, start))
    }

    #[cold]
    fn approach(&self, ray: &Ray) -> f64 {
        let (least, greatest) = self
            .bodies
            .iter()
            .map(Body::bounds)
            .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, g), (bl, bg)| (l.min(bl), g.max(bg)));
        let middle = 0.5 * (least + greatest);
        let radius = 0.5 * (greatest - least).length();
        let start = (middle - ray.origin).dot(ray.direction) - radius - 1.0;
        if start.is_finite() { start.max(0.0) } else { 0.0 }
    }
}

fn hit(body: u32, nearest: &Nearest, start: f64) -> Hit {
    let weights = nearest.meeting.weights;
    let sum = weights.element_sum();
    Hit {
        body,
        triangle: nearest.triangle,
        distance_m: start + f64::from(nearest.meeting.distance),
        barycentric: (weights / sum).to_array(),
        front: sum > 0.0,
    }
}

/// Groups of one body that a ray does not meet.
#[inline(always)]
fn except(ray: &Ray, body: u32) -> [u32; 2] {
    ray.except.map(|s| s.filter(|s| s.body == body).map_or(NONE, |s| s.group))
}

#[inline(always)]
fn closest_body(world: &World, rays: &[Ray], answer: &mut impl FnMut(usize, Option<Hit>)) {
    for (index, ray) in rays.iter().enumerate() {
        let Some((probe, start)) = world.probe(ray) else {
            answer(index, None);
            continue;
        };
        let shear = Shear::new(&probe);
        let mut nearest: Option<(u32, Nearest)> = None;
        let mut farthest = probe.farthest;
        for (number, body) in (0..).zip(&world.bodies) {
            if let Some(n) = body.nearest(&probe, &shear, farthest, except(ray, number))
                && nearest.is_none_or(|(_, best)| n.meeting.distance < best.meeting.distance)
            {
                farthest = n.meeting.distance;
                nearest = Some((number, n));
            }
        }
        answer(index, nearest.map(|(body, n)| hit(body, &n, start)));
    }
}

#[inline(always)]
fn blocked_body(world: &World, ray: &Ray) -> bool {
    let Some((probe, _)) = world.probe(ray) else { return false };
    let shear = Shear::new(&probe);
    // What moves is smaller and met sooner than what does not.
    (0..).zip(&world.bodies).any(|(number, body)| body.any(&probe, &shear, probe.farthest, except(ray, number)))
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn closest_avx2(world: &World, rays: &[Ray], answer: &mut impl FnMut(usize, Option<Hit>)) {
    closest_body(world, rays, answer);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn blocked_avx2(world: &World, ray: &Ray) -> bool {
    blocked_body(world, ray)
}
