//! Error budget of a skin's echoes, and integration settings that meet it.

/// Settings of the integration over a skin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntegrationSettings {
    /// Sine of the angle between normal and bisector: full weight up to the first value, no weight from the second.
    pub window: [f64; 2],
    /// Factor on the usual phase variation across a triangle for a given number of quadrature nodes
    /// ([`crate::em::quadrature`]).
    pub ease: f32,
}

impl IntegrationSettings {
    /// Returns settings that are coarser by a fifth. The difference of a field from the coarser one estimates its own
    /// error.
    pub(super) fn coarser(&self) -> Self {
        IntegrationSettings { window: self.window.map(|sine| 0.8 * sine), ease: 1.2 * self.ease }
    }

    /// Returns the share of the error beyond the window of [`Self::coarser`] that also lies beyond this window.
    pub(super) fn share_beyond_window(&self) -> f64 {
        (1.0 - self.window[1]) / (1.0 - self.coarser().window[1])
    }

    /// Returns the settings for an error in decibels.
    pub fn for_tolerance(tolerance_db: f64) -> Self {
        // Fitted to measurements (`radome bench scene`): truncated tails dominate the error of windows.
        let ratio = (tolerance_db / 0.5).clamp(0.02, 16.0);
        let inner = (0.4 * ratio.powf(if ratio > 1.0 { -0.14 } else { -0.5 })).clamp(0.15, 0.7);
        IntegrationSettings { window: [inner, (inner + 0.4).min(0.97)], ease: (1.1 * ratio.powf(0.2)).min(1.15) as f32 }
    }
}

/// Ratio of a pair's amplitude to the noise of a cell below which its allowed error is relaxed. Such an echo is spread
/// over some cells; its power is 25 dB above the noise of one.
const LOUD_RATIO: f64 = 18.0;

/// Error budget of a frame's echoes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorBudget {
    /// Error, dB, rms over the cells of the map in which the echoes exceed noise.
    pub tolerance_db: f64,
    /// Amplitude of a path that equals the noise of a cell, LSB.
    pub noise_lsb: f64,
}

impl ErrorBudget {
    /// Returns the settings for a pair of images with this loudness, LSB. A pair that hardly exceeds noise may have a
    /// larger error.
    pub(super) fn settings(&self, loudness_lsb: f64) -> IntegrationSettings {
        let relaxation = (LOUD_RATIO * self.noise_lsb / loudness_lsb.max(1e-300)).clamp(1.0, 2.0);
        IntegrationSettings::for_tolerance(self.tolerance_db * relaxation)
    }

    /// Returns the loudness of a body by a pair of images below which the pair is left out, LSB. The echo is spread
    /// over many cells.
    pub(super) fn min_pair_lsb(&self) -> f64 {
        self.noise_lsb * self.omission_factor().min(4.0)
    }

    /// Returns the strength below which a patch is left out, LSB. The limit is low because patches add up.
    pub(super) fn min_patch_lsb(&self) -> f64 {
        0.06 * self.min_pair_lsb()
    }

    /// Returns the relative interpolation error between key times that is allowed for an audible patch. It is small
    /// compared to the error of windows.
    pub(super) fn interpolation_tolerance(&self) -> f64 {
        (0.005 * self.tolerance_db / 0.5).min(0.008)
    }

    /// Returns the key times, up to index `last`, at which occlusion by limbs is computed for an image of this
    /// loudness, LSB. The shadow of a limb moves a few centimetres in a frame, and affects a small part of the echo, unless
    /// an arm moves `arm_motion_m` against the trunk, as when the person turns quickly.
    pub(super) fn occlusion_keys(&self, loudness_lsb: f64, arm_motion_m: f64, last: usize) -> Vec<usize> {
        /// Motion of an arm in a frame up to which its shadow is computed at few key times, m.
        const SLOW_ARM_M: f64 = 0.09;
        if self.tolerance_db < 0.4 || arm_motion_m > SLOW_ARM_M {
            (0..=last).collect()
        } else if loudness_lsb > 2.0 * LOUD_RATIO * self.noise_lsb {
            vec![0, last]
        } else {
            vec![last / 2]
        }
    }

    /// Returns the factor on the omission threshold, relative to half a decibel. Above half a decibel it grows less
    /// than in proportion, because omissions add to integration errors. Below it falls faster, because omissions
    /// dominate the error.
    fn omission_factor(&self) -> f64 {
        let ratio = self.tolerance_db / 0.5;
        ratio.powf(if ratio > 1.0 { 0.5 } else { 1.8 })
    }
}

/// Estimated error of a skin's echoes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ErrorEstimate {
    /// Relative error of cubic interpolation between key times in the loudest pair's field: the error with every second
    /// key time left out, over 16.
    pub interpolation: f64,
    /// Relative error of windows and quadrature in that field. It is the difference from a coarser field
    /// (`IntegrationSettings::coarser`) by path length, scaled to the directions beyond the finer window.
    pub integration: f64,
    /// Power of the omitted pairs and patches, over the noise power of a cell.
    pub omitted_power: f64,
}

impl ErrorEstimate {
    /// Returns the larger of both errors, component by component.
    pub fn max(self, other: Self) -> Self {
        ErrorEstimate {
            interpolation: self.interpolation.max(other.interpolation),
            integration: self.integration.max(other.integration),
            omitted_power: self.omitted_power.max(other.omitted_power),
        }
    }

    /// Converts to an error, dB, rms over the cells in which echoes exceed noise. The relative part applies to all
    /// cells; the omitted power is the same in weak and strong cells.
    pub fn db(&self) -> f64 {
        /// Number of map cells in which a walker exceeds noise, and the mean of noise over echo in them. In the frames
        /// of a corridor they are 170 to 205, and 0.23.
        const CELLS: f64 = 190.0;
        const NOISE_OVER_ECHO: f64 = 0.23;
        let relative_db = 20.0 * self.interpolation.hypot(self.integration).ln_1p() / std::f64::consts::LN_10;
        // On average, half the power of a small addition is in phase or in antiphase: the error is 20 / ln 10 of its
        // rms.
        let omission_db = 8.686 * (0.5 * self.omitted_power / CELLS * NOISE_OVER_ECHO).sqrt();
        relative_db.hypot(omission_db)
    }
}
