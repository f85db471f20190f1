//! Occupancy filter: a causal filter over probabilities of single frames.

use schemars::JsonSchema;
use serde::de::IgnoredAny;
use serde::{Deserialize, Deserializer, Serialize};

use crate::metrics::CLASSES;

/// Least probability of a class in a frame, so that no single frame excludes a class.
const LEAST_PROBABILITY: f64 = 1e-4;
/// Upper bound of the elapsed time, s.
const LONGEST_S: f64 = 1e6;
/// Shortest time of a setting, s.
const SHORTEST_S: f64 = 1e-3;
/// [`Smoothing::independent_s`] if neither it nor a weight is set.
const INDEPENDENT_S: f64 = 0.36;
/// Range of temperatures.
const TEMPERATURES: std::ops::RangeInclusive<f64> = 0.05..=20.0;
/// Range of the probability of one person without evidence.
const ONE_SHARES: std::ops::RangeInclusive<f64> = 0.1..=0.9;

/// Settings of the occupancy filter, saved in the model file.
///
/// Older files also have the share of time in which a person is not detected. It is read and not used.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(from = "SmoothingFile")]
// The keys of `SmoothingFile` that are no longer read are not offered.
#[schemars(!from, default, deny_unknown_fields)]
pub struct Smoothing {
    /// Mean time that the empty room stays empty and two people stay, s: how long the filter holds on to its answer. One person stays
    /// `dwell_s * one_share / (1 - one_share)`. Wrong frames last, which the model of the filter does not know, so the best
    /// value is shorter than people stay.
    pub dwell_s: f64,
    /// Weight of one frame's evidence in (0, 1], whatever the frame interval: of models from before `independent_s`, and absent
    /// where that is given. 1 takes each frame at its word.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weight: Option<f64>,
    /// Time over which frames are one piece of evidence, s. A frame weighs as much of a piece as the time since the frame before
    /// it is of this, and one piece at most: the answer does not depend on the frame interval. Absent where `weight` is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub independent_s: Option<f64>,
    /// Divisor of the logarithms of the answer's probabilities: it calibrates the confidence and leaves the label as it is.
    pub temperature: f64,
    /// Weight in the answer of the newest frame's own evidence beside what the filter holds, 0 to 1: it says more of the present than
    /// frames before it do. What the filter holds does not depend on it.
    pub newest: f64,
    /// Probability of one person without evidence, 0.1 to 0.9; the empty room and two people share the rest. With 1/3, the filter prefers no
    /// number of people.
    pub one_share: f64,
}

/// Settings as files hold them, with the keys that are there.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct SmoothingFile {
    #[serde(deserialize_with = "number")]
    dwell_s: Option<f64>,
    weight: Option<f64>,
    independent_s: Option<f64>,
    #[serde(deserialize_with = "number")]
    temperature: Option<f64>,
    #[serde(deserialize_with = "number")]
    newest: Option<f64>,
    #[serde(deserialize_with = "number")]
    one_share: Option<f64>,
    #[serde(rename = "unseen_share")]
    _unseen_share: IgnoredAny,
    #[serde(rename = "unseen_s")]
    _unseen_s: IgnoredAny,
}

/// Reads a number that may not be null.
fn number<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    f64::deserialize(deserializer).map(Some)
}

impl SmoothingFile {
    /// Returns the settings, with those of `absent` for keys that the file lacks.
    fn or(self, absent: Smoothing) -> Smoothing {
        let SmoothingFile { dwell_s, weight, independent_s, temperature, newest, one_share, .. } = self;
        Smoothing {
            dwell_s: dwell_s.unwrap_or(absent.dwell_s),
            weight,
            // A weight of frames takes the place of the time.
            independent_s: if weight.is_some() { independent_s } else { independent_s.or(absent.independent_s) },
            temperature: temperature.unwrap_or(absent.temperature),
            newest: newest.unwrap_or(absent.newest),
            one_share: one_share.unwrap_or(absent.one_share),
        }
    }
}

impl From<SmoothingFile> for Smoothing {
    /// Settings of a model card, which left out keys with these values until all of them were written.
    fn from(file: SmoothingFile) -> Self {
        file.or(Smoothing {
            independent_s: None,
            temperature: 1.0,
            newest: 0.0,
            one_share: 0.5,
            ..Smoothing::default()
        })
    }
}

impl Default for Smoothing {
    /// Settings close to those with the best log loss on the answers of room-hqnn to the ladder (fixtures/ladder,
    /// `evaluate --ladder --fit-smoothing`). With them, the filter is no worse than single frames on any rung where
    /// most frames are right. Answers of room-hqnn are means over half a second, so that a large weight of the newest one
    /// does not make the filter's answers flicker.
    fn default() -> Self {
        Smoothing {
            dwell_s: 2.3,
            weight: None,
            independent_s: Some(1.0),
            temperature: 1.7,
            newest: 0.7,
            one_share: 0.4,
        }
    }
}

impl Smoothing {
    /// Reads the settings of a training spec, whose absent keys have the values of [`Smoothing::default`]. Those of a model card have
    /// other values.
    pub(crate) fn of_spec<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        SmoothingFile::deserialize(deserializer).map(|file| file.or(Smoothing::default()))
    }

    /// Settings of model files that have none: short presences, full weight of single frames.
    pub(crate) const fn of_old_models() -> Self {
        Smoothing {
            dwell_s: 8.0,
            weight: Some(1.0),
            independent_s: None,
            temperature: 1.0,
            newest: 0.0,
            one_share: 0.5,
        }
    }

    /// First setting that is out of range: `(name, value, expected)`.
    pub(crate) fn invalid_setting(&self) -> Option<(&'static str, f64, &'static str)> {
        let is_time = |v: f64| v.is_finite() && v >= SHORTEST_S;
        if !is_time(self.dwell_s) {
            return Some(("smoothing.dwell_s", self.dwell_s, "a millisecond or more"));
        }
        if !TEMPERATURES.contains(&self.temperature) {
            return Some(("smoothing.temperature", self.temperature, "0.05 to 20"));
        }
        if !(0.0..=1.0).contains(&self.newest) {
            return Some(("smoothing.newest", self.newest, "0 to 1"));
        }
        if !ONE_SHARES.contains(&self.one_share) {
            return Some(("smoothing.one_share", self.one_share, "0.1 to 0.9"));
        }
        match (self.weight, self.independent_s) {
            (Some(weight), Some(_)) => Some(("smoothing.weight", weight, "none beside independent_s")),
            (Some(weight), None) if !(weight > 0.0 && weight <= 1.0) => {
                Some(("smoothing.weight", weight, "above 0 and up to 1"))
            }
            (None, Some(independent_s)) if !is_time(independent_s) => {
                Some(("smoothing.independent_s", independent_s, "a millisecond or more"))
            }
            _ => None,
        }
    }

    /// Transition rates between numbers of people, 1/s. One person comes or goes at a time; with one person present, both are
    /// equally likely. In equilibrium, one person has the probability `one_share`.
    fn rates(&self) -> Matrix {
        let to_one = 1.0 / self.dwell_s;
        let from_one = 0.5 * to_one * (1.0 - self.one_share) / self.one_share;
        [[-to_one, from_one, 0.0], [to_one, -2.0 * from_one, to_one], [0.0, from_one, -to_one]]
    }
}

/// Forward filter of a hidden Markov model in continuous time: people come and go one at a time.
///
/// `q` are the network's probabilities of one frame and `p` those of the filter. Over the time since the frame before,
/// `dp/dt = (Q + diag(ln q) / independent_s) p`, normalised (Rabiner, Proc. IEEE 77(2), 1989, equations 19-20). The
/// network's probabilities replace scaled likelihoods, and evidence comes evenly over time. Time beyond `independent_s`
/// adds no evidence. With a weight `w` for each frame, `p_k <- q_k^w (exp(Q t) p)_k` instead. The answer is
/// `p_k q_k^newest` to the power `1 / temperature`, normalised.
///
/// If most frames in a row are wrong, the filter is wrong in more frames than the classifier, because evidence accumulates.
///
/// # Examples
/// ```
/// use radome_models::occupancy_filter::{OccupancyFilter, Smoothing};
///
/// let mut filter = OccupancyFilter::new(Smoothing::default(), 0.1);
/// let probabilities = filter.update(0.0, [0.1, 0.8, 0.1]);
/// assert!((probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
/// ```
#[derive(Debug, Clone)]
pub struct OccupancyFilter {
    smoothing: Smoothing,
    frame_interval_s: f64,
    rates: Matrix,
    probabilities: [f64; CLASSES],
    last_time_s: Option<f64>,
}

impl OccupancyFilter {
    /// Makes a filter without evidence. The first frame counts as if it came `frame_interval_s` after another one.
    pub fn new(smoothing: Smoothing, frame_interval_s: f64) -> Self {
        let mut filter = OccupancyFilter {
            smoothing,
            frame_interval_s,
            rates: smoothing.rates(),
            probabilities: Default::default(),
            last_time_s: None,
        };
        filter.reset();
        filter
    }

    /// Forgets all frames.
    pub fn reset(&mut self) {
        self.probabilities = [1.0 / CLASSES as f64; CLASSES];
        self.last_time_s = None;
    }

    /// Adds the network's probabilities of the frame at `time_s`, and returns the filtered probabilities of empty, one and two.
    pub fn update(&mut self, time_s: f64, frame: [f32; CLASSES]) -> [f32; CLASSES] {
        let elapsed_s = self.last_time_s.map_or(self.frame_interval_s, |last| time_s - last);
        // Times that go back and NaN count as no elapsed time.
        let elapsed_s = if elapsed_s > 0.0 { elapsed_s.min(LONGEST_S) } else { 0.0 };
        self.last_time_s = Some(time_s);
        let evidence = frame.map(|q| {
            let q = f64::from(q);
            if q > LEAST_PROBABILITY { q.min(1.0).ln() } else { LEAST_PROBABILITY.ln() }
        });
        let mut posterior = self.probabilities;
        match (self.smoothing.independent_s, self.smoothing.weight) {
            (None, Some(weight)) => {
                posterior = propagate(&self.rates, elapsed_s, &posterior);
                for (p, evidence) in posterior.iter_mut().zip(evidence) {
                    *p *= (weight * evidence).exp();
                }
            }
            (independent_s, _) => {
                let independent_s = independent_s.unwrap_or(INDEPENDENT_S);
                let counted_s = elapsed_s.min(independent_s);
                if elapsed_s > counted_s {
                    posterior = propagate(&self.rates, elapsed_s - counted_s, &posterior);
                }
                let mut rates = self.rates;
                for (k, evidence) in evidence.iter().enumerate() {
                    rates[k][k] += evidence / independent_s;
                }
                posterior = propagate(&rates, counted_s, &posterior);
            }
        }
        self.probabilities = normalised(posterior);
        let Smoothing { temperature, newest, .. } = self.smoothing;
        let answer: [f64; CLASSES] =
            std::array::from_fn(|k| (self.probabilities[k] * (newest * evidence[k]).exp()).powf(1.0 / temperature));
        normalised(answer).map(|p| p as f32)
    }
}

fn normalised(values: [f64; CLASSES]) -> [f64; CLASSES] {
    let sum: f64 = values.iter().sum();
    values.map(|value| value / sum)
}

/// Rates or probabilities `[to][from]`.
type Matrix = [[f64; CLASSES]; CLASSES];

/// `exp(rates time_s) p`.
fn propagate(rates: &Matrix, time_s: f64, p: &[f64; CLASSES]) -> [f64; CLASSES] {
    exponential(rates, time_s).map(|row| row.iter().zip(p).map(|(a, p)| a * p).sum())
}

/// Exponential of the matrix `rates time_s` by scaling and squaring. Columns of `rates` sum to zero or less, and only
/// the diagonal is negative. A multiple of the identity makes the diagonal positive, so that the series has no
/// cancellation. The matrix is halved until its norm is 1 at most, and the result is squared as often.
fn exponential(rates: &Matrix, time_s: f64) -> Matrix {
    /// Terms of the series for a norm up to 1. The next term is below 1e-17.
    const TERMS: usize = 18;
    let fastest = rates.iter().enumerate().map(|(k, row)| -row[k]).fold(0.0, f64::max);
    let halvings = (fastest * time_s).log2().ceil().max(0.0) as i32;
    let step_s = time_s * 0.5f64.powi(halvings);
    let mut positive = rates.map(|row| row.map(|rate| rate * step_s));
    positive.iter_mut().enumerate().for_each(|(k, row)| row[k] += fastest * step_s);
    let mut term = diagonal((-fastest * step_s).exp());
    let mut sum = term;
    for k in 1..=TERMS {
        term = product(&term, &positive).map(|row| row.map(|v| v / k as f64));
        for (sum, term) in sum.iter_mut().flatten().zip(term.iter().flatten()) {
            *sum += term;
        }
    }
    for _ in 0..halvings {
        sum = product(&sum, &sum);
    }
    sum
}

/// Identity matrix times `value`.
fn diagonal(value: f64) -> Matrix {
    let mut matrix = Matrix::default();
    matrix.iter_mut().enumerate().for_each(|(k, row)| row[k] = value);
    matrix
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    a.map(|row| std::array::from_fn(|j| row.iter().zip(b).map(|(a, b)| a * b[j]).sum()))
}

#[cfg(test)]
mod tests {
    use radome_dsp::Occupancy;
    use rand::Rng;

    use super::*;
    use crate::evaluate::{Metrics, most_probable};

    /// Settings of models from before `independent_s`: each frame is half a piece of evidence.
    const BY_FRAME: Smoothing = Smoothing { weight: Some(0.5), ..Smoothing::of_old_models() };

    /// Settings for people who stay for long. Evidence counts by time.
    const SLOW: Smoothing =
        Smoothing { dwell_s: 60.0, weight: None, independent_s: Some(1.0), ..Smoothing::of_old_models() };

    fn filter(smoothing: Smoothing) -> OccupancyFilter {
        OccupancyFilter::new(smoothing, 0.1)
    }

    fn largest_difference(a: &Matrix, b: &Matrix) -> f64 {
        a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// Columns are distributions. Two steps are one step of their total time. The exponential is the product of many short steps by
    /// the first terms of the series.
    #[test]
    fn transitions_are_a_markov_chain() {
        let rates = SLOW.rates();
        let one = exponential(&rates, 0.7);
        for from in 0..CLASSES {
            let sum: f64 = one.iter().map(|row| row[from]).sum();
            assert!((sum - 1.0).abs() < 1e-12, "{from}: {sum}");
        }
        let steps = product(&exponential(&rates, 0.4), &exponential(&rates, 0.3));
        assert!(largest_difference(&one, &steps) < 1e-12);
        let still = diagonal(1.0);
        assert!(largest_difference(&exponential(&rates, 0.0), &still) < 1e-15);
        // With evidence, and from a millisecond to a minute.
        let mut rates = rates;
        rates.iter_mut().enumerate().for_each(|(k, row)| row[k] -= k as f64);
        for time_s in [1e-3, 1.0, 60.0] {
            let pieces = 1 << 16;
            let h = time_s / f64::from(pieces);
            let square = product(&rates, &rates);
            let short: Matrix = std::array::from_fn(|i| {
                std::array::from_fn(|j| still[i][j] + h * rates[i][j] + 0.5 * h * h * square[i][j])
            });
            let mut slow = still;
            for _ in 0..pieces {
                slow = product(&slow, &short);
            }
            let difference = largest_difference(&exponential(&rates, time_s), &slow);
            assert!(difference < 1e-5, "{time_s} s: {difference}");
        }
    }

    /// Without evidence, one person has the probability `one_share` after a long time, whatever the first state was. The others
    /// share the rest equally.
    #[test]
    fn without_evidence_one_person_has_its_share() {
        for one_share in [0.2, 1.0 / 3.0, 0.5, 0.8] {
            let settled = exponential(&Smoothing { one_share, ..SLOW }.rates(), 1e5);
            for from in 0..CLASSES {
                let found = settled.map(|row| row[from]);
                let others = 0.5 * (1.0 - one_share);
                let expected = [others, one_share, others];
                assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?} {expected:?}");
            }
        }
    }

    /// The frame rate does not matter: with the same probabilities at 10 and at 20 Hz, results at the same times agree.
    #[test]
    fn evidence_is_by_time_and_not_by_frame() {
        for smoothing in [Smoothing::default(), SLOW] {
            let mut rng = crate::stream(4, "probabilities", 0);
            let (mut slow, mut fast) = (OccupancyFilter::new(smoothing, 0.1), OccupancyFilter::new(smoothing, 0.05));
            for frame in 1..=400 {
                let raw: [f32; 3] = std::array::from_fn(|_| rng.random_range(0.001f32..1.0).powi(3));
                let probabilities = raw.map(|p| p / raw.iter().sum::<f32>());
                let time_s = 0.1 * f64::from(frame);
                let a = slow.update(time_s, probabilities);
                fast.update(time_s - 0.05, probabilities);
                let b = fast.update(time_s, probabilities);
                assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6), "frame {frame}: {a:?} {b:?}");
            }
        }
    }

    /// A frame counts in full if it is independent of the one before, and never more.
    #[test]
    fn a_frame_weighs_one_piece_of_evidence_at_most() {
        let still = Smoothing { dwell_s: 1e9, ..SLOW };
        for (interval_s, weight) in [(0.1, 0.1), (0.5, 0.5), (1.0, 1.0), (7.0, 1.0)] {
            let frame = [0.2f32, 0.5, 0.3];
            let p = OccupancyFilter::new(still, interval_s).update(0.0, frame);
            for (p, expected) in p.iter().zip(normalised(frame.map(|q| f64::from(q).powf(weight)))) {
                assert!((f64::from(*p) - expected).abs() < 1e-6, "{interval_s} s: {p}");
            }
        }
    }

    /// Settings of older model files have their former meaning, except those of people who are not detected, which are ignored.
    #[test]
    fn old_settings_are_read() {
        let old = r#"{"dwell_s":60.0,"unseen_share":0.3,"unseen_s":3.0,"weight":0.15}"#;
        let read: Smoothing = serde_json::from_str(old).expect("old settings");
        assert_eq!(read, Smoothing { dwell_s: 60.0, weight: Some(0.15), ..Smoothing::of_old_models() });
        assert_eq!(read.invalid_setting(), None);
        let written = r#"{"dwell_s":60.0,"weight":0.15,"temperature":1.0,"newest":0.0,"one_share":0.5}"#;
        assert_eq!(serde_json::to_string(&read).expect("JSON"), written);
        // A frame's evidence to the power of its weight, at any frame interval.
        for interval_s in [0.01, 0.1, 1.0] {
            let still = Smoothing { dwell_s: 1e9, ..read };
            let frame = [0.2f32, 0.5, 0.3];
            let p = OccupancyFilter::new(still, interval_s).update(0.0, frame);
            let expected = normalised(frame.map(|q| f64::from(q).powf(0.15)));
            assert!(p.iter().zip(expected).all(|(p, e)| (f64::from(*p) - e).abs() < 1e-6), "{p:?}");
        }
        let by_time = r#"{"dwell_s":60.0,"unseen_share":0.0,"unseen_s":1.0,"independent_s":1.0}"#;
        assert_eq!(serde_json::from_str::<Smoothing>(by_time).expect("old settings"), SLOW);
        for settings in [SLOW, BY_FRAME, Smoothing::default()] {
            let text = serde_json::to_string(&settings).expect("JSON");
            assert_eq!(serde_json::from_str::<Smoothing>(&text).expect("settings"), settings, "{text}");
        }
        // Absent keys have the values that were not written. Without a key of evidence, it counts by time.
        let default = Smoothing::default();
        for text in ["{}".to_owned(), format!(r#"{{"dwell_s":{:?}}}"#, default.dwell_s)] {
            let short: Smoothing = serde_json::from_str(&text).expect("settings");
            assert_eq!((short.dwell_s, short.temperature), (default.dwell_s, 1.0), "{text}");
            assert_eq!((short.weight, short.independent_s), (None, None), "{text}");
            let same = Smoothing { independent_s: None, temperature: 1.0, newest: 0.0, one_share: 0.5, ..default };
            let (mut a, mut b) = (filter(short), filter(same));
            assert_eq!(a.update(0.0, [0.2, 0.5, 0.3]), b.update(0.0, [0.2, 0.5, 0.3]), "{text}");
        }
        serde_json::from_str::<Smoothing>(r#"{"dwell":4.0}"#).expect_err("no such setting");
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let both = Smoothing { weight: Some(0.5), ..Smoothing::default() };
        assert_eq!(both.invalid_setting().map(|(name, ..)| name), Some("smoothing.weight"));
        for bad in [0.0, -1.0, f64::NAN] {
            for (settings, name) in [
                (Smoothing { dwell_s: bad, ..Smoothing::default() }, "smoothing.dwell_s"),
                (Smoothing { independent_s: Some(bad), ..Smoothing::default() }, "smoothing.independent_s"),
                (Smoothing { temperature: bad, ..Smoothing::default() }, "smoothing.temperature"),
            ] {
                assert_eq!(settings.invalid_setting().map(|(name, ..)| name), Some(name), "{bad}");
            }
        }
        for (one_share, newest) in [(0.0, -0.1), (1.0, 1.1), (f64::NAN, f64::NAN)] {
            let named = |settings: Smoothing| settings.invalid_setting().map(|(name, ..)| name);
            assert_eq!(named(Smoothing { one_share, ..Smoothing::default() }), Some("smoothing.one_share"));
            assert_eq!(named(Smoothing { newest, ..Smoothing::default() }), Some("smoothing.newest"));
        }
        assert_eq!(Smoothing::default().invalid_setting(), None);
    }

    /// The extra weight of the newest frame affects its own answer and no later one.
    #[test]
    fn the_newest_frame_counts_more_in_its_own_answer_alone() {
        const NEWEST: f64 = 0.3;
        let mut rng = crate::stream(9, "probabilities", 0);
        let (mut without, mut with) = (filter(SLOW), filter(Smoothing { newest: NEWEST, ..SLOW }));
        for number in 0..200 {
            let raw: [f32; 3] = std::array::from_fn(|_| rng.random_range(0.01f32..1.0));
            let frame = raw.map(|p| p / raw.iter().sum::<f32>());
            let time_s = 0.1 * f64::from(number);
            let (without, with) = (without.update(time_s, frame), with.update(time_s, frame));
            let expected = std::array::from_fn(|k| f64::from(without[k]) * f64::from(frame[k]).powf(NEWEST));
            for (found, expected) in with.iter().zip(normalised(expected)) {
                assert!((f64::from(*found) - expected).abs() < 1e-5, "{number}: {with:?}");
            }
        }
    }

    /// The temperature changes the confidence of an answer, but neither its label nor the state of the filter.
    #[test]
    fn a_temperature_changes_the_confidence_alone() {
        let mut rng = crate::stream(7, "probabilities", 0);
        let (mut cold, mut hot) = (filter(SLOW), filter(Smoothing { temperature: 2.0, ..SLOW }));
        for frame in 0..200 {
            let raw: [f32; 3] = std::array::from_fn(|_| rng.random_range(0.001f32..1.0).powi(3));
            let probabilities = raw.map(|p| p / raw.iter().sum::<f32>());
            let time_s = 0.1 * f64::from(frame);
            let (a, b) = (cold.update(time_s, probabilities), hot.update(time_s, probabilities));
            assert_eq!(most_probable(&a), most_probable(&b), "{a:?} {b:?}");
            let roots = a.map(f32::sqrt);
            let norm: f32 = roots.iter().sum();
            assert!(roots.iter().zip(b).all(|(root, b)| (root / norm - b).abs() < 1e-4), "{a:?} {b:?}");
        }
    }

    /// The filter's balanced accuracy is above that of single frames, at every frame rate. Frames are right more often than wrong
    /// in every class, errors last for up to a piece of evidence, and people stay for half a minute.
    #[test]
    fn the_filter_is_not_worse_than_its_frames() {
        for case in 0..40 {
            let mut rng = crate::stream(31, "case", case);
            let confusion: [[f64; 3]; 3] = std::array::from_fn(|truth| {
                let right = rng.random_range(0.55f64..0.95);
                let first = rng.random_range(0.0f64..1.0) * (1.0 - right);
                let mut wrong = [first, 1.0 - right - first].into_iter();
                std::array::from_fn(|predicted| if predicted == truth { right } else { wrong.next().unwrap_or(0.0) })
            });
            let rate_hz = [5.0, 10.0, 20.0][(case % 3) as usize];
            let error_s = rng.random_range(0.05..INDEPENDENT_S);
            let interval_s = 1.0 / rate_hz;
            let happens = |mean_s: f64| 1.0 - (-interval_s / mean_s).exp();
            let (mut by_frame, mut filtered) = ([[0u64; 3]; 3], [[0u64; 3]; 3]);
            for sequence in 0..6usize {
                let mut filter = OccupancyFilter::new(Smoothing::default(), interval_s);
                let (mut truth, mut last_drawn) = (sequence % 3, None);
                for frame in 1..=(200.0 * rate_hz) as u32 {
                    if rng.random::<f64>() < happens(30.0) {
                        truth = if truth == 1 { 2 * rng.random_range(0..2usize) } else { 1 };
                        last_drawn = None;
                    }
                    if rng.random::<f64>() < happens(error_s) {
                        last_drawn = None;
                    }
                    let u = rng.random::<f64>();
                    let [empty, one, _] = confusion[truth];
                    let drawn = if u < empty { 0 } else { 1 + usize::from(u >= empty + one) };
                    let predicted = *last_drawn.get_or_insert(drawn);
                    let column = confusion.map(|row| row[predicted]);
                    let probabilities = column.map(|p| (p / column.iter().sum::<f64>()) as f32);
                    let answer = filter.update(f64::from(frame) * interval_s, probabilities);
                    by_frame[truth][predicted] += 1;
                    filtered[truth][most_probable(&answer).index()] += 1;
                }
            }
            let [by_frame, filtered] =
                [by_frame, filtered].map(|counts| Metrics::from_confusion(counts).balanced_accuracy);
            assert!(filtered > by_frame, "case {case}, {confusion:?}: {by_frame} by frame, {filtered} filtered");
        }
    }

    #[test]
    fn one_odd_frame_does_not_change_the_label_and_a_lasting_change_does() {
        let mut filter = filter(BY_FRAME);
        let mut time_s = 0.0;
        let mut step = |q| {
            time_s += 0.1;
            most_probable(&filter.update(time_s, q))
        };
        (0..20).for_each(|_| assert_eq!(step([0.9, 0.08, 0.02]), Occupancy::Empty));
        assert_eq!(step([0.1, 0.8, 0.1]), Occupancy::Empty);
        assert_eq!(step([0.9, 0.08, 0.02]), Occupancy::Empty);
        let changed = (0..30).position(|_| step([0.05, 0.9, 0.05]) == Occupancy::One).expect("follows");
        assert!(changed < 10, "{changed} frames");
    }

    #[test]
    fn certain_and_wrong_frames_do_not_lock_the_filter() {
        for smoothing in [BY_FRAME, Smoothing::default()] {
            let mut filter = filter(smoothing);
            for i in 0..1000 {
                filter.update(f64::from(i) * 0.1, [1.0, 0.0, 0.0]);
            }
            let p = (0..40).map(|i| filter.update(100.0 + f64::from(i) * 0.1, [0.0, 0.0, 1.0])).last().expect("some");
            assert_eq!(most_probable(&p), Occupancy::Two);
            assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    mod hard_cases {
        use super::*;

        /// After times that stand still or go back, and after invalid probabilities, results are still distributions.
        #[test]
        fn odd_times_and_odd_probabilities_leave_a_distribution() {
            let shortest = Smoothing { dwell_s: SHORTEST_S, ..BY_FRAME };
            for smoothing in [
                Smoothing { weight: Some(1.0), ..BY_FRAME },
                Smoothing::default(),
                SLOW,
                Smoothing { temperature: 0.05, ..Smoothing::default() },
                Smoothing { temperature: 20.0, ..Smoothing::default() },
                shortest,
                Smoothing { weight: None, independent_s: Some(SHORTEST_S), ..shortest },
            ] {
                for interval_s in [0.1, 0.0, -1.0, f64::NAN, f64::INFINITY] {
                    let mut filter = OccupancyFilter::new(smoothing, interval_s);
                    for (time_s, frame) in [
                        (0.0, [0.2, 0.5, 0.3]),
                        (0.0, [0.2, 0.5, 0.3]),
                        (-5.0, [0.0, 1.0, 0.0]),
                        (1e9, [f32::NAN, 0.5, 0.5]),
                        (1e9 + 0.1, [0.0, 0.0, 0.0]),
                        (f64::NAN, [f32::INFINITY, -1.0, 2.0]),
                        (1e9 + 0.2, [0.1, 0.1, 0.8]),
                    ] {
                        let p = filter.update(time_s, frame);
                        assert!(p.iter().all(|p| (0.0..=1.0).contains(p)), "{p:?} at {time_s}");
                        assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{p:?} at {time_s}");
                    }
                }
            }
        }
    }
}
