//! Minimisation of a smooth function of some hundred parameters.

use std::collections::VecDeque;

/// Steps in the memory of L-BFGS.
const MEMORY: usize = 10;

/// Finds a minimum near `start` of a function with its gradient, in at most `most_steps` steps. The method is L-BFGS
/// (Nocedal and Wright, Numerical Optimization, 2006, algorithm 7.5) with steps that are halved until the function
/// falls. It ends early if a step gains less than the share `least_gain` of the value. `None` if the function is not
/// finite at the start.
///
/// # Errors
/// Those of the function.
pub(super) fn minimise<E>(
    start: Vec<f64>,
    most_steps: usize,
    least_gain: f64,
    mut function: impl FnMut(&[f64]) -> Result<(f64, Vec<f64>), E>,
) -> Result<Option<Vec<f64>>, E> {
    let mut point = start;
    let (mut value, mut gradient) = function(&point)?;
    if !value.is_finite() || gradient.iter().any(|g| !g.is_finite()) {
        return Ok(None);
    }
    // Steps and the changes of the gradient over them, the oldest first.
    let mut past = VecDeque::new();
    for _ in 0..most_steps {
        let direction = descent(&gradient, &past);
        let slope = dot(&direction, &gradient);
        if slope.is_nan() || slope >= 0.0 {
            break;
        }
        let mut length = 1.0;
        let accepted = loop {
            let next = sum(&point, length, &direction);
            let (next_value, next_gradient) = function(&next)?;
            if next_value <= value + 1e-4 * length * slope && next_gradient.iter().all(|g| g.is_finite()) {
                break Some((next, next_value, next_gradient));
            }
            length *= 0.5;
            if length < 1e-6 {
                break None;
            }
        };
        let Some((next, next_value, next_gradient)) = accepted else { break };
        let (step, change) = (sum(&next, -1.0, &point), sum(&next_gradient, -1.0, &gradient));
        if dot(&step, &change) > 1e-10 * dot(&change, &change) {
            past.push_back((step, change));
            if past.len() > MEMORY {
                past.pop_front();
            }
        }
        let gain = value - next_value;
        (point, value, gradient) = (next, next_value, next_gradient);
        if gain < least_gain * value.abs() {
            break;
        }
    }
    Ok(Some(point))
}

/// Direction of descent by the two-loop recursion over past steps and changes of the gradient.
fn descent(gradient: &[f64], past: &VecDeque<(Vec<f64>, Vec<f64>)>) -> Vec<f64> {
    let mut direction: Vec<f64> = gradient.iter().map(|g| -g).collect();
    let mut factors = Vec::with_capacity(past.len());
    for (step, change) in past.iter().rev() {
        let factor = dot(step, &direction) / dot(step, change);
        direction = sum(&direction, -factor, change);
        factors.push(factor);
    }
    let scale = match past.back() {
        Some((step, change)) => dot(step, change) / dot(change, change),
        None => 1.0 / dot(gradient, gradient).sqrt().max(1.0),
    };
    direction.iter_mut().for_each(|d| *d *= scale);
    for ((step, change), factor) in past.iter().zip(factors.iter().rev()) {
        let correction = dot(change, &direction) / dot(step, change);
        direction = sum(&direction, factor - correction, step);
    }
    direction
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// `a + factor b`.
fn sum(a: &[f64], factor: f64, b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a + factor * b).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_minimum_of_rosenbrocks_function_is_found() {
        let rosenbrock = |x: &[f64]| {
            let (a, b) = (1.0 - x[0], x[1] - x[0] * x[0]);
            Ok::<_, String>((a * a + 100.0 * b * b + 1.0, vec![-2.0 * a - 400.0 * x[0] * b, 200.0 * b]))
        };
        let found = minimise(vec![-1.2, 1.0], 100, 1e-6, rosenbrock).expect("no error").expect("a minimum");
        assert!(found.iter().all(|x| (x - 1.0).abs() < 0.02), "{found:?}");
    }

    #[test]
    fn a_function_that_is_not_finite_at_the_start_has_no_minimum() {
        let found = minimise(vec![0.0], 100, 1e-6, |_| Ok::<_, String>((f64::NAN, vec![0.0])));
        assert_eq!(found, Ok(None));
    }
}
