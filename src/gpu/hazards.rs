//! Which allocations were touched since the last barrier, and whether the next command must wait.
//!
//! Reads may overlap; a write may overlap nothing of the same allocation. What a kernel touches is known from the pointers in its block;
//! a kernel that takes pointers from memory may touch anything.

/// Allocations touched since the last barrier.
#[derive(Default)]
pub(super) struct Hazards {
    read: Vec<u64>,
    written: Vec<u64>,
    /// Something unknown was read, or written: earlier submissions, pointers found in memory.
    read_any: bool,
    written_any: bool,
    /// The next command's own accesses.
    pub(super) reads: Vec<u64>,
    pub(super) writes: Vec<u64>,
}

impl Hazards {
    /// Whether the next command must wait for what came before.
    pub(super) fn collide(&self, reads_any: bool, writes_any: bool) -> bool {
        let read_something = self.read_any || !self.read.is_empty();
        let wrote_something = self.written_any || !self.written.is_empty();
        let touches = !self.reads.is_empty() || !self.writes.is_empty() || reads_any || writes_any;
        let writes = !self.writes.is_empty() || writes_any;
        (self.written_any && touches)
            || (self.read_any && writes)
            || (reads_any && wrote_something)
            || (writes_any && (read_something || wrote_something))
            || self.reads.iter().any(|id| self.written.contains(id))
            || self
                .writes
                .iter()
                .any(|id| self.written.contains(id) || self.read.contains(id))
    }

    /// Earlier calls may have touched anything.
    pub(super) fn start(&mut self) {
        self.clear();
        (self.read_any, self.written_any) = (true, true);
    }

    /// A barrier has been recorded.
    pub(super) fn clear(&mut self) {
        self.read.clear();
        self.written.clear();
        (self.read_any, self.written_any) = (false, false);
    }

    /// The next command has been recorded.
    pub(super) fn commit(&mut self, reads_any: bool, writes_any: bool) {
        for id in self.reads.drain(..) {
            if !self.read.contains(&id) {
                self.read.push(id);
            }
        }
        for id in self.writes.drain(..) {
            if !self.written.contains(&id) {
                self.written.push(id);
            }
        }
        self.read_any |= reads_any;
        self.written_any |= writes_any;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Which of a sequence of commands, each (reads, writes), need a barrier before them.
    fn barriers(commands: &[(&[u64], &[u64])]) -> Vec<bool> {
        let mut hazards = Hazards::default();
        let mut needed = Vec::new();
        for (reads, writes) in commands {
            hazards.reads.extend(*reads);
            hazards.writes.extend(*writes);
            needed.push(hazards.collide(false, false));
            if needed.last() == Some(&true) {
                hazards.clear();
            }
            hazards.commit(false, false);
        }
        needed
    }

    #[test]
    fn a_barrier_stands_where_a_write_meets_another_access_and_nowhere_else() {
        // Reading together, and writing apart.
        assert_eq!(
            barriers(&[(&[1], &[2]), (&[1], &[3]), (&[1, 4], &[5])]),
            [false; 3]
        );
        // Read after write, write after read, write after write.
        assert_eq!(barriers(&[(&[1], &[2]), (&[2], &[3])]), [false, true]);
        assert_eq!(barriers(&[(&[1], &[2]), (&[3], &[1])]), [false, true]);
        assert_eq!(barriers(&[(&[1], &[2]), (&[3], &[2])]), [false, true]);
        // A barrier covers all before it, and what comes after it counts again.
        assert_eq!(
            barriers(&[(&[], &[1, 2]), (&[1], &[]), (&[2], &[3]), (&[3], &[2])]),
            [false, true, false, true]
        );
    }

    #[test]
    fn what_pointers_in_memory_reach_is_anything() {
        let collide = |before: (bool, bool), own: (&[u64], &[u64]), any: (bool, bool)| {
            let mut hazards = Hazards {
                written: vec![1],
                read: vec![2],
                ..Hazards::default()
            };
            hazards.commit(before.0, before.1);
            hazards.reads.extend(own.0);
            hazards.writes.extend(own.1);
            hazards.collide(any.0, any.1)
        };
        let none = (false, false);
        let nothing: (&[u64], &[u64]) = (&[], &[]);
        assert!(!collide(none, (&[2], &[3]), none));
        assert!(
            collide(none, nothing, (true, false)),
            "it may read what was written"
        );
        assert!(
            collide(none, nothing, (false, true)),
            "it may write what was touched"
        );
        assert!(
            collide((true, false), (&[], &[3]), none),
            "it may have read this"
        );
        assert!(!collide((true, false), (&[3], &[]), none));
        assert!(
            collide((false, true), (&[3], &[]), none),
            "it may have written this"
        );
    }
}
