//! Processor from frames to maps, without allocation per frame.

use std::ops::Range;

use super::error::SpecError;
use super::fourier::FourierTransform;
use super::lanes::{Input, LaneTransform, Output};
use super::map::{MapFlags, Rdm, RdmShape};
use super::motion::Motion;
use super::motion_average::MotionAverage;
use super::physical::PhysicalTransform;
use super::plan::MapPlan;
use super::saturation::saturated_codes;
use super::spec::{Channels, RdmSpec, StaticRemoval};
use crate::{Frame, FrameMismatch, KernelLevel, Waveform, decibel};

/// Outcome of processing a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapStatus {
    /// The map is valid.
    Ready,
    /// A map over several frames needs more of them; the map is unchanged.
    WarmingUp {
        /// Number of frames in the window.
        have: usize,
        /// Number of frames that are needed.
        need: usize,
    },
}

/// Processor from frames to maps by an [`RdmSpec`]. It owns its plans and buffers; nothing is allocated per frame.
///
/// It keeps state between frames where the spec needs it: the background of recursive MTI, the window of frames, change, and motion.
/// Background, window and change are reset when sequence numbers are not consecutive, motion when more than a second is missing.
/// [`reset`](Self::reset) resets all.
///
/// Frames with powers of two on both axes go through a kernel at the machine's [`KernelLevel`]. Other sizes, and slow time across
/// frames, go through `realfft`. Maps on [`PhysicalAxes`](super::PhysicalAxes) are sums of products. Their cells that the waveform
/// does not measure hold noise at the level of their range bin, drawn by sequence number and cell.
///
/// ```
/// use radome_dsp::{Frame, MapStatus, RdmProcessor, RdmSpec, Waveform, WaveformRequest};
///
/// let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
/// let mut processor = RdmProcessor::new(&RdmSpec::default(), &waveform).expect("the spec suits the waveform");
/// let mut map = processor.empty_map();
///
/// let mut frame = Frame::zeroed(waveform.shape());
/// frame.codes.fill(2048);
/// let status = processor.process(&frame, &mut map)?;
/// assert_eq!(status, MapStatus::Ready);
/// // No signal: all cells read the floor.
/// assert!((map.at(0, 64, 10) + 200.0).abs() < 1e-3);
/// # Ok::<(), radome_dsp::FrameMismatch>(())
/// ```
pub struct RdmProcessor {
    spec: RdmSpec,
    plan: MapPlan,
    steps: (f64, f64),
    level: KernelLevel,
    transform: Transform,
    floor_power: f32,
    /// Lowest power, if the lane transform converts power to decibels itself.
    fused_floor: Option<f32>,
    uses_library_logarithm: bool,
    samples: Vec<f32>,
    last_sequence: Option<u64>,
    /// Index of the first code of a frame that the last map was computed from.
    source_start: usize,
    background: Vec<f32>,
    has_background: bool,
    /// Averages of motion, if the spec asks for them.
    motion: Option<MotionAverage>,
}

enum Transform {
    Lanes(LaneTransform),
    Fourier(Box<FourierTransform>),
    Physical(Box<PhysicalTransform>),
}

impl RdmProcessor {
    /// Creates the processor for frames of `waveform`, at the fastest level of this machine.
    ///
    /// # Errors
    /// [`SpecError`] under the conditions of [`RdmSpec::shape`].
    pub fn new(spec: &RdmSpec, waveform: &Waveform) -> Result<Self, SpecError> {
        Self::with_kernel(spec, waveform, KernelLevel::detect())
    }

    /// Creates the processor at a given level, so that different machines agree. With [`KernelLevel::Portable`], `rustfft` uses its
    /// scalar transforms too. At other levels it chooses its instructions itself.
    ///
    /// # Errors
    /// [`SpecError::Kernel`] if this machine does not have the level, and [`SpecError`] under the conditions of
    /// [`RdmSpec::shape`].
    pub fn with_kernel(spec: &RdmSpec, waveform: &Waveform, level: KernelLevel) -> Result<Self, SpecError> {
        if !level.is_available() {
            return Err(SpecError::Kernel { level, detected: KernelLevel::detect() });
        }
        let plan = MapPlan::new(spec, waveform)?;
        let codes = plan.frame_shape.codes();
        let floor_power = 10f64.powf(spec.floor_db / 10.0) as f32;
        let is_recursive = matches!(spec.static_removal, StaticRemoval::RecursiveMti { .. });
        let transform = if let Some((axes, coverage)) = spec.physical_axes.zip(spec.coverage(waveform)) {
            Transform::Physical(Box::new(PhysicalTransform::new(&plan, spec, &axes, coverage, waveform, level)))
        } else if let Some(lanes) = LaneTransform::new(&plan, level) {
            Transform::Lanes(lanes)
        } else {
            Transform::Fourier(Box::new(FourierTransform::new(&plan, level)))
        };
        Ok(RdmProcessor {
            spec: *spec,
            steps: spec.steps(waveform),
            level,
            transform,
            floor_power,
            fused_floor: if plan.is_sum { None } else { Some(floor_power) },
            uses_library_logarithm: false,
            samples: vec![0.0; codes],
            last_sequence: None,
            source_start: plan.used_samples().start,
            background: vec![0.0; if is_recursive { codes } else { 0 }],
            has_background: false,
            motion: spec.motion_over_s.map(|over_s| {
                MotionAverage::new(plan.shape, over_s, waveform.frame_interval_s(), spec.change_over_s.is_some())
            }),
            plan,
        })
    }

    /// Level at which maps are computed.
    pub fn kernel_level(&self) -> KernelLevel {
        self.level
    }

    /// Returns whether maps are computed by the lane transform, which needs powers of two.
    pub fn uses_lanes(&self) -> bool {
        matches!(self.transform, Transform::Lanes(_))
    }

    /// Replaces the lane transform by the `realfft` transform, which takes any size, for benchmarks that compare the two. Resets
    /// the state. Maps on physical axes are computed as before.
    pub fn use_realfft(&mut self) {
        self.reset();
        if matches!(self.transform, Transform::Physical(_)) {
            return;
        }
        self.transform = Transform::Fourier(Box::new(FourierTransform::new(&self.plan, self.level)));
    }

    /// Replaces the polynomial logarithm by the library's `log10`, for benchmarks that compare the two.
    pub fn use_library_logarithm(&mut self) {
        self.uses_library_logarithm = true;
        self.fused_floor = None;
    }

    /// Specification of the maps.
    pub fn spec(&self) -> &RdmSpec {
        &self.spec
    }

    /// Shape of the maps.
    pub fn shape(&self) -> RdmShape {
        self.plan.shape
    }

    /// Creates a map of the right shape, at the floor, as a buffer for [`process`](Self::process).
    pub fn empty_map(&self) -> Rdm {
        let shape = self.shape();
        Rdm {
            shape,
            db: vec![self.spec.floor_db as f32; shape.cells()],
            range_step_m: self.steps.0,
            velocity_step_m_per_s: self.steps.1,
            sequence: 0,
            flags: MapFlags::default(),
            motion: self.motion.as_ref().map(|_| Motion::default()),
        }
    }

    /// Resets background, window, change and motion. Call it when the scene changes abruptly.
    pub fn reset(&mut self) {
        self.reset_at_gap();
        if let Some(motion) = &mut self.motion {
            motion.reset();
        }
    }

    /// Resets the state that needs consecutive frames: background, window and change. Motion is reset by the next frame if more than a
    /// second is missing before it.
    pub fn reset_at_gap(&mut self) {
        self.last_sequence = None;
        self.has_background = false;
        match &mut self.transform {
            Transform::Fourier(transform) => transform.reset(),
            Transform::Physical(transform) => transform.reset(),
            Transform::Lanes(_) => {}
        }
    }

    /// Computes the map of `frame` and, if the spec says so, of the frames before it.
    ///
    /// # Errors
    /// [`FrameMismatch`] if the frame's shape is not the waveform's, or if the number of its codes is not that of its shape.
    /// State and map are then unchanged.
    ///
    /// # Panics
    /// If `map` has fewer cells than [`shape`](Self::shape) says.
    pub fn process(&mut self, frame: &Frame, map: &mut Rdm) -> Result<MapStatus, FrameMismatch> {
        self.process_changed(frame, frame, map)
    }

    /// Computes the map of a frame whose codes were changed, such as by noise. Receivers that give no signal are those of the frame
    /// as it was `received`: noise that fills the range of the ADC does not make a receiver one of them.
    ///
    /// # Errors
    /// Those of [`process`](Self::process), for either frame.
    ///
    /// # Panics
    /// If `map` has fewer cells than [`shape`](Self::shape) says.
    pub fn process_changed(
        &mut self,
        received: &Frame,
        changed: &Frame,
        map: &mut Rdm,
    ) -> Result<MapStatus, FrameMismatch> {
        FrameMismatch::check(received, self.plan.frame_shape)?;
        FrameMismatch::check(changed, self.plan.frame_shape)?;
        let used = self.plan.used_samples();
        let codes = &changed.codes[self.start_frame(received)];
        let saturated = saturated_codes(self.level, codes);
        if let Transform::Lanes(lanes) = &mut self.transform
            && !matches!(self.spec.static_removal, StaticRemoval::RecursiveMti { .. })
        {
            let channels = codes.chunks_exact(self.plan.channel_length()).map(Input::Codes);
            let cells = transform_lanes(lanes, &self.plan, self.fused_floor, channels, &mut map.db);
            self.finish(received.sequence, saturated, cells, map);
            return Ok(MapStatus::Ready);
        }
        let (factor, offset) = self.plan.scale;
        let (factor, offset) = (factor as f32, offset as f32);
        for (x, code) in self.samples[used].iter_mut().zip(codes) {
            *x = f32::from(*code) * factor + offset;
        }
        self.exclude_dead_receivers(received);
        Ok(self.compute_map(received.sequence, saturated, map))
    }

    /// Computes the map of a frame whose samples were changed, as [`process_changed`](Self::process_changed) does. `samples` are in
    /// the spec's scale, `[rx][chirp][sample]` of all channels, and need not be codes.
    ///
    /// # Errors
    /// Those of [`process`](Self::process), and [`FrameMismatch::Length`] if the number of samples is not that of a frame. State
    /// and map are then unchanged.
    ///
    /// # Panics
    /// If `map` has fewer cells than [`shape`](Self::shape) says.
    pub fn process_changed_samples(
        &mut self,
        received: &Frame,
        samples: &[f32],
        map: &mut Rdm,
    ) -> Result<MapStatus, FrameMismatch> {
        FrameMismatch::check(received, self.plan.frame_shape)?;
        FrameMismatch::check_length(received.sequence, samples.len(), self.plan.frame_shape)?;
        let (used, source) = (self.plan.used_samples(), self.start_frame(received));
        self.samples[used].copy_from_slice(&samples[source]);
        self.exclude_dead_receivers(received);
        Ok(self.compute_map(received.sequence, 0, map))
    }

    /// Computes the map of samples that are already in the spec's scale, `[rx][chirp][sample]` of all channels. NaN and infinity
    /// pass through and are counted in the map's flags.
    ///
    /// # Errors
    /// [`FrameMismatch::Length`] if the number of samples is not that of a frame. State and map are then unchanged.
    ///
    /// # Panics
    /// If `map` has fewer cells than [`shape`](Self::shape) says.
    pub fn process_samples(
        &mut self,
        sequence: u64,
        samples: &[f32],
        map: &mut Rdm,
    ) -> Result<MapStatus, FrameMismatch> {
        FrameMismatch::check_length(sequence, samples.len(), self.plan.frame_shape)?;
        self.check_sequence(sequence);
        self.samples.copy_from_slice(samples);
        if let Transform::Physical(transform) = &mut self.transform {
            transform.set_alive_by_samples(&self.plan, &self.samples[self.plan.used_samples()]);
        }
        Ok(self.compute_map(sequence, 0, map))
    }

    /// Resets the state if it does not belong to this frame. Returns the range of the frame's codes that the map is computed from.
    fn start_frame(&mut self, frame: &Frame) -> Range<usize> {
        let codes = self.source_codes(frame);
        if codes.start != self.source_start {
            // The state between frames is that of another receiver.
            self.reset();
            self.source_start = codes.start;
        }
        self.check_sequence(frame.sequence);
        codes
    }

    /// Leaves receivers that give no signal in a frame out of a mean over receivers on physical axes.
    fn exclude_dead_receivers(&mut self, frame: &Frame) {
        if let Transform::Physical(transform) = &mut self.transform {
            transform.set_alive(&self.plan, |rx| !frame.is_receiver_dead(rx));
        }
    }

    /// Range of the codes of a frame that the map is computed from, by [`Channels`].
    fn source_codes(&self, frame: &Frame) -> Range<usize> {
        let used = self.plan.used_samples();
        match self.spec.channels {
            Channels::One(index) if self.spec.physical_axes.is_some() && frame.is_receiver_dead(index) => {
                let length = self.plan.channel_length();
                let other = (0..frame.shape.rx).find(|rx| !frame.is_receiver_dead(*rx));
                other.map_or(used, |rx| rx * length..(rx + 1) * length)
            }
            _ => used,
        }
    }

    /// Resets the state that needs consecutive frames unless this sequence number is the one after the last.
    fn check_sequence(&mut self, sequence: u64) {
        if self.last_sequence.is_some_and(|last| last.checked_add(1) != Some(sequence)) {
            self.reset_at_gap();
        }
        self.last_sequence = Some(sequence);
    }

    fn compute_map(&mut self, sequence: u64, saturated_samples: u32, map: &mut Rdm) -> MapStatus {
        let used = self.plan.used_samples();
        if self.plan.removes_chirp_mean {
            for chirp in self.samples[used.clone()].chunks_exact_mut(self.plan.frame_shape.samples) {
                let mean = (chirp.iter().map(|x| f64::from(*x)).sum::<f64>() / chirp.len() as f64) as f32;
                chirp.iter_mut().for_each(|x| *x -= mean);
            }
        }
        if let StaticRemoval::RecursiveMti { alpha } = self.spec.static_removal {
            self.subtract_background(alpha as f32);
        }
        let (plan, samples) = (&self.plan, &mut self.samples[used]);
        if let Transform::Fourier(transform) = &mut self.transform
            && plan.is_across_frames
        {
            let frames = transform.push_frame(plan, samples);
            if frames < plan.slow_time_length {
                return MapStatus::WarmingUp { have: frames, need: plan.slow_time_length };
            }
            for index in 0..plan.channels.len() {
                transform.transform_window(plan, index, &mut map.db[plan.cells(index)]);
            }
            return self.finish(sequence, saturated_samples, Cells::Power, map);
        }
        let channels = samples.chunks_exact(plan.channel_length());
        let cells = match &mut self.transform {
            Transform::Lanes(transform) => {
                transform_lanes(transform, plan, self.fused_floor, channels.map(Input::Samples), &mut map.db)
            }
            Transform::Fourier(transform) => {
                for (index, channel) in channels.enumerate() {
                    transform.transform_channel(plan, index, channel, &mut map.db[plan.cells(index)]);
                }
                Cells::Power
            }
            Transform::Physical(transform) => {
                transform.transform_frame(plan, samples, sequence, &mut map.db);
                Cells::Power
            }
        };
        self.finish(sequence, saturated_samples, cells, map)
    }

    fn subtract_background(&mut self, alpha: f32) {
        let used = self.plan.used_samples();
        let (samples, background) = (&mut self.samples[used.clone()], &mut self.background[used]);
        if !self.has_background {
            // As in the vendor's examples, the first frame passes unsuppressed (h starts at zero).
            background.fill(0.0);
            self.has_background = true;
        }
        for (x, h) in samples.iter_mut().zip(background) {
            let raw = *x;
            *x = raw - *h;
            *h = alpha * raw + (1.0 - alpha) * *h;
        }
    }

    /// Converts power to decibels where the transform has not, and sets the map's flags and motion.
    fn finish(&mut self, sequence: u64, saturated_samples: u32, cells: Cells, map: &mut Rdm) -> MapStatus {
        let count = |db: &[f32]| db.iter().map(|v| u32::from(!v.is_finite())).sum();
        let non_finite_cells = match cells {
            Cells::Decibels { are_finite: true } => 0,
            Cells::Decibels { are_finite: false } => count(&map.db),
            Cells::Power if self.uses_library_logarithm => {
                decibel::power_to_db_library(&mut map.db, self.floor_power);
                count(&map.db)
            }
            Cells::Power => decibel::power_to_db_at(self.level, &mut map.db, self.floor_power),
        };
        map.sequence = sequence;
        map.flags = MapFlags { saturated_samples, non_finite_cells };
        map.motion = self.motion.as_mut().map(|motion| motion.push(map));
        MapStatus::Ready
    }
}

/// Contents of a map after its transform.
enum Cells {
    /// Powers.
    Power,
    /// Decibels. Unless all cells are known to be finite, the others must be counted.
    Decibels { are_finite: bool },
}

/// Computes all channels by the lane transform, to decibels unless channels are summed.
fn transform_lanes<'a>(
    transform: &mut LaneTransform,
    plan: &MapPlan,
    floor_power: Option<f32>,
    channels: impl Iterator<Item = Input<'a>>,
    db: &mut [f32],
) -> Cells {
    let mut are_finite = true;
    for (index, channel) in channels.enumerate() {
        let output = match floor_power {
            Some(floor_power) => Output::Decibels { floor_power },
            None => Output::Power { adds: plan.adds(index) },
        };
        are_finite &= transform.transform_channel(channel, output, &mut db[plan.cells(index)]);
    }
    if floor_power.is_some() { Cells::Decibels { are_finite } } else { Cells::Power }
}
