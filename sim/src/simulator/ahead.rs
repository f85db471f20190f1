//! Computations queued ahead of their use, on rayon's threads.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::{ThreadPool, Yield};

/// A queued computation. When it is dropped, it does not begin any more, or its result is discarded.
#[derive(Debug)]
pub(super) struct Ahead<T> {
    /// Never locked. The mutex only makes a type with an [`Ahead`] shareable between threads.
    result: Mutex<Receiver<Result<T, Box<dyn Any + Send>>>>,
    unwanted: Arc<AtomicBool>,
}

impl<T: Send + 'static> Ahead<T> {
    /// Queues a computation, first come first served, on the threads of a pool or on the shared ones.
    pub(super) fn new(pool: Option<&ThreadPool>, make: impl FnOnce() -> T + Send + 'static) -> Self {
        let (send, result) = sync_channel(1);
        let unwanted = Arc::new(AtomicBool::new(false));
        let stop = Arc::clone(&unwanted);
        let job = move || {
            if !stop.load(Ordering::Relaxed) {
                // A panic is passed to the waiting thread, since unwinding here would end the process. If nobody waits,
                // the result is dropped.
                let _ = send.send(catch_unwind(AssertUnwindSafe(make)));
            }
        };
        match pool {
            Some(pool) => pool.spawn_fifo(job),
            None => rayon::spawn_fifo(job),
        }
        Ahead { result: Mutex::new(result), unwanted }
    }

    /// Waits for the result. A panic of the computation continues here. Returns `None` if the computation never began.
    ///
    /// A rayon thread does other work while it waits, since it may be the only thread. If no work is left, other
    /// threads run all queued computations, and this thread sleeps.
    pub(super) fn wait(mut self) -> Option<T> {
        let receiver = self.result.get_mut().unwrap_or_else(PoisonError::into_inner);
        let result = loop {
            match receiver.try_recv() {
                Ok(result) => break Some(result),
                Err(TryRecvError::Disconnected) => break None,
                Err(TryRecvError::Empty) => {}
            }
            if rayon::yield_now() != Some(Yield::Executed) {
                break receiver.recv().ok();
            }
        };
        result.map(|made| made.unwrap_or_else(|panic| resume_unwind(panic)))
    }
}

impl<T> Drop for Ahead<T> {
    fn drop(&mut self) {
        self.unwanted.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn things_arrive_inside_and_outside_of_a_pool_of_one() {
        let make = || (0..5).map(|i| Ahead::new(None, move || i)).collect::<Vec<_>>();
        let wait = |all: Vec<Ahead<i32>>| all.into_iter().map(Ahead::wait).collect::<Vec<_>>();
        let expected: Vec<_> = (0..5).map(Some).collect();
        assert_eq!(wait(make()), expected);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        assert_eq!(pool.install(|| wait(make())), expected);
        // The computation begins in one place, and another place waits for it.
        let begun = pool.install(make);
        assert_eq!(wait(begun), expected);
        let begun = make();
        assert_eq!(pool.install(|| wait(begun)), expected);
    }

    #[test]
    fn a_panic_reaches_who_waits() {
        let made = Ahead::new(None, || -> i32 { std::panic::resume_unwind(Box::new("no")) });
        let caught = catch_unwind(AssertUnwindSafe(|| made.wait()));
        assert_eq!(caught.expect_err("panics").downcast_ref::<&str>(), Some(&"no"));
    }

    #[test]
    fn what_is_dropped_before_its_turn_is_never_made() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        let begun = Arc::new(AtomicBool::new(false));
        pool.install(|| {
            let mark = Arc::clone(&begun);
            // The pool's only thread is busy here, so no other computation has begun.
            drop(Ahead::new(None, move || mark.store(true, Ordering::Relaxed)));
            Ahead::new(None, || ()).wait();
        });
        assert!(!begun.load(Ordering::Relaxed));
    }
}
