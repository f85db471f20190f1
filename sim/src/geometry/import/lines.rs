//! A text handed out line by line, so that one knows in which line a parser stopped.

use std::cell::Cell;
use std::io::{BufRead, Read, Result, Seek, SeekFrom};

/// A reader that never gives more than a line at once.
pub(super) struct Lines<'a> {
    text: &'a [u8],
    at: usize,
    end: usize,
    /// Lines begun.
    pub count: &'a Cell<usize>,
}

impl<'a> Lines<'a> {
    pub fn new(text: &'a [u8], count: &'a Cell<usize>) -> Self {
        Lines { text, at: 0, end: 0, count }
    }
}

impl BufRead for Lines<'_> {
    fn fill_buf(&mut self) -> Result<&[u8]> {
        let rest = self.text.get(self.end..).unwrap_or(&[]);
        if self.at >= self.end && !rest.is_empty() {
            self.end += rest.iter().position(|&b| b == b'\n').map_or(rest.len(), |i| i + 1);
            self.count.set(self.count.get() + 1);
        }
        Ok(self.text.get(self.at..self.end).unwrap_or(&[]))
    }

    fn consume(&mut self, amount: usize) {
        self.at = (self.at + amount).min(self.end);
    }
}

impl Read for Lines<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        let read = self.fill_buf()?.read(buffer)?;
        self.consume(read);
        Ok(read)
    }
}

impl Seek for Lines<'_> {
    /// Back to the beginning; nothing else is asked for.
    fn seek(&mut self, _: SeekFrom) -> Result<u64> {
        (self.at, self.end) = (0, 0);
        self.count.set(0);
        Ok(0)
    }
}
