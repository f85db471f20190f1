//! Time of each layer shape of ResNet-18 and EfficientNet-B0 on 32 maps of 128 x 128, ms, for the forward pass alone
//! and with the backward pass. `radome bench train` and `radome bench infer` time whole networks.
//!
//! `cargo run --release -p radome-models --example layer_time [level]`
#![allow(clippy::print_stdout)]

use std::time::Instant;

use candle_core::{Device, Result, Tensor, Var};
use radome_models::layer::{
    Activation, BatchNormConstants, BatchNormMode, ConvGeometry, InputGradient, KernelLevel, RunningStatistics,
    backward, batch_norm, conv2d, linear, max_pool2d,
};

#[global_allocator]
static ALLOCATOR: radome_models::LargeBlocks = radome_models::LargeBlocks::new();

const BATCH: usize = 32;

/// Name, rows and columns, inputs, outputs, kernel and stride; the last field is true for depthwise convolutions.
const SHAPES: &[(&str, usize, usize, usize, usize, usize, bool)] = &[
    ("resnet stem 7x7/2", 128, 1, 64, 7, 2, false),
    ("resnet 3x3", 32, 64, 64, 3, 1, false),
    ("resnet 3x3/2", 32, 64, 128, 3, 2, false),
    ("resnet 1x1/2", 32, 64, 128, 1, 2, false),
    ("resnet 3x3", 16, 128, 128, 3, 1, false),
    ("resnet 3x3", 8, 256, 256, 3, 1, false),
    ("resnet 3x3", 4, 512, 512, 3, 1, false),
    ("b0 stem 3x3/2", 128, 1, 32, 3, 2, false),
    ("b0 depthwise 3x3", 64, 32, 32, 3, 1, true),
    ("b0 pointwise", 64, 32, 16, 1, 1, false),
    ("b0 pointwise", 64, 16, 96, 1, 1, false),
    ("b0 depthwise 3x3/2", 64, 96, 96, 3, 2, true),
    ("b0 pointwise", 32, 96, 24, 1, 1, false),
    ("b0 pointwise", 32, 24, 144, 1, 1, false),
    ("b0 depthwise 5x5/2", 32, 144, 144, 5, 2, true),
    ("b0 pointwise", 16, 240, 40, 1, 1, false),
    ("b0 depthwise 3x3", 8, 480, 480, 3, 1, true),
    ("b0 depthwise 5x5", 8, 672, 672, 5, 1, true),
    ("b0 pointwise", 8, 672, 112, 1, 1, false),
    ("b0 pointwise", 4, 1152, 320, 1, 1, false),
    ("b0 pointwise", 4, 320, 1280, 1, 1, false),
];

/// Current time, ms: the wall time since `start`, or if `RAYON_NUM_THREADS` is 1 the processor time of all threads, which other
/// programs disturb less.
fn now_ms(start: Instant) -> f64 {
    #[cfg(target_os = "linux")]
    if std::env::var("RAYON_NUM_THREADS").as_deref() == Ok("1") {
        let cpu = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        return cpu.tv_sec as f64 * 1e3 + cpu.tv_nsec as f64 * 1e-6;
    }
    start.elapsed().as_secs_f64() * 1e3
}

/// Least time of several runs, ms: forward pass, and forward with backward pass.
fn time(repetitions: usize, mut f: impl FnMut() -> Result<Tensor>) -> Result<[f64; 2]> {
    let mut best = [f64::INFINITY; 2];
    let start = Instant::now();
    for _ in 0..repetitions {
        let start_ms = now_ms(start);
        let out = f()?;
        best[0] = best[0].min(now_ms(start) - start_ms);
        backward(&out)?;
        best[1] = best[1].min(now_ms(start) - start_ms);
    }
    Ok(best)
}

fn random(shape: &[usize]) -> Result<Var> {
    let fan_in: usize = shape.iter().skip(1).product();
    Var::from_tensor(&Tensor::randn(0f32, (2.0 / fan_in as f32).sqrt(), shape, &Device::Cpu)?)
}

fn main() -> Result<()> {
    let level = match std::env::args().nth(1).as_deref() {
        Some("portable") => KernelLevel::Portable,
        Some("avx2") => KernelLevel::Avx2,
        _ => KernelLevel::detect(),
    };
    println!("{level:?}, batch {BATCH}; forward ms, forward and backward ms, billion multiply-adds a second forwards");
    for &(name, size, inputs, outputs, kernel, stride, depthwise) in SHAPES {
        let geometry = ConvGeometry { stride, padding: kernel / 2, groups: if depthwise { inputs } else { 1 } };
        let x = random(&[BATCH, size, size, inputs])?;
        let weight = random(&[outputs, inputs / geometry.groups, kernel, kernel])?;
        let input_gradient = if inputs == 1 { InputGradient::Unused } else { InputGradient::Needed };
        let [forward, both] = time(7, || conv2d(&x, &weight, None, geometry, input_gradient, level))?;
        let work = (BATCH * (size / stride).pow(2) * outputs * inputs / geometry.groups * kernel * kernel) as f64;
        println!("{name:20} {size:3} {inputs:4} -> {outputs:4} {forward:8.2} {both:8.2} {:8.1}", work / forward * 1e-6);
    }
    for (size, channels) in [(64, 64), (32, 64), (64, 96), (8, 480)] {
        for act in [Activation::Relu, Activation::Silu] {
            let x = random(&[BATCH, size, size, channels])?;
            let scale = Var::ones(channels, candle_core::DType::F32, &Device::Cpu)?;
            let statistics = RunningStatistics::new(channels, BatchNormConstants::default());
            let [forward, both] =
                time(7, || batch_norm(&x, &scale, &scale, &statistics, BatchNormMode::Training, act, level))?;
            println!("{:20} {size:3} {channels:4}         {forward:8.2} {both:8.2}", format!("batch norm, {act:?}"));
        }
    }
    let x = random(&[BATCH, 64, 64, 64])?;
    let [forward, both] = time(7, || max_pool2d(&x, 3, 2, 1, level))?;
    println!("{:20} {:3} {:4}         {forward:8.2} {both:8.2}", "max pool 3x3/2", 64, 64);
    let (x, w, b) = (random(&[BATCH, 4096])?, random(&[512, 4096])?, random(&[512, 1])?.flatten_all()?);
    let [forward, both] = time(7, || linear(&x, &w, &b, level))?;
    println!("{:20}     4096 ->  512 {forward:8.2} {both:8.2}", "linear");
    Ok(())
}
