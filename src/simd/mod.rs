//! The processor's widest vectors, chosen when the program runs.
//!
//! A kernel is written once, in plain Rust over rows of eight values, and compiled once for each
//! [`Level`]. The levels differ in the width of the registers and in nothing else: no multiplication is
//! fused with an addition on any of them (Rust never does so by itself), and every sum has one order.
//! So a frame has the same bytes on every processor, and the baseline is the scalar twin that the tests
//! hold the others to.
//!
//! ```text
//!   dispatch(kernel) ──┬─ Avx512    16 values an instruction, masks in registers of their own
//!                      ├─ Avx2       8
//!                      └─ Baseline   4 on x86-64 (SSE2) and on aarch64 (NEON)
//! ```
//!
//! This is the only module with unsafe code: calling a function that was compiled for more than the
//! baseline is safe only after the processor was asked.

use std::sync::OnceLock;

/// Which instructions kernels may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// What every processor of the architecture has.
    Baseline,
    /// x86-64 with AVX2.
    Avx2,
    /// x86-64 with the AVX-512 of server processors since 2017 (F, BW, DQ, VL).
    Avx512,
}

impl Level {
    /// All levels, the plainest first.
    pub const ALL: [Level; 3] = [Level::Baseline, Level::Avx2, Level::Avx512];

    /// The name by which [`LEVEL_VARIABLE`] and reports know it.
    pub fn name(self) -> &'static str {
        match self {
            Level::Baseline => "baseline",
            Level::Avx2 => "avx2",
            Level::Avx512 => "avx512",
        }
    }

    /// Whether this processor can run it.
    pub fn is_available(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = || {
                is_x86_feature_detected!("avx2")
                    && is_x86_feature_detected!("bmi1")
                    && is_x86_feature_detected!("bmi2")
                    && is_x86_feature_detected!("lzcnt")
                    && is_x86_feature_detected!("popcnt")
                    && is_x86_feature_detected!("f16c")
            };
            match self {
                Level::Baseline => true,
                Level::Avx2 => avx2(),
                Level::Avx512 => {
                    avx2()
                        && is_x86_feature_detected!("avx512f")
                        && is_x86_feature_detected!("avx512bw")
                        && is_x86_feature_detected!("avx512dq")
                        && is_x86_feature_detected!("avx512vl")
                }
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            self == Level::Baseline
        }
    }

    /// The widest level of this processor, or the one that [`LEVEL_VARIABLE`] names if that is narrower.
    pub fn current() -> Level {
        static CURRENT: OnceLock<Level> = OnceLock::new();
        *CURRENT.get_or_init(|| {
            let asked = std::env::var(LEVEL_VARIABLE).ok();
            let most = Level::ALL
                .into_iter()
                .find(|level| asked.as_deref() == Some(level.name()))
                .unwrap_or(Level::Avx512);
            Level::ALL
                .into_iter()
                .rev()
                .find(|level| *level <= most && level.is_available())
                .unwrap_or(Level::Baseline)
        })
    }
}

/// The environment variable that holds kernels to a narrower level: to show that the bytes are the same.
pub const LEVEL_VARIABLE: &str = "MENISCUS_SIMD";

/// A piece of work that is compiled for each level.
///
/// `run`, and all that is called from it in a loop, must be `#[inline(always)]`: only what is inlined
/// into the level's entry is compiled for that level.
pub trait Kernel {
    /// What it returns.
    type Output;

    /// Does the work.
    fn run(self) -> Self::Output;
}

/// Runs a kernel at [`Level::current`].
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    dispatch_at(Level::current(), kernel)
}

/// Runs a kernel at this level, or at the baseline where the processor lacks it.
#[inline]
#[allow(unsafe_code, reason = "the call that the processor was asked about")]
pub fn dispatch_at<K: Kernel>(level: Level, kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    {
        // Asking is a load of a cached word: nothing beside a leaf's work.
        if level == Level::Avx512 && level.is_available() {
            // SAFETY: the processor has every feature that the function is compiled for.
            return unsafe { x86::run_avx512(kernel) };
        }
        if level >= Level::Avx2 && Level::Avx2.is_available() {
            // SAFETY: as above.
            return unsafe { x86::run_avx2(kernel) };
        }
    }
    let _ = level;
    kernel.run()
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Kernel;

    #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt,f16c")]
    pub(super) fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
        kernel.run()
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,bmi1,bmi2,lzcnt,popcnt,f16c")]
    pub(super) fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
        kernel.run()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [f32]);

    impl Kernel for Sum<'_> {
        type Output = [f32; 8];

        #[inline(always)]
        fn run(self) -> [f32; 8] {
            self.0.as_chunks::<8>().0.iter().fold([0.0; 8], |sum, row| {
                // A product and a sum that would round differently if they were one operation.
                std::array::from_fn(|z| sum[z] * 0.999_999 + row[z] * row[z])
            })
        }
    }

    #[test]
    fn every_level_gives_the_same_bits() {
        let values: Vec<f32> = (0..4096).map(|i| (i as f32 * 0.7).sin() * 1.7).collect();
        let baseline = Sum(&values).run().map(f32::to_bits);
        for level in Level::ALL {
            assert_eq!(dispatch_at(level, Sum(&values)).map(f32::to_bits), baseline, "{level:?}");
        }
    }
}
