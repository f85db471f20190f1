//! Time of each layer shape of ResNet-18 and EfficientNet-B0 on 32 maps of 128 x 128, ms, for the forward pass alone
//! and with the backward pass. Also times a training step of a whole ResNet-18.
//!
//! `cargo run --release -p radome-models --example layer_time [level]`
#![allow(clippy::print_stdout)]

use std::time::Instant;

use candle_core::{Device, Result, Tensor, Var};
use radome_models::layer::{
    Activation, BatchNormConstants, BatchNormMode, ConvGeometry, Feature, InputGradient, KernelLevel, PreparedConv,
    RunningStatistics, adaptive_average_pool, add_relu, backward, batch_norm, conv2d, cross_entropy, linear,
    max_pool2d,
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

/// Current time, ms. Where `RAYON_NUM_THREADS` is 1, the processor time of all threads, which other programs disturb
/// less; otherwise the wall time.
fn now(began: Instant) -> f64 {
    #[cfg(target_os = "linux")]
    if std::env::var("RAYON_NUM_THREADS").as_deref() == Ok("1") {
        let cpu = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        return cpu.tv_sec as f64 * 1e3 + cpu.tv_nsec as f64 * 1e-6;
    }
    began.elapsed().as_secs_f64() * 1e3
}

/// Least time of several runs, ms: forward pass, and forward with backward pass.
fn time(repetitions: usize, mut f: impl FnMut() -> Result<Tensor>) -> Result<[f64; 2]> {
    let mut best = [f64::INFINITY; 2];
    let began = Instant::now();
    for _ in 0..repetitions {
        let start = now(began);
        let out = f()?;
        best[0] = best[0].min(now(began) - start);
        backward(&out)?;
        best[1] = best[1].min(now(began) - start);
    }
    Ok(best)
}

fn random(shape: &[usize]) -> Result<Var> {
    let fan_in: usize = shape.iter().skip(1).product();
    Var::from_tensor(&Tensor::randn(0f32, (2.0 / fan_in as f32).sqrt(), shape, &Device::Cpu)?)
}

/// Convolution followed by batch norm.
struct Block {
    weight: Var,
    scale: Var,
    shift: Var,
    statistics: RunningStatistics,
    geometry: ConvGeometry,
}

impl Block {
    fn new(inputs: usize, outputs: usize, kernel: usize, stride: usize) -> Result<Self> {
        Ok(Block {
            weight: random(&[outputs, inputs, kernel, kernel])?,
            scale: Var::ones(outputs, candle_core::DType::F32, &Device::Cpu)?,
            shift: Var::zeros(outputs, candle_core::DType::F32, &Device::Cpu)?,
            statistics: RunningStatistics::new(outputs, BatchNormConstants::default()),
            geometry: ConvGeometry::dense(stride, kernel / 2),
        })
    }

    fn run(&self, x: &Tensor, act: Activation, needs: InputGradient, level: KernelLevel) -> Result<Tensor> {
        let y = conv2d(x, &self.weight, None, self.geometry, needs, level)?;
        batch_norm(&y, &self.scale, &self.shift, &self.statistics, BatchNormMode::Training, act, level)
    }
}

fn resnet(level: KernelLevel) -> Result<impl FnMut() -> Result<Tensor>> {
    let stem = Block::new(1, 64, 7, 2)?;
    let mut blocks = Vec::new();
    let mut inputs = 64;
    for outputs in [64, 128, 256, 512] {
        for k in 0..2 {
            let stride = if k == 0 && outputs > 64 { 2 } else { 1 };
            let shortcut = if stride == 2 { Some(Block::new(inputs, outputs, 1, 2)?) } else { None };
            blocks.push((Block::new(inputs, outputs, 3, stride)?, Block::new(outputs, outputs, 3, 1)?, shortcut));
            inputs = outputs;
        }
    }
    let (weight, bias) = (random(&[3, 512])?, Var::zeros(3, candle_core::DType::F32, &Device::Cpu)?);
    let input = Tensor::randn(0f32, 1.0, (BATCH, 128, 128, 1), &Device::Cpu)?;
    let labels: Vec<usize> = (0..BATCH).map(|i| i % 3).collect();
    Ok(move || {
        let mut x = stem.run(&input, Activation::Relu, InputGradient::Unused, level)?;
        x = max_pool2d(&x, 3, 2, 1, level)?;
        for (first, second, shortcut) in &blocks {
            let y = first.run(&x, Activation::Relu, InputGradient::Needed, level)?;
            let y = second.run(&y, Activation::None, InputGradient::Needed, level)?;
            let short = match shortcut {
                Some(block) => block.run(&x, Activation::None, InputGradient::Needed, level)?,
                None => x,
            };
            x = add_relu(&y, &short, level)?;
        }
        let x = adaptive_average_pool(&x, 1, 1)?;
        cross_entropy(&linear(&x, &weight, &bias, level)?, &labels, &[1.0; 3])
    })
}

/// Classifies `batch` maps by a ResNet-18 with random weights, in the same way as inference.
fn resnet_inference(batch: usize, level: KernelLevel) -> Result<impl FnMut() -> Result<()>> {
    let conv = |inputs: usize, outputs: usize, kernel: usize, stride: usize, act: Activation| -> Result<PreparedConv> {
        let weight = random(&[outputs, inputs, kernel, kernel])?.flatten_all()?.to_vec1::<f32>()?;
        let geometry = ConvGeometry::dense(stride, kernel / 2);
        PreparedConv::new(&weight, [outputs, inputs, kernel, kernel], None, None, geometry, act, level)
    };
    let stem = conv(1, 64, 7, 2, Activation::Relu)?;
    let mut blocks = Vec::new();
    let mut inputs = 64;
    for outputs in [64, 128, 256, 512] {
        for k in 0..2 {
            let stride = if k == 0 && outputs > 64 { 2 } else { 1 };
            let shortcut = if stride == 2 { Some(conv(inputs, outputs, 1, 2, Activation::None)?) } else { None };
            let first = conv(inputs, outputs, 3, stride, Activation::Relu)?;
            blocks.push((first, conv(outputs, outputs, 3, 1, Activation::Relu)?, shortcut));
            inputs = outputs;
        }
    }
    let head = conv(512, 3, 1, 1, Activation::None)?;
    let input = Feature::new([batch, 128, 128, 1], vec![0.5; batch * 128 * 128])?;
    let [mut x, mut y, mut z, mut short] = std::array::from_fn(|_| Feature::default());
    Ok(move || {
        stem.run(&input, None, &mut y)?;
        y.max_pool2d(3, 2, 1, level, &mut x)?;
        for (first, second, shortcut) in &blocks {
            first.run(&x, None, &mut y)?;
            match shortcut {
                Some(conv) => {
                    conv.run(&x, None, &mut short)?;
                    second.run(&y, Some(&short), &mut z)?;
                }
                None => second.run(&y, Some(&x), &mut z)?,
            }
            std::mem::swap(&mut x, &mut z);
        }
        x.adaptive_average_pool(1, 1, &mut y)?;
        head.run(&y, None, &mut z)
    })
}

fn main() -> Result<()> {
    let level = match std::env::args().nth(1).as_deref() {
        Some("portable") => KernelLevel::Portable,
        Some("avx2") => KernelLevel::Avx2,
        _ => KernelLevel::detect(),
    };
    if std::env::args().any(|a| a == "resnet") {
        let [forward, both] = time(8, resnet(level)?)?;
        println!("ResNet-18 {forward:.1} {both:.1}");
        for batch in [1, 32] {
            let mut run = resnet_inference(batch, level)?;
            let (began, mut best) = (Instant::now(), f64::INFINITY);
            for _ in 0..if batch == 1 { 100 } else { 6 } {
                let start = now(began);
                run()?;
                best = best.min(now(began) - start);
            }
            println!("ResNet-18 inference, batch {batch}: {best:.2}");
        }
        return Ok(());
    }
    println!("{level:?}, batch {BATCH}; forward ms, forward and backward ms, billion multiply-adds a second forwards");
    for &(name, size, inputs, outputs, kernel, stride, depthwise) in SHAPES {
        let geometry = ConvGeometry { stride, padding: kernel / 2, groups: if depthwise { inputs } else { 1 } };
        let x = random(&[BATCH, size, size, inputs])?;
        let weight = random(&[outputs, inputs / geometry.groups, kernel, kernel])?;
        let needs = if inputs == 1 { InputGradient::Unused } else { InputGradient::Needed };
        let [forward, both] = time(7, || conv2d(&x, &weight, None, geometry, needs, level))?;
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
    let [forward, both] = time(5, resnet(level)?)?;
    println!("{:20}                  {forward:8.2} {both:8.2}", "ResNet-18");
    Ok(())
}
