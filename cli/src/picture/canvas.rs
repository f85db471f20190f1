//! Canvas that collects marks until the picture is written.

use std::path::Path;

use anyhow::Context;
use radome_driver::recording::Existing;

use super::mark::Mark;
pub use super::mark::{Ink, Letters, Line, Pixel};
use super::{raster, svg};
use crate::files;

/// Picture under construction.
pub struct Canvas {
    /// Width and height, pixels.
    size: [f64; 2],
    background: Ink,
    marks: Vec<Mark>,
}

impl Canvas {
    /// Creates a canvas with a width and a height, pixels, of one colour.
    pub fn new(width: f64, height: f64, background: Ink) -> Self {
        Canvas { size: [width, height], background, marks: Vec::new() }
    }

    /// Fills the union of areas; overlaps have the same colour as the rest.
    pub fn fill(&mut self, areas: &[Vec<Pixel>], ink: Ink) {
        // All areas get the same orientation, so that none counts as a hole in another.
        let oriented = |area: &Vec<Pixel>| {
            if signed_area(area) < 0.0 { area.iter().rev().copied().collect() } else { area.clone() }
        };
        self.marks.push(Mark::Fill { areas: areas.iter().map(oriented).collect(), ink });
    }

    /// Fills a rectangle with its upper left corner at `corner`.
    pub fn rectangle(&mut self, corner: Pixel, size: [f64; 2], ink: Ink) {
        self.marks.push(Mark::Rectangle { corner, size, ink });
    }

    pub fn line(&mut self, points: &[Pixel], style: &Line) {
        self.marks.push(Mark::Stroke { lines: vec![points.to_vec()], is_closed: false, style: *style });
    }

    /// Draws the outlines of areas.
    pub fn outline(&mut self, areas: &[Vec<Pixel>], style: &Line) {
        self.marks.push(Mark::Stroke { lines: areas.to_vec(), is_closed: true, style: *style });
    }

    /// Writes a line of text with its upper left corner at `corner`.
    pub fn text(&mut self, corner: Pixel, text: &str, letters: Letters, ink: Ink) {
        self.marks.push(Mark::Text { corner, text: text.to_owned(), letters, ink });
    }

    /// Writes the picture atomically, as SVG if the file's name ends in .svg, else as PNG.
    ///
    /// # Errors
    /// The width or the height is zero, both are too large, or the file cannot be written.
    pub fn save(&self, path: &Path) -> anyhow::Result<()> {
        let is_svg = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("svg"));
        files::write_output(path, Existing::Replace, |writer| {
            let written = match is_svg {
                true => svg::write(writer, self.size, self.background, &self.marks),
                false => raster::write(writer, self.size, self.background, &self.marks),
            };
            written.context("cannot write the picture")
        })
    }
}

fn signed_area(area: &[Pixel]) -> f64 {
    let next = area.iter().cycle().skip(1);
    area.iter().zip(next).map(|(a, b)| 0.5 * (a[0] * b[1] - a[1] * b[0])).sum()
}

/// Places text labels without overlap.
#[derive(Debug, Default)]
pub struct Labels {
    /// Low and high corners of the occupied boxes, pixels.
    reserved: Vec<[Pixel; 2]>,
}

impl Labels {
    /// Reserves a box, so that no text is placed there.
    pub fn reserve(&mut self, low: Pixel, high: Pixel) {
        self.reserved.push([low, high]);
    }

    /// Finds and reserves a place for a line of text of this size: the first of the candidate upper left corners at which it fits
    /// within a box and overlaps nothing.
    pub fn find(&mut self, size: [f64; 2], candidates: &[Pixel], within: [Pixel; 2]) -> Option<Pixel> {
        let is_free = |&&[x, y]: &&Pixel| {
            let (low, high) = ([x - 1.0, y - 1.0], [x + size[0] + 1.0, y + size[1] + 1.0]);
            let is_inside = (0..2).all(|i| low[i] >= within[0][i] && high[i] <= within[1][i]);
            let is_apart = |[l, h]: &[Pixel; 2]| (0..2).any(|i| high[i] <= l[i] || low[i] >= h[i]);
            is_inside && self.reserved.iter().all(is_apart)
        };
        let &[x, y] = candidates.iter().find(is_free)?;
        self.reserve([x, y], [x + size[0], y + size[1]]);
        Some([x, y])
    }
}
