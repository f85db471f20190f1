//! `radome bench train` and `radome bench infer`: networks beside PyTorch and onnxruntime in the same run.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, bail};
use radome_models::layer::KernelLevel;
use radome_models::network::{Inference, Network};
use radome_models::train::Trainer;
use radome_models::{NetworkSpec, onnx};
use serde::{Deserialize, Serialize};

use super::point::{Point, least_ms};
use crate::output;

/// Networks that are timed if none is named, as the script of the peers knows them.
const NETWORKS: [&str; 5] = ["hqnn", "estimator_matched", "doppler_net", "resnet18", "efficientnet_b0"];
/// The same as stages of the table.
const STAGES: [&str; NETWORKS.len()] = [
    "a map by the HQNN",
    "a map by its linear control",
    "a map by DopplerNet",
    "a map by ResNet-18",
    "a map by EfficientNet-B0",
];
const SIZE: usize = 128;

/// `radome bench train`, `radome bench infer`
#[derive(clap::Args)]
pub struct Arguments {
    /// Networks, as `radome models` names them
    networks: Vec<String>,
    /// Maps of a step or of a call
    #[arg(long)]
    batch: Option<usize>,
    /// Threads, ours and the peers'
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Runs of which the least counts
    #[arg(long)]
    repeats: Option<usize>,
    /// Python with torch, torchvision and onnxruntime; `python3` if not given, and nothing beside ours if it has none
    #[arg(long)]
    python: Option<PathBuf>,
    /// A list of objects
    #[arg(long)]
    json: bool,
}

/// One network by one program.
#[derive(Serialize, Deserialize, Clone)]
struct Row {
    model: String,
    peer: String,
    batch: usize,
    threads: usize,
    milliseconds: f64,
}

/// A training step: forward, backward, Adam.
pub fn train(arguments: &Arguments) -> anyhow::Result<()> {
    let (batch, repeats) = (arguments.batch.unwrap_or(32), arguments.repeats.unwrap_or(5));
    compare(arguments, "train", batch, repeats, &|spec, _| {
        // At rate zero a step is whole, but the network stays as random as it was: units that die while made-up maps are
        // learnt by heart would make later steps cheaper.
        let mut trainer = Trainer::new(spec, 1, 0.0, KernelLevel::detect())?;
        let (maps, labels) = Trainer::made_up_maps(batch, SIZE, SIZE)?;
        least(repeats, || Ok(trainer.step(&maps, &labels).map(|_| ())?))
    })
}

/// One map to logits, for the table of all stages; errors are those of logits against the portable
/// kernels, over the largest.
pub fn points(python: Option<&Path>) -> anyhow::Result<Vec<Point>> {
    const ROUNDS: usize = 30;
    let folder = std::env::temp_dir().join(format!("radome-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let mut points = Vec::new();
    for (name, stage) in NETWORKS.iter().zip(STAGES) {
        let spec = NetworkSpec::named(name).with_context(|| format!("there is no network '{name}'"))?;
        let maps: Vec<f32> = Trainer::made_up_maps(1, SIZE, SIZE)?.0.flatten_all()?.to_vec1()?;
        let mut portable = Vec::new();
        for level in [KernelLevel::Portable, KernelLevel::detect()] {
            let network = Network::initialise(&spec, 1, 0, level)?;
            let mut inference = Inference::new(&network)?;
            let mut logits = Vec::new();
            let rounds = if level == KernelLevel::Portable { 1 } else { ROUNDS };
            let milliseconds = least_ms(rounds, || {
                logits = inference.logits(&maps, [1, SIZE, SIZE])?.to_vec();
                Ok(())
            })?;
            if level == KernelLevel::Portable {
                std::fs::write(folder.join(format!("{name}.onnx")), onnx::export_network(&network, SIZE, SIZE)?)?;
                portable = logits;
                continue;
            }
            let largest = portable.iter().map(|a| f64::from(a.abs())).fold(f64::MIN_POSITIVE, f64::max);
            let apart =
                portable.iter().zip(&logits).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max) / largest;
            let way = format!("native, {:.0} k parameters", spec.parameter_count() as f64 * 1e-3);
            points.push(Point {
                stage,
                way,
                milliseconds,
                error: Some(apart),
                error_unit: "of logits",
                is_peer: false,
            });
        }
        let arguments = Arguments {
            networks: Vec::new(),
            batch: None,
            threads: rayon::current_num_threads(),
            repeats: None,
            python: python.map(Path::to_owned),
            json: false,
        };
        let mut rows = peers(&arguments, "infer", name, 1, ROUNDS, None);
        rows.extend(peers(&arguments, "infer", name, 1, ROUNDS, Some(&folder)));
        points.extend(rows.into_iter().map(|row| Point {
            stage,
            way: row.peer,
            milliseconds: row.milliseconds,
            error: None,
            error_unit: "of logits",
            is_peer: true,
        }));
    }
    std::fs::remove_dir_all(&folder)?;
    Ok(points)
}

/// Maps to logits.
pub fn infer(arguments: &Arguments) -> anyhow::Result<()> {
    let (batch, repeats) = (arguments.batch.unwrap_or(1), arguments.repeats.unwrap_or(30));
    compare(arguments, "infer", batch, repeats, &|spec, folder| {
        let network = Network::initialise(spec, 1, 0, KernelLevel::detect())?;
        let name = named(spec)?;
        std::fs::write(folder.join(format!("{name}.onnx")), onnx::export_network(&network, SIZE, SIZE)?)?;
        let maps: Vec<f32> = Trainer::made_up_maps(batch, SIZE, SIZE)?.0.flatten_all()?.to_vec1()?;
        let mut inference = Inference::new(&network)?;
        least(repeats, || Ok(inference.logits(&maps, [batch, SIZE, SIZE]).map(|_| ())?))
    })
}

fn named(spec: &NetworkSpec) -> anyhow::Result<String> {
    let networks = radome_models::networks().into_iter();
    let found = networks.map(|network| network.name).find(|name| NetworkSpec::named(name).as_ref() == Some(spec));
    found.context("a network without a name")
}

fn least(repeats: usize, mut run: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    run()?;
    let mut least = f64::INFINITY;
    for _ in 0..repeats {
        let began = Instant::now();
        run()?;
        least = least.min(1e3 * began.elapsed().as_secs_f64());
    }
    Ok(least)
}

fn compare(
    arguments: &Arguments,
    what: &str,
    batch: usize,
    repeats: usize,
    ours: &dyn Fn(&NetworkSpec, &Path) -> anyhow::Result<f64>,
) -> anyhow::Result<()> {
    let names: Vec<String> = match arguments.networks.as_slice() {
        [] => NETWORKS.map(str::to_owned).to_vec(),
        named => named.to_vec(),
    };
    let threads = arguments.threads.max(1);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("cannot start threads")?;
    let folder = std::env::temp_dir().join(format!("radome-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let mut rows = Vec::new();
    for name in &names {
        let Some(spec) = NetworkSpec::named(name) else {
            bail!("there is no network '{name}'\n\nhint: `radome models` lists them");
        };
        let mut of_network = vec![Row {
            model: name.clone(),
            peer: "radome".to_owned(),
            batch,
            threads,
            milliseconds: ours(&spec, &folder)?,
        }];
        // Beside each of ours its peers, so that whatever else the machine does meets both.
        of_network.extend(peers(arguments, what, name, batch, repeats, None));
        if what == "infer" {
            of_network.extend(peers(arguments, what, name, batch, repeats, Some(&folder)));
        }
        if !arguments.json {
            let own = of_network.first().map_or(f64::NAN, |row| row.milliseconds);
            for row in &of_network {
                let ratio = own / row.milliseconds;
                output::text_line(&format!(
                    "{:18} {:12} batch {:2} {} threads {:9.2} ms   ours is {ratio:.2} of it",
                    row.model, row.peer, row.batch, row.threads, row.milliseconds
                ))?;
            }
        }
        rows.extend(of_network);
    }
    std::fs::remove_dir_all(&folder)?;
    if arguments.json { output::json_line(&rows) } else { Ok(()) }
}

/// What the script of the peers says, or nothing where it cannot run.
fn peers(arguments: &Arguments, what: &str, name: &str, batch: usize, repeats: usize, onnx: Option<&Path>) -> Vec<Row> {
    let python = arguments.python.clone().unwrap_or_else(|| PathBuf::from("python3"));
    let mut command = Command::new(python);
    command.args(["cli/bench/networks.py", what, name, "--threads", &arguments.threads.to_string()]);
    command.args(["--batch", &batch.to_string(), "--repeats", &repeats.to_string()]);
    if let Some(folder) = onnx {
        command.arg("--onnx").arg(folder);
    }
    let Ok(output) = command.output() else { return Vec::new() };
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        eprintln!("no peer for {name}: {}", said.lines().last().unwrap_or("it failed without a word"));
    }
    let said = String::from_utf8_lossy(&output.stdout);
    said.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}
