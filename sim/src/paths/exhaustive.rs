//! Brute-force search for paths: every sequence of facets up to an order. Ray discovery is tested against it.

use glam::DVec3;

use super::discovery::{MAX_ORDER, is_possible};
use super::environment::{Environment, FacetId};

/// Every sequence of at most `max_order` facets, including the empty one, in which each facet faces the image before
/// it.
pub fn all_sequences(environment: &Environment, origin: DVec3, max_order: usize) -> Vec<Vec<FacetId>> {
    let mut all = vec![Vec::new()];
    let mut first = 0;
    for _ in 0..max_order.min(MAX_ORDER) {
        let end = all.len();
        for number in first..end {
            let Some(prefix) = all.get(number).cloned() else { continue };
            for facet in 0..environment.len() as FacetId {
                let mut sequence = prefix.clone();
                sequence.push(facet);
                if is_possible(environment, origin, &sequence) {
                    all.push(sequence);
                }
            }
        }
        first = end;
    }
    all
}
