//! Error budget of a skin's echoes, and the settings that meet it.

/// Settings of the integration over a skin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntegrationSettings {
    /// Sine of the angle between normal and bisector up to which everything counts, and from which nothing does.
    pub window: [f64; 2],
    /// Factor by which phases may run farther than usual across a triangle for the places that it is given
    /// ([`crate::em::quadrature`]).
    pub ease: f32,
}

impl IntegrationSettings {
    /// Coarser by a fifth: how far a field is from that is about what it misses itself.
    pub(super) fn coarser(&self) -> Self {
        IntegrationSettings { window: self.window.map(|sine| 0.8 * sine), ease: 1.2 * self.ease }
    }

    /// Share of the echo beyond the window of [`Self::coarser`] that is beyond this window, too.
    pub(super) fn beyond(&self) -> f64 {
        (1.0 - self.window[1]) / (1.0 - self.coarser().window[1])
    }

    /// For an error of this many decibels.
    pub fn for_tolerance(tolerance_db: f64) -> Self {
        // Found by measuring (`radome bench scene`): windows err by their tails.
        let part = (tolerance_db / 0.5).clamp(0.02, 16.0);
        let inner = (0.4 * part.powf(if part > 1.0 { -0.14 } else { -0.5 })).clamp(0.15, 0.7);
        IntegrationSettings { window: [inner, (inner + 0.4).min(0.97)], ease: (1.1 * part.powf(0.2)).min(1.15) as f32 }
    }
}

/// Level over the noise of a cell at which relaxation begins: spread over some cells, this is 25 dB above noise in all.
const LOUD: f64 = 18.0;

/// Error budget of a frame's echoes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorBudget {
    /// Error, dB, rms over the cells of the map in which they stand above noise.
    pub tolerance_db: f64,
    /// Amplitude of a path that is as strong as the noise of a cell, LSB.
    pub noise_lsb: f64,
}

impl ErrorBudget {
    /// For a pair of images that is this loud, LSB: one that hardly rises above noise may err by more.
    pub(super) fn settings(&self, loudness_lsb: f64) -> IntegrationSettings {
        let relaxed = (LOUD * self.noise_lsb / loudness_lsb.max(1e-300)).clamp(1.0, 2.0);
        IntegrationSettings::for_tolerance(self.tolerance_db * relaxed)
    }

    /// The loudness of all of a body by a pair of images below which the pair is left out, LSB: it is spread over many cells.
    pub(super) fn least_pair_lsb(&self) -> f64 {
        self.noise_lsb * self.laxity().min(4.0)
    }

    /// The strength below which a patch is left out, LSB: patches add up.
    pub(super) fn least_patch_lsb(&self) -> f64 {
        0.06 * self.least_pair_lsb()
    }

    /// Part of a patch's own field that may be missed between keys, where what is missed would be heard: little beside what windows
    /// miss.
    pub(super) fn missed_between_keys(&self) -> f64 {
        (0.005 * self.tolerance_db / 0.5).min(0.008)
    }

    /// At which keys, of those up to the last, it is found what limbs shade of an image that is this loud, LSB: a limb's shadow
    /// moves a few centimetres in a frame, on what is a small part of the echo.
    pub(super) fn shade_keys(&self, loudness_lsb: f64, last: usize) -> Vec<usize> {
        if self.tolerance_db < 0.4 {
            (0..=last).collect()
        } else if loudness_lsb > 2.0 * LOUD * self.noise_lsb {
            vec![0, last]
        } else {
            vec![last / 2]
        }
    }

    /// Factor on what may be left out for half a decibel: beyond that it grows less than in proportion, for it adds to what
    /// integration misses, less in more, for below that it is most of what is missed.
    fn laxity(&self) -> f64 {
        let part = self.tolerance_db / 0.5;
        part.powf(if part > 1.0 { 0.5 } else { 1.8 })
    }
}

/// Error of a skin's echoes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Missed {
    /// By cubics between keys, relative to the loudest pair's field: what leaving out every second key misses, over 16.
    pub between_keys: f64,
    /// By windows and places, relative to that field: how far it is from a coarser one ([`IntegrationSettings::coarser`]), by path length,
    /// of which the part of all directions is counted that lies beyond the finer window.
    pub by_integration: f64,
    /// Power of the pairs and patches that are left out, over that of a cell's noise.
    pub left_out: f64,
}

impl Missed {
    /// Greater error of two people's.
    pub fn max(self, other: Self) -> Self {
        Missed {
            between_keys: self.between_keys.max(other.between_keys),
            by_integration: self.by_integration.max(other.by_integration),
            left_out: self.left_out.max(other.left_out),
        }
    }

    /// Converts to an error, dB, rms over the cells in which echoes stand above noise: a relative part is missed of all of
    /// them, and what is left out is as loud in weak cells as in strong ones.
    pub fn db(&self) -> f64 {
        /// Cells of a map over which a walker is spread above noise, and the mean of noise over echo in them: 170 to 205, and
        /// 0.23, in the frames of a corridor.
        const CELLS: f64 = 190.0;
        const NOISE_OVER_ECHO: f64 = 0.23;
        let relative = 20.0 * self.between_keys.hypot(self.by_integration).ln_1p() / std::f64::consts::LN_10;
        // Half of a small addition is in phase or against it: 20 / ln 10 of that, by its root mean square.
        let left_out = 8.686 * (0.5 * self.left_out / CELLS * NOISE_OVER_ECHO).sqrt();
        relative.hypot(left_out)
    }
}
