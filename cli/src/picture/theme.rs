//! Colours of plots on light and on dark pages.

use super::mark::Ink;
use super::palette::INK;

/// Colours of a plot.
pub struct Theme {
    /// Background.
    pub paper: Ink,
    /// Text and axes.
    pub ink: Ink,
    /// A colour for each series in turn.
    pub series: [Ink; 12],
}

impl Theme {
    /// Theme of light pages. Its series are told apart side by side: ColorBrewer's Set1 and Dark2, less the yellows.
    pub const LIGHT: Theme = Theme {
        paper: Ink::solid([255, 255, 255]),
        ink: INK,
        series: [
            Ink::solid([228, 26, 28]),
            Ink::solid([55, 126, 184]),
            Ink::solid([77, 175, 74]),
            Ink::solid([152, 78, 163]),
            Ink::solid([255, 127, 0]),
            Ink::solid([166, 86, 40]),
            Ink::solid([247, 129, 191]),
            Ink::solid([102, 102, 102]),
            Ink::solid([27, 158, 119]),
            Ink::solid([0, 0, 0]),
            Ink::solid([117, 112, 179]),
            Ink::solid([102, 166, 30]),
        ],
    };

    /// Theme of dark pages. Each of its series is as far as can be from those before it in CIE Lab, to eyes that see all colours, no
    /// red or no green; the first two are Okabe and Ito's.
    pub const DARK: Theme = Theme {
        paper: Ink::solid([13, 17, 23]),
        ink: Ink::solid([230, 237, 243]),
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

    /// Linear red, green and blue of an sRGB colour (IEC 61966-2-1).
    fn linear(ink: Ink) -> [f64; 3] {
        ink.rgb.map(|value| match f64::from(value) / 255.0 {
            low if low <= 0.04045 => low / 12.92,
            value => ((value + 0.055) / 1.055).powf(2.4),
        })
    }

    /// Contrast by the Web Content Accessibility Guidelines.
    fn contrast(a: Ink, b: Ink) -> f64 {
        let luminance =
            |ink: Ink| linear(ink).iter().zip([0.2126, 0.7152, 0.0722]).map(|(c, weight)| c * weight).sum::<f64>();
        let (a, b) = (luminance(a), luminance(b));
        (a.max(b) + 0.05) / (a.min(b) + 0.05)
    }

    fn product(rows: [[f64; 3]; 3], vector: [f64; 3]) -> [f64; 3] {
        rows.map(|row| row.iter().zip(vector).map(|(a, b)| a * b).sum())
    }

    /// CIE Lab under D65.
    fn lab(linear: [f64; 3]) -> [f64; 3] {
        let xyz = product(
            [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]],
            linear.map(|c| c.clamp(0.0, 1.0)),
        );
        let root = |t: f64| if t > 216.0 / 24389.0 { t.cbrt() } else { (24389.0 / 27.0 * t + 16.0) / 116.0 };
        let [x, y, z] = [root(xyz[0] / 0.95047), root(xyz[1]), root(xyz[2] / 1.08883)];
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    }

    /// Text at 4.5 to 1 and lines at 3 to 1, levels AA of the guidelines for text and for graphics.
    #[test]
    fn dark_plots_have_the_contrast_that_readers_need() {
        let Theme { paper, ink, series } = Theme::DARK;
        assert!(contrast(ink, paper) >= 4.5);
        for line in series {
            assert!(contrast(line, paper) >= 3.0, "{line:?}: {}", contrast(line, paper));
        }
    }

    /// Eyes without cones for red and for green: Machado, Oliveira and Fernandes, "A Physiologically-based Model for Simulation of
    /// Color Vision Deficiency", 2009, severity 1. A difference of 2 is just seen.
    #[test]
    fn dark_series_are_told_apart_by_the_colour_blind() {
        let eyes = [
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
            [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
        ];
        for eye in eyes {
            let seen = Theme::DARK.series.map(|ink| lab(product(eye, linear(ink))));
            for (i, a) in seen.iter().enumerate() {
                for b in seen.iter().skip(i + 1) {
                    let distance = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
                    assert!(distance > 25.0, "series {i}: {distance}");
                }
            }
        }
    }
}
