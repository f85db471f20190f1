//! Converts panics to errors that name their source location, so that a bug ends a run like any other error.

use std::any::Any;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind};
use std::sync::{Mutex, MutexGuard, PoisonError};

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

/// Number of panics whose locations are kept, since several threads may panic at once.
const MOST_LOCATIONS: usize = 32;

/// Panic as an error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "internal error at {location}: {message}\n\nhint: this is a fault of the program; please report it with the command line, and with \
     the file that `radome doctor --bundle` makes"
)]
pub struct Panicked {
    /// File and line, or a text for an unknown location.
    pub location: String,
    pub message: String,
}

/// Messages and locations of the last panics. A panic that another thread receives does not contain its location.
static LOCATIONS: Mutex<VecDeque<(String, String)>> = Mutex::new(VecDeque::new());

/// Installs a hook that stores the location of each panic for its error. Panics are still printed on stderr.
pub fn install_hook() {
    let previous_hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic: &PanicHookInfo| {
        let location = panic.location().map_or_else(|| "an unknown place".to_owned(), ToString::to_string);
        let mut locations = lock(&LOCATIONS);
        if locations.len() == MOST_LOCATIONS {
            locations.pop_front();
        }
        locations.push_back((message(panic.payload()), location));
        drop(locations);
        previous_hook(panic);
    }));
}

/// Runs a function and converts a panic to an error. After a panic, values that the function borrowed may be in any state.
///
/// # Errors
/// The function panicked.
pub fn catch_panic<T>(work: impl FnOnce() -> T) -> Result<T, Panicked> {
    catch_unwind(AssertUnwindSafe(work)).map_err(|payload| Panicked::new(payload.as_ref()))
}

/// Locks a mutex, also after a panic of a thread that held it.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Panicked {
    /// Creates the error from the payload of a panic, as returned by `catch_unwind` or by joining a thread.
    pub fn new(payload: &(dyn Any + Send)) -> Self {
        let message = message(payload);
        let locations = lock(&LOCATIONS);
        let location = locations.iter().rev().find(|(text, _)| *text == message).map(|(_, location)| location.clone());
        Panicked { location: location.unwrap_or_else(|| "an unknown place".to_owned()), message }
    }
}

fn message(payload: &(dyn Any + Send)) -> String {
    match (payload.downcast_ref::<&str>(), payload.downcast_ref::<String>()) {
        (Some(text), _) => (*text).to_owned(),
        (None, Some(text)) => text.clone(),
        (None, None) => "a panic without a message".to_owned(),
    }
}

/// Source whose panics become errors. After a panic, it is not read again.
pub struct PanicGuard {
    source: Box<dyn FrameSource>,
    panicked: Option<Panicked>,
}

impl PanicGuard {
    pub fn new(source: Box<dyn FrameSource>) -> Self {
        PanicGuard { source, panicked: None }
    }
}

impl FrameSource for PanicGuard {
    fn waveform(&self) -> &Waveform {
        self.source.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        if let Some(panicked) = &self.panicked {
            return Err(panicked.clone().into());
        }
        match catch_panic(|| self.source.next_frame(frame)) {
            Ok(event) => event,
            Err(panicked) => Err(self.panicked.insert(panicked).clone().into()),
        }
    }

    fn frame_count(&self) -> Option<u64> {
        self.source.frame_count()
    }
}

#[cfg(test)]
pub mod tests {
    use std::sync::Once;

    use radome_dsp::{WaveformRequest, source_from_fn};

    use super::*;

    /// Creates a source that panics instead of returning frame number `frames`.
    pub fn panicking_after(frames: u64) -> Box<dyn FrameSource> {
        static HOOK: Once = Once::new();
        HOOK.call_once(install_hook);
        failing_after(frames, |next| panic!("frame {next} cannot be made"))
    }

    /// Creates a source that returns the error of this number instead of frame number `frames`.
    pub fn failing_after(frames: u64, error: fn(u64) -> SourceError) -> Box<dyn FrameSource> {
        let request = WaveformRequest { samples_per_chirp: 8, chirps_per_frame: 2, ..WaveformRequest::paper() };
        let mut next = 0;
        Box::new(source_from_fn(Waveform::realise(request).expect("a valid waveform"), move |frame| {
            if next == frames {
                return Err(error(next));
            }
            (frame.sequence, frame.time_ns) = (next, next * 100_000_000);
            next += 1;
            Ok(SourceEvent::Frame)
        }))
    }

    #[test]
    fn a_panic_becomes_an_error_with_message_and_location_and_the_source_is_not_read_again() {
        let mut source = PanicGuard::new(panicking_after(1));
        let mut frame = Frame::zeroed(source.waveform().shape());
        assert_eq!(source.next_frame(&mut frame).expect("a frame"), SourceEvent::Frame);
        for _ in 0..2 {
            let error = source.next_frame(&mut frame).expect_err("a panic");
            let panicked = error.downcast_ref::<Panicked>().expect("its own type");
            assert_eq!(panicked.message, "frame 1 cannot be made");
            assert!(panicked.location.contains("panics.rs:"), "{}", panicked.location);
        }
    }

    #[test]
    fn a_panic_of_another_thread_keeps_its_location() {
        let thread = std::thread::spawn(|| {
            let mut source = panicking_after(0);
            let mut frame = Frame::zeroed(source.waveform().shape());
            source.next_frame(&mut frame).is_ok()
        });
        let panicked = Panicked::new(thread.join().expect_err("a panic").as_ref());
        assert!(panicked.message == "frame 0 cannot be made", "{panicked}");
        assert!(panicked.location.contains("panics.rs:"), "{panicked}");
    }
}
