//! Converts panics to errors that name their source location, so that a bug ends a run like any other error.

use std::any::Any;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind};
use std::sync::{Mutex, MutexGuard, PoisonError};

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

/// Number of panics whose location is remembered, since several threads may panic at once.
const REMEMBERED: usize = 32;

/// Panic as an error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "internal error at {place}: {message}\n\nhint: this is a fault of the program; please report it with the command line, and with \
     the file that `radome doctor --bundle` makes"
)]
pub struct Panicked {
    /// File and line, or a text that they are unknown.
    pub place: String,
    pub message: String,
}

/// Messages and locations of the last panics. When a thread passes a panic on to another, its location is stored
/// nowhere else.
static PLACES: Mutex<VecDeque<(String, String)>> = Mutex::new(VecDeque::new());

/// Installs a hook that remembers the location of each panic for its error. Panics are still printed on stderr.
pub fn remember_places() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic: &PanicHookInfo| {
        let place = panic.location().map_or_else(|| "an unknown place".to_owned(), ToString::to_string);
        let mut places = lock(&PLACES);
        if places.len() == REMEMBERED {
            places.pop_front();
        }
        places.push_back((message(panic.payload()), place));
        drop(places);
        before(panic);
    }));
}

/// Runs a function and converts a panic to an error. Values that the function borrows must be unused afterwards, or
/// valid in any state.
///
/// # Errors
/// A panic of the work, with its place.
pub fn caught<T>(work: impl FnOnce() -> T) -> Result<T, Panicked> {
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
        let places = lock(&PLACES);
        let place = places.iter().rev().find(|(said, _)| *said == message).map(|(_, place)| place.clone());
        Panicked { place: place.unwrap_or_else(|| "an unknown place".to_owned()), message }
    }
}

fn message(payload: &(dyn Any + Send)) -> String {
    match (payload.downcast_ref::<&str>(), payload.downcast_ref::<String>()) {
        (Some(text), _) => (*text).to_owned(),
        (None, Some(text)) => text.clone(),
        (None, None) => "a panic without a message".to_owned(),
    }
}

/// Source whose panics become errors. It is not read again after one.
pub struct Guarded {
    source: Box<dyn FrameSource>,
    panicked: Option<Panicked>,
}

impl Guarded {
    pub fn new(source: Box<dyn FrameSource>) -> Self {
        Guarded { source, panicked: None }
    }
}

impl FrameSource for Guarded {
    fn waveform(&self) -> &Waveform {
        self.source.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        if let Some(panicked) = &self.panicked {
            return Err(panicked.clone().into());
        }
        match caught(|| self.source.next_frame(frame)) {
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
        HOOK.call_once(remember_places);
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
    fn a_panic_becomes_an_error_with_message_and_place_and_the_source_is_left_alone() {
        let mut source = Guarded::new(panicking_after(1));
        let mut frame = Frame::zeroed(source.waveform().shape());
        assert_eq!(source.next_frame(&mut frame).expect("a frame"), SourceEvent::Frame);
        for _ in 0..2 {
            let error = source.next_frame(&mut frame).expect_err("a panic");
            let panicked = error.downcast_ref::<Panicked>().expect("its own type");
            assert_eq!(panicked.message, "frame 1 cannot be made");
            assert!(panicked.place.contains("panics.rs:"), "{}", panicked.place);
        }
    }

    #[test]
    fn a_panic_of_another_thread_keeps_its_place() {
        let thread = std::thread::spawn(|| {
            let mut source = panicking_after(0);
            let mut frame = Frame::zeroed(source.waveform().shape());
            source.next_frame(&mut frame).is_ok()
        });
        let panicked = Panicked::new(thread.join().expect_err("a panic").as_ref());
        assert!(panicked.message == "frame 0 cannot be made", "{panicked}");
        assert!(panicked.place.contains("panics.rs:"), "{panicked}");
    }
}
