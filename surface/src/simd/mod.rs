//! Runtime selection of the processor's widest vectors.
//!
//! A kernel is written once, over rows of eight values ([`Lanes`]) or over one or two such rows ([`Vector`]),
//! and compiled for each [`SimdLevel`].
//! Levels differ only in instructions: multiplications are never fused with additions, and every sum has a
//! fixed order. So a frame is bit-identical on every processor, and tests compare the other levels with the
//! baseline.
//!
//! ```text
//!   dispatch(kernel) ──┬─ Avx512     8 or 16 values per instruction, twice as many registers
//!                      ├─ Avx2       8
//!                      └─ Baseline   4 on x86-64 (SSE2) and on aarch64 (NEON)
//! ```
//!
//! This is the only module in `surface` with unsafe code: calling a function compiled for more than the
//! baseline is safe only after checking the processor's features.

mod lanes;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::sync::OnceLock;

use lanes::Portable;
pub use lanes::{Lanes, Vector, greatest};

use crate::cancel::checkpoint;

/// The instructions that kernels may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SimdLevel {
    /// Supported by every processor of the architecture.
    Baseline,
    /// x86-64 with AVX2.
    Avx2,
    /// x86-64 with the AVX-512 of server processors since 2017 (F, BW, DQ, VL).
    Avx512,
}

impl SimdLevel {
    /// All levels, from narrow to wide.
    pub const ALL: [SimdLevel; 3] = [SimdLevel::Baseline, SimdLevel::Avx2, SimdLevel::Avx512];

    /// Name in [`LEVEL_VARIABLE`] and in reports.
    pub fn name(self) -> &'static str {
        match self {
            SimdLevel::Baseline => "baseline",
            SimdLevel::Avx2 => "avx2",
            SimdLevel::Avx512 => "avx512",
        }
    }

    /// True if this processor supports the level.
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
                SimdLevel::Baseline => true,
                SimdLevel::Avx2 => avx2(),
                SimdLevel::Avx512 => {
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
            self == SimdLevel::Baseline
        }
    }

    /// The widest level of this processor, or the one in [`LEVEL_VARIABLE`] if that is narrower.
    pub fn current() -> SimdLevel {
        static CURRENT: OnceLock<SimdLevel> = OnceLock::new();
        *CURRENT.get_or_init(|| {
            let requested = std::env::var(LEVEL_VARIABLE).ok();
            let most = SimdLevel::ALL
                .into_iter()
                .find(|level| requested.as_deref() == Some(level.name()))
                .unwrap_or(SimdLevel::Avx512);
            SimdLevel::ALL
                .into_iter()
                .rev()
                .find(|level| *level <= most && level.is_available())
                .unwrap_or(SimdLevel::Baseline)
        })
    }
}

/// A warning for users if [`LEVEL_VARIABLE`] has no effect; without a full stop.
pub fn level_warning() -> Option<String> {
    let requested = std::env::var_os(LEVEL_VARIABLE)?;
    warning_of(&requested.to_string_lossy(), SimdLevel::current())
}

/// The warning if the requested level differs from the one used. An empty value requests nothing.
fn warning_of(requested: &str, used: SimdLevel) -> Option<String> {
    match SimdLevel::ALL.into_iter().find(|level| level.name() == requested) {
        Some(level) if level <= used => None,
        Some(_) => Some(format!(
            "{LEVEL_VARIABLE}={requested}: not supported by this processor, using {}",
            used.name()
        )),
        None if requested.is_empty() => None,
        None => {
            let [first, second, third] = SimdLevel::ALL.map(SimdLevel::name);
            Some(format!("{LEVEL_VARIABLE}={requested} is ignored: expected {first}, {second} or {third}"))
        }
    }
}

/// The environment variable that limits kernels to a narrower level, to verify that results are
/// bit-identical.
pub const LEVEL_VARIABLE: &str = "MENISCUS_SIMD";

/// A computation that is compiled for each level.
///
/// `run`, and all that it calls in a loop, must be `#[inline(always)]`: only code that is inlined into the
/// level's entry is compiled for that level.
pub trait Kernel {
    /// The result.
    type Output;

    /// Runs the computation, with rows in registers of type `V`.
    fn run<V: Lanes>(self) -> Self::Output;
}

/// A kernel that processes one row or two consecutive rows at a time, as registers permit. See [`Kernel`].
pub trait WideKernel {
    /// The result.
    type Output;

    /// Runs the computation, with rows in registers of type `V`.
    fn run<V: Vector>(self) -> Self::Output;
}

/// A wide kernel that processes one row at a time.
struct RowByRow<K>(K);

impl<K: WideKernel> Kernel for RowByRow<K> {
    type Output = K::Output;

    #[inline(always)]
    fn run<V: Lanes>(self) -> K::Output {
        self.0.run::<V>()
    }
}

/// Runs a kernel at [`SimdLevel::current`]. If the frame is cancelled, the call unwinds instead of returning.
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    checkpoint();
    run_available(SimdLevel::current(), kernel)
}

/// Runs a kernel at this level, or at the baseline if the processor does not support it. If the frame is
/// cancelled, the call unwinds instead of returning.
#[inline]
pub fn dispatch_at<K: Kernel>(level: SimdLevel, kernel: K) -> K::Output {
    checkpoint();
    run_available(if level.is_available() { level } else { SimdLevel::Baseline }, kernel)
}

/// Like [`dispatch`].
#[inline]
pub fn dispatch_wide<K: WideKernel>(kernel: K) -> K::Output {
    checkpoint();
    run_available_wide(SimdLevel::current(), kernel)
}

/// Like [`dispatch_at`].
#[cfg(test)]
pub fn dispatch_wide_at<K: WideKernel>(level: SimdLevel, kernel: K) -> K::Output {
    run_available_wide(if level.is_available() { level } else { SimdLevel::Baseline }, kernel)
}

/// Runs a wide kernel at an available level.
#[inline]
#[allow(unsafe_code, reason = "callers have checked the processor features")]
fn run_available_wide<K: WideKernel>(level: SimdLevel, kernel: K) -> K::Output {
    match level {
        // SAFETY: callers have checked every feature that the function is compiled for.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { x86::run_avx512_wide(kernel) },
        _ => run_available(level, RowByRow(kernel)),
    }
}

/// Runs a kernel at an available level. Does not check the processor again, because a check for each leaf
/// would take measurable time.
#[inline]
#[allow(unsafe_code, reason = "callers have checked the processor features")]
fn run_available<K: Kernel>(level: SimdLevel, kernel: K) -> K::Output {
    match level {
        // SAFETY: callers have checked every feature that the function is compiled for.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { x86::run_avx512(kernel) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { x86::run_avx2(kernel) },
        _ => kernel.run::<Portable>(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation on eight rows, with ordered and unordered values.
    struct Everything<'a>([&'a [[f32; 8]; 8]; 3]);

    impl WideKernel for Everything<'_> {
        type Output = Vec<u32>;

        #[inline(always)]
        fn run<V: Vector>(self) -> Vec<u32> {
            const RESULT_COUNT: usize = 14;
            let mut results = [[[0.0; 8]; 8]; RESULT_COUNT];
            let (mut less, mut differs, mut is_any_less) = (0, 0, false);
            for y in (0..8).step_by(V::ROWS) {
                let [a, b, c] = self.0.map(|rows| V::load_at(rows, y));
                let (is_less, is_different) = (a.lt(b), a.ne(c));
                let vectors: [V; RESULT_COUNT] = [
                    a.mul(b).add(c),
                    a.sub(b),
                    a.div(b),
                    a.abs().sqrt(),
                    a.copysign(c),
                    a.min(b),
                    a.max(b),
                    V::select(is_less, a, b),
                    V::select(V::both(is_less, is_different), b, c),
                    V::select(V::not(is_less), b, c),
                    V::select(V::mask_at(0x1234_5678_9abc_def0, y), a, V::splat(4.0)),
                    a.shift_rows_up(|row| (y + row) as f32),
                    a.shift_rows_down(|row| -((y + row) as f32)),
                    V::from_rows(|row| &self.0[0][7 - y - row]),
                ];
                for (vector, rows) in vectors.into_iter().zip(&mut results) {
                    vector.store_at(rows, y);
                }
                less |= V::row_bits(is_less) << (8 * y);
                differs |= V::row_bits(is_different) << (8 * y);
                is_any_less |= V::any(is_less);
            }
            let masks = [less, differs].into_iter().flat_map(|mask| [mask as u32, (mask >> 32) as u32]);
            // The bits of a NaN are not specified.
            let bits = |value: &f32| if value.is_nan() { u32::MAX } else { value.to_bits() };
            let values = results.as_flattened().as_flattened().iter().map(bits);
            masks.chain([u32::from(is_any_less)]).chain(values).collect()
        }
    }

    #[test]
    fn unavailable_or_unknown_level_gives_a_warning() {
        for used in SimdLevel::ALL {
            for requested in SimdLevel::ALL {
                let warning = warning_of(requested.name(), used);
                assert_eq!(warning.is_some(), requested > used, "{requested:?} {used:?}");
                assert!(warning.is_none_or(|text| text.contains(used.name())), "{requested:?} {used:?}");
            }
            assert_eq!(warning_of("", used), None);
            let unknown = "MENISCUS_SIMD=xyz is ignored: expected baseline, avx2 or avx512";
            assert_eq!(warning_of("xyz", used).as_deref(), Some(unknown));
        }
    }

    #[test]
    fn all_simd_levels_give_the_same_bits() {
        let wave = |scale: f32| std::array::from_fn(|k| (k as f32 * scale).sin() * 1.7);
        let odd = [f32::NAN, f32::INFINITY, -0.0, 0.0, -f32::INFINITY, f32::MIN_POSITIVE, 1.0, -1.0];
        let (slow, quick, zeros) = (wave(0.7), wave(2.9), [0.0; 8]);
        let of_rows = |rows: [[f32; 8]; 4]| std::array::from_fn(|y| rows[(y + y / 4) % 4]);
        let a = of_rows([slow, odd, slow, zeros]);
        let b = of_rows([wave(1.3), slow, odd, zeros.map(|zero| -zero)]);
        let c = of_rows([quick, odd, slow, odd]);
        let everything = || Everything([&a, &b, &c]);
        let baseline = RowByRow(everything()).run::<Portable>();
        for level in SimdLevel::ALL {
            assert_eq!(dispatch_at(level, RowByRow(everything())), baseline, "{level:?}");
            assert_eq!(dispatch_wide_at(level, everything()), baseline, "{level:?}, wide");
        }
    }

    #[test]
    fn one_row_is_loaded_stored_and_masked() {
        struct Negated<'a>(&'a mut [f32; 8], u8);

        impl Kernel for Negated<'_> {
            type Output = (u8, f32);

            #[inline(always)]
            fn run<V: Lanes>(self) -> (u8, f32) {
                let values = V::load(self.0);
                let negated = V::splat(0.0).sub(values);
                V::select(V::mask(self.1), negated, values).store(self.0);
                (V::bits(values.lt(V::splat(3.0))), greatest(values))
            }
        }

        for level in SimdLevel::ALL {
            let mut row = [2.0, 0.0, 5.0, 1.0, 3.0, 7.0, 6.0, 4.0];
            assert_eq!(dispatch_at(level, Negated(&mut row, 0b0000_0101)), (0b0000_1011, 7.0));
            assert_eq!(row, [-2.0, 0.0, -5.0, 1.0, 3.0, 7.0, 6.0, 4.0], "{level:?}");
        }
    }
}
