//! Kernels on rows of sixteen numbers in single precision, or eight in double precision.
//!
//! The loops over lanes are plain Rust and are compiled once for each instruction set ([`compiled_for_levels`]).
//! Multiply and add are never fused, so every level computes the same bits.

pub mod vector;

/// Number of lanes in single precision.
pub const LANES: usize = 16;

/// One number for each lane.
pub type Row = [f32; LANES];

/// A vector in every lane: `[axis][lane]`.
pub type Row3 = [Row; 3];

/// Number of lanes in double precision.
pub const WIDE: usize = 8;

/// One number in double precision for each lane.
pub type WideRow = [f64; WIDE];

/// A vector in double precision in every lane: `[axis][lane]`.
pub type WideRow3 = [WideRow; 3];

/// Defines a function that is compiled once for each instruction level. Its body is another function, which must be
/// `#[inline(always)]`. The first argument selects the level, and the processor must support it.
///
/// A [`radome_dsp::KernelLevel`] may name any level, and a check in every call would cost too much. Therefore functions
/// of this macro are never public, and this crate takes levels from `KernelLevel::detect`.
macro_rules! compiled_for_levels {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? = $body:path;) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name(level: radome_dsp::KernelLevel, $($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            #[allow(clippy::too_many_arguments)]
            fn avx2($($arg: $ty),*) $(-> $ret)? {
                $body($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl")]
            #[allow(clippy::too_many_arguments)]
            fn avx512($($arg: $ty),*) $(-> $ret)? {
                $body($($arg),*)
            }
            match level {
                radome_dsp::KernelLevel::Portable => $body($($arg),*),
                // SAFETY: the level was detected; no other crate can call this function.
                #[cfg(target_arch = "x86_64")]
                radome_dsp::KernelLevel::Avx2 => unsafe { avx2($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                radome_dsp::KernelLevel::Avx512 => unsafe { avx512($($arg),*) },
                #[cfg(not(target_arch = "x86_64"))]
                radome_dsp::KernelLevel::Avx2 | radome_dsp::KernelLevel::Avx512 => $body($($arg),*),
            }
        }
    };
}
pub(crate) use compiled_for_levels;

/// Cosine and sine of an angle in turns, with an error below 3e-6. Best polynomials give those of the half angle, which
/// is then doubled.
#[inline(always)]
pub fn cos_sin_of_turns(turns: f32) -> (f32, f32) {
    /// 1.5 times 2^23: adding it leaves the nearest integer in a number's last bits.
    const SHIFT: f32 = 12_582_912.0;
    let y = turns - ((turns + SHIFT) - SHIFT);
    let z = y * y;
    let sine = y * (3.141_582 + z * (-5.167_143 + z * (2.541_899 - z * 0.554_636_2)));
    let cosine = 1.0 + z * (-4.934_793 + z * (4.058_412 + z * (-1.331_880_2 + z * 0.219_696_8)));
    (1.0 - 2.0 * sine * sine, 2.0 * sine * cosine)
}

/// Natural logarithm of a positive normal number, with an absolute or relative error of 1e-15.
#[inline(always)]
pub fn ln(x: f64) -> f64 {
    /// Bits of the root of 1/2, the lower limit of the reduced mantissa.
    const LEAST: u64 = 0x3FE6_A09E_667F_3BCD;
    /// Bits of 2^52: OR with an integer in the last bits gives 2^52 plus that integer.
    const INTEGER: u64 = 0x4330_0000_0000_0000;
    let bits = x.to_bits().wrapping_add(0x3FF0_0000_0000_0000 - LEAST);
    let exponent = f64::from_bits((bits >> 52) | INTEGER) - (4_503_599_627_370_496.0 + 1023.0);
    let mantissa = f64::from_bits((bits & 0x000F_FFFF_FFFF_FFFF) + LEAST);
    let y = (mantissa - 1.0) / (mantissa + 1.0);
    let z = y * y;
    // The series is written out, as all series are: a loop within a lane prevents vectorisation over lanes.
    let high = 1.0 / 11.0 + z * (1.0 / 13.0 + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z * (1.0 / 19.0))));
    let sum = 1.0 + z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0 + z * high))));
    exponent * std::f64::consts::LN_2 + 2.0 * y * sum
}

/// Exponential, with a relative error of 1e-14, of numbers within 700 of zero; others are clamped to that range.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    /// 1.5 times 2^52: adding it leaves the nearest integer in a number's last bits.
    const SHIFT: f64 = 6_755_399_441_055_744.0;
    /// Parts of the logarithm of 2: products of integers with the first are exact.
    const LN_2: [f64; 2] = [0.693_147_180_369_123_8, 1.908_214_929_270_587_7e-10];
    let x = x.clamp(-700.0, 700.0);
    let shifted = x * std::f64::consts::LOG2_E + SHIFT;
    let whole = shifted - SHIFT;
    let rest = (x - whole * LN_2[0]) - whole * LN_2[1];
    let high = 1.0 / 40_320.0 + rest * (1.0 / 362_880.0 + rest * (1.0 / 3_628_800.0 + rest * (1.0 / 39_916_800.0)));
    let middle = 1.0 / 24.0 + rest * (1.0 / 120.0 + rest * (1.0 / 720.0 + rest * (1.0 / 5040.0 + rest * high)));
    let sum = 1.0 + rest * (1.0 + rest * (0.5 + rest * (1.0 / 6.0 + rest * middle)));
    sum * f64::from_bits((shifted.to_bits() << 52).wrapping_add(1f64.to_bits()))
}

/// The vector of one lane, in double precision.
#[inline(always)]
pub fn wide_lane(rows: &WideRow3, l: usize) -> [f64; 3] {
    [rows[0][l], rows[1][l], rows[2][l]]
}

/// The vector of one lane.
#[inline(always)]
pub fn lane(rows: &Row3, l: usize) -> [f32; 3] {
    // The elements are written out, as in all kernels: the compiler does not always inline `map` over an array.
    [rows[0][l], rows[1][l], rows[2][l]]
}

/// Dot product in every lane.
#[inline(always)]
pub fn dot(a: &Row3, b: &Row3) -> Row {
    let mut products = [0.0; LANES];
    for (l, product) in products.iter_mut().enumerate() {
        *product = a[0][l] * b[0][l] + a[1][l] * b[1][l] + a[2][l] * b[2][l];
    }
    products
}

#[cfg(test)]
pub(crate) mod tests {
    use radome_dsp::KernelLevel;

    use super::*;

    /// Asserts that a function gives the same with every instruction set of this processor.
    pub(crate) fn assert_same_at_every_level<T: PartialEq>(compute: impl Fn(KernelLevel) -> T) {
        let portable = compute(KernelLevel::Portable);
        for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
            assert!(compute(level) == portable, "{level}");
        }
    }

    #[test]
    fn logarithms_and_exponentials_are_those_of_the_library() {
        for i in -6990..=6990 {
            let x = 0.1 * f64::from(i);
            assert!((exp(x) / x.exp() - 1.0).abs() < 3e-14, "{x}: {}", exp(x));
            assert!((ln(x.exp()) - x).abs() < 1e-14 * x.abs().max(1.0), "{x}: {}", ln(x.exp()));
            let near_one = 1.0 + 1e-4 * f64::from(i);
            assert!((ln(near_one) - near_one.ln()).abs() < 1e-14, "{near_one}");
        }
        assert_eq!((ln(1.0), exp(0.0)), (0.0, 1.0));
        assert!((ln(f64::MIN_POSITIVE) + 708.396_418_532_264_1).abs() < 1e-12);
        assert!(exp(-1e9) < 1e-300);
    }

    #[test]
    fn cosines_and_sines_are_right_over_many_turns() {
        for i in -4000..4000 {
            let turns = i as f32 * 0.01371;
            let (cosine, sine) = cos_sin_of_turns(turns);
            let (s, c) = (f64::from(turns) * std::f64::consts::TAU).sin_cos();
            assert!((f64::from(cosine) - c).abs() < 3e-6 && (f64::from(sine) - s).abs() < 3e-6, "{turns}");
        }
    }
}
