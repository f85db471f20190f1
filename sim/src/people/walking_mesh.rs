//! A person's motion with a skin.

use std::sync::Arc;

use super::motion::{Motion, Steps};
use super::skin::{BoneMap, PosedSkin, Skin};
use crate::geometry::{Mesh, one_ring_normals};

/// Step of the finite differences for rates, s. Their error is that of the fifth derivative, below 1 um/s.
const RATE_STEP_S: f64 = 5e-4;

/// A walking person with a skin.
#[derive(Debug, Clone)]
pub struct WalkingMesh {
    skin: Arc<Skin>,
    motion: Arc<Motion>,
}

impl WalkingMesh {
    /// Makes the mesh for a motion: the actor's own skin, or one for the person's build. See [`Skin::new`] for
    /// `edge_m`.
    pub fn new(motion: Arc<Motion>, edge_m: f64) -> Self {
        let skin = match &motion.person.steps {
            Steps::Actor(actor) => Arc::clone(&actor.skin),
            Steps::Gait | Steps::Clip(_) => Arc::new(Skin::new(&motion.person.build, edge_m)),
        };
        WalkingMesh { skin, motion }
    }

    /// Skin of the person.
    pub fn skin(&self) -> &Skin {
        &self.skin
    }

    /// Motion of the person.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// Returns the maps of the skin's bones at a time, in room coordinates.
    fn maps(&self, time_s: f64) -> Vec<BoneMap> {
        match &self.motion.person.steps {
            Steps::Actor(actor) => actor.maps(&self.motion.walk(time_s)),
            Steps::Gait | Steps::Clip(_) => self.motion.body(time_s).iter().map(BoneMap::of_ellipsoid).collect(),
        }
    }

    /// Returns the skin at a time, in room coordinates, with velocities and normals for a surface integral.
    pub fn posed(&self, time_s: f64) -> PosedSkin {
        let h = RATE_STEP_S;
        let [far_before, before, after, far_after] =
            [-2.0 * h, -h, h, 2.0 * h].map(|offset| self.maps(time_s + offset));
        // The five-point rule: (f(-2h) - 8 f(-h) + 8 f(h) - f(2h)) / 12 h.
        let near = before.iter().zip(&after);
        let rates: Vec<BoneMap> = far_before
            .iter()
            .zip(&far_after)
            .zip(near)
            .map(|((a, d), (b, c))| BoneMap {
                centre: (a.centre - d.centre + (c.centre - b.centre) * 8.0) / (12.0 * h),
                linear: (a.linear - d.linear + (c.linear - b.linear) * 8.0) * (1.0 / (12.0 * h)),
            })
            .collect();
        let vertices = self.skin.pose(&self.maps(time_s));
        let normals = one_ring_normals(&vertices, &self.skin.rest().triangles);
        PosedSkin { vertices, velocities_m_per_s: self.skin.pose(&rates), normals }
    }

    /// Returns the mesh at a time, in room coordinates.
    pub fn mesh_at(&self, time_s: f64) -> Mesh {
        Mesh { vertices: self.skin.pose(&self.maps(time_s)), triangles: self.skin.rest().triangles.clone() }
    }
}
