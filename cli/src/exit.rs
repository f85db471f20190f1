//! Outcome of a command and its exit status.

use std::process::ExitCode;

use crate::output;

/// Examples and exit statuses at the end of `radome --help`.
pub const HELP: &str = "Examples:\n  \
                        radome demo --view\n  \
                        radome board list\n  \
                        radome live auto --view\n\n\
                        Exit status: 0 done, 1 failed, 2 wrong use, 3 done but something was lost. A closed stdout ends a command \
                        quietly with 0. After Ctrl-C or SIGTERM, commands that stream, record, simulate or build complete their \
                        files, and others end at once. Repeated after a second, either signal ends any command at once with 130.";

/// Outcome of a command that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Completion {
    Done,
    /// Everything is done, but data were lost.
    WithLoss,
}

impl Completion {
    pub fn from_loss(has_loss: bool) -> Self {
        if has_loss { Completion::WithLoss } else { Completion::Done }
    }
}

/// Error of an argument that the program checks itself, such as one that must not be quoted or that has no effect. Its exit
/// status is that of wrong use.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct WrongUse(pub anyhow::Error);

/// Returns a [`WrongUse`] with this message, as `anyhow::bail!` returns other errors.
macro_rules! wrong_use {
    ($($message:tt)*) => {
        anyhow::bail!($crate::exit::WrongUse(anyhow::anyhow!($($message)*)))
    };
}
pub(crate) use wrong_use;

/// Prints the error of a failed command on stderr; returns the exit status.
pub fn report(outcome: &anyhow::Result<Completion>) -> ExitCode {
    match outcome {
        Ok(Completion::Done) => ExitCode::SUCCESS,
        Ok(Completion::WithLoss) => ExitCode::from(3),
        // The reader of stdout has closed it and needs no more.
        Err(error) if output::is_closed_stdout(error) => ExitCode::SUCCESS,
        Err(error) => {
            message!("error: {}", output::chain(error));
            if error.is::<WrongUse>() { ExitCode::from(2) } else { ExitCode::FAILURE }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Error, ErrorKind};

    use anyhow::Context;

    use super::*;

    fn has_status(code: ExitCode, expected: u8) -> bool {
        // Exit codes cannot be compared, but they can be formatted.
        format!("{code:?}") == format!("{:?}", ExitCode::from(expected))
    }

    fn wrong_use_error(argument: &str) -> anyhow::Result<Completion> {
        wrong_use!("no such option {argument}")
    }

    #[test]
    fn every_end_has_its_status() {
        assert!(has_status(report(&Ok(Completion::from_loss(false))), 0));
        assert!(has_status(report(&Ok(Completion::from_loss(true))), 3));
        assert!(has_status(report(&Err(anyhow::anyhow!("no such board"))), 1));
        assert!(has_status(report(&wrong_use_error("--none")), 2));
        assert!(has_status(report(&wrong_use_error("--none").context("cannot begin")), 2));
        assert_eq!(wrong_use_error("--none").expect_err("an error").to_string(), "no such option --none");
        let closed: anyhow::Result<Completion> = Err(output::StdoutClosed.into());
        assert!(has_status(report(&closed), 0));
        assert!(has_status(report(&closed.context("cannot say it")), 0));
    }

    #[test]
    fn a_broken_pipe_that_is_not_stdout_is_a_failure() {
        let of_a_board: anyhow::Result<Completion> =
            Err(Error::from(ErrorKind::BrokenPipe)).context("the connection broke");
        assert!(has_status(report(&of_a_board), 1));
    }
}
