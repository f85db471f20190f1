//! Label spans in the text formats of other tools, Audacity's label track and DEEPCRAFT Studio's `.label` file, and as JSON, which
//! holds all parts of a label.
//!
//! Audacity: `start TAB end TAB label`, seconds, no header. DEEPCRAFT: the header below, then one comma-separated row a
//! span, by start and length. Fields with a comma, a quote or a line's end are quoted (RFC 4180). Blanks at either end
//! of a label are not part of it. Times are written to the nanosecond, the resolution of frames' clocks, and with six
//! decimals at least.

use thiserror::Error;

use super::mcap::LabelSpan;

/// First line of a DEEPCRAFT file, to the letter.
pub const DEEPCRAFT_HEADER: &str = "Time(Seconds),Length(Seconds),Label(string),Confidence(double),Comment(string)";

/// Error of a label file.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("line {line}: {what}")]
pub struct LabelTextError {
    /// Number of the line, from 1.
    pub line: usize,
    /// Description of the error.
    pub what: String,
}

/// Formats an Audacity label track. It cannot hold author, time of labelling, confidence and note; line ends and tabs in
/// labels become blanks.
pub fn to_audacity(spans: &[LabelSpan]) -> String {
    let line = |span: &LabelSpan| {
        let label = span.label.replace(['\t', '\r', '\n'], " ");
        format!("{}\t{}\t{label}\n", seconds_text(span.start_s), seconds_text(span.end_s))
    };
    spans.iter().filter(|span| has_duration_in_file(span)).map(line).collect()
}

/// Returns whether a span has a duration in a file, where times have at most nine decimals. A class for less than that covers
/// no frame.
fn has_duration_in_file(span: &LabelSpan) -> bool {
    let has_length = seconds_text(span.end_s - span.start_s) != seconds_text(0.0);
    span.occupancy().is_none() || has_length && seconds_text(span.start_s) != seconds_text(span.end_s)
}

/// Parses an Audacity label track, also one that begins with a mark of the byte order. Lines that begin with a backslash hold
/// frequencies and are skipped.
///
/// # Errors
/// [`LabelTextError`] for a line without two times, or with times that are not finite or reversed.
pub fn from_audacity(text: &str) -> Result<Vec<LabelSpan>, LabelTextError> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('\\'));
    lines
        .map(|(index, line)| {
            let mut fields = line.splitn(3, '\t');
            let mut time = |name| seconds(index, name, fields.next());
            let (start_s, end_s) = (time("start")?, time("end")?);
            span(index, start_s, end_s, fields.next().unwrap_or(""))
        })
        .collect()
}

/// Formats a DEEPCRAFT `.label` file. It cannot hold the author of a label and the time of labelling. A label without a
/// confidence has 1 there, since other programs always write a number.
pub fn to_deepcraft(spans: &[LabelSpan]) -> String {
    let mut text = format!("{DEEPCRAFT_HEADER}\n");
    for span in spans.iter().filter(|span| has_duration_in_file(span)) {
        let (start, length) = (seconds_text(span.start_s), seconds_text(span.end_s - span.start_s));
        let (label, note) = (quoted(&span.label), quoted(span.note.as_deref().unwrap_or("")));
        text += &format!("{start},{length},{label},{},{note}\n", span.confidence.unwrap_or(1.0));
    }
    text
}

/// Parses a DEEPCRAFT `.label` file.
///
/// # Errors
/// [`LabelTextError`] for another header, a row of other than five fields, an invalid number, a negative length, or a confidence
/// beyond 0 to 1.
pub fn from_deepcraft(text: &str) -> Result<Vec<LabelSpan>, LabelTextError> {
    let error = |line: usize, what: String| LabelTextError { line, what };
    let mut rows = rows(text.strip_prefix('\u{feff}').unwrap_or(text))?.into_iter();
    match rows.next() {
        Some((_, header)) if header.join(",") == DEEPCRAFT_HEADER => {}
        _ => return Err(error(1, format!("expected the header {DEEPCRAFT_HEADER}"))),
    }
    rows.map(|(index, fields)| {
        let [start, length, label, confidence, note] = fields.as_slice() else {
            return Err(error(index + 1, format!("{} fields, expected 5", fields.len())));
        };
        let start_s = seconds(index, "time", Some(start))?;
        let length_s = seconds(index, "length", Some(length))?;
        let mut span = span(index, start_s, start_s + length_s, label)?;
        if !confidence.trim().is_empty() {
            let number = seconds(index, "confidence", Some(confidence))?;
            check_confidence(index, number)?;
            span.confidence = Some(number);
        }
        span.note = (!note.is_empty()).then(|| note.clone());
        Ok(span)
    })
    .collect()
}

/// Formats labels as a JSON array with an object for each label.
pub fn to_json(spans: &[LabelSpan]) -> String {
    serde_json::json!(spans).to_string()
}

/// Parses the text of [`to_json`].
///
/// # Errors
/// [`LabelTextError`] for text that is no array of labels, for times that are reversed, and for confidences that are not 0 to 1.
pub fn from_json(text: &str) -> Result<Vec<LabelSpan>, LabelTextError> {
    let unreadable = |error: serde_json::Error| {
        let text = error.to_string();
        let what = text.rsplit_once(" at line ").map_or(text.as_str(), |(what, _)| what);
        LabelTextError { line: error.line().max(1), what: what.to_owned() }
    };
    let spans: Vec<LabelSpan> =
        serde_json::from_str(text.strip_prefix('\u{feff}').unwrap_or(text)).map_err(unreadable)?;
    let checked = |(index, read): (usize, LabelSpan)| {
        let checked = span(0, read.start_s, read.end_s, &read.label).and_then(|span| {
            read.confidence.map_or(Ok(()), |confidence| check_confidence(0, confidence))?;
            Ok(LabelSpan { label: span.label, ..read })
        });
        // The reader does not tell on which line a label stands.
        checked.map_err(|error| LabelTextError { line: 1, what: format!("label {}: {}", index + 1, error.what) })
    };
    spans.into_iter().enumerate().map(checked).collect()
}

/// Formats a time with six to nine decimals.
fn seconds_text(time_s: f64) -> String {
    let text = format!("{time_s:.9}");
    let (six_decimals, further_decimals) = text.split_at(text.len().saturating_sub(3));
    six_decimals.to_owned() + further_decimals.trim_end_matches('0')
}

/// Parses a number of a line.
fn seconds(index: usize, name: &str, field: Option<&str>) -> Result<f64, LabelTextError> {
    let field = field.unwrap_or("").trim();
    let number = field.parse::<f64>().ok().filter(|number| number.is_finite());
    number.ok_or_else(|| LabelTextError { line: index + 1, what: format!("{name} is '{field}', expected a number") })
}

/// Checks that a confidence is 0 to 1.
fn check_confidence(index: usize, confidence: f64) -> Result<(), LabelTextError> {
    if (0.0..=1.0).contains(&confidence) {
        return Ok(());
    }
    Err(LabelTextError { line: index + 1, what: format!("confidence is {confidence}, expected 0 to 1") })
}

/// Creates a span; it must not end before its start.
fn span(index: usize, start_s: f64, end_s: f64, label: &str) -> Result<LabelSpan, LabelTextError> {
    if end_s < start_s {
        let what = format!("ends at {end_s} s, before its start at {start_s} s");
        return Err(LabelTextError { line: index + 1, what });
    }
    Ok(LabelSpan::new(start_s, end_s, label.trim()))
}

/// Quotes a field if necessary.
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) || field.trim() != field {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}

/// Splits comma-separated rows; each comes with the number of its first line, from 0.
fn rows(text: &str) -> Result<Vec<(usize, Vec<String>)>, LabelTextError> {
    let (mut all, mut fields, mut field) = (Vec::new(), Vec::new(), String::new());
    let (mut line, mut first_line, mut in_quotes) = (0, 0, false);
    let mut characters = text.chars().peekable();
    while let Some(character) = characters.next() {
        line += usize::from(character == '\n');
        match (character, in_quotes) {
            ('"', true) if characters.peek() == Some(&'"') => {
                characters.next();
                field.push('"');
            }
            ('"', true) => in_quotes = false,
            ('"', false) if field.is_empty() => in_quotes = true,
            (',', false) => fields.push(std::mem::take(&mut field)),
            ('\r', false) if characters.peek() == Some(&'\n') => {}
            ('\n', false) => {
                fields.push(std::mem::take(&mut field));
                all.push((first_line, std::mem::take(&mut fields)));
                first_line = line;
            }
            (character, _) => field.push(character),
        }
    }
    if in_quotes {
        return Err(LabelTextError { line: first_line + 1, what: "a quote is never closed".into() });
    }
    if !field.is_empty() || !fields.is_empty() {
        fields.push(field);
        all.push((first_line, fields));
    }
    all.retain(|(_, fields)| fields.iter().any(|f| !f.trim().is_empty()));
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn files_of_other_tools_are_read() {
        let track = "0.500000\t2.250000\tempty\r\n\\\t100.0\t200.0\n2.25\t4\ttwo people\n";
        let spans = [LabelSpan::new(0.5, 2.25, "empty"), LabelSpan::new(2.25, 4.0, "two people")];
        assert_eq!(from_audacity(track), Ok(spans.to_vec()));
        // Editors on Windows put a mark of the byte order before the text.
        assert_eq!(from_audacity(&format!("\u{feff}{track}")), Ok(spans.to_vec()));
        let file = format!(
            "\u{feff}{DEEPCRAFT_HEADER}\r\n0.5,1.75,empty,1,\r\n2.25,1.75,\"two, or \"\"more\"\"\",0.5,seen\r\n"
        );
        let mut spans = [LabelSpan::new(0.5, 2.25, "empty"), LabelSpan::new(2.25, 4.0, "two, or \"more\"")];
        (spans[0].confidence, spans[1].confidence) = (Some(1.0), Some(0.5));
        spans[1].note = Some("seen".into());
        assert_eq!(from_deepcraft(&file), Ok(spans.to_vec()));
    }

    proptest! {
        /// Round trips are exact to the nanosecond, with every character that the format can hold.
        #[test]
        fn labels_round_trip(
            parts in prop::collection::vec((0u64..1 << 45, 0u64..1 << 45, "\\PC{0,12}|[ -~\n]{0,12}", 0u8..=100, "[ -~\n]{0,8}"), 0..8),
        ) {
            let spans: Vec<LabelSpan> = parts
                .iter()
                .map(|(start_ns, length_ns, label, confidence, note)| {
                    let end_s = (start_ns + length_ns) as f64 * 1e-9;
                    let mut span = LabelSpan::new(*start_ns as f64 * 1e-9, end_s, label.trim());
                    span.confidence = Some(f64::from(*confidence) / 100.0);
                    span.note = (!note.is_empty()).then(|| note.clone());
                    span
                })
                .collect();
            let near = |a: &LabelSpan, b: &LabelSpan| (a.start_s - b.start_s).abs() < 1e-9 && (a.end_s - b.end_s).abs() < 2e-9;
            let read = from_deepcraft(&to_deepcraft(&spans)).expect("readable");
            prop_assert_eq!(read.len(), spans.len());
            for (a, b) in read.iter().zip(&spans) {
                prop_assert!(near(a, b) && (&a.label, a.confidence, &a.note) == (&b.label, b.confidence, &b.note), "{:?} {:?}", a, b);
            }
            prop_assert_eq!(from_json(&to_json(&spans)), Ok(spans.clone()));
            let read = from_audacity(&to_audacity(&spans)).expect("readable");
            prop_assert_eq!(read.len(), spans.len());
            for (a, b) in read.iter().zip(&spans) {
                let label = b.label.replace(['\t', '\r', '\n'], " ");
                prop_assert!(near(a, b) && a.label == label.trim(), "{:?} {:?}", a, b);
            }
        }

        #[test]
        fn any_text_is_read_without_panic(text in "\\PC{0,200}|[0-9,\t\n\"]{0,200}") {
            let _ = (from_json(&text), from_audacity(&text), from_deepcraft(&text), from_deepcraft(&format!("{DEEPCRAFT_HEADER}\n{text}")));
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn errors_name_their_line() {
            for (text, line, what) in [
                ("0\t1\ta\nx\t2\tb\n", 2, "start is 'x'"),
                ("0\n", 1, "end is ''"),
                ("2\t1\ta\n", 1, "before its start"),
                ("0\tinf\ta\n", 1, "end is 'inf'"),
            ] {
                let error = from_audacity(text).expect_err("wrong");
                assert!(error.line == line && error.what.contains(what), "{error}");
            }
            for (rows, line, what) in [
                ("1,2,a\n", 2, "3 fields"),
                ("0,1,a,1,\n0,-1,a,1,\n", 3, "before its start"),
                ("0,1,\"a,1,\n", 2, "quote"),
                ("0,1,a,2,\n", 2, "confidence is 2"),
            ] {
                let error = from_deepcraft(&format!("{DEEPCRAFT_HEADER}\n{rows}")).expect_err("wrong");
                assert!(error.line == line && error.what.contains(what), "{error}");
            }
            for (text, line, what) in [
                ("", 1, "EOF"),
                ("[\n{\"start_s\": 1, \"label\": \"one\"}]", 2, "missing field `end_s`"),
                ("[{\"start_s\": 2, \"end_s\": 1, \"label\": \"one\"}]", 1, "before its start"),
                (
                    "[{\"start_s\": 0, \"end_s\": 1, \"label\": \"one\", \"confidence\": 7}]",
                    1,
                    "label 1: confidence is 7",
                ),
                ("[{\"start_s\": 0, \"end_s\": 1e999, \"label\": \"one\"}]", 1, "number out of range"),
            ] {
                let error = from_json(text).expect_err("wrong");
                assert!(error.line == line && error.what.contains(what), "{error}");
            }
            let blanks = from_json("[{\"start_s\": 0, \"end_s\": 1, \"label\": \" one \"}]");
            assert_eq!(blanks, Ok(vec![LabelSpan::new(0.0, 1.0, "one")]));
            assert!(from_deepcraft("").expect_err("no header").to_string().contains("Time(Seconds)"));
        }
    }
}
