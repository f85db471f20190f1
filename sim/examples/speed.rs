//! Frames a second of a scene: `speed SCENE [SEED] [PEOPLE]`, 200 frames through the stream.
#![allow(clippy::print_stdout)]

use std::path::Path;
use std::time::Instant;

use radome_dsp::{Frame, FrameSource};
use radome_sim::{Scene, SimulateOptions, Simulator};

fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().unwrap_or_else(|| "fixtures/scenes/corridor.toml".to_owned());
    let seed = arguments.next().map_or(Ok(0), |s| s.parse())?;
    let people = arguments.next().map(|s| s.parse()).transpose()?;
    let scene = Scene::load(Path::new(&path))?;
    let begin = Instant::now();
    let mut simulator = Simulator::new(&scene, SimulateOptions { seed, people, ..SimulateOptions::default() })?;
    println!("prepared in {:.1} ms", begin.elapsed().as_secs_f64() * 1e3);
    let mut frame = Frame::zeroed(simulator.waveform().shape());
    let begin = Instant::now();
    let mut persons = 0;
    for index in 0..200 {
        simulator.next_frame(&mut frame)?;
        persons += simulator.truth(index).occupancy.index();
    }
    let seconds = begin.elapsed().as_secs_f64();
    println!(
        "{:.0} frames/s, {:.2} people on average, {} threads",
        200.0 / seconds,
        f64::from(persons as u32) / 200.0,
        rayon::current_num_threads()
    );
    Ok(())
}
