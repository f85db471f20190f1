//! Studies: comparisons of networks over seeds, label fractions and noise. A study is a list of jobs, each of which writes one
//! file, and a report on the files that exist. A stopped study continues where it was, also within a training.
//!
//! # Shards
//! Several processes may run the shards of a study in one folder. Each job is locked by the process that runs it. Its
//! outcome, except for the times, is a function of job, dataset and kernel level. The report holds no times: it is the
//! same, byte for byte, for any distribution of the jobs.
//!
//! # Equal treatment
//! Every variant is trained by the same recipe ([`mod@crate::train`]) with the same grid of learning rates. The best rate by balanced
//! accuracy on the validation split under the first seed is used for all seeds; the test split decides nothing. A training that
//! stops on a number that is not finite, or ends below [`FAILED_BELOW`] on its training maps, counts as failed and stays in the
//! means.
//!
//! # Conditions
//! Models of trainings on all labels are kept and evaluated on other sets ([`Condition`]) without training again. A
//! model is not evaluated on maps whose sequence has the name of one of the study's sequences outside the test split of
//! the training. So for the same frames under other noise only the test split counts, and for unknown recordings all
//! maps count. Conditions are not part of a study's identity: they can be added to a complete study. Each model and
//! condition has one file, which contains the hash of the condition's dataset. A dataset with another hash is evaluated
//! again.

mod condition;
mod cost;
mod error;
mod jobs;
mod noise;
mod outcome;
mod plan;
mod report;
mod run;
mod score;
mod spec;
mod times;

pub use condition::{Condition, ConditionCell, ConditionReport, ConditionScores, condition_file_name};
pub use cost::Cost;
pub use error::StudyError;
pub use outcome::{FAILED_BELOW, Job, Noisy, Outcome};
pub use plan::{Plan, PlannedNetwork};
pub use report::{
    Cell, CurvePoint, Failure, PAPER_CLEAN, PAPER_FRACTIONS, PAPER_NOISE, PAPER_SHARES, PAPER_SNR_DB, Report, report,
};
pub use run::{Progress, Study};
pub use score::{Score, mean_scores, paired_difference};
pub use spec::{StudySpec, Variant};
pub use times::{CellTimes, Times};
