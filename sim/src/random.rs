//! Random draws that are functions of (seed, purpose, index), independent of thread and order.

use radome_dsp::split_mix_64;
use rand::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// Purpose of a draw: draws for different purposes are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Receiver noise of (frame, rx).
    Noise,
    /// Jitter of clutter, leakage and offset of a frame.
    FrameJitter,
    /// Slow drift of a static path.
    Drift,
    /// Scattering points of furniture.
    Furniture,
    /// Start of visits of a slot, and events in them.
    Visit,
    /// Build and clothes of a person.
    Build,
    /// Small motions of a person.
    MicroMotion,
    /// Fidgets of a person in an epoch.
    Fidget,
    /// Way in which people sit at a desk.
    Desk,
    /// Differences between scenes of one file.
    Scene,
    /// Points of walls that scatter in all directions.
    WallPoints,
    /// Gait of a person. The number 11 stays unused: renumbering would change all later draws.
    Gait = 12,
    /// Phase noise of a frame.
    PhaseNoise,
    /// Times and heights of the steps of echoes.
    ClutterStep,
    /// Paths from wall to wall.
    WallWalks,
    /// Small reflectors that sway.
    Sway,
    /// Vibration of the radar.
    Vibration,
    /// Spurious tones of the receiver, and their phases.
    Spur,
    /// Slow changes of the gain.
    GainDrift,
    /// Jitter of the chirps' times in a frame.
    ChirpJitter,
    /// People who wander.
    Wander,
}

/// Generator for one purpose and index.
pub fn generator(seed: u64, purpose: Purpose, index: [u64; 2]) -> Xoshiro256PlusPlus {
    let mut state = split_mix_64(seed);
    for word in [purpose as u64 + 1, index[0], index[1]] {
        state = split_mix_64(state ^ split_mix_64(word));
    }
    Xoshiro256PlusPlus::seed_from_u64(state)
}

/// Draws a number between two bounds.
pub(crate) fn draw(rng: &mut Xoshiro256PlusPlus, [low, high]: [f64; 2]) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngCore;

    #[test]
    fn neighbouring_indices_and_purposes_give_unrelated_streams() {
        let first = |seed, purpose, index| generator(seed, purpose, index).next_u64();
        let mut seen = std::collections::HashSet::new();
        for seed in 0..4 {
            for purpose in [Purpose::Noise, Purpose::Visit, Purpose::Desk] {
                for a in 0..16 {
                    for b in 0..16 {
                        assert!(seen.insert(first(seed, purpose, [a, b])), "{seed} {purpose:?} {a} {b}");
                    }
                }
            }
        }
        assert_eq!(first(7, Purpose::Noise, [3, 1]), first(7, Purpose::Noise, [3, 1]));
    }
}
