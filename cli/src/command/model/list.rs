use crate::output;

/// Text below the options in the help.
const NOTES: &str = "\
hqnn                     the paper's network: two convolutions, two numbers, a circuit of two qubits
estimator_matched, dequantization, squashed_linear, squashed_dequantization, trigonometric, frozen_angles
                         the same with other heads than a trained circuit
doppler_net, resnet18, efficientnet_b0, efficientnet_b0_rgb
                         larger networks
descriptor_linear        63 descriptors of a map and of motion, and a linear head: the baseline
descriptor_hqnn          the same 63 descriptors, two numbers, and the paper's circuit or another head

Networks whose names begin with descriptor_ read maps over their own noise: their training spec needs \
reference = { over_noise = { skip_range_bins = 3 } }. They have no ONNX form.";

/// `radome model list`
#[derive(clap::Args)]
#[command(after_help = NOTES)]
pub struct Arguments {
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

/// Lists the networks that can be trained.
///
/// # Errors
/// Standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let networks = radome_models::networks();
    if arguments.json {
        return output::json_line(&networks);
    }
    output::text_line(&format!("{:24} {:>12} {:>14}  input", "network", "parameters", "multiply-adds"))?;
    for network in networks {
        output::text_line(&format!(
            "{:24} {:>12} {:>14}  {:?}",
            network.name, network.parameters, network.multiply_adds, network.input
        ))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_notes_name_every_network() {
        let words: Vec<&str> = NOTES.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).collect();
        for network in radome_models::networks() {
            assert!(words.contains(&network.name.as_str()), "{}", network.name);
        }
    }
}
