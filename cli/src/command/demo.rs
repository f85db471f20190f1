use std::path::PathBuf;

use super::live;
use crate::classifier::Delays;
use crate::exit::Completion;
use crate::files;
use crate::source::{SourceArgs, not_negative};

/// `radome demo`
#[derive(clap::Args)]
// A pair belongs to a recording, and the demo has none.
#[command(mut_arg("pair", |pair| pair.hide(true)))]
pub struct Arguments {
    /// Stop after this number of frames
    #[arg(long, default_value_t = 300)]
    frames: u64,
    /// Seed of the people's paths, 100001 if absent; paper-hqnn was trained on seeds below 100000
    #[arg(long)]
    seed: Option<u64>,
    /// Pace, as a multiple of real time; 0 is as fast as possible
    #[arg(long, default_value_t = 1.0, value_parser = not_negative)]
    speed: f64,
    /// Scene to use instead of the corridor
    #[arg(long, value_name = "FILE.toml")]
    scene: Option<PathBuf>,
    /// Model to use instead of paper-hqnn
    #[arg(long)]
    model: Option<PathBuf>,
    /// Print one JSON object per frame and one at the end
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    view: crate::live::view::Arguments,
}

/// Runs the live classification on a simulated scene, without hardware.
///
/// # Errors
/// The scene or the model is not found, or the run fails.
pub fn run(arguments: Arguments) -> anyhow::Result<Completion> {
    let scene = arguments.scene.map_or_else(|| files::fixture("scenes/corridor.toml"), Ok)?;
    let model = arguments.model.map_or_else(|| files::fixture("models/paper-hqnn.safetensors"), Ok)?;
    let delays = Delays::default();
    live::run(&live::Arguments {
        source: SourceArgs {
            source: format!("emulated:{}", scene.display()),
            frames: Some(arguments.frames),
            speed: (arguments.speed > 0.0).then_some(arguments.speed),
            seed: arguments.seed,
            ..SourceArgs::default()
        },
        model,
        output: None,
        allow_loss: false,
        overwrite: Default::default(),
        background: None,
        max_range_m: None,
        on_delay_s: delays.on_s,
        off_delay_s: delays.off_s,
        json: arguments.json,
        view: arguments.view,
        integrations: Default::default(),
    })
}
