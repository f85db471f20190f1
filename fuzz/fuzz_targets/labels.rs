//! Labels of other tools: labels that were read can be written, and further round trips do not change them.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::LabelSpan;
use radome_driver::recording::label_text::{from_audacity, from_deepcraft, to_audacity, to_deepcraft};
use radome_driver::recording::span_check::{SpanError, check_spans};
use radome_fuzz::with_memory_limit;

/// Asserts equality to six decimals.
fn assert_near(a: &[LabelSpan], b: &[LabelSpan]) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        let tolerance = |x: f64| 1.1e-6 + 1e-12 * x.abs();
        assert!((a.start_s - b.start_s).abs() <= tolerance(a.start_s), "{a:?} {b:?}");
        assert!((a.end_s - b.end_s).abs() <= 2.0 * tolerance(a.end_s.abs().max(a.start_s.abs())), "{a:?} {b:?}");
        assert_eq!((&a.label, &a.note, a.confidence), (&b.label, &b.note, b.confidence));
    }
}

/// Asserts that labels do not end before they start, so that overlaps and the recording's ends are the only possible errors.
fn check(spans: &[LabelSpan]) {
    assert!(matches!(check_spans(spans, None), Ok(()) | Err(SpanError::Overlap { .. })));
    assert!(matches!(
        check_spans(spans, Some((0.0, 60.0))),
        Ok(()) | Err(SpanError::Overlap { .. } | SpanError::OutOfRange { .. })
    ));
}

fuzz_target!(|input: &str| {
    let allowed = 64 * 1024 + 1024 * input.len();
    if let Ok(mut spans) = with_memory_limit(allowed, || from_audacity(input)) {
        assert!(spans.iter().all(|s| s.start_s.is_finite() && s.end_s >= s.start_s));
        // Tabs and line ends cannot be written to a label track.
        spans.iter_mut().for_each(|s| s.label = s.label.replace(['\t', '\r'], " ").trim().to_owned());
        check(&spans);
        let again = from_audacity(&to_audacity(&spans)).expect("what was written is read");
        assert_near(&spans, &again);
    }
    if let Ok(spans) = with_memory_limit(allowed, || from_deepcraft(input)) {
        assert!(spans.iter().all(|s| s.start_s.is_finite() && s.end_s.is_finite() && s.end_s >= s.start_s));
        // The format requires a confidence; a missing one counts as 1.
        let spans: Vec<LabelSpan> =
            spans.into_iter().map(|s| LabelSpan { confidence: s.confidence.or(Some(1.0)), ..s }).collect();
        check(&spans);
        let again = from_deepcraft(&to_deepcraft(&spans)).expect("what was written is read");
        assert_near(&spans, &again);
    }
});
