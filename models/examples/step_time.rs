//! Time of each step of a prepared network on one map of 128 x 128, us: median and least of several runs.
//!
//! `RAYON_NUM_THREADS=2 cargo run --release -p radome-models --example step_time [NETWORK [RUNS [LEVEL]]]`
#![allow(clippy::print_stdout)]

use std::time::Instant;

use candle_core::{Result, bail};
use radome_models::NetworkSpec;
use radome_models::layer::KernelLevel;
use radome_models::network::{Inference, Network};
use radome_models::train::Trainer;

#[global_allocator]
static ALLOCATOR: radome_models::LargeBlocks = radome_models::LargeBlocks::new();

const SIZE: usize = 128;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let name = arguments.next().unwrap_or_else(|| "hqnn".to_owned());
    let runs = arguments.next().and_then(|runs| runs.parse().ok()).unwrap_or(1000);
    let level = match arguments.next().as_deref() {
        Some("portable") => KernelLevel::Portable,
        Some("avx2") => KernelLevel::Avx2,
        _ => KernelLevel::detect(),
    };
    let Some(spec) = NetworkSpec::named(&name) else { bail!("there is no network '{name}'") };
    let network = Network::initialise(&spec, 1, 0, level)?;
    let mut inference = Inference::new(&network)?;
    let (input, _) = Trainer::random_inputs(&spec, 1, SIZE, SIZE)?;
    let shape = input.dims3()?;
    let input: Vec<f32> = input.flatten_all()?.to_vec1()?;
    // Times of each step and of the whole run.
    let mut times: Vec<(String, Vec<f64>)> = Vec::new();
    for _ in 0..runs {
        let mut step = 0;
        let mut add = |name: &str, seconds: f64| {
            if times.len() <= step {
                times.push((name.to_owned(), Vec::new()));
            }
            times[step].1.push(1e6 * seconds);
            step += 1;
        };
        let start = Instant::now();
        let mut last = start;
        inference.logits_step_by_step(&input, shape.into(), |name| {
            let now = Instant::now();
            add(name, (now - last).as_secs_f64());
            last = now;
        })?;
        add("all", start.elapsed().as_secs_f64());
    }
    for (name, times) in &mut times {
        times.sort_by(f64::total_cmp);
        println!("{name:40} {:8.1} {:8.1}", times[times.len() / 2], times[0]);
    }
    Ok(())
}
