//! Marks that a picture consists of: lines, areas and text, in pixels.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster_width};

/// Lengths of a dash and of the gap after it, pixels.
pub(super) const DASH: [f64; 2] = [6.0, 5.0];

/// Position in pixels, to the right and down.
pub type Pixel = [f64; 2];

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ink {
    /// Red, green, blue.
    pub rgb: [u8; 3],
    /// Opacity: 0 is invisible, 1 hides the background.
    pub opacity: f64,
}

impl Ink {
    pub const fn solid(rgb: [u8; 3]) -> Self {
        Ink { rgb, opacity: 1.0 }
    }

    pub fn faint(self, opacity: f64) -> Self {
        Ink { opacity, ..self }
    }

    pub fn darker(self, by: f64) -> Self {
        Ink { rgb: self.rgb.map(|c| (f64::from(c) * (1.0 - by)) as u8), ..self }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    pub ink: Ink,
    /// Width, pixels.
    pub width: f64,
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

/// Drawn element, in pixels. Later marks cover earlier ones.
pub enum Mark {
    /// Union of areas, all with the same orientation, by their corners.
    Fill { areas: Vec<Vec<Pixel>>, ink: Ink },
    /// Rectangle by its upper left corner, and its width and height.
    Rectangle { corner: Pixel, size: [f64; 2], ink: Ink },
    /// Lines through points. Closed ones return to their first point.
    Stroke { lines: Vec<Vec<Pixel>>, is_closed: bool, style: Line },
    /// Line of text by its upper left corner.
    Text { corner: Pixel, text: String, letters: Letters, ink: Ink },
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
