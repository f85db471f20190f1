//! Buffers whose values are all overwritten.

/// An array for a layer's result with arbitrary values, all of which the layer overwrites: filling tens of megabytes with zeros
/// first would take as long as many a layer.
#[allow(clippy::uninit_vec)]
pub(crate) fn unwritten(length: usize) -> Vec<f32> {
    if cfg!(miri) || !cfg!(any(target_arch = "x86_64", target_arch = "aarch64")) {
        return vec![0.0; length];
    }
    let mut values = Vec::<f32>::with_capacity(length);
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    // SAFETY: the capacity is `length`, and any bits are an f32. The assembly stands for code that writes arbitrary bits to the
    // whole block, of which leaving what is there is one way; the compiler has to assume such writes, so that the block is
    // initialised behind it.
    unsafe {
        std::arch::asm!("/* {} */", in(reg) values.as_mut_ptr(), options(nostack, preserves_flags));
        values.set_len(length);
    }
    values
}
