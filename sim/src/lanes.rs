//! Sixteen numbers side by side: loops over them are plain Rust, which is compiled once more for each set of instructions
//! ([`compiled_for_levels`]) without fusing multiply and add, so that every level computes the same bits.

/// Numbers side by side.
pub const LANES: usize = 16;

/// As many numbers as there are lanes.
pub type Row = [f32; LANES];

/// A vector in every lane: `[axis][lane]`.
pub type Row3 = [Row; 3];

/// A function that has the body of another, an `#[inline(always)]` one, compiled for the level of instructions that its first
/// argument names (which the processor must have).
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
                // SAFETY: a level is only ever one that the processor has.
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

/// Cosine and sine of so many turns, to three millionths: the half angle's best polynomials, and their doubling.
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

/// The vector of one lane.
#[inline(always)]
pub fn lane(of: &Row3, l: usize) -> [f32; 3] {
    // Written out, as in all kernels: `map` over an array is not always compiled into its caller.
    [of[0][l], of[1][l], of[2][l]]
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
mod tests {
    use super::*;

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
