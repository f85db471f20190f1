//! Plots: maps, points and lines on axes.

use std::path::Path;
use std::sync::LazyLock;

use anyhow::Context;
use radome_dsp::Rdm;

use super::canvas::{Canvas, Ink, Letters, Line, Pixel};
use super::raster::write_png;
use super::theme::Theme;

/// Margins of a plot, pixels: for numbers to the left and below, and for the names of axes.
const MARGIN_LEFT: f64 = 72.0;
const MARGIN_RIGHT: f64 = 92.0;
const MARGIN_TOP: f64 = 32.0;
const MARGIN_BOTTOM: f64 = 52.0;
/// Size of a plot of series, pixels.
const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 400.0;
/// Colour of cells that are not numbers.
const NOT_A_NUMBER: Ink = Ink::solid([255, 0, 255]);
/// Length of a tick, pixels.
const TICK: f64 = 5.0;
/// Distance between lines of a legend, pixels.
const LEGEND_STEP: f64 = 20.0;

/// Writes the first channel of a map as a picture. Range is to the right in metres, velocity upwards in m/s (receding above),
/// colour in dB from 10 dB below the median to the peak.
///
/// # Errors
/// The file cannot be written.
pub fn save_map(path: &Path, map: &Rdm) -> anyhow::Result<()> {
    let (doppler, range) = (map.shape.doppler, map.shape.range);
    let (cell_x, cell_y) = ((768 / range).max(1) as f64, (512 / doppler).max(1) as f64);
    let (width, height) = (range as f64 * cell_x, doppler as f64 * cell_y);
    let theme = &Theme::LIGHT;
    let (all_width, all_height) = (width + MARGIN_LEFT + MARGIN_RIGHT, height + MARGIN_TOP + MARGIN_BOTTOM);
    let mut plot = Plot { canvas: Canvas::new(all_width, all_height, theme.background), theme };
    let (low, high) = levels(map);
    for d in 0..doppler {
        let y = MARGIN_TOP + (doppler - 1 - d) as f64 * cell_y;
        for r in 0..range {
            let value = map.at(0, d, r);
            let ink = if value.is_finite() { viridis((value - low) / (high - low)) } else { NOT_A_NUMBER };
            plot.canvas.rectangle([MARGIN_LEFT + r as f64 * cell_x, y], [cell_x, cell_y], ink);
        }
    }
    let max_range_m = map.range_m(range);
    for tick in ticks(0.0, max_range_m) {
        let x = MARGIN_LEFT + (tick / map.range_step_m + 0.5) * cell_x;
        plot.tick_below([x, MARGIN_TOP + height], 0.0, &label(tick, max_range_m));
    }
    let max_velocity = map.velocity_m_per_s(doppler);
    for tick in ticks(-max_velocity, max_velocity) {
        let row = tick / map.velocity_step_m_per_s + (doppler / 2) as f64;
        let y = MARGIN_TOP + height - (row + 0.5) * cell_y;
        if (MARGIN_TOP..=MARGIN_TOP + height).contains(&y) {
            plot.tick_beside([MARGIN_LEFT, y], 0.0, &label(tick, max_velocity));
        }
    }
    plot.axis_names([width, height], ("range / m", "velocity / (m/s), receding up"));
    let bar_x = MARGIN_LEFT + width + 16.0;
    for row in 0..height as u32 {
        let ink = viridis(1.0 - row as f32 / height as f32);
        plot.canvas.rectangle([bar_x, MARGIN_TOP + f64::from(row)], [12.0, 1.0], ink);
    }
    for tick in ticks(f64::from(low), f64::from(high)) {
        let y = MARGIN_TOP + (f64::from(high) - tick) / f64::from(high - low) * height;
        plot.text([bar_x + 18.0, y - 8.0], &label(tick, 100.0));
    }
    plot.text([bar_x, MARGIN_TOP - 24.0], "dB");
    plot.canvas.save(path)
}

/// Encodes the first channel of a map as a PNG without axes, with one pixel per cell. Range is to the right, velocity upwards
/// (receding above), colour between two levels, dB.
///
/// # Errors
/// The picture cannot be encoded.
pub fn map_png(map: &Rdm, (low, high): (f32, f32)) -> anyhow::Result<Vec<u8>> {
    let (doppler, range) = (map.shape.doppler, map.shape.range);
    let steps = VIRIDIS.len() as f32 - 1.0;
    let mut rgb = Vec::with_capacity(3 * doppler * range);
    for row in (0..doppler).rev() {
        for column in 0..range {
            let position = (map.at(0, row, column) - low) / (high - low);
            let colour = VIRIDIS[(position.clamp(0.0, 1.0) * steps + 0.5) as usize];
            rgb.extend_from_slice(if position.is_finite() { &colour } else { &NOT_A_NUMBER.rgb });
        }
    }
    let mut png = Vec::new();
    write_png(&mut png, [range as u32, doppler as u32], &rgb).context("cannot encode a picture")?;
    Ok(png)
}

/// Returns the levels of the first and the last colour, dB: 10 dB below the median, and the peak or 20 dB above the
/// median.
pub fn levels(map: &Rdm) -> (f32, f32) {
    let mut finite: Vec<f32> = map.db.iter().copied().filter(|v| v.is_finite()).collect();
    finite.sort_by(f32::total_cmp);
    let median = finite.get(finite.len() / 2).copied().unwrap_or(-200.0);
    (median - 10.0, finite.last().copied().unwrap_or(0.0).max(median + 20.0))
}

/// Series of a plot: name and points.
type Series<'a> = (&'a str, Vec<(f64, f64)>);

/// Draws points of several series on logarithmic axes, with one colour per series.
pub fn scatter(theme: &Theme, names: (&str, &str), series: &[Series]) -> Canvas {
    let mut plot = Plot::of_series(theme, series);
    let points = || series.iter().flat_map(|s| &s.1).filter(|p| p.0 > 0.0 && p.1 > 0.0);
    // Full decades around all points.
    let decades = |values: Vec<f64>| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let low = if low.is_finite() { low.floor() } else { 0.0 };
        (low, if high.is_finite() { high.ceil().max(low + 1.0) } else { low + 1.0 })
    };
    let (x_low, x_high) = decades(points().map(|p| p.0.log10()).collect());
    let (y_low, y_high) = decades(points().map(|p| p.1.log10()).collect());
    let project = |x: f64, y: f64| -> Pixel {
        [MARGIN_LEFT + (x - x_low) / (x_high - x_low) * WIDTH, MARGIN_TOP + (y_high - y) / (y_high - y_low) * HEIGHT]
    };
    for decade in x_low as i32..=x_high as i32 {
        plot.tick_below(project(f64::from(decade), y_low), HEIGHT, &power(decade));
    }
    for decade in y_low as i32..=y_high as i32 {
        plot.tick_beside(project(x_low, f64::from(decade)), WIDTH, &power(decade));
    }
    plot.axes();
    plot.axis_names([WIDTH, HEIGHT], names);
    for (i, (name, points)) in series.iter().enumerate() {
        for (x, y) in points.iter().filter(|p| p.0 > 0.0 && p.1 > 0.0) {
            plot.dot(project(x.log10(), y.log10()), i);
        }
        plot.legend(i, name);
    }
    plot.canvas
}

/// Formats a power of ten.
fn power(decade: i32) -> String {
    match decade {
        -3..=4 => format!("{}", 10f64.powi(decade)),
        _ => format!("1e{decade}"),
    }
}

/// Draws lines through points of several series on linear axes, with one colour per series. The vertical axis shows a
/// fraction, from the tenth below the lowest point to the tenth above the highest. `dashed` has further points of each
/// series, drawn with a dashed line; it may be empty.
pub fn lines(theme: &Theme, names: (&str, &str), series: &[Series], dashed: &[Series]) -> Canvas {
    let mut plot = Plot::of_series(theme, series);
    let points = || series.iter().chain(dashed).flat_map(|s| &s.1);
    let x_values = || points().map(|p| p.0).filter(|x| x.is_finite());
    let low = x_values().fold(f64::INFINITY, f64::min);
    let high = x_values().fold(f64::NEG_INFINITY, f64::max);
    let (low, high) = if high > low { (low, high) } else { (low.min(0.0), low.max(0.0) + 1.0) };
    let lowest = points().map(|p| p.1).filter(|y| y.is_finite()).fold(1.0, f64::min);
    let highest = points().map(|p| p.1).filter(|y| y.is_finite()).fold(0.0, f64::max);
    let floor = ((10.0 * lowest).floor() / 10.0).clamp(0.0, 0.9);
    let top = ((10.0 * highest).ceil() / 10.0).clamp(floor + 0.1, 1.0);
    let project = |x: f64, y: f64| -> Pixel {
        [
            MARGIN_LEFT + (x - low) / (high - low) * WIDTH,
            MARGIN_TOP + (top - y.clamp(floor, top)) / (top - floor) * HEIGHT,
        ]
    };
    for tick in ticks(low, high) {
        plot.tick_below(project(tick, floor), 0.0, &label(tick, high - low));
    }
    for share in ticks(floor, top) {
        plot.tick_beside(project(low, share), WIDTH, &format!("{share:.2}"));
    }
    plot.axes();
    plot.axis_names([WIDTH, HEIGHT], names);
    // Points without a value are skipped.
    let points_of = |points: &[(f64, f64)]| -> Vec<Pixel> {
        points.iter().map(|(x, y)| project(*x, *y)).filter(|point| point.iter().all(|v| v.is_finite())).collect()
    };
    for (i, (_, points)) in dashed.iter().enumerate() {
        plot.canvas.line(&points_of(points), &Line { ink: plot.series_ink(i), width: 1.5, is_dashed: true });
    }
    for (i, (name, points)) in series.iter().enumerate() {
        let points = points_of(points);
        plot.canvas.line(&points, &Line { ink: plot.series_ink(i), width: 3.0, is_dashed: false });
        points.iter().for_each(|point| plot.dot(*point, i));
        plot.legend(i, name);
    }
    plot.canvas
}

/// Plot under construction.
struct Plot<'a> {
    canvas: Canvas,
    theme: &'a Theme,
}

impl<'a> Plot<'a> {
    /// Creates a plot for series, with a margin for their names.
    fn of_series(theme: &'a Theme, series: &[Series]) -> Self {
        let longest = series.iter().map(|(name, _)| Letters::Small.size(name)[0]).fold(0.0, f64::max);
        let height = (MARGIN_TOP + HEIGHT + MARGIN_BOTTOM).max(MARGIN_TOP + LEGEND_STEP * series.len() as f64 + TICK);
        Plot { canvas: Canvas::new(MARGIN_LEFT + WIDTH + 40.0 + longest, height, theme.background), theme }
    }

    fn axis(&self) -> Line {
        Line { ink: self.theme.ink, width: 1.0, is_dashed: false }
    }

    fn grid(&self) -> Line {
        Line { ink: self.theme.grid, width: 1.0, is_dashed: false }
    }

    fn text(&mut self, corner: Pixel, text: &str) {
        self.canvas.text(corner, text, Letters::Small, self.theme.ink);
    }

    /// Draws a tick below an axis, a grid line of `length` above it, and its number.
    fn tick_below(&mut self, [x, y]: Pixel, length: f64, number: &str) {
        self.canvas.line(&[[x, y - length], [x, y]], &self.grid());
        self.canvas.line(&[[x, y], [x, y + TICK]], &self.axis());
        self.text([x - 0.5 * Letters::Small.size(number)[0], y + 8.0], number);
    }

    /// Draws a tick to the left of an axis, a grid line of `length` to its right, and its number.
    fn tick_beside(&mut self, [x, y]: Pixel, length: f64, number: &str) {
        self.canvas.line(&[[x, y], [x + length, y]], &self.grid());
        self.canvas.line(&[[x - TICK, y], [x, y]], &self.axis());
        self.text([x - 8.0 - Letters::Small.size(number)[0], y - 8.0], number);
    }

    /// Draws the axes to the left of and below the series, over the grid.
    fn axes(&mut self) {
        let (left, bottom) = (MARGIN_LEFT, MARGIN_TOP + HEIGHT);
        self.canvas.line(&[[left, MARGIN_TOP], [left, bottom], [left + WIDTH, bottom]], &self.axis());
    }

    /// Draws the names of the axes of a plot of this size: below its middle, and above its upper left corner.
    fn axis_names(&mut self, [width, height]: [f64; 2], (across, up): (&str, &str)) {
        let middle = MARGIN_LEFT + 0.5 * (width - Letters::Small.size(across)[0]);
        self.text([middle, MARGIN_TOP + height + 28.0], across);
        self.text([4.0, 8.0], up);
    }

    /// Draws the name of a series in its colour.
    fn legend(&mut self, index: usize, name: &str) {
        let y = MARGIN_TOP + 10.0 + LEGEND_STEP * index as f64;
        self.dot([MARGIN_LEFT + WIDTH + 16.0, y], index);
        self.text([MARGIN_LEFT + WIDTH + 26.0, y - 8.0], name);
    }

    fn series_ink(&self, index: usize) -> Ink {
        self.theme.series[index % self.theme.series.len()]
    }

    /// Draws a dot of a series. The second dozen of series has the colours of the first and hollow dots.
    fn dot(&mut self, [x, y]: Pixel, index: usize) {
        let (corner, ink) = ([x.round() - 3.0, y.round() - 3.0], self.series_ink(index));
        self.canvas.rectangle(corner, [7.0, 7.0], ink);
        if !(index / self.theme.series.len()).is_multiple_of(2) {
            self.canvas.rectangle(corner.map(|v| v + 2.0), [3.0, 3.0], self.theme.background);
        }
    }
}

/// Computes about seven round values between two ends.
fn ticks(from: f64, to: f64) -> Vec<f64> {
    let raw = (to - from) / 7.0;
    let magnitude = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].iter().map(|s| s * magnitude).find(|s| *s >= raw).unwrap_or(raw);
    let first = (from / step).ceil() as i64;
    (first..).map(|i| i as f64 * step).take_while(|t| *t <= to).collect()
}

/// Formats a tick on an axis of this length, with the digits that its steps need.
fn label(value: f64, scale: f64) -> String {
    let digits = (2.0 - scale.abs().max(1e-9).log10()).clamp(0.0, 4.0) as usize;
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// Colours of the viridis map in equal steps. The table is fast enough for a picture of each frame of a recording.
static VIRIDIS: LazyLock<[[u8; 3]; 256]> = LazyLock::new(|| std::array::from_fn(|i| viridis(i as f32 / 255.0).rgb));

/// Computes the viridis map by interpolation of nine of its colours.
fn viridis(t: f32) -> Ink {
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
    Ink::solid([0, 1, 2].map(|c| (COLOURS[i][c] + f * (COLOURS[i + 1][c] - COLOURS[i][c])).round() as u8))
}
