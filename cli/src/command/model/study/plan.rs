//! `radome model study --plan`.

use radome_models::study::{Plan, Study};

use crate::output;

/// Counts and times a study's trainings, and prints them as a table or as one object. `conditions` is the number of its
/// conditions, including those whose datasets are not built yet.
///
/// # Errors
/// A network cannot be trained on the dataset, or standard output cannot be written.
pub fn print(study: &Study, conditions: usize, json: bool) -> anyhow::Result<()> {
    let bar = output::progress(0, "timing");
    let plan = study.plan(conditions, &mut |variant: &str| {
        bar.inc(1);
        bar.set_message(variant.to_owned());
    });
    bar.finish_and_clear();
    let plan = plan?;
    if json { output::json_line(&plan) } else { table(&plan) }
}

fn table(plan: &Plan) -> anyhow::Result<()> {
    let line = |name: &str, trainings: usize, done: usize, steps: usize, step: &str, hours: f64| {
        output::text_line(&format!("{name:<28} {trainings:>9} {done:>6} {steps:>9} {step:>9} {hours:>8.2}"))
    };
    output::text_line(&format!(
        "{:<28} {:>9} {:>6} {:>9} {:>9} {:>8}",
        "network", "trainings", "done", "steps", "s a step", "hours"
    ))?;
    for network in &plan.networks {
        let step = output::or_dash(network.step_seconds, 4);
        line(&network.variant, network.trainings, network.done, network.steps, &step, network.hours)?;
    }
    let steps = plan.networks.iter().map(|network| network.steps).sum();
    line("all", plan.trainings, plan.done, steps, "", plan.hours)?;
    output::text_line(&format!(
        "{:.2} hours on {} threads of this machine, {:.2} CPU-hours",
        plan.hours, plan.threads, plan.cpu_hours
    ))?;
    if plan.judgings_left > 0 {
        output::text_line(&format!(
            "{} scores under conditions are left, which are not in the hours",
            plan.judgings_left
        ))?;
    }
    Ok(())
}
