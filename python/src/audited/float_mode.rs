//! The floating-point mode of the threads that compute.
//!
//! A new thread inherits the mode of the thread that starts it. Some libraries, such as Taichi and everything
//! that GCC links with `-ffast-math`, make the processor replace denormal numbers by zero. With that mode, a
//! surface would differ in some bytes from the surface that the command line writes.

/// Sets the default mode for this thread: keep denormal numbers, round to nearest, mask all exceptions.
pub(crate) fn set_default() {
    #[cfg(target_arch = "x86_64")]
    {
        /// The value after a reset of the processor: all exceptions masked.
        const MXCSR_DEFAULT: u32 = 0x1F80;
        // SAFETY: reads four bytes of a constant. Rust code assumes the default mode, so no code can depend
        // on another mode.
        unsafe {
            std::arch::asm!("ldmxcsr [{}]", in(reg) &MXCSR_DEFAULT, options(readonly, nostack));
        }
    }
    #[cfg(target_arch = "aarch64")]
    // SAFETY: as above; zero is the default of the control register.
    unsafe {
        std::arch::asm!("msr fpcr, xzr", options(nomem, nostack));
    }
}
