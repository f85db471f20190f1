use crate::output;

/// `radome models`
#[derive(clap::Args)]
pub struct Arguments {
    /// A list of objects
    #[arg(long)]
    json: bool,
}

/// The networks that can be trained.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let networks = radome_models::networks();
    if arguments.json {
        return output::json_line(&networks);
    }
    output::text_line(&format!("{:12} {:>12} {:>14}  input", "network", "parameters", "multiply-adds"))?;
    for network in networks {
        output::text_line(&format!(
            "{:12} {:>12} {:>14}  {:?}",
            network.name, network.parameters, network.multiply_adds, network.input
        ))?;
    }
    Ok(())
}
