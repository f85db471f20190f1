//! Reliability of the HQNN's training: balanced accuracy over seeds on made-up maps, for variants of the recipe.
//!
//! `cargo run --release -p radome-models --example reliability -- [seeds] [variant...]`
#![allow(clippy::print_stdout)]

#[path = "../tests/support/mod.rs"]
mod support;

use radome_models::train::LatentStandardisation;
use radome_models::{TrainSpec, train};
use support::{Maps, dataset};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let seeds: u64 = arguments.next().map_or(Ok(5), |s| s.parse())?;
    let wanted: Vec<String> = arguments.collect();
    let set = dataset(Maps::default());
    let base = TrainSpec::default();
    let one = TrainSpec { starts: 1, ..base.clone() };
    let variants = [
        ("default", base.clone()),
        ("one-start", one.clone()),
        ("slow-angles", TrainSpec { angle_rate: 1.0, ..one.clone() }),
        ("slow-head", TrainSpec { head_rate: 1.0, ..one.clone() }),
        ("slow-both", TrainSpec { angle_rate: 1.0, head_rate: 1.0, ..one.clone() }),
        ("fast-both", TrainSpec { angle_rate: 10.0, head_rate: 20.0, ..one.clone() }),
        ("narrow", TrainSpec { latent_sigma: 0.25, ..one.clone() }),
        ("wide", TrainSpec { latent_sigma: 1.0, ..one.clone() }),
        ("cold", TrainSpec { linear_epochs: Some(0), ..one.clone() }),
        ("colder", TrainSpec { linear_epochs: Some(0), latent_penalty: 0.0, ..one.clone() }),
        ("no-penalty", TrainSpec { latent_penalty: 0.0, ..one.clone() }),
        ("penalty-0.2", TrainSpec { latent_penalty: 0.2, ..one.clone() }),
        ("linear-2", TrainSpec { linear_epochs: Some(2), ..one.clone() }),
        ("linear-4", TrainSpec { linear_epochs: Some(4), ..one.clone() }),
        ("features-0.1", TrainSpec { feature_sigma: 0.1, ..one.clone() }),
        ("linear", TrainSpec { linear_epochs: Some(15), ..one.clone() }),
        ("frozen", TrainSpec { latent: LatentStandardisation::FrozenByEpoch, ..one.clone() }),
        ("running", TrainSpec { latent: LatentStandardisation::Running { momentum: 0.1 }, ..one.clone() }),
        ("rate-2", TrainSpec { learning_rate: 2e-3, ..one.clone() }),
        ("rate-half", TrainSpec { learning_rate: 5e-4, ..one.clone() }),
    ];
    for (name, spec) in variants.iter().filter(|(name, _)| wanted.is_empty() || wanted.iter().any(|w| w == name)) {
        let began = std::time::Instant::now();
        let (mut scores, mut training) = (Vec::new(), Vec::new());
        for seed in 1..=seeds {
            let outcome = train(&set, &TrainSpec { seed, ..spec.clone() }, &mut |r| {
                if wanted.len() == 1 && seed == 1 {
                    println!(
                        "  start {} epoch {:2}: loss {:.3} bal {:.3}; validation {:.3} {:.3}",
                        r.start,
                        r.epoch,
                        r.training_loss,
                        r.training_balanced_accuracy,
                        r.validation_loss,
                        r.validation_balanced_accuracy
                    );
                }
            })?;
            scores.push(outcome.test.map_or(0.0, |t| t.balanced_accuracy));
            training.push(outcome.history.last().map_or(0.0, |h| h.training_balanced_accuracy));
        }
        let list = |v: &[f64]| v.iter().map(|s| format!("{s:.3}")).collect::<Vec<_>>().join(" ");
        let (least, mean) = (scores.iter().copied().fold(1.0, f64::min), scores.iter().sum::<f64>() / seeds as f64);
        println!(
            "{name:12} mean {mean:.3} least {least:.3} | test {} | train {} | {:.0} s",
            list(&scores),
            list(&training),
            began.elapsed().as_secs_f64()
        );
    }
    Ok(())
}
