//! Frames to maps, without allocation per frame.

use std::ops::Range;

use thiserror::Error;

use super::chain::ChainPlan;
use super::fourier::FourierChain;
use super::lanes::{Input, LaneChain, Output};
use super::physical::PhysicalChain;
use super::saturation::saturated_codes;
use super::{Channels, MapFlags, Rdm, RdmShape, RdmSpec, SpecError, StaticRemoval};
use crate::{Frame, FrameShape, KernelLevel, Waveform, decibel};

/// Whether a map was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapStatus {
    /// The map is valid.
    Ready,
    /// A map over several frames needs more of them; the map is untouched.
    WarmingUp {
        /// Frames in the window so far.
        have: usize,
        /// Frames needed.
        need: usize,
    },
}

/// A frame that does not fit the processor.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum MapError {
    /// Another shape than that of the waveform.
    #[error("frame {sequence} is {got}, expected {expected}: is this from another waveform?")]
    Shape {
        /// Sequence number of the frame.
        sequence: u64,
        /// Shape of the waveform.
        expected: FrameShape,
        /// Shape of the frame.
        got: FrameShape,
    },
    /// Fewer or more samples than the shape says.
    #[error("frame {sequence} holds {got} samples, expected {expected}")]
    Length {
        /// Sequence number of the frame.
        sequence: u64,
        /// Samples that the shape calls for.
        expected: usize,
        /// Samples there are.
        got: usize,
    },
}

/// Makes maps of frames as its [`RdmSpec`] says. Owns its plans and buffers; nothing is allocated per frame.
///
/// Keeps state between frames where the spec calls for it (MTI background, window of frames, change); it forgets it by itself
/// when sequence numbers do not follow one another, and on [`reset`](Self::reset).
///
/// Frames with powers of two on both axes go through a kernel of its own at the machine's [`KernelLevel`], other sizes
/// and slow time across frames through `realfft`. Maps on [`PhysicalAxes`](super::PhysicalAxes) are sums of products: cells that the
/// waveform does not measure hold noise at the level of their range bin, drawn by sequence number and cell.
pub struct RdmProcessor {
    spec: RdmSpec,
    plan: ChainPlan,
    steps: (f64, f64),
    level: KernelLevel,
    chain: Chain,
    floor_power: f32,
    /// Lowest power where the lane kernel makes decibels of it at once.
    fused_floor: Option<f32>,
    uses_library_logarithm: bool,
    samples: Vec<f32>,
    last_sequence: Option<u64>,
    /// First code of a frame that the last map was made of.
    source_start: usize,
    background: Vec<f32>,
    has_background: bool,
}

enum Chain {
    Lanes(LaneChain),
    Fourier(Box<FourierChain>),
    Physical(Box<PhysicalChain>),
}

impl RdmProcessor {
    /// Plans the transforms for frames of `waveform`, at the fastest level of this machine.
    pub fn new(spec: &RdmSpec, waveform: &Waveform) -> Result<Self, SpecError> {
        Self::with_kernel(spec, waveform, KernelLevel::detect())
    }

    /// The same at a given level, so that unlike machines agree. With [`KernelLevel::Portable`] `rustfft`, too, keeps
    /// to its scalar transforms where it is used; at other levels it picks its instructions by itself.
    ///
    /// # Errors
    /// [`SpecError::Kernel`] if this machine does not have the level.
    pub fn with_kernel(spec: &RdmSpec, waveform: &Waveform, level: KernelLevel) -> Result<Self, SpecError> {
        if !level.is_available() {
            return Err(SpecError::Kernel { level, detected: KernelLevel::detect() });
        }
        let plan = ChainPlan::new(spec, waveform)?;
        let codes = plan.frame_shape.codes();
        let floor_power = 10f64.powf(spec.floor_db / 10.0) as f32;
        let is_recursive = matches!(spec.static_removal, StaticRemoval::RecursiveMti { .. });
        let chain = if let Some(axes) = spec.physical_axes {
            Chain::Physical(Box::new(PhysicalChain::new(&plan, &axes, spec.change_over_s, waveform, level)))
        } else if let Some(lanes) = LaneChain::new(&plan, level) {
            Chain::Lanes(lanes)
        } else {
            Chain::Fourier(Box::new(FourierChain::new(&plan, level)))
        };
        Ok(RdmProcessor {
            spec: *spec,
            steps: spec.steps(waveform),
            level,
            chain,
            floor_power,
            fused_floor: if plan.is_sum { None } else { Some(floor_power) },
            uses_library_logarithm: false,
            samples: vec![0.0; codes],
            last_sequence: None,
            source_start: plan.used().start,
            background: vec![0.0; if is_recursive { codes } else { 0 }],
            has_background: false,
            plan,
        })
    }

    /// Level at which maps are made.
    pub fn kernel_level(&self) -> KernelLevel {
        self.level
    }

    /// Whether the sizes suit the kernel whose lanes are transforms.
    pub fn uses_lanes(&self) -> bool {
        matches!(self.chain, Chain::Lanes(_))
    }

    /// Uses the `realfft` chain, which takes any size, even where the lane kernel would do: for benchmarks that
    /// compare the two. Forgets all frames. Maps on physical axes are made as before.
    pub fn use_realfft(&mut self) {
        self.reset();
        if matches!(self.chain, Chain::Physical(_)) {
            return;
        }
        self.chain = Chain::Fourier(Box::new(FourierChain::new(&self.plan, self.level)));
    }

    /// Uses the library's `log10` instead of the polynomial: for benchmarks that compare the two.
    pub fn use_library_logarithm(&mut self) {
        self.uses_library_logarithm = true;
        self.fused_floor = None;
    }

    /// The spec.
    pub fn spec(&self) -> &RdmSpec {
        &self.spec
    }

    /// Shape of the maps.
    pub fn shape(&self) -> RdmShape {
        self.plan.shape
    }

    /// A map to process into.
    pub fn empty_map(&self) -> Rdm {
        let shape = self.shape();
        Rdm {
            shape,
            db: vec![self.spec.floor_db as f32; shape.cells()],
            range_step_m: self.steps.0,
            velocity_step_m_per_s: self.steps.1,
            sequence: 0,
            flags: MapFlags::default(),
        }
    }

    /// Forgets background and window: call it at a gap or when the scene jumps.
    pub fn reset(&mut self) {
        self.last_sequence = None;
        self.has_background = false;
        match &mut self.chain {
            Chain::Fourier(chain) => chain.reset(),
            Chain::Physical(chain) => chain.reset(),
            Chain::Lanes(_) => {}
        }
    }

    /// Makes the map of `frame` (and, if the spec says so, of those before it).
    ///
    /// # Errors
    /// [`MapError`] if the frame's shape is not the waveform's; state and map are then untouched.
    pub fn process(&mut self, frame: &Frame, map: &mut Rdm) -> Result<MapStatus, MapError> {
        if frame.shape != self.plan.frame_shape {
            let (expected, got) = (self.plan.frame_shape, frame.shape);
            return Err(MapError::Shape { sequence: frame.sequence, expected, got });
        }
        self.check_length(frame.sequence, frame.codes.len())?;
        let used = self.plan.used();
        let source = self.source(frame);
        if source.start != self.source_start {
            // What was kept between frames is that of another receiver.
            self.reset();
            self.source_start = source.start;
        }
        let codes = &frame.codes[source];
        self.follow(frame.sequence);
        let saturated = saturated_codes(self.level, codes);
        if let Chain::Lanes(lanes) = &mut self.chain
            && !matches!(self.spec.static_removal, StaticRemoval::RecursiveMti { .. })
        {
            let channels = codes.chunks_exact(self.plan.channel_length()).map(Input::Codes);
            let cells = through_lanes(lanes, &self.plan, self.fused_floor, channels, &mut map.db);
            self.finish(frame.sequence, saturated, cells, map);
            return Ok(MapStatus::Ready);
        }
        let (factor, offset) = self.plan.scale;
        let (factor, offset) = (factor as f32, offset as f32);
        for (x, code) in self.samples[used].iter_mut().zip(codes) {
            *x = f32::from(*code) * factor + offset;
        }
        Ok(self.transform(frame.sequence, saturated, map))
    }

    /// The same for samples that are already numbers in the spec's scale, `[rx][chirp][sample]` of all channels.
    /// NaN and infinity go through and are counted in the map's flags.
    pub fn process_samples(&mut self, sequence: u64, samples: &[f32], map: &mut Rdm) -> Result<MapStatus, MapError> {
        self.check_length(sequence, samples.len())?;
        self.follow(sequence);
        self.samples.copy_from_slice(samples);
        Ok(self.transform(sequence, 0, map))
    }

    fn check_length(&self, sequence: u64, got: usize) -> Result<(), MapError> {
        let expected = self.plan.frame_shape.codes();
        if got == expected { Ok(()) } else { Err(MapError::Length { sequence, expected, got }) }
    }

    /// Codes of a frame that the map is made of, as [`Channels`] says.
    fn source(&self, frame: &Frame) -> Range<usize> {
        let used = self.plan.used();
        match self.spec.channels {
            Channels::One(index) if self.spec.physical_axes.is_some() && frame.is_receiver_dead(index) => {
                let length = self.plan.channel_length();
                let other = (0..frame.shape.rx).find(|rx| !frame.is_receiver_dead(*rx));
                other.map_or(used, |rx| rx * length..(rx + 1) * length)
            }
            _ => used,
        }
    }

    /// Forgets the past if this frame does not follow it.
    fn follow(&mut self, sequence: u64) {
        if self.last_sequence.is_some_and(|last| last.checked_add(1) != Some(sequence)) {
            self.reset();
        }
        self.last_sequence = Some(sequence);
    }

    /// From `samples` to the map.
    fn transform(&mut self, sequence: u64, saturated_samples: u32, map: &mut Rdm) -> MapStatus {
        let used = self.plan.used();
        if let Chain::Physical(chain) = &mut self.chain {
            chain.find_alive(&self.plan, &self.samples[used.clone()]);
        }
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
        if let Chain::Fourier(chain) = &mut self.chain
            && plan.is_across_frames
        {
            let have = chain.push_frame(plan, samples);
            if have < plan.slow_length {
                return MapStatus::WarmingUp { have, need: plan.slow_length };
            }
            for index in 0..plan.channels.len() {
                chain.window(plan, index, &mut map.db[plan.cells(index)]);
            }
            return self.finish(sequence, saturated_samples, Cells::Power, map);
        }
        let channels = samples.chunks_exact(plan.channel_length());
        let cells = match &mut self.chain {
            Chain::Lanes(chain) => {
                through_lanes(chain, plan, self.fused_floor, channels.map(Input::Samples), &mut map.db)
            }
            Chain::Fourier(chain) => {
                for (index, channel) in channels.enumerate() {
                    chain.channel(plan, index, channel, &mut map.db[plan.cells(index)]);
                }
                Cells::Power
            }
            Chain::Physical(chain) => {
                chain.map(plan, samples, sequence, &mut map.db);
                Cells::Power
            }
        };
        self.finish(sequence, saturated_samples, cells, map)
    }

    fn subtract_background(&mut self, alpha: f32) {
        let used = self.plan.used();
        let (samples, background) = (&mut self.samples[used.clone()], &mut self.background[used]);
        if !self.has_background {
            // As in the vendor's examples the first frame passes unsuppressed (h starts at zero).
            background.fill(0.0);
            self.has_background = true;
        }
        for (x, h) in samples.iter_mut().zip(background) {
            let raw = *x;
            *x = raw - *h;
            *h = alpha * raw + (1.0 - alpha) * *h;
        }
    }

    /// Decibels where there is still power, and the map's flags.
    fn finish(&self, sequence: u64, saturated_samples: u32, cells: Cells, map: &mut Rdm) -> MapStatus {
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
        MapStatus::Ready
    }
}

/// What a chain has left in the map.
enum Cells {
    Power,
    /// If not all are known to be finite, they are to be counted.
    Decibels {
        are_finite: bool,
    },
}

/// All channels through the lane kernel, to decibels where nothing is to be added up.
fn through_lanes<'a>(
    chain: &mut LaneChain,
    plan: &ChainPlan,
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
        are_finite &= chain.channel(channel, output, &mut db[plan.cells(index)]);
    }
    if floor_power.is_some() { Cells::Decibels { are_finite } } else { Cells::Power }
}
