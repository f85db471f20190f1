//! CPU time of a training step and of one classification at the paper's map size, beside a fixed calibration kernel.
//!
//! `RAYON_NUM_THREADS=1 cargo run --release -p radome-models --example step_time`
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use candle_core::{Device, Tensor};
use radome_models::layer::{KernelLevel, backward, cross_entropy};
use radome_models::network::Hqnn;

#[global_allocator]
static ALLOCATOR: radome_models::LargeBlocks = radome_models::LargeBlocks::new();

/// CPU time of all threads so far, ms, as Linux counts it; wall time elsewhere.
fn cpu_ms(began: Instant) -> f64 {
    let wall = began.elapsed().as_secs_f64() * 1e3;
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return wall };
    let times = tasks.flatten().filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok());
    times.filter_map(|t| t.split(' ').next()?.parse::<f64>().ok()).sum::<f64>() * 1e-6
}

/// Least CPU time of several runs, ms.
fn best_of(times: usize, mut f: impl FnMut() -> candle_core::Result<()>) -> candle_core::Result<f64> {
    let began = Instant::now();
    let mut best = f64::INFINITY;
    for _ in 0..times {
        let before = cpu_ms(began);
        f()?;
        best = best.min(cpu_ms(began) - before);
    }
    Ok(best)
}

/// 64 million dependent multiply-adds of f64: a measure of the machine, not of this crate.
fn calibration() -> candle_core::Result<f64> {
    best_of(3, || {
        let mut x = black_box(1.0f64);
        for _ in 0..64_000_000 {
            x = x * 0.999_999_9 + 1e-7;
        }
        black_box(x);
        Ok(())
    })
}

fn main() -> candle_core::Result<()> {
    println!("calibration kernel: {:.1} ms", calibration()?);
    for level in KernelLevel::ALL {
        let network = Hqnn::initialise(1, 0, radome_models::network::PAPER_POOLED, level)?;
        let input = Tensor::randn(0f32, 1.0, (32, 128, 128), &Device::Cpu)?;
        let labels: Vec<usize> = (0..32).map(|i| i % 3).collect();
        let forward = best_of(9, || network.stages(&input).map(|_| ()))?;
        let step = best_of(9, || {
            let loss = cross_entropy(&network.stages(&input)?.logits, &labels, &[1.0; 3])?;
            backward(&loss).map(|_| ())
        })?;
        let one = input.narrow(0, 0, 1)?.contiguous()?;
        // The kernel's clock of CPU time is too coarse for a single one.
        let single = best_of(5, || (0..50).try_for_each(|_| network.stages(&one).map(|_| ())))? / 50.0;
        println!(
            "{level:?}: batch 32 forward {forward:.1} ms, with backward {step:.1} ms; batch 1 forward {single:.2} ms"
        );
    }
    Ok(())
}
