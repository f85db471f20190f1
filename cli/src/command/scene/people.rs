//! `radome scene people`.

use std::path::PathBuf;

use radome_sim::people_list::ListedPerson;
use radome_sim::{Scene, SimulateOptions, Simulator};

use super::SceneArgs;
use crate::output_file::Overwrite;
use crate::{files, output};

/// Text below the options in the help.
const NOTES: &str = "\
There is one line for each person and frame. A place is the middle of the chest in the middle of the frame, in the axes of the \
scene. Azimuth is positive to the left of the radar's boresight, and elevation upwards. The radial velocity is positive if the \
range increases, as in maps. The people are those of `radome scene simulate` with the same seed.";

/// `radome scene people`
#[derive(clap::Args)]
#[command(after_help = NOTES)]
pub struct Arguments {
    /// CSV file to write, instead of stdout
    #[arg(short, long, value_name = "FILE.csv")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Number of frames
    #[arg(long, default_value_t = 400)]
    frames: u64,
    #[command(flatten)]
    scene: SceneArgs,
    /// Print one JSON object for each person and frame
    #[arg(long, conflicts_with = "output")]
    json: bool,
}

const HEADING: &str = "sequence,time_s,person,in_room,x_m,y_m,z_m,velocity_x_m_per_s,velocity_y_m_per_s,velocity_z_m_per_s,range_m,\
                       radial_velocity_m_per_s,azimuth_deg,elevation_deg";

/// Lists where the people of a scene are in each frame, without simulating the frames.
///
/// # Errors
/// The scene is not valid or has fewer people, the file cannot be written, or the user interrupts.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let Arguments { frames, scene: SceneArgs { scene: ref scene_file, seed, people }, .. } = *arguments;
    if let Some(path) = &arguments.output {
        arguments.overwrite.check(path, &[scene_file])?;
    }
    let scene = Scene::load(scene_file)?;
    Simulator::check_people(&scene, people)?;
    let options = SimulateOptions { seed, people, frames: Some(frames), ..SimulateOptions::default() };
    let simulator = Simulator::new(&scene, options)?;
    let people = (0..frames).take_while(|_| !output::interrupted()).flat_map(|frame| simulator.listed_people(frame));
    let lines = people.map(|person| if arguments.json { output::json_text(&person) } else { Ok(csv_line(&person)) });
    let heading = (!arguments.json).then(|| Ok(HEADING.to_owned()));
    files::write_lines(arguments.output.as_deref(), arguments.overwrite.existing(), heading.into_iter().chain(lines))
}

fn csv_line(listed: &ListedPerson) -> String {
    let ListedPerson { sequence, time_s, person, in_room, position_m: [x, y, z], velocity_m_per_s, .. } = listed;
    let [velocity_x, velocity_y, velocity_z] = velocity_m_per_s;
    let ListedPerson { range_m, radial_velocity_m_per_s, azimuth_deg, elevation_deg, .. } = listed;
    format!(
        "{sequence},{time_s:.6},{person},{in_room},{x:.5},{y:.5},{z:.5},{velocity_x:.5},{velocity_y:.5},{velocity_z:.5},\
         {range_m:.5},{radial_velocity_m_per_s:.5},{azimuth_deg:.4},{elevation_deg:.4}"
    )
}
