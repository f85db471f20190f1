//! `radome bench train` and `radome bench infer`: networks compared with PyTorch and onnxruntime in the same run.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use radome_models::layer::KernelLevel;
use radome_models::network::{Inference, Network};
use radome_models::train::Trainer;
use radome_models::{NetworkSpec, onnx};
use serde::Serialize;

use super::peer::Peer;
use super::point::{Point, least_ms};
use crate::output;

/// Networks that are timed by default, by the names that the script of the peers uses.
const NETWORKS: [&str; 5] = ["hqnn", "estimator_matched", "doppler_net", "resnet18", "efficientnet_b0"];
/// The same networks as stages of the table.
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
    /// Networks, as `radome model list` names them; hqnn, estimator_matched, doppler_net, resnet18 and efficientnet_b0 if absent. Only
    /// these five are compared with other libraries. `bench infer` takes none whose name begins with descriptor_
    networks: Vec<String>,
    /// Number of maps in a step or call; if absent 32 for `bench train`, 1 for `bench infer`
    #[arg(long)]
    batch: Option<usize>,
    /// Number of threads of radome and of the other libraries
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Timed runs in a turn, after one that is not timed; if absent 5 for `bench train`, 30 for `bench infer`
    #[arg(long)]
    repeats: Option<usize>,
    /// Turns of radome and of the other libraries, which alternate
    #[arg(long, default_value_t = 5)]
    turns: usize,
    /// Python with torch, torchvision and onnxruntime; `python3` if absent. Without these packages, only radome is measured
    #[arg(long)]
    python: Option<PathBuf>,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

/// Time of one network in one program: minimum and median of all runs of all turns.
#[derive(Serialize)]
struct Row {
    model: String,
    peer: String,
    batch: usize,
    threads: usize,
    milliseconds: f64,
    median_milliseconds: f64,
}

/// Pause after each turn. Programs take turns, so that other load on the machine affects all of them. Threads that
/// still spin after a turn do so in this pause and not in the next program's turn.
const PAUSE: Duration = Duration::from_millis(100);

/// Times a training step: forward, backward, Adam.
///
/// # Errors
/// There is no such network, or the peer fails.
pub fn train(arguments: &Arguments) -> anyhow::Result<()> {
    let (batch, repeats) = (arguments.batch.unwrap_or(32), arguments.repeats.unwrap_or(5));
    compare(arguments, "train", batch, repeats, &|spec, _, _| {
        // At learning rate zero a step does all its work, but the network stays random. Learning the random maps by
        // heart would kill units, which would make later steps cheaper.
        let mut trainer = Trainer::new(spec, 1, 0.0, KernelLevel::detect())?;
        let (maps, labels) = Trainer::random_inputs(spec, batch, SIZE, SIZE)?;
        Ok(Box::new(move || Ok(trainer.step(&maps, &labels).map(|_| ())?)))
    })
}

/// Measures one map to logits, for the table of all stages. The error is that of the logits against the portable
/// kernels, relative to the largest.
///
/// # Errors
/// A network cannot be prepared, or the peer fails.
pub fn points(python: Option<&Path>) -> anyhow::Result<Vec<Point>> {
    const ROUNDS: usize = 30;
    let folder = std::env::temp_dir().join(format!("radome-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let mut points = Vec::new();
    let point = |stage, way, milliseconds, error, is_peer| Point {
        stage,
        way,
        milliseconds,
        error,
        error_unit: "of logits",
        is_peer,
    };
    for (name, stage) in NETWORKS.iter().zip(STAGES) {
        let spec = NetworkSpec::named(name).with_context(|| format!("there is no network '{name}'"))?;
        let maps: Vec<f32> = Trainer::random_inputs(&spec, 1, SIZE, SIZE)?.0.flatten_all()?.to_vec1()?;
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
            let difference =
                portable.iter().zip(&logits).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max) / largest;
            let way = format!("native, {:.0} k parameters", spec.parameter_count() as f64 * 1e-3);
            points.push(point(stage, way, milliseconds, Some(difference), false));
        }
        let threads = rayon::current_num_threads();
        for onnx in [None, Some(folder.as_path())] {
            let Some(mut peer) = Peer::start(python, "infer", name, threads, 1, ROUNDS, onnx) else { continue };
            let times = peer.turn();
            let Some(milliseconds) = times.iter().copied().reduce(f64::min) else { continue };
            points.push(point(stage, peer.name.clone(), milliseconds, None, true));
        }
    }
    std::fs::remove_dir_all(&folder)?;
    Ok(points)
}

/// Times the inference from maps to logits.
///
/// # Errors
/// There is no such network, or the peer fails.
pub fn infer(arguments: &Arguments) -> anyhow::Result<()> {
    let (batch, repeats) = (arguments.batch.unwrap_or(1), arguments.repeats.unwrap_or(30));
    compare(arguments, "infer", batch, repeats, &|spec, name, folder| {
        let network = Network::initialise(spec, 1, 0, KernelLevel::detect())?;
        std::fs::write(folder.join(format!("{name}.onnx")), onnx::export_network(&network, SIZE, SIZE)?)?;
        let maps: Vec<f32> = Trainer::random_inputs(spec, batch, SIZE, SIZE)?.0.flatten_all()?.to_vec1()?;
        let mut inference = Inference::new(&network)?;
        Ok(Box::new(move || Ok(inference.logits(&maps, [batch, SIZE, SIZE]).map(|_| ())?)))
    })
}

/// One run of a network of this program.
type Run = Box<dyn FnMut() -> anyhow::Result<()>>;

/// Measures `repeats` runs after one warm-up run, ms, as `networks.py` does.
fn times(repeats: usize, run: &mut Run) -> anyhow::Result<Vec<f64>> {
    run()?;
    let timed = |_| -> anyhow::Result<f64> {
        let began = Instant::now();
        run()?;
        Ok(1e3 * began.elapsed().as_secs_f64())
    };
    (0..repeats).map(timed).collect()
}

fn compare(
    arguments: &Arguments,
    what: &str,
    batch: usize,
    repeats: usize,
    ours: &dyn Fn(&NetworkSpec, &str, &Path) -> anyhow::Result<Run>,
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
            bail!("there is no network '{name}'\n\nhint: `radome model list` lists them");
        };
        // The cost of the circuit shows in comparison with the same network with a linear head, which takes turns too.
        let linear = if what == "train" && name == NETWORKS[0] { NetworkSpec::named(NETWORKS[1]) } else { None };
        let mut own_runs = vec![("radome".to_owned(), ours(&spec, name, &folder)?)];
        if let Some(spec) = &linear {
            own_runs.push(("linear head".to_owned(), ours(spec, NETWORKS[1], &folder)?));
        }
        let python = arguments.python.as_deref();
        let start = |onnx| Peer::start(python, what, name, threads, batch, repeats, onnx);
        let onnxruntime = if what == "infer" { start(Some(folder.as_path())) } else { None };
        let peers: Vec<Peer> = start(None).into_iter().chain(onnxruntime).collect();
        let mut network_rows = Vec::new();
        for (peer, mut times) in take_turns(own_runs, peers, arguments.turns.max(1), repeats)? {
            times.sort_by(f64::total_cmp);
            let (Some(&milliseconds), Some(&median_milliseconds)) = (times.first(), times.get(times.len() / 2)) else {
                continue;
            };
            network_rows.push(Row { model: name.clone(), peer, batch, threads, milliseconds, median_milliseconds });
        }
        if !arguments.json {
            print(&network_rows)?;
        }
        rows.extend(network_rows);
    }
    std::fs::remove_dir_all(&folder)?;
    if arguments.json { output::json_line(&rows) } else { Ok(()) }
}

/// Runs this program's networks and the peers in turns. Returns the names with the times of all their runs, ms.
fn take_turns(
    mut own_runs: Vec<(String, Run)>,
    mut peers: Vec<Peer>,
    turns: usize,
    repeats: usize,
) -> anyhow::Result<Vec<(String, Vec<f64>)>> {
    let (mut own_times, mut peer_times) = (vec![Vec::new(); own_runs.len()], vec![Vec::new(); peers.len()]);
    for _ in 0..turns {
        for ((_, run), times_of_run) in own_runs.iter_mut().zip(&mut own_times) {
            times_of_run.extend(times(repeats, run)?);
            std::thread::sleep(PAUSE);
        }
        for (peer, times_of_run) in peers.iter_mut().zip(&mut peer_times) {
            times_of_run.extend(peer.turn());
            std::thread::sleep(PAUSE);
        }
    }
    // A peer reports its name in its first turn.
    let names = own_runs.into_iter().map(|(name, _)| name).chain(peers.iter().map(|peer| peer.name.clone()));
    Ok(names.zip(own_times.into_iter().chain(peer_times)).collect())
}

/// Prints the rows of one network, this program's first.
fn print(rows: &[Row]) -> anyhow::Result<()> {
    let own = rows.first().map_or([f64::NAN; 2], |row| [row.milliseconds, row.median_milliseconds]);
    for row in rows {
        output::text_line(&format!(
            "{:18} {:12} batch {:2} {} threads: least {:8.3} ms, median {:8.3} ms; ours is {:.2} and {:.2} of it",
            row.model,
            row.peer,
            row.batch,
            row.threads,
            row.milliseconds,
            row.median_milliseconds,
            own[0] / row.milliseconds,
            own[1] / row.median_milliseconds
        ))?;
    }
    Ok(())
}
