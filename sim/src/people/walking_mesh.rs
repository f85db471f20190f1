//! A person's motion with a skin.

use std::sync::Arc;

use super::motion::{Motion, Steps};
use super::skin::{Map, PosedSkin, Skin};
use crate::geometry::{Mesh, one_ring_normals};

/// Step of the rates' differences, s: their error is that of the fifth derivative, below 1 um/s.
const RATE_STEP_S: f64 = 5e-4;

/// A person who walks as a mesh.
#[derive(Debug, Clone)]
pub struct WalkingMesh {
    skin: Arc<Skin>,
    motion: Arc<Motion>,
}

impl WalkingMesh {
    /// A mesh for a motion: the actor's own skin, or one of the person's build; see [`Skin::new`] for `edge_m`.
    pub fn new(motion: Arc<Motion>, edge_m: f64) -> Self {
        let skin = match &motion.person.steps {
            Steps::Actor(actor) => Arc::clone(actor.skin()),
            Steps::Gait | Steps::Clip(_) => Arc::new(Skin::new(&motion.person.build, edge_m)),
        };
        WalkingMesh { skin, motion }
    }

    /// The skin.
    pub fn skin(&self) -> &Skin {
        &self.skin
    }

    /// The motion.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// The skin's bones at a time, in the room.
    fn maps(&self, time_s: f64) -> Vec<Map> {
        match &self.motion.person.steps {
            Steps::Actor(actor) => actor.maps(&self.motion.walk(time_s)),
            Steps::Gait | Steps::Clip(_) => self.motion.body(time_s).iter().map(Map::of).collect(),
        }
    }

    /// The skin at a time, in the room, with what a surface integral needs.
    pub fn posed(&self, time_s: f64) -> PosedSkin {
        let h = RATE_STEP_S;
        let [far_before, before, after, far_after] =
            [-2.0 * h, -h, h, 2.0 * h].map(|offset| self.maps(time_s + offset));
        // The five-point rule: (f(-2h) - 8 f(-h) + 8 f(h) - f(2h)) / 12 h.
        let near = before.iter().zip(&after);
        let rates: Vec<Map> = far_before
            .iter()
            .zip(&far_after)
            .zip(near)
            .map(|((a, d), (b, c))| Map {
                centre: (a.centre - d.centre + (c.centre - b.centre) * 8.0) / (12.0 * h),
                stretch: (a.stretch - d.stretch + (c.stretch - b.stretch) * 8.0) * (1.0 / (12.0 * h)),
            })
            .collect();
        let vertices = self.skin.pose(&self.maps(time_s));
        let normals = one_ring_normals(&vertices, &self.skin.rest().triangles);
        PosedSkin { vertices, velocities_m_per_s: self.skin.pose(&rates), normals }
    }

    /// The mesh at a time, in the room.
    pub fn mesh_at(&self, time_s: f64) -> Mesh {
        Mesh { vertices: self.skin.pose(&self.maps(time_s)), triangles: self.skin.rest().triangles.clone() }
    }
}
