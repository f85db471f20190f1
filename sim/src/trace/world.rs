//! All bodies together: the two-level query.

use glam::DVec3;

use super::body::{Body, BodyError, Nearest, roaming_m};
use super::packet::{Found, LANES, Packet};
use super::probe::Probe;
use super::ray::{Crossings, Hit, Ray, Surface};

/// Bodies that rays are traced among. Index 0 is best the static room: it ends most rays.
#[derive(Debug, Clone)]
pub struct World {
    bodies: Vec<Body>,
    /// Largest coordinate of all bodies, m.
    scale_m: f64,
    /// Rays from farther away are let begin nearer.
    roaming_m: f64,
}

impl World {
    /// A world of bodies. Those much smaller than it have their boxes enlarged for it.
    ///
    /// # Errors
    /// [`BodyError`] if a structure cannot be built again with larger boxes.
    pub fn new(mut bodies: Vec<Body>) -> Result<Self, BodyError> {
        let scale_m = bodies.iter().map(Body::scale_m).fold(0.0, f64::max);
        enlarge(&mut bodies, scale_m)?;
        Ok(World { bodies, scale_m, roaming_m: roaming_m(scale_m) })
    }

    /// Moves the vertices of a body; see [`Body::refit`].
    ///
    /// # Errors
    /// [`BodyError::NoSuchBody`], and those of [`Body::refit`].
    pub fn refit(&mut self, body: u32, vertices: &[DVec3]) -> Result<(), BodyError> {
        let bodies = self.bodies.len();
        let moved = self.bodies.get_mut(body as usize).ok_or(BodyError::NoSuchBody { body, bodies })?;
        moved.refit(vertices)?;
        let scale_m = moved.scale_m();
        if scale_m > self.scale_m {
            (self.scale_m, self.roaming_m) = (scale_m, roaming_m(scale_m));
            enlarge(&mut self.bodies, scale_m)?;
        }
        Ok(())
    }

    /// The bodies.
    pub fn bodies(&self) -> &[Body] {
        &self.bodies
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
        let probe = self.probe(ray);
        let all = self.bodies.get(body as usize).map(|b| b.all(&probe)).unwrap_or_default();
        all.iter().map(|n| hit(body, n, probe.start)).collect()
    }

    /// Number of times that a ray enters and leaves a body: equally often where the body is closed and the ray begins and ends
    /// outside.
    pub fn crossings(&self, body: u32, ray: &Ray) -> Crossings {
        let probe = self.probe(ray);
        self.bodies.get(body as usize).map(|b| b.crossings(&probe)).unwrap_or_default()
    }

    /// The point of a hit in f64, m: on the triangle to the last bit, beside the ray by what f32 rounded of its weights.
    pub fn point(&self, hit: &Hit) -> Option<DVec3> {
        let [a, b, c] = self.bodies.get(hit.body as usize)?.mesh().corners(hit.triangle as usize)?;
        let [wa, wb, wc] = hit.barycentric.map(f64::from);
        Some((a * wa + b * wb + c * wc) / (wa + wb + wc))
    }

    /// Meeting of a ray with the plane of a hit's triangle in f64: distance, m, and weights of the corners. `None` where it
    /// runs along the plane.
    pub fn exact(&self, ray: &Ray, hit: &Hit) -> Option<(f64, [f64; 3])> {
        let corners = self.bodies.get(hit.body as usize)?.mesh().corners(hit.triangle as usize)?;
        super::reference::plane(ray, corners)
    }

    /// The ray in f32. Rays from far away begin a metre before the first body, where f32 still tells small things apart.
    #[inline(always)]
    fn probe(&self, ray: &Ray) -> Probe {
        let start = if ray.origin.abs().max_element() > self.roaming_m { self.approach_m(ray) } else { 0.0 };
        Probe::new(ray, start)
    }

    #[cold]
    fn approach_m(&self, ray: &Ray) -> f64 {
        let reach = 3f64.sqrt() * self.scale_m + 1.0;
        let start = -ray.origin.dot(ray.direction) - reach;
        if start.is_finite() { start.max(0.0) } else { 0.0 }
    }
}

/// Enlarges the boxes of bodies much smaller than the world they are in.
fn enlarge(bodies: &mut [Body], scale_m: f64) -> Result<(), BodyError> {
    for body in bodies.iter_mut().filter(|b| 1.5 * roaming_m(b.scale_m()) < roaming_m(scale_m)) {
        body.fit(scale_m)?;
    }
    Ok(())
}

#[inline(always)]
fn hit(body: u32, nearest: &Nearest, start: f64) -> Hit {
    let weights = nearest.meeting.weights;
    let sum = (weights.x + weights.y) + weights.z;
    Hit {
        body,
        triangle: nearest.triangle,
        distance_m: start + f64::from(nearest.meeting.distance).max(0.0),
        barycentric: (weights / sum).to_array(),
        front: sum > 0.0,
    }
}

// Loops rather than closures where it is hot: what is not inlined is not compiled for the processor's own instructions.
#[inline(always)]
pub(super) fn closest_body(world: &World, rays: &[Ray], answer: &mut impl FnMut(usize, Option<Hit>)) {
    let mut probes = [Probe::NOWHERE; LANES];
    for (chunk, rays) in rays.chunks(LANES).enumerate() {
        for (probe, ray) in probes.iter_mut().zip(rays) {
            *probe = world.probe(ray);
        }
        let mut found: Found = [None; LANES];
        let packet = if rays.len() == LANES { Packet::new(&probes) } else { None };
        if let Some(mut packet) = packet {
            for (number, body) in (0..).zip(&world.bodies) {
                packet.closest(&probes, number, body, &mut found);
            }
        } else {
            for ((probe, best), _) in probes.iter().zip(&mut found).zip(rays) {
                for (number, body) in (0..).zip(&world.bodies) {
                    body.closest(probe, number, best);
                }
            }
        }
        for (i, ((probe, found), _)) in probes.iter().zip(&found).zip(rays).enumerate() {
            answer(chunk * LANES + i, found.as_ref().map(|(body, nearest)| hit(*body, nearest, probe.start)));
        }
    }
}

#[inline(always)]
fn blocked_body(world: &World, ray: &Ray) -> bool {
    let probe = world.probe(ray);
    for (number, body) in (0..).zip(&world.bodies) {
        if body.any(&probe, number) {
            return true;
        }
    }
    false
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
