//! Classifier at the end of a pipeline: converts frames to answers, and computes the summary.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use radome_driver::{Outage, Transport};
use radome_dsp::{Frame, Gap, GapReason, Occupancy, Rdm, Truth, Waveform};
use radome_models::evaluate::{Confusion, Metrics, most_probable};
use radome_models::occupancy_filter::{OccupancyFilter, Smoothing};

use super::answer::{Answer, Latency, Summary};
use super::background::{Background, NOBODY_SEEN};
use super::health::Health;
use super::occupancy::PeopleCount;
use super::pipeline::{End, Inlet, Item};
use super::sink::{ClassifiedFrame, Sink};
use crate::classifier::{Delays, FrameClassifier, Model, Prediction};
use crate::{output, panics};

/// Longest time without frames over which earlier frames still affect answers, s.
const LONGEST_MEMORY_S: f64 = 5.0;

/// Multiple of the model's memory after which a frame has lost 95 % of its weight.
const MEMORIES: f64 = 3.0;

/// Classifies frames one after the other.
pub struct LiveClassifier<'m> {
    frame_classifier: FrameClassifier<'m>,
    filter: OccupancyFilter,
    background: Option<Background>,
    outage: Outage,
    transport: Option<Transport>,
    people: PeopleCount,
    delays: Delays,
    smoothing: Smoothing,
    /// Time span of the frames of a map, s.
    map_s: f64,
    /// Time over which the model averages the evidence of frames, s.
    model_memory_s: f64,
    /// Time without frames, or without a signal in them, after which the state is reset, s.
    reset_after_s: f64,
    last_time_s: Option<f64>,
    /// Time of the last frame with a signal since the reset, s.
    last_signal_s: Option<f64>,
    pub health: Health,
    transition_frames: u64,
    all: Confusion,
    without_transitions: Confusion,
    unfiltered: Confusion,
}

impl<'m> LiveClassifier<'m> {
    /// Creates a classifier for a waveform; refuses one that the model does not support. People farther away than `max_range_m`, if
    /// given, do not count.
    ///
    /// # Errors
    /// The model does not take the waveform, or its maps cannot be limited to a range.
    pub fn new(
        model: &'m mut Model,
        waveform: &Waveform,
        delays: Delays,
        max_range_m: Option<f64>,
        started: Instant,
    ) -> anyhow::Result<Self> {
        let smoothing = model.smoothing();
        let map_s = model.frames() as f64 * waveform.frame_interval_s();
        let model_memory_s = model.memory_s();
        Ok(LiveClassifier {
            filter: OccupancyFilter::new(smoothing, waveform.frame_interval_s()),
            frame_classifier: model.for_waveform(waveform, max_range_m)?,
            background: None,
            outage: Outage::default(),
            transport: None,
            people: PeopleCount::new(delays.on_s, delays.off_s),
            delays,
            smoothing,
            map_s,
            model_memory_s,
            // At a low frame rate, three frames may be missing. A count that is held for minutes is also held over a gap.
            reset_after_s: (smoothing.dwell_s.min(LONGEST_MEMORY_S))
                .max(3.0 * waveform.frame_interval_s())
                .max(delays.off_s),
            last_time_s: None,
            last_signal_s: None,
            health: Health::new(started),
            transition_frames: 0,
            all: Confusion::default(),
            without_transitions: Confusion::default(),
            unfiltered: Confusion::default(),
        })
    }

    /// Treats maps that show no more than the empty room as empty.
    pub fn with_background(mut self, background: Option<Background>) -> Self {
        self.background = background;
        self
    }

    /// Counts an outage during which the run is stopped as a gap at the end.
    pub fn with_outage(mut self, outage: Outage) -> Self {
        self.outage = outage;
        self
    }

    /// Marks the frames before the one that this transport has sought: they are neither counted nor passed on.
    pub fn with_transport(mut self, transport: Transport) -> Self {
        self.transport = Some(transport);
        self
    }

    pub fn map(&self) -> &Rdm {
        self.frame_classifier.map()
    }

    /// Time over which earlier frames affect an answer, s: the frames of a map, what the model remembers, and the time for which
    /// people usually stay.
    pub fn memory_s(&self) -> f64 {
        self.map_s + MEMORIES * self.model_memory_s + self.smoothing.dwell_s.min(10.0)
    }

    /// Notes missing frames and resets state that must not persist across them.
    pub fn note_gap(&mut self, gap: &Gap) {
        self.health.add_gap(gap);
        self.frame_classifier.reset_at_gap();
    }

    /// Classifies a frame that arrived at `arrived`.
    ///
    /// # Errors
    /// The frame does not have the shape of the waveform, or the model fails.
    pub fn classify(&mut self, frame: &Frame, arrived: Instant) -> anyhow::Result<Answer> {
        let time_s = frame.time_s();
        let is_long_after = |last_s: f64| time_s - last_s > self.reset_after_s;
        let has_jumped = self.last_time_s.is_some_and(|last_s| time_s < last_s || is_long_after(last_s));
        let is_outdated = self.last_signal_s.is_some_and(is_long_after);
        if has_jumped {
            self.frame_classifier.reset();
        }
        if has_jumped || is_outdated {
            // After a seek in a recording, a long gap or a long time without a signal, people may have come or gone.
            self.last_signal_s = None;
            self.filter.reset();
            self.people = PeopleCount::new(self.delays.on_s, self.delays.off_s);
        }
        self.last_time_s = Some(time_s);
        let prediction = self.frame_classifier.classify(frame)?;
        let mut answer = Answer {
            sequence: frame.sequence,
            time_s,
            truth: frame.truth.map(|t| t.occupancy),
            transition: frame.truth.map(|t| t.transition),
            is_preroll: self.transport.as_ref().is_some_and(|transport| transport.is_preroll(frame.sequence)),
            ..Answer::default()
        };
        match prediction {
            Prediction::WarmingUp { have, need } => answer.warming_up = Some(format!("{have}/{need}")),
            Prediction::NoSignal => {
                answer.no_signal = true;
                answer.saturated_samples = frame.saturated_samples();
            }
            Prediction::Probabilities(raw) => {
                let is_background = self.background.as_ref().is_some_and(|background| background.explains(self.map()));
                let raw = if is_background { NOBODY_SEEN } else { raw };
                let filtered = self.filter.update(answer.time_s, raw);
                let label = most_probable(&filtered);
                answer.saturated_samples = frame.saturated_samples();
                answer.frame_probabilities = Some(raw.into());
                answer.probabilities = Some(filtered.into());
                answer.label = Some(label);
                self.people.update(answer.time_s, label);
            }
        }
        if !answer.no_signal {
            self.last_signal_s = Some(time_s);
        }
        // Frames without a label contain no information about people, so the previous state persists. They occur while a window
        // of frames fills, and without a signal.
        answer.people = self.people.people();
        answer.occupied = answer.people > 0;
        answer.is_settled = self.people.is_settled();
        self.health.temperature_millicelsius = frame.temperature_millicelsius;
        let latency = arrived.elapsed();
        answer.latency_ms = latency.as_secs_f64() * 1e3;
        if !answer.is_preroll {
            self.health.add_frame(arrived, latency);
            self.count(&answer, frame.truth);
        }
        Ok(answer)
    }

    /// Counts the label of an answer, and scores it where the truth is known.
    fn count(&mut self, answer: &Answer, truth: Option<Truth>) {
        self.health.saturated_samples += u64::from(answer.saturated_samples);
        let (Some(label), Some(raw)) = (answer.label, answer.frame_probabilities) else { return };
        self.health.labels[label.index()] += 1;
        self.health.first_label.get_or_insert_with(|| self.health.started.elapsed());
        let Some(truth) = truth else { return };
        let unfiltered = most_probable(&raw.values());
        let row = truth.occupancy.index();
        self.all[row][label.index()] += 1;
        self.unfiltered[row][unfiltered.index()] += 1;
        if truth.transition {
            self.transition_frames += 1;
        } else {
            self.without_transitions[row][label.index()] += 1;
        }
    }

    pub fn summary(&self) -> Summary {
        let metrics = |confusion: &Confusion| {
            (confusion.iter().flatten().sum::<u64>() > 0).then(|| Metrics::from_confusion(*confusion))
        };
        let health = &self.health;
        let all = metrics(&self.all);
        Summary {
            frames: health.frames,
            dropped: health.dropped_total(),
            gaps_of_unknown_length: health.unknown_gaps,
            dropped_by_reason: health.dropped.iter().map(|(reason, frames)| (reason.name(), *frames)).collect(),
            labelled: health.labels.iter().sum(),
            labels: Occupancy::ALL.iter().map(|o| (o.name(), health.labels[o.index()])).collect(),
            balanced_accuracy: all.as_ref().map(|m| m.balanced_accuracy),
            metrics: all,
            metrics_without_transitions: metrics(&self.without_transitions),
            transition_frames: self.transition_frames,
            metrics_unfiltered: metrics(&self.unfiltered),
            latency_ms: Latency {
                p50: health.latency.quantile_s(0.5) * 1e3,
                p95: health.latency.quantile_s(0.95) * 1e3,
                p99: health.latency.quantile_s(0.99) * 1e3,
            },
            first_label_s: health.first_label.map(|d| d.as_secs_f64()),
        }
    }
}

/// Runs until the stream ends. Passes answers and gaps to the sinks in order, then the summary, which it also returns. A panic of
/// the classifier or of a sink becomes an error, and the other sinks are still ended.
///
/// # Errors
/// The first error of the stream, the classifier and the sinks; others are written to stderr. A closed stdout, which also ends
/// the run, is returned only if there is no other error.
pub fn run(
    inlet: &Inlet,
    classifier: &mut LiveClassifier,
    poll_interval: Duration,
    sinks: &mut [Box<dyn Sink>],
) -> anyhow::Result<Summary> {
    let mut ends = vec![guarded(|| classify_all(inlet, classifier, poll_interval, sinks))];
    let summary = classifier.summary();
    // Sinks complete their output whatever ended the run.
    ends.extend(sinks.iter_mut().map(|sink| guarded(|| sink.end(&summary))));
    let (closed, failed): (Vec<_>, Vec<_>) =
        ends.into_iter().filter_map(Result::err).partition(output::is_closed_stdout);
    let mut failed = failed.into_iter();
    let first = failed.next();
    for error in failed {
        message!("error: {}", output::chain(&error));
    }
    match first.or(closed.into_iter().next()) {
        Some(error) => Err(error),
        None => Ok(summary),
    }
}

fn guarded(work: impl FnOnce() -> anyhow::Result<()>) -> anyhow::Result<()> {
    panics::catch_panic(work).unwrap_or_else(|panicked| Err(panicked.into()))
}

fn classify_all(
    inlet: &Inlet,
    classifier: &mut LiveClassifier,
    poll_interval: Duration,
    sinks: &mut [Box<dyn Sink>],
) -> anyhow::Result<()> {
    let mut missed = MissedFrames { inlet, reported: 0, next_sequence: 0 };
    while !output::interrupted() {
        let delivery = match inlet.receiver.recv_timeout(poll_interval) {
            Ok(delivery) => delivery,
            Err(crossbeam::channel::RecvTimeoutError::Timeout) => continue,
            Err(crossbeam::channel::RecvTimeoutError::Disconnected) => {
                return missed.report_end(inlet.end_of_stream(), classifier, sinks);
            }
        };
        match delivery.item {
            Item::Frame(frame) => {
                missed.report_before(frame.sequence, classifier, sinks)?;
                let answer = classifier.classify(&frame, delivery.arrived)?;
                if answer.is_preroll {
                    continue;
                }
                let classified = ClassifiedFrame {
                    answer: &answer,
                    frame: &frame,
                    map: classifier.map(),
                    health: &classifier.health,
                };
                for sink in sinks.iter_mut() {
                    sink.answer(&classified)?;
                }
            }
            Item::Gap(gap) => report_gap(&gap, classifier, sinks)?,
            Item::End(end) => return missed.report_end(end, classifier, sinks),
        }
    }
    let outage = classifier.outage.gap(missed.next_sequence);
    missed.report_last(outage, classifier, sinks)
}

/// Counts a gap, and passes it to the sinks.
fn report_gap(gap: &Gap, classifier: &mut LiveClassifier, sinks: &mut [Box<dyn Sink>]) -> anyhow::Result<()> {
    classifier.note_gap(gap);
    sinks.iter_mut().try_for_each(|sink| sink.gap(gap, &classifier.health))
}

/// Reports frames that were dropped because the classifier was too slow, as gaps at their position.
struct MissedFrames<'a> {
    inlet: &'a Inlet,
    /// Number of missed frames that are reported.
    reported: u64,
    next_sequence: u64,
}

impl MissedFrames<'_> {
    /// Reports frames that were missed before the frame with this number.
    fn report_before(
        &mut self,
        sequence: u64,
        classifier: &mut LiveClassifier,
        sinks: &mut [Box<dyn Sink>],
    ) -> anyhow::Result<()> {
        let dropped = self.inlet.queue.missed.load(Ordering::Relaxed);
        let missed = dropped.saturating_add(self.inlet.queue.missed_in_gaps.load(Ordering::Relaxed));
        let first_sequence = std::mem::replace(&mut self.next_sequence, sequence.saturating_add(1));
        let frames = missed - std::mem::replace(&mut self.reported, missed);
        if frames > 0 {
            report_gap(&Gap { first_sequence, frames, reason: GapReason::QueueFull }, classifier, sinks)?;
        }
        Ok(())
    }

    /// Reports missed frames at the end of the stream, and the gap that a lost board leaves there. Returns the error of the
    /// stream, if it has one.
    fn report_end(
        &mut self,
        end: End,
        classifier: &mut LiveClassifier,
        sinks: &mut [Box<dyn Sink>],
    ) -> anyhow::Result<()> {
        let gap = end.as_ref().err().and_then(|failure| failure.gap(self.next_sequence));
        let reported = self.report_last(gap, classifier, sinks);
        end?;
        reported
    }

    /// Reports the frames that were missed up to the end, and a gap that follows them.
    fn report_last(
        &mut self,
        gap: Option<Gap>,
        classifier: &mut LiveClassifier,
        sinks: &mut [Box<dyn Sink>],
    ) -> anyhow::Result<()> {
        self.report_before(u64::MAX, classifier, sinks)?;
        gap.map_or(Ok(()), |gap| report_gap(&gap, classifier, sinks))
    }
}

#[cfg(test)]
mod tests {
    use std::cell::{Cell, RefCell};
    use std::rc::Rc;

    use radome_driver::BoardError;
    use radome_dsp::{SourceEvent, WaveformRequest, source_from_fn};

    use super::*;
    use crate::live::pipeline::{Pipeline, Policy};

    fn waveform() -> Waveform {
        Waveform::realise(WaveformRequest::paper()).expect("a valid waveform")
    }

    fn classifier() -> LiveClassifier<'static> {
        let model = Box::leak(Box::new(Model::Cfar));
        LiveClassifier::new(model, &waveform(), Delays::default(), None, Instant::now()).expect("a classifier")
    }

    /// Sink that runs a given function for each answer, and counts how often it is ended.
    struct CallbackSink(fn() -> anyhow::Result<()>, Rc<Cell<usize>>);

    impl Sink for CallbackSink {
        fn answer(&mut self, _classified: &ClassifiedFrame) -> anyhow::Result<()> {
            (self.0)()
        }

        fn gap(&mut self, _gap: &Gap, _health: &Health) -> anyhow::Result<()> {
            Ok(())
        }

        fn end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
            self.1.set(self.1.get() + 1);
            Ok(())
        }
    }

    /// Runs three frames with such a sink; returns the error and the number of sinks that were ended.
    fn run_with(answer: fn() -> anyhow::Result<()>) -> (anyhow::Error, usize) {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("classifier", 4, Policy::Wait);
        let source = source_from_fn(waveform(), |frame| {
            frame.codes.fill(2048);
            frame.sequence += 1;
            Ok(SourceEvent::Frame)
        });
        let _reader = pipeline.start(Box::new(source), Some(3));
        let ends = Rc::new(Cell::new(0));
        let mut sinks: Vec<Box<dyn Sink>> =
            vec![Box::new(CallbackSink(|| Ok(()), ends.clone())), Box::new(CallbackSink(answer, ends.clone()))];
        let error = run(&inlet, &mut classifier(), Duration::from_millis(10), &mut sinks).expect_err("an error");
        (error, ends.get())
    }

    #[test]
    fn a_source_that_ends_without_a_result_is_an_error() {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("classifier", 4, Policy::Wait);
        drop(pipeline);
        let error = run(&inlet, &mut classifier(), Duration::from_secs(600), &mut []).expect_err("no end was sent");
        assert!(error.to_string().contains("without a result"), "{error}");
    }

    /// Sink that keeps the gaps that it receives.
    struct Gaps(Rc<RefCell<Vec<Gap>>>);

    impl Sink for Gaps {
        fn answer(&mut self, _classified: &ClassifiedFrame) -> anyhow::Result<()> {
            Ok(())
        }

        fn gap(&mut self, gap: &Gap, _health: &Health) -> anyhow::Result<()> {
            self.0.borrow_mut().push(*gap);
            Ok(())
        }
    }

    /// Regression test: the gap was counted, but no sink received it.
    #[test]
    fn sinks_receive_the_gap_that_a_lost_board_leaves_at_the_end() {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("classifier", 8, Policy::Wait);
        let mut next = 0;
        let source = source_from_fn(waveform(), move |frame| {
            if next == 3 {
                return Err(BoardError::Stopped.into());
            }
            frame.codes.fill(2048);
            (frame.sequence, frame.time_ns) = (next, next * 100_000_000);
            next += 1;
            Ok(SourceEvent::Frame)
        });
        let _reader = pipeline.start(Box::new(source), None);
        let received = Rc::<RefCell<Vec<Gap>>>::default();
        let mut classifier = classifier();
        let outcome = run(&inlet, &mut classifier, Duration::from_secs(5), &mut [Box::new(Gaps(received.clone()))]);
        assert!(outcome.is_err(), "the board is lost");
        let expected = Gap { first_sequence: 3, frames: 0, reason: GapReason::Disconnected };
        assert_eq!((received.take(), classifier.summary().gaps_of_unknown_length), (vec![expected], 1));
    }

    /// Regression test: if nobody read stdout while the recording ended, the error said that the source had ended without a
    /// result.
    #[test]
    fn an_end_that_could_not_be_delivered_in_time_is_an_end() {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("classifier", 4, Policy::Wait);
        inlet.queue.end.set(Ok(())).expect("no end yet");
        drop(pipeline);
        run(&inlet, &mut classifier(), Duration::from_secs(600), &mut []).expect("an end");
    }

    #[test]
    fn a_panic_of_a_sink_is_an_error_and_all_sinks_are_ended() {
        let (error, ended) = run_with(|| panic!("no room on the screen"));
        assert!(error.to_string().contains("no room on the screen"), "{error}");
        assert_eq!(ended, 2);
    }

    #[test]
    fn a_closed_stdout_ends_the_run_as_such() {
        let (error, ended) = run_with(|| Err(output::StdoutClosed.into()));
        assert!(output::is_closed_stdout(&error), "{error}");
        assert_eq!(ended, 2);
    }
}
