//! Spinning thread pool: its threads do not sleep while a network runs.
//!
//! A step of a small network takes microseconds; waking a sleeping thread takes tens of them. A pool consists of the leader, which
//! is the thread that runs a network, and of helpers, which are threads of rayon's pool. The leader calls helpers when a job begins.
//! Helpers spin until there is a job and return to rayon after [`HELPER_TIMEOUT`] without one. The leader never waits for a late
//! helper: threads take tasks one by one, and the leader takes all remaining ones.

use std::cell::{Cell, UnsafeCell};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::affinity::Affinity;

/// Time without a job after which a helper returns to rayon.
const HELPER_TIMEOUT: Duration = Duration::from_micros(300);
/// Number of spins, some ten nanoseconds each, before a thread yields its processor. They take longer than the time
/// between two steps, because on a busy machine a thread that yields may not resume before the end of the run. They take
/// no longer than needed, because the awaited thread may need this processor.
const SPINS_BEFORE_YIELD: u32 = 1 << 11;

thread_local! {
    /// Pool that this thread leads.
    static CURRENT: Cell<Option<*const SpinPool>> = const { Cell::new(None) };
}

/// Calls `task` with `0..count` in any order, on the pool that this thread leads, or on rayon's pool if it leads none.
pub(crate) fn for_each_task(count: usize, task: impl Fn(usize) + Sync) {
    if count == 1 {
        return task(0);
    }
    match CURRENT.get() {
        // SAFETY: `run` borrows the pool for as long as it is this thread's current one.
        Some(pool) => (unsafe { &*pool }).execute(count, &task),
        None => (0..count).into_par_iter().for_each(&task),
    }
}

/// Calls `f` with the index and the values of every chunk of `length` values, in parallel as [`for_each_task`]. The last chunk may be
/// shorter.
pub(crate) fn for_each_chunk(values: &mut [f32], length: usize, f: impl Fn(usize, &mut [f32]) + Sync) {
    let (total, shared) = (values.len(), super::tile::SharedBuffer::new(values));
    for_each_task(total.div_ceil(length), |index| {
        let first = index * length;
        // SAFETY: chunks do not overlap, and each belongs to one task.
        f(index, unsafe { std::slice::from_raw_parts_mut(shared.get().add(first), length.min(total - first)) });
    });
}

/// Spinning thread pool of one network. One thread at a time runs the network.
#[derive(Default)]
pub(crate) struct SpinPool(Arc<State>);

/// State shared by leader and helpers. Each counter has its own cache line.
#[derive(Default)]
struct State {
    /// Twice the number of finished jobs; one more while a job runs.
    round: CacheLine<AtomicUsize>,
    /// Index of the next free task.
    next: CacheLine<AtomicUsize>,
    /// Number of helpers that may read the job.
    readers: CacheLine<AtomicUsize>,
    /// Number of helpers that have been called and have not returned to rayon.
    called: CacheLine<AtomicUsize>,
    /// Number of these helpers that have started.
    spinning: CacheLine<AtomicUsize>,
    /// Whether the leader has called a helper and has not yielded to it yet.
    must_yield: AtomicBool,
    affinity: Affinity,
    job: UnsafeCell<Option<Job>>,
}

// SAFETY: only the leader writes the job, while the round is even and there are no readers. Helpers read it as readers, after they
// have seen an odd round.
unsafe impl Sync for State {}
// SAFETY: as above; a job's task is `Sync`.
unsafe impl Send for State {}

#[derive(Default)]
#[repr(align(128))]
struct CacheLine<T>(T);

#[derive(Clone, Copy)]
struct Job {
    count: usize,
    task: *const (dyn Fn(usize) + Sync),
}

/// Restores the current pool of this thread when dropped.
struct Restore(Option<*const SpinPool>);

impl Drop for Restore {
    fn drop(&mut self) {
        CURRENT.set(self.0);
    }
}

impl SpinPool {
    /// Calls `f` with this pool as the current one of the thread: tasks of `f` run on this pool.
    pub fn run<R>(&mut self, f: impl FnOnce() -> R) -> R {
        let _restore = Restore(CURRENT.replace(Some(std::ptr::from_ref(self))));
        f()
    }

    /// Runs `task` with `0..count` on leader and helpers.
    fn execute(&self, count: usize, task: &(dyn Fn(usize) + Sync)) {
        /// Ends the job when dropped, also by a panic of the leader, and waits for its readers.
        struct RunningJob<'a>(&'a State);
        impl Drop for RunningJob<'_> {
            fn drop(&mut self) {
                self.0.round.0.fetch_add(1, Ordering::SeqCst);
                let mut spins = 0;
                while self.0.readers.0.load(Ordering::SeqCst) != 0 {
                    wait(&mut spins);
                }
            }
        }
        let state = &self.0;
        // A pool runs one job at a time: nested tasks run on rayon's pool.
        let _restore = Restore(CURRENT.take());
        if State::call_helper(state) {
            state.affinity.set_leader();
            state.must_yield.store(true, Ordering::Relaxed);
        } else if state.must_yield.swap(false, Ordering::Relaxed) && state.spinning.0.load(Ordering::Relaxed) == 0 {
            // The helper called for the previous job may wait for this processor (see `affinity.rs`). The leader yields only once,
            // because on a busy machine other threads would run first each time.
            std::thread::yield_now();
        }
        // SAFETY: only the lifetime changes. `RunningJob` waits for all readers before the lifetime ends.
        let task = unsafe { std::mem::transmute::<*const (dyn Fn(usize) + Sync), *const (dyn Fn(usize) + Sync)>(task) };
        let job = Job { count, task };
        // SAFETY: there is no job now, and there are no readers.
        unsafe { *state.job.get() = Some(job) };
        state.next.0.store(0, Ordering::Relaxed);
        state.round.0.fetch_add(1, Ordering::SeqCst);
        let _running = RunningJob(state);
        state.take_tasks(job);
    }
}

impl State {
    /// Calls a helper if there are fewer than threads of rayon allow, and returns whether it did. The helper calls the next one.
    fn call_helper(state: &Arc<State>) -> bool {
        let called = state.called.0.load(Ordering::Relaxed);
        let is_missing = called + 1 < rayon::current_num_threads()
            && state.called.0.compare_exchange(called, called + 1, Ordering::Relaxed, Ordering::Relaxed).is_ok();
        if is_missing {
            let state = state.clone();
            rayon::spawn(move || State::help(&state));
        }
        is_missing
    }

    /// Runs free tasks of the job until there are none.
    fn take_tasks(&self, job: Job) {
        loop {
            let index = self.next.0.fetch_add(1, Ordering::Relaxed);
            if index >= job.count {
                return;
            }
            // SAFETY: the leader keeps the task until there are no readers.
            let task = unsafe { &*job.task };
            task(index);
        }
    }

    /// Runs tasks of one job after the other, on a thread of rayon's pool.
    fn help(state: &Arc<State>) {
        /// Decrements a counter when dropped, also by a panic of a task.
        struct Decrement<'a>(&'a AtomicUsize);
        impl Drop for Decrement<'_> {
            fn drop(&mut self) {
                self.0.fetch_sub(1, Ordering::SeqCst);
            }
        }
        let _called = Decrement(&state.called.0);
        state.spinning.0.fetch_add(1, Ordering::Relaxed);
        let _spinning = Decrement(&state.spinning.0);
        let _placement = state.affinity.place_helper();
        State::call_helper(state);
        let (mut last_round, mut last_job, mut spins) = (0, Instant::now(), 0u32);
        loop {
            let round = state.round.0.load(Ordering::Acquire);
            if !round.is_multiple_of(2) && round != last_round {
                // The leader waits for helpers that become readers before the round ends. Later ones see that it has ended.
                state.readers.0.fetch_add(1, Ordering::SeqCst);
                let _reader = Decrement(&state.readers.0);
                if state.round.0.load(Ordering::SeqCst) == round
                    // SAFETY: the round has not ended, and its leader waits for this thread before the job changes.
                    && let Some(job) = unsafe { *state.job.get() }
                {
                    state.take_tasks(job);
                }
                (last_round, last_job, spins) = (round, Instant::now(), 0);
            } else {
                wait(&mut spins);
                if spins > SPINS_BEFORE_YIELD && last_job.elapsed() > HELPER_TIMEOUT {
                    return;
                }
            }
        }
    }
}

/// Waits a moment for another thread: spins at first, then yields.
fn wait(spins: &mut u32) {
    *spins = spins.saturating_add(1);
    if *spins <= SPINS_BEFORE_YIELD { std::hint::spin_loop() } else { std::thread::yield_now() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::sync::atomic::AtomicU32;

    fn with_threads<R: Send>(threads: usize, f: impl FnOnce() -> R + Send) -> R {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads").install(f)
    }

    #[test]
    fn every_task_is_done_once() {
        for threads in [1, 2, 5] {
            with_threads(threads, || {
                let mut pool = SpinPool::default();
                for round in 0..200 {
                    let counts: Vec<AtomicU32> = (0..round).map(|_| AtomicU32::new(0)).collect();
                    pool.run(|| {
                        for _ in 0..3 {
                            for_each_task(round, |k| _ = counts[k].fetch_add(1, Ordering::Relaxed));
                        }
                    });
                    assert!(counts.iter().all(|count| count.load(Ordering::Relaxed) == 3), "{threads} threads");
                }
            });
        }
    }

    #[test]
    fn chunks_are_handed_out_whole() {
        let mut pool = SpinPool::default();
        for length in [1, 3, 10, 11] {
            let mut values = vec![0.0; 10];
            pool.run(|| for_each_chunk(&mut values, length, |index, chunk| chunk.fill(index as f32)));
            for_each_chunk(&mut [], length, |_, _| ());
            let expected: Vec<f32> = (0..10).map(|k| (k / length) as f32).collect();
            assert_eq!(values, expected);
        }
    }

    /// Several threads work in parallel: each of these tasks waits for the other.
    #[test]
    fn helpers_help() {
        with_threads(2, || {
            let seen = Mutex::new(Vec::new());
            SpinPool::default().run(|| {
                for_each_task(2, |_| {
                    seen.lock().expect("no panic").push(std::thread::current().id());
                    while seen.lock().expect("no panic").len() < 2 {
                        std::thread::yield_now();
                    }
                });
            });
            let seen = seen.into_inner().expect("no panic");
            assert_ne!(seen[0], seen[1]);
        });
    }

    /// No helper reads a job whose leader has panicked.
    #[test]
    fn a_panic_of_the_leader_leaves_the_pool_usable() {
        with_threads(1, || {
            let mut pool = SpinPool::default();
            let run = std::panic::AssertUnwindSafe(|| pool.run(|| for_each_task(4, |k| assert!(k < 2, "as asked"))));
            assert!(std::panic::catch_unwind(run).is_err());
            let done = AtomicU32::new(0);
            pool.run(|| for_each_task(4, |_| _ = done.fetch_add(1, Ordering::Relaxed)));
            assert_eq!(done.into_inner(), 4);
        });
    }
}
