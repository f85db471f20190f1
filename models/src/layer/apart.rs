//! Threads of a crew on processors of their own.
//!
//! A virtual machine's kernel does not trust a processor that its host has put to sleep, and wakes a thread beside the one that
//! calls it: a helper would wait for its own leader, for milliseconds. So whoever finds itself where another of the crew is keeps
//! off those processors for as long as it helps.

#[cfg(not(target_os = "linux"))]
pub(super) use elsewhere::Places;
#[cfg(target_os = "linux")]
pub(super) use linux::Places;

#[cfg(target_os = "linux")]
mod linux {
    use std::sync::{Mutex, MutexGuard, PoisonError};

    use rustix::thread::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};

    /// Processors that the threads of a crew are on.
    #[derive(Default)]
    pub struct Places {
        leader: Mutex<usize>,
        helpers: Mutex<Vec<usize>>,
    }

    fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
        mutex.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A helper's place; given back, and the helper free to go anywhere again, when this is dropped.
    pub struct Place<'a> {
        places: &'a Places,
        processor: usize,
        /// Where the helper may be otherwise, if it was moved.
        allowed: Option<CpuSet>,
    }

    impl Places {
        /// Notes where the leader is, which calls this.
        pub fn lead(&self) {
            *lock(&self.leader) = sched_getcpu();
        }

        /// Moves the calling thread to a processor that nobody of the crew is on, if it may go there.
        pub fn help(&self) -> Place<'_> {
            let mut helpers = lock(&self.helpers);
            let mut allowed = None;
            let taken = |processor| processor == *lock(&self.leader) || helpers.contains(&processor);
            if taken(sched_getcpu())
                && let Ok(all) = sched_getaffinity(None)
            {
                let mut free = CpuSet::new();
                (0..CpuSet::MAX_CPU).filter(|&k| all.is_set(k) && !taken(k)).for_each(|k| free.set(k));
                if free.count() > 0 && sched_setaffinity(None, &free).is_ok() {
                    allowed = Some(all);
                }
            }
            let processor = sched_getcpu();
            helpers.push(processor);
            Place { places: self, processor, allowed }
        }
    }

    impl Drop for Place<'_> {
        fn drop(&mut self) {
            let mut helpers = lock(&self.places.helpers);
            if let Some(index) = helpers.iter().position(|&processor| processor == self.processor) {
                helpers.swap_remove(index);
            }
            if let Some(allowed) = &self.allowed {
                // It was allowed before. Should it not be now, there is another mask by somebody else's will.
                _ = sched_setaffinity(None, allowed);
            }
        }
    }
}

/// Where threads cannot be moved they stay where they are.
#[cfg(not(target_os = "linux"))]
mod elsewhere {
    #[derive(Default)]
    pub struct Places;
    pub struct Place;

    impl Places {
        pub fn lead(&self) {}

        pub fn help(&self) -> Place {
            Place
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use rustix::thread::{sched_getaffinity, sched_getcpu};

    /// A helper that begins where its leader is goes elsewhere, and may be anywhere again afterwards.
    #[test]
    fn a_helper_leaves_its_leaders_processor() {
        let before = sched_getaffinity(None).expect("a mask");
        for _ in 0..20 {
            let places = Places::default();
            places.lead();
            let here = sched_getcpu();
            let place = places.help();
            if before.count() > 1 && sched_getaffinity(None).expect("a mask") != before {
                assert_ne!(sched_getcpu(), here);
            }
            drop(place);
            assert!(sched_getaffinity(None).expect("a mask") == before);
        }
    }

    /// More helpers than processors stay where they may be.
    #[test]
    fn nobody_is_sent_away_from_everywhere() {
        let before = sched_getaffinity(None).expect("a mask");
        let places = Places::default();
        places.lead();
        std::thread::scope(|scope| {
            for _ in 0..2 * before.count() {
                scope.spawn(|| {
                    let place = places.help();
                    assert!(sched_getaffinity(None).expect("a mask").count() > 0);
                    drop(place);
                    assert!(sched_getaffinity(None).expect("a mask") == before);
                });
            }
        });
    }
}
