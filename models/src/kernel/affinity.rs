//! CPU affinity of a spinning pool's threads: each gets a processor of its own.
//!
//! In a virtual machine, the operating system avoids processors that the host has put to sleep. It starts a helper on the processor
//! of the thread that called it, which may be its leader's. There the helper waits for milliseconds. Therefore, a helper that starts
//! on a processor of another thread of the pool excludes the pool's processors from its affinity mask while it runs.

#[cfg(not(target_os = "linux"))]
pub(crate) use elsewhere::Affinity;
#[cfg(target_os = "linux")]
pub(crate) use linux::Affinity;

#[cfg(target_os = "linux")]
mod linux {
    use std::sync::{Mutex, MutexGuard, PoisonError};

    use rustix::thread::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};

    /// Processors that the threads of a pool run on.
    #[derive(Default)]
    pub struct Affinity {
        leader: Mutex<usize>,
        helpers: Mutex<Vec<usize>>,
    }

    fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
        mutex.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Processor that is reserved for a helper. Dropping it frees the processor and restores the helper's affinity mask.
    pub struct Placement<'a> {
        affinity: &'a Affinity,
        processor: usize,
        /// Affinity mask of the helper before it was moved, if it was.
        allowed: Option<CpuSet>,
    }

    impl Affinity {
        /// Records the processor of the calling thread as the leader's.
        pub fn set_leader(&self) {
            *lock(&self.leader) = sched_getcpu();
        }

        /// Moves the calling thread to a processor that no thread of the pool runs on, if its mask allows one.
        pub fn place_helper(&self) -> Placement<'_> {
            let mut helpers = lock(&self.helpers);
            let mut allowed = None;
            let is_taken = |processor| processor == *lock(&self.leader) || helpers.contains(&processor);
            if is_taken(sched_getcpu())
                && let Ok(all) = sched_getaffinity(None)
            {
                let mut free = CpuSet::new();
                (0..CpuSet::MAX_CPU).filter(|&k| all.is_set(k) && !is_taken(k)).for_each(|k| free.set(k));
                if free.count() > 0 && sched_setaffinity(None, &free).is_ok() {
                    allowed = Some(all);
                }
            }
            let processor = sched_getcpu();
            helpers.push(processor);
            Placement { affinity: self, processor, allowed }
        }
    }

    impl Drop for Placement<'_> {
        fn drop(&mut self) {
            let mut helpers = lock(&self.affinity.helpers);
            if let Some(index) = helpers.iter().position(|&processor| processor == self.processor) {
                helpers.swap_remove(index);
            }
            if let Some(allowed) = &self.allowed {
                // This fails only if another program has changed the allowed processors. The mask then stays as it is.
                _ = sched_setaffinity(None, allowed);
            }
        }
    }
}

/// Affinity on systems without such masks: threads stay where they are.
#[cfg(not(target_os = "linux"))]
mod elsewhere {
    #[derive(Default)]
    pub struct Affinity;
    pub struct Placement;

    impl Affinity {
        pub fn set_leader(&self) {}

        pub fn place_helper(&self) -> Placement {
            Placement
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use rustix::thread::{sched_getaffinity, sched_getcpu};

    /// A helper that starts on its leader's processor moves to another one, and has its former mask afterwards.
    #[test]
    fn a_helper_leaves_its_leaders_processor() {
        let before = sched_getaffinity(None).expect("a mask");
        for _ in 0..20 {
            let affinity = Affinity::default();
            affinity.set_leader();
            let leader = sched_getcpu();
            let placement = affinity.place_helper();
            if before.count() > 1 && sched_getaffinity(None).expect("a mask") != before {
                assert_ne!(sched_getcpu(), leader);
            }
            drop(placement);
            assert!(sched_getaffinity(None).expect("a mask") == before);
        }
    }

    /// With more helpers than processors, masks stay valid.
    #[test]
    fn no_helper_is_excluded_from_all_processors() {
        let before = sched_getaffinity(None).expect("a mask");
        let affinity = Affinity::default();
        affinity.set_leader();
        std::thread::scope(|scope| {
            for _ in 0..2 * before.count() {
                scope.spawn(|| {
                    let placement = affinity.place_helper();
                    assert!(sched_getaffinity(None).expect("a mask").count() > 0);
                    drop(placement);
                    assert!(sched_getaffinity(None).expect("a mask") == before);
                });
            }
        });
    }
}
