//! Timestamps of the messages of an export.

use radome_dsp::Frame;

/// Clock of an export: the frames' own clock, offset to the host's time of the first frame. It never goes backwards.
#[derive(Debug, Default)]
pub struct Clock {
    /// Time at which the frames' own clock shows 0, ns since 1970.
    origin_ns: u64,
    newest_frame_ns: Option<u64>,
    /// Time of the previous message, ns since 1970.
    pub last_ns: u64,
}

impl Clock {
    /// Updates the clock with the next frame. If the frames' own clock went backwards, it has restarted, and the offset
    /// is computed anew.
    pub fn update(&mut self, frame: &Frame) {
        if self.newest_frame_ns.is_none_or(|newest_ns| frame.time_ns < newest_ns) {
            self.origin_ns = frame.host_time_ns.max(self.last_ns).saturating_sub(frame.time_ns);
        }
        self.newest_frame_ns = Some(frame.time_ns);
    }

    /// Returns the time of a message, ns since 1970, from the frames' own clock, ns; no earlier than the message
    /// before.
    pub fn message_time_ns(&mut self, time_ns: u64) -> u64 {
        self.last_ns = self.last_ns.max(self.origin_ns.saturating_add(time_ns));
        self.last_ns
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::FrameShape;

    use super::*;

    fn frame(time_ns: u64, host_time_ns: u64) -> Frame {
        Frame { time_ns, host_time_ns, ..Frame::zeroed(FrameShape { rx: 1, chirps: 1, samples: 1 }) }
    }

    #[test]
    fn time_continues_from_the_first_frame_if_clocks_are_set_back() {
        let mut clock = Clock::default();
        let mut time_of_message = |time_ns, host_time_ns| {
            clock.update(&frame(time_ns, host_time_ns));
            clock.message_time_ns(time_ns)
        };
        assert_eq!(time_of_message(500, 10_500), 10_500);
        // The host's clock is set back; the frames' own clock is not.
        assert_eq!(time_of_message(600, 3), 10_600);
        // The board restarts.
        assert_eq!(time_of_message(0, 20_000), 20_000);
        assert_eq!(time_of_message(100, 20_100), 20_100);
        assert_eq!(time_of_message(0, 0), 20_100);
        assert_eq!(time_of_message(7, 0), 20_107);
    }

    #[test]
    fn a_simulation_keeps_its_own_time() {
        let mut clock = Clock::default();
        clock.update(&frame(0, 0));
        assert_eq!(
            (clock.message_time_ns(0), clock.message_time_ns(300), clock.message_time_ns(200), clock.last_ns),
            (0, 300, 300, 300)
        );
    }
}
