//! Allocation of buffers without initialisation.

/// Allocates an array for a layer's result. Its values are arbitrary, and the layer overwrites them. Filling tens of megabytes with
/// zeros would take as long as some layers.
#[allow(clippy::uninit_vec)]
pub(crate) fn uninitialised(length: usize) -> Vec<f32> {
    if cfg!(miri) || !cfg!(any(target_arch = "x86_64", target_arch = "aarch64")) {
        return vec![0.0; length];
    }
    let mut values = Vec::<f32>::with_capacity(length);
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    // SAFETY: the capacity is `length`, and any bits are a valid f32. For the compiler, the assembly may have written the whole
    // block, so the block counts as initialised.
    unsafe {
        std::arch::asm!("/* {} */", in(reg) values.as_mut_ptr(), options(nostack, preserves_flags));
        values.set_len(length);
    }
    values
}
