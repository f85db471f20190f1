//! Conversion of marks to PNG.

use std::io::Write;

use anyhow::Context;
use noto_sans_mono_bitmap::{get_raster, get_raster_width};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, PremultipliedColorU8, Rect, Stroke, StrokeDash,
    Transform,
};

use super::mark::{DASH, Ink, Letters, Line, Mark, Pixel};

/// Writes marks on a background of a size, pixels, as a PNG.
///
/// # Errors
/// The width or the height is zero, both are too large, or the writer fails.
pub(super) fn write(
    writer: impl Write,
    [width, height]: [f64; 2],
    background: Ink,
    marks: &[Mark],
) -> anyhow::Result<()> {
    let pixels = Pixmap::new(width.ceil() as u32, height.ceil() as u32).context("the picture has no size")?;
    let mut raster = Raster { pixels };
    raster.pixels.fill(color(background));
    marks.iter().for_each(|mark| raster.draw(mark));
    let rgb: Vec<u8> = raster.pixels.pixels().iter().flat_map(|p| [p.red(), p.green(), p.blue()]).collect();
    Ok(write_png(writer, [raster.pixels.width(), raster.pixels.height()], &rgb)?)
}

/// Writes colours, row by row, as a PNG without transparency.
///
/// # Errors
/// The writer fails, or there are not three bytes for each pixel.
pub(super) fn write_png(writer: impl Write, [width, height]: [u32; 2], rgb: &[u8]) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(writer, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fast);
    let mut image = encoder.write_header()?;
    image.write_image_data(rgb)?;
    image.finish()
}

/// Pixels on which marks are drawn.
struct Raster {
    pixels: Pixmap,
}

impl Raster {
    fn draw(&mut self, mark: &Mark) {
        match mark {
            Mark::Fill { areas, ink } => {
                if let Some(path) = path(areas, true) {
                    self.pixels.fill_path(&path, &paint(*ink), FillRule::Winding, Transform::identity(), None);
                }
            }
            Mark::Rectangle { corner: [x, y], size: [width, height], ink } => {
                if let Some(area) = Rect::from_xywh(*x as f32, *y as f32, *width as f32, *height as f32) {
                    self.pixels.fill_rect(area, &paint(*ink), Transform::identity(), None);
                }
            }
            Mark::Stroke { lines, is_closed, style } => self.stroke(lines, *is_closed, style),
            Mark::Text { corner, text, letters, ink } => self.text(*corner, text, *letters, *ink),
        }
    }

    fn stroke(&mut self, lines: &[Vec<Pixel>], is_closed: bool, style: &Line) {
        let dash = if style.is_dashed { StrokeDash::new(DASH.map(|length| length as f32).to_vec(), 0.0) } else { None };
        let stroke = Stroke {
            width: style.width as f32,
            line_cap: LineCap::Butt,
            line_join: LineJoin::Round,
            dash,
            ..Stroke::default()
        };
        if let Some(path) = path(lines, is_closed) {
            self.pixels.stroke_path(&path, &paint(style.ink), &stroke, Transform::identity(), None);
        }
    }

    fn text(&mut self, [x, y]: Pixel, line: &str, letters: Letters, ink: Ink) {
        let (weight, height) = letters.font();
        let step = get_raster_width(weight, height);
        for (i, character) in line.chars().enumerate() {
            // Characters that the font lacks become question marks.
            let glyph = get_raster(character, weight, height).or_else(|| get_raster('?', weight, height));
            let Some(glyph) = glyph else { continue };
            for (row, values) in glyph.rows().enumerate() {
                for (column, &value) in values.iter().enumerate().filter(|(_, value)| **value > 0) {
                    let position = [x.round() as i64 + (i * step + column) as i64, y.round() as i64 + row as i64];
                    self.blend(position, ink, f64::from(value) / 255.0);
                }
            }
        }
    }

    fn blend(&mut self, [x, y]: [i64; 2], ink: Ink, part: f64) {
        let (width, height) = (i64::from(self.pixels.width()), i64::from(self.pixels.height()));
        if !(0..width).contains(&x) || !(0..height).contains(&y) {
            return;
        }
        if let Some(pixel) = self.pixels.pixels_mut().get_mut((y * width + x) as usize) {
            let part = part * ink.opacity;
            let mix = |old: u8, new: u8| (f64::from(old) * (1.0 - part) + f64::from(new) * part).round() as u8;
            let [r, g, b] = ink.rgb;
            let mixed = [mix(pixel.red(), r), mix(pixel.green(), g), mix(pixel.blue(), b)];
            if let Some(opaque) = PremultipliedColorU8::from_rgba(mixed[0], mixed[1], mixed[2], 255) {
                *pixel = opaque;
            }
        }
    }
}

fn color(Ink { rgb: [r, g, b], opacity }: Ink) -> Color {
    Color::from_rgba8(r, g, b, (255.0 * opacity.clamp(0.0, 1.0)).round() as u8)
}

fn paint(ink: Ink) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color(color(ink));
    paint
}

fn path(lines: &[Vec<Pixel>], is_closed: bool) -> Option<tiny_skia::Path> {
    let mut path = PathBuilder::new();
    for places in lines {
        for (i, [x, y]) in places.iter().enumerate() {
            if i == 0 {
                path.move_to(*x as f32, *y as f32);
            } else {
                path.line_to(*x as f32, *y as f32);
            }
        }
        if is_closed {
            path.close();
        }
    }
    path.finish()
}
