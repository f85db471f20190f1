//! Time limit of a wait for the next event of a stream.

use std::time::{Duration, Instant};

/// Longest wait of a read after the end.
const LATE_READ_WAIT: Duration = Duration::from_millis(20);
/// Longest time of reads after the end. It ends the wait for a board that sends nothing but garbage.
const LATE_READ_LIMIT: Duration = Duration::from_secs(1);

/// Time limit of a wait for the next event. Data that arrived in time while the program was paused are read after the end.
pub(super) struct ReadDeadline {
    timeout: Duration,
    end: Instant,
    /// Whether the current read began after the end.
    is_after_end: bool,
    /// Whether no further read is due.
    is_expired: bool,
    /// Time at which the first data were read after the end.
    first_late_read: Option<Instant>,
}

impl ReadDeadline {
    /// Starts a wait.
    pub fn new(timeout: Duration) -> Self {
        let end = Instant::now() + timeout;
        ReadDeadline { timeout, end, is_after_end: false, is_expired: false, first_late_read: None }
    }

    /// Starts the wait again after a restart of the board.
    pub fn restart(&mut self) {
        *self = ReadDeadline::new(self.timeout);
    }

    /// Longest duration of the next read; `None` if the wait is over.
    pub fn next_read(&mut self) -> Option<Duration> {
        let remaining = self.end.saturating_duration_since(Instant::now());
        self.is_after_end = remaining.is_zero();
        let wait = if self.first_late_read.is_some() { LATE_READ_WAIT } else { remaining };
        (!self.is_expired).then_some(wait)
    }

    /// Notes whether the read has given data.
    pub fn note_read(&mut self, has_data: bool) {
        self.is_expired = self.is_after_end
            && (!has_data || self.first_late_read.get_or_insert_with(Instant::now).elapsed() > LATE_READ_LIMIT);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: a read that began after the end was the last one even if it gave data.
    #[test]
    fn data_that_arrived_in_time_are_read_after_the_end() {
        let mut deadline = ReadDeadline::new(Duration::ZERO);
        for wait in [Duration::ZERO, LATE_READ_WAIT, LATE_READ_WAIT] {
            assert_eq!(deadline.next_read(), Some(wait));
            deadline.note_read(true);
        }
        assert_eq!(deadline.next_read(), Some(LATE_READ_WAIT));
        deadline.note_read(false);
        assert_eq!(deadline.next_read(), None);
        deadline.restart();
        assert_eq!(deadline.next_read(), Some(Duration::ZERO));
    }

    #[test]
    fn a_wait_without_data_ends_with_the_read_after_its_end() {
        let mut deadline = ReadDeadline::new(Duration::from_secs(60));
        assert!(deadline.next_read().is_some_and(|wait| wait > Duration::from_secs(50)));
        deadline.note_read(false);
        assert!(deadline.next_read().is_some());
        let mut deadline = ReadDeadline::new(Duration::ZERO);
        assert!(deadline.next_read().is_some());
        deadline.note_read(false);
        assert_eq!(deadline.next_read(), None);
    }
}
