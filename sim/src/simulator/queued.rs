//! Computations queued on rayon's threads before their results are needed.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::{ThreadPool, Yield};

/// A queued computation. When it is dropped, it does not begin any more, or its result is discarded.
#[derive(Debug)]
pub(super) struct Queued<T> {
    /// Never locked. The mutex only makes a type with a [`Queued`] shareable between threads.
    result: Mutex<Receiver<Result<T, Box<dyn Any + Send>>>>,
    is_cancelled: Arc<AtomicBool>,
}

impl<T: Send + 'static> Queued<T> {
    /// Queues a computation, first come first served, on the threads of a pool or on the shared ones.
    pub(super) fn new(pool: Option<&ThreadPool>, compute: impl FnOnce() -> T + Send + 'static) -> Self {
        let (send, result) = sync_channel(1);
        let is_cancelled = Arc::new(AtomicBool::new(false));
        let cancelled = Arc::clone(&is_cancelled);
        let job = move || {
            if !cancelled.load(Ordering::Relaxed) {
                // A panic is passed to the waiting thread, since unwinding here would end the process. If nobody waits,
                // the result is dropped.
                let _ = send.send(catch_unwind(AssertUnwindSafe(compute)));
            }
        };
        match pool {
            Some(pool) => pool.spawn_fifo(job),
            None => rayon::spawn_fifo(job),
        }
        Queued { result: Mutex::new(result), is_cancelled }
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
        result.map(|result| result.unwrap_or_else(|panic| resume_unwind(panic)))
    }
}

impl<T> Drop for Queued<T> {
    fn drop(&mut self) {
        self.is_cancelled.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_arrive_inside_and_outside_of_a_pool_of_one() {
        let queue = || (0..5).map(|i| Queued::new(None, move || i)).collect::<Vec<_>>();
        let wait = |all: Vec<Queued<i32>>| all.into_iter().map(Queued::wait).collect::<Vec<_>>();
        let expected: Vec<_> = (0..5).map(Some).collect();
        assert_eq!(wait(queue()), expected);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        assert_eq!(pool.install(|| wait(queue())), expected);
        // The computation begins in one place, and another place waits for it.
        let begun = pool.install(queue);
        assert_eq!(wait(begun), expected);
        let begun = queue();
        assert_eq!(pool.install(|| wait(begun)), expected);
    }

    #[test]
    fn a_panic_reaches_the_waiting_thread() {
        let queued = Queued::new(None, || -> i32 { std::panic::resume_unwind(Box::new("no")) });
        let caught = catch_unwind(AssertUnwindSafe(|| queued.wait()));
        assert_eq!(caught.expect_err("panics").downcast_ref::<&str>(), Some(&"no"));
    }

    #[test]
    fn a_computation_dropped_before_it_begins_never_runs() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        let begun = Arc::new(AtomicBool::new(false));
        pool.install(|| {
            let mark = Arc::clone(&begun);
            // The pool's only thread is busy here, so no other computation has begun.
            drop(Queued::new(None, move || mark.store(true, Ordering::Relaxed)));
            Queued::new(None, || ()).wait();
        });
        assert!(!begun.load(Ordering::Relaxed));
    }
}
