mod circuit;
mod circuit_time;
mod networks;
mod peer;
mod people;
mod point;
mod rcs;
mod rdm;
mod scene;
mod scene_speed;
mod solver;
mod stored_dense;
mod synthesis;
mod table;
mod trainability;

/// `radome bench`
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Arguments {
    #[command(subcommand)]
    stage: Option<Stage>,
    #[command(flatten)]
    table: table::Arguments,
}

// There is one in a program: its size does not matter.
#[allow(clippy::large_enum_variant)]
#[derive(clap::Subcommand)]
enum Stage {
    /// Measure range-Doppler maps: 3 receivers x 128 chirps x 256 samples on one thread; compare with libraries and scipy
    Rdm(rdm::Arguments),
    /// Measure radar cross-sections of canonical targets by every suitable method; compare with plain sums over patches
    Solver(solver::Arguments),
    /// Measure the synthesis of samples from paths: 128 chirps of 256 samples on one thread; compare with the sum of exponentials
    Synthesis(synthesis::Arguments),
    /// Measure the simulation of frames, relative to scipy's maps; with a SCENE, compare people as skins with dense physical optics
    Scene(scene::Arguments),
    /// Measure a training step of the networks with maps of 128 x 128; compare with PyTorch
    Train(networks::Arguments),
    /// Measure inference of the networks on one map of 128 x 128; compare with onnxruntime and PyTorch
    Infer(networks::Arguments),
    /// Solve one target: radar cross-section, analytic value, error, time
    Rcs(rcs::Arguments),
    /// Evaluate the quantum circuit at one point: expectations and gradients
    Circuit(circuit::Arguments),
    /// Measure gradients of quantum circuits at random points, by the number of qubits
    Trainability(trainability::Arguments),
}

/// Measures speed against error, of one stage or of all of them in one table.
///
/// # Errors
/// A stage cannot be set up or measured, or standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.stage {
        None => table::run(&arguments.table),
        Some(Stage::Rdm(arguments)) => rdm::run(arguments),
        Some(Stage::Solver(arguments)) => solver::run(arguments),
        Some(Stage::Synthesis(arguments)) => synthesis::run(arguments),
        Some(Stage::Scene(arguments)) => scene::run(arguments),
        Some(Stage::Train(arguments)) => networks::train(arguments),
        Some(Stage::Infer(arguments)) => networks::infer(arguments),
        Some(Stage::Rcs(arguments)) => rcs::run(arguments),
        Some(Stage::Circuit(arguments)) => circuit::run(arguments),
        Some(Stage::Trainability(arguments)) => trainability::run(arguments),
    }
}
