use anyhow::bail;
use radome_models::quantum;

use crate::output;

/// `radome circuit`
#[derive(clap::Args)]
pub struct Arguments {
    /// Inputs X0,X1 in radians
    #[arg(long, value_delimiter = ',', num_args = 1, allow_hyphen_values = true, required = true)]
    x: Vec<f64>,
    /// Angles T0,T1,T2,T3 in radians
    #[arg(long, value_delimiter = ',', num_args = 1, allow_hyphen_values = true, required = true)]
    theta: Vec<f64>,
    /// Repetitions of the feature map
    #[arg(long, default_value_t = 1)]
    repetitions: usize,
    /// One object
    #[arg(long)]
    json: bool,
}

/// The two-qubit circuit at one point.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (Ok(x), Ok(theta)) = (<[f64; 2]>::try_from(&*arguments.x), <[f64; 4]>::try_from(&*arguments.theta)) else {
        bail!("--x takes two numbers and --theta four, got {} and {}", arguments.x.len(), arguments.theta.len());
    };
    if arguments.repetitions != 1 {
        bail!("--repetitions {} is not offered: the closed form is for 1", arguments.repetitions);
    }
    if x.iter().chain(&theta).any(|v| !v.is_finite()) {
        bail!("--x and --theta must be finite numbers");
    }
    let point = quantum::circuit(x, theta);
    if arguments.json {
        return output::json_line(&point);
    }
    output::text_line(&format!("<ZI> {:+.12}   <IZ> {:+.12}", point.zi, point.iz))?;
    output::text_line(&format!("d<ZI>/dtheta {:?}", point.zi_grad_theta))?;
    output::text_line(&format!("d<IZ>/dtheta {:?}", point.iz_grad_theta))?;
    output::text_line(&format!("d<ZI>/dx     {:?}", point.zi_grad_x))?;
    output::text_line(&format!("d<IZ>/dx     {:?}", point.iz_grad_x))
}
