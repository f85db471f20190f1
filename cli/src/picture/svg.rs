//! Conversion of marks to SVG.

use std::fmt::Write as _;
use std::io::Write;

use super::mark::{DASH, Ink, Letters, Mark, Pixel};

/// Baseline of the letters below the upper edge of a line of text, and font size, as fractions of the line's height.
/// They match the font of PNG pictures.
const BASELINE: f64 = 0.785;
const FONT_SIZE: f64 = 0.734;

/// Writes marks on a background of a size, pixels, as SVG. Text stays text.
///
/// # Errors
/// The writer fails.
pub(super) fn write(mut writer: impl Write, size: [f64; 2], background: Ink, marks: &[Mark]) -> anyhow::Result<()> {
    let [width, height] = size.map(f64::ceil);
    let mut out = String::new();
    // Writing to a string does not fail.
    let _ = writeln!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"'Noto Sans Mono', ui-monospace, monospace\">\n<rect width=\"{width}\" height=\"{height}\" {}/>",
        colour("fill", background)
    );
    for mark in marks {
        let _ = draw(&mut out, mark);
    }
    out.push_str("</svg>\n");
    Ok(writer.write_all(out.as_bytes())?)
}

fn draw(out: &mut String, mark: &Mark) -> std::fmt::Result {
    match mark {
        Mark::Fill { areas, ink } => writeln!(out, "<path d=\"{}\" {}/>", path(areas, true), colour("fill", *ink)),
        Mark::Rectangle { corner: [x, y], size: [width, height], ink } => {
            let [x, y, width, height] = [*x, *y, *width, *height].map(number);
            let fill = colour("fill", *ink);
            writeln!(out, "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" {fill}/>")
        }
        Mark::Stroke { lines, is_closed, style } => {
            let [dash, gap] = DASH;
            let dashes = if style.is_dashed { format!(" stroke-dasharray=\"{dash} {gap}\"") } else { String::new() };
            writeln!(
                out,
                "<path d=\"{}\" fill=\"none\" {} stroke-width=\"{}\" stroke-linejoin=\"round\"{dashes}/>",
                path(lines, *is_closed),
                colour("stroke", style.ink),
                number(style.width)
            )
        }
        Mark::Text { corner: [x, y], text, letters, ink } => {
            let [width, height] = letters.size(text);
            let weight = if *letters == Letters::Title { " font-weight=\"bold\"" } else { "" };
            // Other fonts have other widths; the text length keeps the layout.
            writeln!(
                out,
                "<text x=\"{}\" y=\"{}\" font-size=\"{}\"{weight} textLength=\"{}\" xml:space=\"preserve\" {}>{}</text>",
                number(x.round()),
                number(y.round() + BASELINE * height),
                number(FONT_SIZE * height),
                number(width),
                colour("fill", *ink),
                escaped(text)
            )
        }
    }
}

fn path(lines: &[Vec<Pixel>], is_closed: bool) -> String {
    let mut path = String::new();
    for places in lines {
        for (i, [x, y]) in places.iter().enumerate() {
            let _ = write!(path, "{}{} {}", if i == 0 { 'M' } else { 'L' }, number(*x), number(*y));
        }
        if is_closed {
            path.push('Z');
        }
    }
    path
}

/// Formats the attributes of a colour.
fn colour(name: &str, Ink { rgb: [r, g, b], opacity }: Ink) -> String {
    let solid = format!("{name}=\"#{r:02x}{g:02x}{b:02x}\"");
    if opacity < 1.0 { format!("{solid} {name}-opacity=\"{}\"", number(opacity.max(0.0))) } else { solid }
}

/// Formats a number with two digits, without trailing zeros.
fn number(value: f64) -> String {
    let text = format!("{value:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Escapes text for XML. Characters that XML cannot hold become question marks.
fn escaped(text: &str) -> String {
    let mut escaped = String::new();
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '\u{fffe}' | '\u{ffff}' => escaped.push('?'),
            _ if character.is_control() => escaped.push('?'),
            _ => escaped.push(character),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::super::canvas::Canvas;
    use super::super::mark::Line;
    use super::*;

    /// An XML parser finds each mark with its text, colours and dashes.
    #[test]
    fn marks_are_elements_that_a_reader_of_xml_takes() {
        let ink = Ink::solid([1, 171, 255]);
        let mut canvas = Canvas::new(99.5, 40.0, Ink::solid([255, 255, 255]));
        canvas.fill(&[vec![[0.0, 0.0], [0.0, 10.0], [10.0, 0.126]]], ink.faint(0.5));
        canvas.rectangle([1.0, 2.0], [3.0, 4.5], ink);
        canvas.line(&[[0.0, 1.0], [20.0, 1.0]], &Line { ink, width: 3.0, is_dashed: true });
        canvas.text([5.0, 8.0], "a < b & \u{1}", Letters::Small, ink);
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("picture.svg");
        canvas.save(&path).expect("is written");
        let text = std::fs::read_to_string(&path).expect("a file");
        assert!(text.starts_with("<svg ") && text.contains("viewBox=\"0 0 100 40\""), "{text}");
        for part in [
            "<path d=\"M10 0.13L0 10L0 0Z\" fill=\"#01abff\" fill-opacity=\"0.5\"/>",
            "<rect x=\"1\" y=\"2\" width=\"3\" height=\"4.5\" fill=\"#01abff\"/>",
            "stroke-dasharray=\"6 5\"",
            ">a &lt; b &amp; ?</text>",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        // Also saves the same marks as PNG.
        canvas.save(&path.with_extension("png")).expect("is written");
        let png = std::fs::read(path.with_extension("png")).expect("a file");
        assert!(png.starts_with(b"\x89PNG"));
    }
}
