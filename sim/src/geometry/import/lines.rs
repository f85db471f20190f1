//! Reader that returns a text line by line, so that the line at which a parser stopped is known.

use std::cell::Cell;
use std::io::{BufRead, Read, Result, Seek, SeekFrom};

/// Reader that never returns more than one line at once.
pub(super) struct Lines<'a> {
    text: &'a [u8],
    /// Offset of the next byte to return.
    next: usize,
    /// Offset behind the current line.
    line_end: usize,
    /// Number of lines begun.
    pub count: &'a Cell<usize>,
}

impl<'a> Lines<'a> {
    pub fn new(text: &'a [u8], count: &'a Cell<usize>) -> Self {
        Lines { text, next: 0, line_end: 0, count }
    }
}

impl BufRead for Lines<'_> {
    fn fill_buf(&mut self) -> Result<&[u8]> {
        let rest = self.text.get(self.line_end..).unwrap_or(&[]);
        if self.next >= self.line_end && !rest.is_empty() {
            self.line_end += rest.iter().position(|&b| b == b'\n').map_or(rest.len(), |i| i + 1);
            self.count.set(self.count.get() + 1);
        }
        Ok(self.text.get(self.next..self.line_end).unwrap_or(&[]))
    }

    fn consume(&mut self, amount: usize) {
        self.next = (self.next + amount).min(self.line_end);
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
    /// Seeks back to the beginning; the parser requests no other position.
    fn seek(&mut self, _: SeekFrom) -> Result<u64> {
        (self.next, self.line_end) = (0, 0);
        self.count.set(0);
        Ok(0)
    }
}
