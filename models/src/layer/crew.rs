//! Threads that stay awake while a network runs.
//!
//! A small network's steps take microseconds, a thread that has gone to sleep between two of them tens until it is back. A crew is the
//! thread that runs a network and helpers among rayon's threads: helpers are called once a run, wait for work without sleeping,
//! and go home when there is none for [`LINGER`]. Nobody waits for a helper that is late: tasks are taken one by one, and the leader
//! takes what is left.

use std::cell::{Cell, UnsafeCell};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::apart::Places;

/// How long a helper waits for work before it goes back among rayon's threads.
const LINGER: Duration = Duration::from_micros(300);
/// Turns of waiting, some ten nanoseconds each, before a thread offers its processor to others: longer than from step to step, for
/// on a busy machine it may be back when the run is over, and no longer, for who is waited for may be in want of this very one.
const PATIENCE: u32 = 1 << 11;

thread_local! {
    /// The crew that this thread leads.
    static LED: Cell<Option<*const Crew>> = const { Cell::new(None) };
}

/// Calls `task` with `0..count`, in any order: by the crew that this thread leads, or by rayon's threads if it leads none.
pub(super) fn for_each_task(count: usize, task: impl Fn(usize) + Sync) {
    if count == 1 {
        return task(0);
    }
    match LED.get() {
        // SAFETY: `lead` holds the crew for as long as it is this thread's.
        Some(crew) => (unsafe { &*crew }).work_off(count, &task),
        None => (0..count).into_par_iter().for_each(&task),
    }
}

/// Calls `f` with the index and the values of every chunk of `length` values, as [`for_each_task`] does; the last may be shorter.
pub(crate) fn for_each_chunk(values: &mut [f32], length: usize, f: impl Fn(usize, &mut [f32]) + Sync) {
    let (total, shared) = (values.len(), super::tile::Shared::new(values));
    for_each_task(total.div_ceil(length), |index| {
        let first = index * length;
        // SAFETY: chunks do not overlap, and each is one task's.
        f(index, unsafe { std::slice::from_raw_parts_mut(shared.get().add(first), length.min(total - first)) });
    });
}

/// A crew. It belongs to one network, which one thread at a time runs.
#[derive(Default)]
pub(crate) struct Crew(Arc<Board>);

/// What leader and helpers tell each other, each on cache lines of its own.
#[derive(Default)]
struct Board {
    /// Odd while there is a job, another one each time.
    round: Line<AtomicUsize>,
    /// The next task that nobody has taken.
    next: Line<AtomicUsize>,
    /// Helpers that may be looking at the job.
    inside: Line<AtomicUsize>,
    /// Helpers that are there or on their way.
    enlisted: Line<AtomicUsize>,
    /// Helpers that are there.
    arrived: Line<AtomicUsize>,
    /// Whether the leader has called a helper and has not made way for it yet.
    awaits: AtomicBool,
    places: Places,
    job: UnsafeCell<Option<Job>>,
}

// SAFETY: the leader alone writes the job, while the round is even and nobody is inside; helpers read it inside, once they have
// seen an odd round from there.
unsafe impl Sync for Board {}
// SAFETY: as above; a job's task is `Sync`.
unsafe impl Send for Board {}

#[derive(Default)]
#[repr(align(128))]
struct Line<T>(T);

#[derive(Clone, Copy)]
struct Job {
    count: usize,
    task: *const (dyn Fn(usize) + Sync),
}

/// What this thread led before, and leads again.
struct Led(Option<*const Crew>);

impl Drop for Led {
    fn drop(&mut self) {
        LED.set(self.0);
    }
}

impl Crew {
    /// Runs `f`, whose tasks this crew does.
    pub fn lead<R>(&mut self, f: impl FnOnce() -> R) -> R {
        let _before = Led(LED.replace(Some(std::ptr::from_ref(self))));
        f()
    }

    fn work_off(&self, count: usize, task: &(dyn Fn(usize) + Sync)) {
        /// Ends the job, however the leader's own part of it ends.
        struct Open<'a>(&'a Board);
        impl Drop for Open<'_> {
            fn drop(&mut self) {
                self.0.round.0.fetch_add(1, Ordering::SeqCst);
                let mut turns = 0;
                while self.0.inside.0.load(Ordering::SeqCst) != 0 {
                    wait(&mut turns);
                }
            }
        }
        let board = &self.0;
        // There is one job at a time: tasks within tasks are rayon's.
        let _before = Led(LED.take());
        if Board::enlist(board) {
            board.places.lead();
            board.awaits.store(true, Ordering::Relaxed);
        } else if board.awaits.swap(false, Ordering::Relaxed) && board.arrived.0.load(Ordering::Relaxed) == 0 {
            // The helper that was called for the job before may be waiting for this very processor: see `apart.rs`. Once, for on a
            // busy machine others come first each time.
            std::thread::yield_now();
        }
        // SAFETY: of the lifetime only, which ends behind `Open`: it waits until nobody looks at the job any more.
        let task = unsafe { std::mem::transmute::<*const (dyn Fn(usize) + Sync), *const (dyn Fn(usize) + Sync)>(task) };
        let job = Job { count, task };
        // SAFETY: there is no job now, and nobody inside.
        unsafe { *board.job.get() = Some(job) };
        board.next.0.store(0, Ordering::Relaxed);
        board.round.0.fetch_add(1, Ordering::SeqCst);
        let _open = Open(board);
        board.work(job);
    }
}

impl Board {
    /// Calls a helper if one is missing, and tells so; that one calls the next.
    fn enlist(board: &Arc<Board>) -> bool {
        let there = board.enlisted.0.load(Ordering::Relaxed);
        let is_missing = there + 1 < rayon::current_num_threads()
            && board.enlisted.0.compare_exchange(there, there + 1, Ordering::Relaxed, Ordering::Relaxed).is_ok();
        if is_missing {
            let board = board.clone();
            rayon::spawn(move || Board::help(&board));
        }
        is_missing
    }

    fn work(&self, job: Job) {
        loop {
            let index = self.next.0.fetch_add(1, Ordering::Relaxed);
            if index >= job.count {
                return;
            }
            // SAFETY: the leader keeps the task until nobody is inside.
            let task = unsafe { &*job.task };
            task(index);
        }
    }

    fn help(board: &Arc<Board>) {
        /// Leaves, whatever a task did.
        struct Leave<'a>(&'a AtomicUsize);
        impl Drop for Leave<'_> {
            fn drop(&mut self) {
                self.0.fetch_sub(1, Ordering::SeqCst);
            }
        }
        let _enlisted = Leave(&board.enlisted.0);
        board.arrived.0.fetch_add(1, Ordering::Relaxed);
        let _arrived = Leave(&board.arrived.0);
        let _place = board.places.help();
        Board::enlist(board);
        let (mut done, mut since, mut turns) = (0, Instant::now(), 0u32);
        loop {
            let round = board.round.0.load(Ordering::Acquire);
            if !round.is_multiple_of(2) && round != done {
                // Whoever is inside before the round ends is waited for; who comes later sees that it has ended.
                board.inside.0.fetch_add(1, Ordering::SeqCst);
                let _inside = Leave(&board.inside.0);
                if board.round.0.load(Ordering::SeqCst) == round
                    // SAFETY: the round is on, and its leader waits for this thread before the job changes.
                    && let Some(job) = unsafe { *board.job.get() }
                {
                    board.work(job);
                }
                (done, since, turns) = (round, Instant::now(), 0);
            } else {
                wait(&mut turns);
                if turns > PATIENCE && since.elapsed() > LINGER {
                    return;
                }
            }
        }
    }
}

/// One turn of waiting for another thread.
fn wait(turns: &mut u32) {
    *turns = turns.saturating_add(1);
    if *turns <= PATIENCE { std::hint::spin_loop() } else { std::thread::yield_now() }
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
                let mut crew = Crew::default();
                for round in 0..200 {
                    let counts: Vec<AtomicU32> = (0..round).map(|_| AtomicU32::new(0)).collect();
                    crew.lead(|| {
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
        let mut crew = Crew::default();
        for length in [1, 3, 10, 11] {
            let mut values = vec![0.0; 10];
            crew.lead(|| for_each_chunk(&mut values, length, |index, chunk| chunk.fill(index as f32)));
            for_each_chunk(&mut [], length, |_, _| ());
            let expected: Vec<f32> = (0..10).map(|k| (k / length) as f32).collect();
            assert_eq!(values, expected);
        }
    }

    /// Several threads are at work at once: each of these tasks waits for the other.
    #[test]
    fn helpers_help() {
        with_threads(2, || {
            let seen = Mutex::new(Vec::new());
            Crew::default().lead(|| {
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

    /// Nobody looks at a job that its leader has left by a panic.
    #[test]
    fn a_panic_of_the_leader_leaves_the_crew_usable() {
        with_threads(1, || {
            let mut crew = Crew::default();
            let run = std::panic::AssertUnwindSafe(|| crew.lead(|| for_each_task(4, |k| assert!(k < 2, "as asked"))));
            assert!(std::panic::catch_unwind(run).is_err());
            let done = AtomicU32::new(0);
            crew.lead(|| for_each_task(4, |_| _ = done.fetch_add(1, Ordering::Relaxed)));
            assert_eq!(done.into_inner(), 4);
        });
    }
}
