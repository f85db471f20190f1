//! Colours of plots on light and on dark pages.

use super::mark::Ink;
use super::palette::INK;

/// Colours of a plot.
pub struct Theme {
    /// Background.
    pub background: Ink,
    /// Text and axes.
    pub ink: Ink,
    /// Grid lines behind the data.
    pub grid: Ink,
    /// Colours of the series, in turn.
    pub series: [Ink; 12],
}

impl Theme {
    /// Theme of light pages. The colour of each series has the largest possible CIE Lab distance from those before it,
    /// for normal, red-blind and green-blind vision. The first two are Okabe and Ito's.
    pub const LIGHT: Theme = Theme {
        background: Ink::solid([255, 255, 255]),
        ink: INK,
        grid: Ink::solid([221, 225, 230]),
        series: [
            Ink::solid([0, 114, 178]),
            Ink::solid([213, 94, 0]),
            Ink::solid([60, 0, 0]),
            Ink::solid([0, 0, 255]),
            Ink::solid([135, 150, 135]),
            Ink::solid([0, 0, 60]),
            Ink::solid([45, 0, 150]),
            Ink::solid([105, 105, 255]),
            Ink::solid([30, 75, 90]),
            Ink::solid([135, 75, 45]),
            Ink::solid([120, 150, 180]),
            Ink::solid([45, 45, 120]),
        ],
    };

    /// Theme of dark pages, with series colours chosen by the same rule.
    pub const DARK: Theme = Theme {
        background: Ink::solid([13, 17, 23]),
        ink: Ink::solid([230, 237, 243]),
        grid: Ink::solid([45, 51, 59]),
        series: [
            Ink::solid([86, 180, 233]),
            Ink::solid([230, 159, 0]),
            Ink::solid([140, 0, 255]),
            Ink::solid([140, 255, 200]),
            Ink::solid([200, 0, 80]),
            Ink::solid([110, 80, 200]),
            Ink::solid([255, 255, 140]),
            Ink::solid([170, 80, 0]),
            Ink::solid([200, 40, 140]),
            Ink::solid([255, 255, 0]),
            Ink::solid([80, 255, 255]),
            Ink::solid([200, 170, 110]),
        ],
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Converts an sRGB colour to linear red, green and blue (IEC 61966-2-1).
    fn linear(ink: Ink) -> [f64; 3] {
        ink.rgb.map(|value| match f64::from(value) / 255.0 {
            low if low <= 0.04045 => low / 12.92,
            value => ((value + 0.055) / 1.055).powf(2.4),
        })
    }

    /// Contrast ratio by the Web Content Accessibility Guidelines.
    fn contrast(a: Ink, b: Ink) -> f64 {
        let luminance =
            |ink: Ink| linear(ink).iter().zip([0.2126, 0.7152, 0.0722]).map(|(c, weight)| c * weight).sum::<f64>();
        let (a, b) = (luminance(a), luminance(b));
        (a.max(b) + 0.05) / (a.min(b) + 0.05)
    }

    fn product(rows: [[f64; 3]; 3], vector: [f64; 3]) -> [f64; 3] {
        rows.map(|row| row.iter().zip(vector).map(|(a, b)| a * b).sum())
    }

    /// Converts linear red, green and blue to CIE Lab under D65.
    fn lab(linear: [f64; 3]) -> [f64; 3] {
        let xyz = product(
            [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]],
            linear.map(|c| c.clamp(0.0, 1.0)),
        );
        let root = |t: f64| if t > 216.0 / 24389.0 { t.cbrt() } else { (24389.0 / 27.0 * t + 16.0) / 116.0 };
        let [x, y, z] = [root(xyz[0] / 0.95047), root(xyz[1]), root(xyz[2] / 1.08883)];
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    }

    /// Contrast of 4.5 to 1 for text and 3 to 1 for lines: levels AA of the guidelines for text and for graphics.
    #[test]
    fn plots_have_the_contrast_that_readers_need() {
        for Theme { background, ink, series, .. } in [Theme::LIGHT, Theme::DARK] {
            assert!(contrast(ink, background) >= 4.5);
            for line in series {
                assert!(contrast(line, background) >= 3.0, "{line:?}: {}", contrast(line, background));
            }
        }
    }

    /// Red-blind and green-blind vision by Machado, Oliveira and Fernandes, "A Physiologically-based Model for
    /// Simulation of Color Vision Deficiency", 2009, severity 1. A difference of 2 is barely visible.
    #[test]
    fn series_are_distinguishable_by_the_colour_blind() {
        let eyes = [
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
            [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
        ];
        for (eye, theme) in eyes.into_iter().flat_map(|eye| [(eye, Theme::LIGHT), (eye, Theme::DARK)]) {
            let seen = theme.series.map(|ink| lab(product(eye, linear(ink))));
            for (i, a) in seen.iter().enumerate() {
                for b in seen.iter().skip(i + 1) {
                    let distance = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
                    assert!(distance > 20.0, "series {i}: {distance}");
                }
            }
        }
    }
}
