//! Marks that a picture consists of: lines, areas and text, in pixels.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster_width};

/// Lengths of a dash and of the gap after it, pixels.
pub(super) const DASH: [f64; 2] = [6.0, 5.0];

/// Position in pixels, to the right and down.
pub type Pixel = [f64; 2];

/// A colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ink {
    /// Red, green, blue.
    pub rgb: [u8; 3],
    /// Opacity: 0 is invisible, 1 hides the background.
    pub opacity: f64,
}

impl Ink {
    /// Creates an opaque colour.
    pub const fn solid(rgb: [u8; 3]) -> Self {
        Ink { rgb, opacity: 1.0 }
    }

    /// Returns the colour with another opacity.
    pub fn faint(self, opacity: f64) -> Self {
        Ink { opacity, ..self }
    }

    /// Returns a darker colour.
    pub fn darker(self, by: f64) -> Self {
        Ink { rgb: self.rgb.map(|c| (f64::from(c) * (1.0 - by)) as u8), ..self }
    }
}

/// Style of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    /// Colour.
    pub ink: Ink,
    /// Width, pixels.
    pub width: f64,
    /// Whether it is dashed.
    pub is_dashed: bool,
}

/// Size of letters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Letters {
    /// 16 pixels high.
    Small,
    /// 24 pixels high, bold.
    Title,
}

impl Letters {
    /// Returns weight and height of the glyphs.
    pub(super) fn font(self) -> (FontWeight, RasterHeight) {
        match self {
            Letters::Small => (FontWeight::Regular, RasterHeight::Size16),
            Letters::Title => (FontWeight::Bold, RasterHeight::Size24),
        }
    }

    /// Returns width and height of a line of text, pixels.
    pub fn size(self, line: &str) -> [f64; 2] {
        let (weight, height) = self.font();
        [(get_raster_width(weight, height) * line.chars().count()) as f64, height.val() as f64]
    }

    /// Shortens a line of text that is wider than this many pixels, with dots at its end.
    pub fn shortened(self, line: &str, width: f64) -> String {
        if self.size(line)[0] <= width {
            return line.to_owned();
        }
        let most = (width / self.size(".")[0]) as usize;
        let kept: String = line.chars().take(most.saturating_sub(3)).collect();
        format!("{}...", kept.trim_end())
    }
}

/// Drawn element. Later marks cover earlier ones.
pub enum Mark {
    /// Union of areas, all with the same orientation.
    Fill {
        /// Corners of each area.
        areas: Vec<Vec<Pixel>>,
        /// Colour.
        ink: Ink,
    },
    /// Rectangle.
    Rectangle {
        /// Upper left corner.
        corner: Pixel,
        /// Width and height, pixels.
        size: [f64; 2],
        /// Colour.
        ink: Ink,
    },
    /// Lines.
    Stroke {
        /// Points that each line passes through.
        lines: Vec<Vec<Pixel>>,
        /// Whether each line returns to its first point.
        is_closed: bool,
        /// Style.
        style: Line,
    },
    /// Line of text.
    Text {
        /// Upper left corner.
        corner: Pixel,
        /// The text.
        text: String,
        /// Size of its letters.
        letters: Letters,
        /// Colour.
        ink: Ink,
    },
}

#[cfg(test)]
mod tests {
    use noto_sans_mono_bitmap::get_raster;

    use super::*;

    #[test]
    fn letters_of_european_languages_have_glyphs() {
        for letters in [Letters::Small, Letters::Title] {
            let (weight, height) = letters.font();
            for character in "Büro Küche, Fußgänger, año, żółw".chars() {
                assert!(get_raster(character, weight, height).is_some(), "{character}");
            }
        }
    }

    /// A line that fits stays as it is; a longer one is shortened to fit.
    #[test]
    fn long_lines_are_shortened() {
        let letters = Letters::Title;
        let width = letters.size("0123456789")[0];
        assert_eq!(letters.shortened("Büro Küche", width), "Büro Küche");
        assert_eq!(letters.shortened("Büro Küche!", width), "Büro Kü...");
        assert_eq!(letters.shortened("abcdef ghijk", width), "abcdef...");
    }
}
