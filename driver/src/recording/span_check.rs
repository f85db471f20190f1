//! Checks of label spans against each other and against their recording.

use thiserror::Error;

use super::mcap::LabelSpan;

/// Tolerance of times in files with six decimals, s: start and length are rounded separately.
pub const ROUNDING_S: f64 = 2e-6;

/// Error of inconsistent spans.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum SpanError {
    /// A time is not a finite number.
    #[error("the label '{label}' from {start_s} to {end_s} s: times must be finite")]
    NotFinite { label: String, start_s: f64, end_s: f64 },
    /// The end comes before the start.
    #[error("the label '{label}' is reversed: it starts at {} s and ends at {} s", rounded(*.start_s), rounded(*.end_s))]
    Reversed { label: String, start_s: f64, end_s: f64 },
    /// A label of a class has no duration.
    #[error("the label '{label}' at {} s has no duration, so it covers no frame", rounded(*.start_s))]
    NoDuration { label: String, start_s: f64 },
    /// Part of the span lies outside the recording.
    #[error(
        "the label '{label}' from {} to {} s is out of range: the recording's frames are from {} to {} s",
        rounded(*.start_s), rounded(*.end_s), rounded(*.first_s), rounded(*.last_s)
    )]
    OutOfRange { label: String, start_s: f64, end_s: f64, first_s: f64, last_s: f64 },
    /// Two spans of different classes overlap.
    #[error(
        "the labels '{first}' ({} to {} s) and '{second}' ({} to {} s) overlap",
        rounded(*.first_start_s), rounded(*.first_end_s), rounded(*.second_start_s), rounded(*.second_end_s)
    )]
    Overlap {
        first: String,
        first_start_s: f64,
        first_end_s: f64,
        second: String,
        second_start_s: f64,
        second_end_s: f64,
    },
}

/// Time rounded to the microsecond, as in files; sums of times have more digits.
fn rounded(time_s: f64) -> f64 {
    (time_s * 1e6).round() / 1e6
}

/// Checks that spans do not end before they start, lie within `extent_s` if it is given, and that spans of classes have a duration
/// and do not overlap. Free text may overlap anything.
///
/// # Errors
/// [`SpanError`] for the first inconsistency by time.
pub fn check_spans(spans: &[LabelSpan], extent_s: Option<(f64, f64)>) -> Result<(), SpanError> {
    for span in spans {
        let (label, start_s, end_s) = (span.label.clone(), span.start_s, span.end_s);
        if !start_s.is_finite() || !end_s.is_finite() {
            return Err(SpanError::NotFinite { label, start_s, end_s });
        }
        if end_s < start_s {
            return Err(SpanError::Reversed { label, start_s, end_s });
        }
        if end_s == start_s && span.occupancy().is_some() {
            return Err(SpanError::NoDuration { label, start_s });
        }
        if let Some((first_s, last_s)) = extent_s
            && (start_s < first_s - ROUNDING_S || end_s > last_s + ROUNDING_S)
        {
            return Err(SpanError::OutOfRange { label, start_s, end_s, first_s, last_s });
        }
    }
    let mut classes: Vec<&LabelSpan> = spans.iter().filter(|span| span.occupancy().is_some()).collect();
    classes.sort_by(|a, b| a.start_s.total_cmp(&b.start_s).then(a.end_s.total_cmp(&b.end_s)));
    // The earlier span that ends last, because a long span may cover several.
    let mut latest: Option<&LabelSpan> = None;
    for span in classes {
        if let Some(first) = latest.filter(|first| span.start_s < first.end_s - ROUNDING_S) {
            return Err(SpanError::Overlap {
                first: first.label.clone(),
                first_start_s: first.start_s,
                first_end_s: first.end_s,
                second: span.label.clone(),
                second_start_s: span.start_s,
                second_end_s: span.end_s,
            });
        }
        latest = latest.filter(|first| first.end_s >= span.end_s).or(Some(span));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::label_text::{from_audacity, from_deepcraft, to_audacity, to_deepcraft};
    use proptest::prelude::*;

    /// Spans one behind the other, with pauses, in any order.
    fn spans() -> impl Strategy<Value = Vec<LabelSpan>> {
        let one = (0u32..4_000_000, 1u32..4_000_000, "empty|one|two|\\PC{0,8}");
        prop::collection::vec(one, 0..12).prop_map(|parts| {
            let mut at_us = 0u64;
            let append = |(pause, length, label): (u32, u32, String)| {
                let start_us = at_us + u64::from(pause);
                at_us = start_us + u64::from(length);
                LabelSpan::new(start_us as f64 * 1e-6, at_us as f64 * 1e-6, label.trim())
            };
            let mut spans: Vec<LabelSpan> = parts.into_iter().map(append).collect();
            spans.reverse();
            spans
        })
    }

    proptest! {
        #[test]
        fn consistent_spans_stay_consistent_in_the_formats_of_other_tools(spans in spans()) {
            let end_s = spans.iter().map(|s| s.end_s).fold(0.0, f64::max);
            prop_assert_eq!(check_spans(&spans, Some((0.0, end_s))), Ok(()));
            for read in [from_audacity(&to_audacity(&spans)), from_deepcraft(&to_deepcraft(&spans))] {
                prop_assert_eq!(check_spans(&read.expect("what is written is read"), Some((0.0, end_s))), Ok(()));
            }
        }

        /// Compares with the definition: any two spans of different classes that share more than a rounding.
        #[test]
        fn overlaps_agree_with_a_comparison_of_all_pairs(parts in prop::collection::vec((0u8..40, 1u8..12, 0usize..4), 0..8)) {
            let names = ["empty", "one", "two", "sofa"];
            let spans: Vec<LabelSpan> = parts
                .iter()
                .map(|&(start, length, name)| LabelSpan::new(f64::from(start), f64::from(start + length), names[name]))
                .collect();
            let mut classes: Vec<&LabelSpan> = spans.iter().filter(|s| s.occupancy().is_some()).collect();
            classes.sort_by(|a, b| (a.start_s, a.end_s).partial_cmp(&(b.start_s, b.end_s)).expect("finite"));
            let any = (0..classes.len()).any(|j| (0..j).any(|i| classes[j].start_s < classes[i].end_s));
            prop_assert_eq!(check_spans(&spans, None).is_err(), any, "{:?}", spans);
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn inconsistent_spans_are_named() {
            let message_of = |spans: &[(f64, f64, &str)]| {
                let spans: Vec<LabelSpan> = spans.iter().map(|&(a, b, label)| LabelSpan::new(a, b, label)).collect();
                check_spans(&spans, Some((0.0, 10.0))).expect_err("wrong").to_string()
            };
            assert!(message_of(&[(3.0, 2.0, "one")]).contains("'one' is reversed"));
            assert!(message_of(&[(9.0, 10.5, "two")]).contains("'two' from 9 to 10.5 s is out of range"));
            assert!(message_of(&[(-0.1, 1.0, "sofa")]).contains("'sofa'"));
            assert!(message_of(&[(1.9000000000000001, 10.6, "one")]).contains("'one' from 1.9 to 10.6 s is out"));
            assert!(message_of(&[(f64::NAN, 1.0, "one")]).contains("finite"));
            assert!(message_of(&[(5.0, 5.0, "one")]).contains("'one' at 5 s has no duration"));
            // A long span covers several others; the one in between does not hide it.
            let text = message_of(&[(0.0, 8.0, "empty"), (8.0, 9.0, "two"), (2.0, 3.0, "one")]);
            assert!(text.contains("'empty' (0 to 8 s) and 'one' (2 to 3 s) overlap"), "{text}");
            let text = message_of(&[(0.0, 8.0, "one"), (2.0, 3.0, "sofa"), (5.0, 6.0, "one")]);
            assert!(text.contains("overlap"), "{text}");
        }

        #[test]
        fn free_text_may_overlap_and_neighbours_may_touch() {
            let spans = [
                (0.0, 5.0, "one"),
                (5.0 - 1e-6, 10.0 + 1e-6, "two"),
                (1.0, 9.0, "sofa"),
                (2.0, 4.0, "window"),
                (3.0, 3.0, "a knock"),
            ];
            let spans: Vec<LabelSpan> = spans.iter().map(|&(a, b, label)| LabelSpan::new(a, b, label)).collect();
            assert_eq!(check_spans(&spans, Some((0.0, 10.0))), Ok(()));
        }
    }
}
