//! Random numbers as a function of (seed, purpose, index), not of threads or order.

use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use sha2::{Digest, Sha256};

/// Random generator for one purpose. The same seed, purpose and index give the same numbers.
pub fn stream(seed: u64, purpose: &str, index: u64) -> Xoshiro256PlusPlus {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    hash.update(purpose.as_bytes());
    Xoshiro256PlusPlus::from_seed(hash.finalize().into())
}
