//! Time limit of a wait for the next event of a stream.

use std::time::{Duration, Instant};

/// Longest wait for data while those of a paused program are read.
const LATE_WAIT: Duration = Duration::from_millis(20);
/// Longest time for which they are read: a board that sends garbage alone does not end.
const LATEST: Duration = Duration::from_secs(1);

/// Time limit of a wait. A program that was paused finds its time up and data that came in time: these are read first.
pub(super) struct Patience {
    timeout: Duration,
    end: Instant,
    /// Whether the present read began after the end.
    is_over: bool,
    is_up: bool,
    /// Time at which the first data were read after the end.
    late: Option<Instant>,
}

impl Patience {
    /// Starts a wait.
    pub fn new(timeout: Duration) -> Self {
        let end = Instant::now() + timeout;
        Patience { timeout, end, is_over: false, is_up: false, late: None }
    }

    /// Starts the wait again, since the board has been started anew.
    pub fn renew(&mut self) {
        *self = Patience::new(self.timeout);
    }

    /// Longest duration of the next read; `None` if the time is up.
    pub fn next_read(&mut self) -> Option<Duration> {
        let left = self.end.saturating_duration_since(Instant::now());
        self.is_over = left.is_zero();
        let wait = if self.late.is_some() { LATE_WAIT } else { left };
        (!self.is_up).then_some(wait)
    }

    /// Notes whether the read has given any data.
    pub fn has_read(&mut self, any: bool) {
        self.is_up = self.is_over && (!any || self.late.get_or_insert_with(Instant::now).elapsed() > LATEST);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: a read that began after the end was the last one even if it gave data.
    #[test]
    fn data_that_came_in_time_are_read_before_the_time_is_up() {
        let mut patience = Patience::new(Duration::ZERO);
        for wait in [Duration::ZERO, LATE_WAIT, LATE_WAIT] {
            assert_eq!(patience.next_read(), Some(wait));
            patience.has_read(true);
        }
        assert_eq!(patience.next_read(), Some(LATE_WAIT));
        patience.has_read(false);
        assert_eq!(patience.next_read(), None);
        patience.renew();
        assert_eq!(patience.next_read(), Some(Duration::ZERO));
    }

    #[test]
    fn a_wait_without_data_ends_with_the_read_after_its_end() {
        let mut patience = Patience::new(Duration::from_secs(60));
        assert!(patience.next_read().is_some_and(|wait| wait > Duration::from_secs(50)));
        patience.has_read(false);
        assert!(patience.next_read().is_some());
        let mut patience = Patience::new(Duration::ZERO);
        assert!(patience.next_read().is_some());
        patience.has_read(false);
        assert_eq!(patience.next_read(), None);
    }
}
