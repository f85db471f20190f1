//! Pictures of maps.

use std::path::Path;

use anyhow::Context;
use font8x8::{BASIC_FONTS, UnicodeFonts};
use image::{Rgb, RgbImage};
use radome_dsp::Rdm;

const MARGIN_LEFT: u32 = 64;
const MARGIN_RIGHT: u32 = 84;
const MARGIN_TOP: u32 = 28;
const MARGIN_BOTTOM: u32 = 44;
const INK: Rgb<u8> = Rgb([40, 44, 52]);

/// Writes one channel of a map: range to the right in metres, velocity upwards in m/s (receding above), colour in dB from
/// 10 dB under the median to the peak.
///
/// # Errors
/// The file cannot be written.
pub fn map(path: &Path, map: &Rdm, rx: usize) -> anyhow::Result<()> {
    let (doppler, range) = (map.shape.doppler as u32, map.shape.range as u32);
    let (cell_x, cell_y) = ((768 / range).max(1), (512 / doppler).max(1));
    let (width, height) = (range * cell_x, doppler * cell_y);
    let mut image = RgbImage::from_pixel(
        width + MARGIN_LEFT + MARGIN_RIGHT,
        height + MARGIN_TOP + MARGIN_BOTTOM,
        Rgb([255, 255, 255]),
    );
    let mut finite: Vec<f32> = map.db.iter().copied().filter(|v| v.is_finite()).collect();
    finite.sort_by(f32::total_cmp);
    let median = finite.get(finite.len() / 2).copied().unwrap_or(-200.0);
    let (low, high) = (median - 10.0, finite.last().copied().unwrap_or(0.0).max(median + 20.0));

    for y in 0..height {
        for x in 0..width {
            let d = (doppler - 1 - y / cell_y) as usize;
            let value = map.at(rx, d, (x / cell_x) as usize);
            // What is not a number must not look like one.
            let colour = if value.is_finite() { viridis((value - low) / (high - low)) } else { Rgb([255, 0, 255]) };
            image.put_pixel(MARGIN_LEFT + x, MARGIN_TOP + y, colour);
        }
    }
    let max_range_m = map.range_m(map.shape.range);
    for tick in ticks(0.0, max_range_m) {
        let x = MARGIN_LEFT + (tick / map.range_step_m * f64::from(cell_x)) as u32 + cell_x / 2;
        vertical(&mut image, x, MARGIN_TOP + height, 5);
        let label = label(tick, max_range_m);
        text(&mut image, x.saturating_sub(4 * label.len() as u32), MARGIN_TOP + height + 8, &label);
    }
    let max_velocity = map.velocity_m_per_s(map.shape.doppler);
    for tick in ticks(-max_velocity, max_velocity) {
        let row = tick / map.velocity_step_m_per_s + (doppler / 2) as f64;
        let y = i64::from(MARGIN_TOP + height) - ((row + 0.5) * f64::from(cell_y)) as i64;
        if y < i64::from(MARGIN_TOP) || y > i64::from(MARGIN_TOP + height) {
            continue;
        }
        let label = label(tick, max_velocity);
        horizontal(&mut image, MARGIN_LEFT - 5, y as u32, 5);
        text(
            &mut image,
            (MARGIN_LEFT - 8).saturating_sub(8 * label.len() as u32),
            (y as u32).saturating_sub(4),
            &label,
        );
    }
    text(&mut image, MARGIN_LEFT + width / 2 - 36, MARGIN_TOP + height + 26, "range / m");
    text(&mut image, 4, 8, "velocity / (m/s), receding up");
    let bar_x = MARGIN_LEFT + width + 16;
    for y in 0..height {
        let colour = viridis(1.0 - y as f32 / height as f32);
        for x in 0..12 {
            image.put_pixel(bar_x + x, MARGIN_TOP + y, colour);
        }
    }
    for tick in ticks(f64::from(low), f64::from(high)) {
        let y = MARGIN_TOP + ((f64::from(high) - tick) / f64::from(high - low) * f64::from(height)) as u32;
        text(&mut image, bar_x + 18, y.saturating_sub(4), &label(tick, 100.0));
    }
    text(&mut image, bar_x, MARGIN_TOP - 20, "dB");
    image.save(path).with_context(|| format!("cannot write {}", path.display()))
}

/// Writes points of several series on logarithmic axes, a colour a series.
///
/// # Errors
/// The file cannot be written.
pub fn scatter(path: &Path, (across, up): (&str, &str), series: &[(&str, Vec<(f64, f64)>)]) -> anyhow::Result<()> {
    const WIDTH: u32 = 640;
    const HEIGHT: u32 = 400;
    let longest = series.iter().map(|(name, _)| name.chars().count() as u32).max().unwrap_or(0);
    let size = (MARGIN_LEFT + WIDTH + 40 + 8 * longest, MARGIN_TOP + HEIGHT + MARGIN_BOTTOM);
    let power = |decade: i32| match decade {
        -3..=4 => format!("{}", 10f64.powi(decade)),
        _ => format!("1e{decade}"),
    };
    let mut image = RgbImage::from_pixel(size.0, size.1, Rgb([255, 255, 255]));
    let points = || series.iter().flat_map(|s| &s.1).filter(|p| p.0 > 0.0 && p.1 > 0.0);
    // Whole decades around all points.
    let decades = |values: Vec<f64>| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let low = if low.is_finite() { low.floor() } else { 0.0 };
        (low, if high.is_finite() { high.ceil().max(low + 1.0) } else { low + 1.0 })
    };
    let (x_low, x_high) = decades(points().map(|p| p.0.log10()).collect());
    let (y_low, y_high) = decades(points().map(|p| p.1.log10()).collect());
    let x_of = |v: f64| MARGIN_LEFT + ((v - x_low) / (x_high - x_low) * f64::from(WIDTH)) as u32;
    let y_of = |v: f64| MARGIN_TOP + ((y_high - v) / (y_high - y_low) * f64::from(HEIGHT)) as u32;
    for decade in x_low as i32..=x_high as i32 {
        let x = x_of(f64::from(decade));
        vertical(&mut image, x, MARGIN_TOP, HEIGHT + 5);
        let name = power(decade);
        text(&mut image, x.saturating_sub(4 * name.len() as u32), MARGIN_TOP + HEIGHT + 8, &name);
    }
    for decade in y_low as i32..=y_high as i32 {
        let y = y_of(f64::from(decade));
        horizontal(&mut image, MARGIN_LEFT - 5, y, WIDTH + 5);
        let name = power(decade);
        text(&mut image, (MARGIN_LEFT - 8).saturating_sub(8 * name.len() as u32), y.saturating_sub(4), &name);
    }
    text(&mut image, MARGIN_LEFT + WIDTH / 2 - 36, MARGIN_TOP + HEIGHT + 26, across);
    text(&mut image, 4, 8, up);
    let dot = |image: &mut RgbImage, x: u32, y: u32, colour: Rgb<u8>| {
        for (dx, dy) in (0..7).flat_map(|dx| (0..7).map(move |dy| (dx, dy))) {
            let (px, py) = ((x + dx).saturating_sub(3), (y + dy).saturating_sub(3));
            if px < image.width() && py < image.height() {
                image.put_pixel(px, py, colour);
            }
        }
    };
    for (i, (name, points)) in (0u32..).zip(series) {
        let colour = series_colour(i);
        for (x, y) in points.iter().filter(|p| p.0 > 0.0 && p.1 > 0.0) {
            dot(&mut image, x_of(x.log10()), y_of(y.log10()), colour);
        }
        dot(&mut image, MARGIN_LEFT + WIDTH + 16, MARGIN_TOP + 10 + 20 * i, colour);
        text(&mut image, MARGIN_LEFT + WIDTH + 26, MARGIN_TOP + 6 + 20 * i, name);
    }
    image.save(path).with_context(|| format!("cannot write {}", path.display()))
}

/// Writes lines through points of several series, a colour a series, on linear axes; what is up is a share, drawn
/// from the tenth below the lowest point to 1.
///
/// # Errors
/// The file cannot be written.
pub fn lines(path: &Path, (across, up): (&str, &str), series: &[(&str, Vec<(f64, f64)>)]) -> anyhow::Result<()> {
    const WIDTH: u32 = 640;
    const HEIGHT: u32 = 400;
    const LEGEND: u32 = 230;
    let size = (MARGIN_LEFT + WIDTH + LEGEND, MARGIN_TOP + HEIGHT + MARGIN_BOTTOM);
    let mut image = RgbImage::from_pixel(size.0, size.1, Rgb([255, 255, 255]));
    let across_values = || series.iter().flat_map(|s| &s.1).map(|p| p.0).filter(|x| x.is_finite());
    let low = across_values().fold(f64::INFINITY, f64::min);
    let high = across_values().fold(f64::NEG_INFINITY, f64::max);
    let (low, high) = if high > low { (low, high) } else { (low.min(0.0), low.max(0.0) + 1.0) };
    let x_of = |v: f64| MARGIN_LEFT + ((v - low) / (high - low) * f64::from(WIDTH)) as u32;
    let lowest = series.iter().flat_map(|s| &s.1).map(|p| p.1).filter(|y| y.is_finite()).fold(1.0, f64::min);
    let floor = ((10.0 * lowest).floor() / 10.0).clamp(0.0, 0.9);
    let y_of = |v: f64| MARGIN_TOP + ((1.0 - v.clamp(floor, 1.0)) / (1.0 - floor) * f64::from(HEIGHT)) as u32;
    for tick in ticks(low, high) {
        vertical(&mut image, x_of(tick), MARGIN_TOP + HEIGHT, 5);
        let name = label(tick, high - low);
        text(&mut image, x_of(tick).saturating_sub(4 * name.len() as u32), MARGIN_TOP + HEIGHT + 8, &name);
    }
    for v in ticks(floor, 1.0) {
        horizontal(&mut image, MARGIN_LEFT - 5, y_of(v), WIDTH + 5);
        text(&mut image, MARGIN_LEFT - 48, y_of(v).saturating_sub(4), &format!("{v:.2}"));
    }
    vertical(&mut image, MARGIN_LEFT, MARGIN_TOP, HEIGHT);
    text(&mut image, MARGIN_LEFT + WIDTH / 2 - 36, MARGIN_TOP + HEIGHT + 26, across);
    text(&mut image, 4, 8, up);
    let blot = |image: &mut RgbImage, x: u32, y: u32, half: u32, colour: Rgb<u8>| {
        for (dx, dy) in (0..=2 * half).flat_map(|dx| (0..=2 * half).map(move |dy| (dx, dy))) {
            let (px, py) = ((x + dx).saturating_sub(half), (y + dy).saturating_sub(half));
            if px < image.width() && py < image.height() {
                image.put_pixel(px, py, colour);
            }
        }
    };
    for (i, (name, points)) in (0u32..).zip(series) {
        let colour = series_colour(i);
        for pair in points.windows(2) {
            let [(x0, y0), (x1, y1)] = [pair[0], pair[1]].map(|(x, y)| (f64::from(x_of(x)), f64::from(y_of(y))));
            for step in 0..=400 {
                let t = f64::from(step) / 400.0;
                blot(&mut image, (x0 + t * (x1 - x0)) as u32, (y0 + t * (y1 - y0)) as u32, 1, colour);
            }
        }
        points.iter().for_each(|(x, y)| blot(&mut image, x_of(*x), y_of(*y), 3, colour));
        blot(&mut image, MARGIN_LEFT + WIDTH + 16, MARGIN_TOP + 10 + 20 * i, 3, colour);
        text(&mut image, MARGIN_LEFT + WIDTH + 26, MARGIN_TOP + 6 + 20 * i, name);
    }
    image.save(path).with_context(|| format!("cannot write {}", path.display()))
}

/// Colours that are told apart side by side: ColorBrewer's Set1 and Dark2, less the yellows.
fn series_colour(index: u32) -> Rgb<u8> {
    const COLOURS: [[u8; 3]; 12] = [
        [228, 26, 28],
        [55, 126, 184],
        [77, 175, 74],
        [152, 78, 163],
        [255, 127, 0],
        [166, 86, 40],
        [247, 129, 191],
        [102, 102, 102],
        [27, 158, 119],
        [0, 0, 0],
        [117, 112, 179],
        [102, 166, 30],
    ];
    Rgb(COLOURS.get(index as usize % COLOURS.len()).copied().unwrap_or_default())
}

/// Round values between two ends, about seven of them.
fn ticks(from: f64, to: f64) -> Vec<f64> {
    let raw = (to - from) / 7.0;
    let magnitude = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].iter().map(|s| s * magnitude).find(|s| *s >= raw).unwrap_or(raw);
    let first = (from / step).ceil() as i64;
    (first..).map(|i| i as f64 * step).take_while(|t| *t <= to).collect()
}

fn label(value: f64, scale: f64) -> String {
    let digits = (2.0 - scale.abs().max(1e-9).log10()).clamp(0.0, 4.0) as usize;
    format!("{value:.digits$}")
}

fn text(image: &mut RgbImage, x: u32, y: u32, line: &str) {
    for (i, character) in line.chars().enumerate() {
        let Some(glyph) = BASIC_FONTS.get(character) else { continue };
        for (row, bits) in (0u32..).zip(glyph) {
            for column in (0..8).filter(|c| bits & (1 << c) != 0) {
                let (px, py) = (x + 8 * i as u32 + column, y + row);
                if px < image.width() && py < image.height() {
                    image.put_pixel(px, py, INK);
                }
            }
        }
    }
}

fn vertical(image: &mut RgbImage, x: u32, y: u32, length: u32) {
    (y..(y + length).min(image.height()))
        .filter(|_| x < image.width())
        .collect::<Vec<_>>()
        .into_iter()
        .for_each(|y| image.put_pixel(x, y, INK));
}

fn horizontal(image: &mut RgbImage, x: u32, y: u32, length: u32) {
    (x..(x + length).min(image.width())).collect::<Vec<_>>().into_iter().for_each(|x| image.put_pixel(x, y, INK));
}

/// The viridis map by interpolation of nine of its colours.
fn viridis(t: f32) -> Rgb<u8> {
    const COLOURS: [[f32; 3]; 9] = [
        [68.0, 1.0, 84.0],
        [71.0, 44.0, 122.0],
        [59.0, 81.0, 139.0],
        [44.0, 113.0, 142.0],
        [33.0, 144.0, 141.0],
        [39.0, 173.0, 129.0],
        [92.0, 200.0, 99.0],
        [170.0, 220.0, 50.0],
        [253.0, 231.0, 37.0],
    ];
    let position = t.clamp(0.0, 1.0) * 8.0;
    let (i, f) = ((position as usize).min(7), position - (position as usize).min(7) as f32);
    Rgb([0, 1, 2].map(|c| (COLOURS[i][c] + f * (COLOURS[i + 1][c] - COLOURS[i][c])).round() as u8))
}
