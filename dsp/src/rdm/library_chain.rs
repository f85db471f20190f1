//! Processing chain of libraries, for benchmarks. It is in this crate because the program's commands are compiled without optimisation.

use std::sync::Arc;

use num_complex::Complex32;
use realfft::RealToComplex;
use rustfft::Fft;

use crate::decibel;
use crate::frame::Frame;
use crate::spectrum::{complex_fft_f32, real_fft_f32};
use crate::waveform::Waveform;
use crate::window::Window;

/// Processing chain written directly with the FFT libraries: f32 throughout, plans and buffers kept, a blocked copy
/// between the axes, and this crate's logarithm.
pub struct LibraryChain {
    range: Arc<dyn RealToComplex<f32>>,
    doppler: Arc<dyn Fft<f32>>,
    /// `[chirp][sample]`
    window: Vec<f32>,
    samples: Vec<f32>,
    spectrum: Vec<Complex32>,
    /// `[range][chirp]`
    columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
    range_scratch: Vec<Complex32>,
}

impl LibraryChain {
    /// Creates the plans for frames of a waveform.
    pub fn new(waveform: &Waveform) -> Self {
        let shape = waveform.shape();
        let (range_window, doppler_window) = (Window::Hann.weights(shape.samples), Window::Hann.weights(shape.chirps));
        let gain = 2.0 / (range_window.iter().sum::<f64>() * doppler_window.iter().sum::<f64>()) / 2048.0;
        let window = doppler_window.iter().flat_map(|d| range_window.iter().map(move |r| (gain * d * r) as f32));
        let range = real_fft_f32(shape.samples);
        let doppler = complex_fft_f32(shape.chirps);
        LibraryChain {
            window: window.collect(),
            samples: range.make_input_vec(),
            spectrum: range.make_output_vec(),
            columns: vec![Complex32::default(); shape.samples / 2 * shape.chirps],
            scratch: vec![Complex32::default(); doppler.get_inplace_scratch_len()],
            range_scratch: range.make_scratch_vec(),
            range,
            doppler,
        }
    }

    /// Computes the maps of all receivers into `cells`, `[rx][doppler][range]`, dB.
    pub fn maps(&mut self, frame: &Frame, cells: &mut [f32]) {
        let shape = frame.shape;
        let (chirps, bins) = (shape.chirps, shape.samples / 2);
        for (codes, cells) in
            frame.codes.chunks_exact(chirps * shape.samples).zip(cells.chunks_exact_mut(chirps * bins))
        {
            for (chirp, codes) in codes.chunks_exact(shape.samples).enumerate() {
                let window = &self.window[chirp * shape.samples..(chirp + 1) * shape.samples];
                for ((x, code), w) in self.samples.iter_mut().zip(codes).zip(window) {
                    *x = (f32::from(*code) - 2048.0) * w;
                }
                let result =
                    self.range.process_with_scratch(&mut self.samples, &mut self.spectrum, &mut self.range_scratch);
                debug_assert!(result.is_ok(), "buffers have the planned lengths");
                // A constant offset has one spectral line, a sine has two.
                self.spectrum[0] *= 0.5;
                for (bin, x) in self.spectrum[..bins].iter().enumerate() {
                    self.columns[bin * chirps + chirp] = *x;
                }
            }
            self.doppler.process_with_scratch(&mut self.columns, &mut self.scratch);
            for first in (0..bins).step_by(8) {
                for doppler in 0..chirps {
                    let row = (doppler + chirps / 2) % chirps * bins;
                    for bin in first..(first + 8).min(bins) {
                        cells[row + bin] = self.columns[bin * chirps + doppler].norm_sqr();
                    }
                }
            }
            decibel::power_to_db(cells, 1e-20);
        }
    }
}
