//! Part of a job that this process does: `--shard I/N`.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Part `index` of `count`, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    pub index: usize,
    pub count: usize,
}

impl Shard {
    /// Shard that is the whole job.
    pub const WHOLE: Shard = Shard { index: 0, count: 1 };

    /// Name of the shard's folder, or suffix of its file's name.
    pub fn name(self) -> String {
        format!("shard-{:05}-of-{:05}", self.index, self.count)
    }
}

/// Returns the name of the whole job whose shard has this name: the part before the suffix that [`Shard::name`] gives. Other names stay.
pub fn name_of_whole(name: &str) -> &str {
    let is_number = |text: &str| text.len() >= 5 && text.bytes().all(|byte| byte.is_ascii_digit());
    let is_suffix =
        |text: &str| text.split_once("-of-").is_some_and(|(index, count)| is_number(index) && is_number(count));
    match name.rsplit_once("-shard-") {
        Some((whole, suffix)) if is_suffix(suffix) => whole,
        _ => name,
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

impl FromStr for Shard {
    type Err = String;

    /// Parses `I/N` with I from 0, `auto/N` with I from the environment, or `auto` in a Slurm array, which also gives
    /// N.
    fn from_str(text: &str) -> Result<Self, String> {
        parse(text, &|name| std::env::var(name).ok())
    }
}

/// Variables in which schedulers store the task index in an array, the innermost first: HyperQueue's workers run in
/// Slurm's jobs.
const INDEX_VARIABLES: [&str; 3] = ["HQ_TASK_ID", "JOB_COMPLETION_INDEX", "SLURM_ARRAY_TASK_ID"];

fn parse(text: &str, variable: &dyn Fn(&str) -> Option<String>) -> Result<Shard, String> {
    let number = |what: &str, text: &str| {
        text.trim().parse::<usize>().map_err(|_| format!("{what} is '{text}', expected a whole number"))
    };
    let from_variable = |name: &str| variable(name).map(|value| number(name, &value)).transpose();
    let shard = match text.split_once('/') {
        Some((index, count)) => {
            let count = number("the number of shards", count)?;
            let index =
                match index {
                    "auto" => INDEX_VARIABLES.iter().find_map(|name| from_variable(name).transpose()).unwrap_or_else(
                        || Err(format!("this is no task of an array: none of {} is set", INDEX_VARIABLES.join(", "))),
                    )?,
                    index => number("the shard", index)?,
                };
            Shard { index, count }
        }
        None if text == "auto" => {
            let slurm = |name: &str| {
                from_variable(name)?.ok_or_else(|| {
                    format!("{name} is not set: this is no task of a Slurm array; elsewhere say auto/N or I/N")
                })
            };
            let index = slurm("SLURM_ARRAY_TASK_ID")?;
            let (least, most) = (slurm("SLURM_ARRAY_TASK_MIN")?, slurm("SLURM_ARRAY_TASK_MAX")?);
            let count = slurm("SLURM_ARRAY_TASK_COUNT")?;
            if most.checked_sub(least).and_then(|n| n.checked_add(1)) != Some(count) || index < least {
                return Err(format!(
                    "task {index} of the array {least}-{most} with {count} tasks: the array has holes; say auto/N"
                ));
            }
            Shard { index: index - least, count }
        }
        None => return Err("expected I/N such as 3/8, auto/N, or auto in a Slurm array".into()),
    };
    if shard.index >= shard.count {
        return Err(format!("there is no shard {} of {}: they are counted from 0", shard.index, shard.count));
    }
    Ok(shard)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shard(text: &str, variables: &[(&str, &str)]) -> Result<(usize, usize), String> {
        let lookup = |name: &str| variables.iter().find(|(n, _)| *n == name).map(|(_, v)| v.to_string());
        parse(text, &lookup).map(|s| (s.index, s.count))
    }

    #[test]
    fn the_index_comes_from_the_command_line_or_from_a_scheduler() {
        assert_eq!(shard("3/8", &[]), Ok((3, 8)));
        assert_eq!(shard("auto/8", &[("SLURM_ARRAY_TASK_ID", "5")]), Ok((5, 8)));
        assert_eq!(shard("auto/8", &[("JOB_COMPLETION_INDEX", "0")]), Ok((0, 8)));
        // HyperQueue inside a Slurm array: its own index counts.
        assert_eq!(shard("auto/8", &[("SLURM_ARRAY_TASK_ID", "1"), ("HQ_TASK_ID", "7")]), Ok((7, 8)));
        let array = [
            ("SLURM_ARRAY_TASK_ID", "3"),
            ("SLURM_ARRAY_TASK_MIN", "1"),
            ("SLURM_ARRAY_TASK_MAX", "4"),
            ("SLURM_ARRAY_TASK_COUNT", "4"),
        ];
        assert_eq!(shard("auto", &array), Ok((2, 4)));
    }

    #[test]
    fn the_name_of_a_shard_tells_that_of_the_whole() {
        let name = format!("night/run-shard-2-{}", Shard { index: 3, count: 8 }.name());
        assert_eq!(name_of_whole(&name), "night/run-shard-2");
        for other in ["run", "run-shard-1-of-8", "run-shard-00001", "run-shard-00001-of-0000x", "shard-00001-of-00008"]
        {
            assert_eq!(name_of_whole(other), other);
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn invalid_shards_are_refused_with_a_reason() {
            let said = |text, variables: &[_]| shard(text, variables).expect_err("no shard");
            assert!(said("8/8", &[]).contains("no shard 8 of 8"));
            assert!(said("0/0", &[]).contains("no shard 0 of 0"));
            assert!(said("-1/8", &[]).contains("'-1'"));
            assert!(said("3", &[]).contains("I/N"));
            assert!(said("auto/8", &[]).contains("SLURM_ARRAY_TASK_ID"));
            assert!(said("auto/8", &[("HQ_TASK_ID", "x")]).contains("HQ_TASK_ID is 'x'"));
            assert!(said("auto", &[("HQ_TASK_ID", "1")]).contains("auto/N"));
            // Arrays with gaps, such as every second task, are refused, since the shards are ambiguous.
            let holes = [
                ("SLURM_ARRAY_TASK_ID", "2"),
                ("SLURM_ARRAY_TASK_MIN", "0"),
                ("SLURM_ARRAY_TASK_MAX", "6"),
                ("SLURM_ARRAY_TASK_COUNT", "4"),
            ];
            assert!(said("auto", &holes).contains("holes"));
        }
    }
}
