//! The processor's widest vectors, chosen when the program runs.
//!
//! A kernel is written once, over rows of eight values ([`Lanes`]), and compiled once for each
//! [`Level`]. The levels differ in the instructions and in nothing else: no multiplication is fused with an
//! addition on any of them, and every sum has one order. So a frame has the same bytes on every
//! processor, and the baseline is the plain twin that the tests hold the others to.
//!
//! ```text
//!   dispatch(kernel) ──┬─ Avx512     8 values an instruction, twice as many registers
//!                      ├─ Avx2       8
//!                      └─ Baseline   4 on x86-64 (SSE2) and on aarch64 (NEON)
//! ```
//!
//! In `surface` this is the only module with unsafe code: calling a function that was compiled for more than the
//! baseline is safe only after the processor was asked.

mod lanes;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::sync::OnceLock;

pub use lanes::Lanes;
use lanes::Portable;

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

/// What a user should know of [`LEVEL_VARIABLE`] where it does not do what it says; without full stop.
pub fn level_warning() -> Option<String> {
    let asked = std::env::var_os(LEVEL_VARIABLE)?;
    warning_of(&asked.to_string_lossy(), Level::current())
}

/// The warning where one level was asked for and another one is used. Nothing is asked for by nothing.
fn warning_of(asked: &str, used: Level) -> Option<String> {
    match Level::ALL.into_iter().find(|level| level.name() == asked) {
        Some(level) if level <= used => None,
        Some(_) => {
            Some(format!("{LEVEL_VARIABLE}={asked}: this processor lacks it, and {} is used", used.name()))
        }
        None if asked.is_empty() => None,
        None => {
            let [first, second, third] = Level::ALL.map(Level::name);
            Some(format!("{LEVEL_VARIABLE}={asked} is not {first}, {second} or {third}: it is ignored"))
        }
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

    /// Does the work, on rows in registers where `V` is of use.
    fn run<V: Lanes>(self) -> Self::Output;
}

/// Runs a kernel at [`Level::current`].
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    run_available(Level::current(), kernel)
}

/// Runs a kernel at this level, or at the baseline where the processor lacks it.
#[inline]
pub fn dispatch_at<K: Kernel>(level: Level, kernel: K) -> K::Output {
    run_available(if level.is_available() { level } else { Level::Baseline }, kernel)
}

/// Runs a kernel at a level that was found to be available: asking again for each leaf would show.
#[inline]
#[allow(unsafe_code, reason = "the calls that the processor was asked about")]
fn run_available<K: Kernel>(level: Level, kernel: K) -> K::Output {
    match level {
        // SAFETY: whoever calls has asked for every feature that the function is compiled for.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { x86::run_avx512(kernel) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { x86::run_avx2(kernel) },
        _ => kernel.run::<Portable>(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation of a row, on values that do and do not compare.
    struct Everything([[f32; 8]; 3]);

    impl Kernel for Everything {
        type Output = Vec<u32>;

        #[inline(always)]
        fn run<V: Lanes>(self) -> Vec<u32> {
            let [a, b, c] = [V::load(&self.0[0]), V::load(&self.0[1]), V::load(&self.0[2])];
            let (less, differs) = (a.lt(b), a.ne(c));
            let rows = [
                a.mul(b).add(c),
                a.sub(b),
                a.div(b),
                a.abs().sqrt(),
                a.copysign(c),
                a.min(b),
                a.max(b),
                V::select(less, a, b),
                V::select(V::both(less, differs), b, c),
                V::select(V::not(less), b, c),
                V::select(V::mask(0b1011_0010), a, V::splat(4.0)),
                a.shift_up(9.0),
                a.shift_down(-9.0),
            ];
            let mut stored = [0.0; 8];
            let mut all = vec![u32::from(V::bits(less)), u32::from(V::bits(differs))];
            for row in rows {
                row.store(&mut stored);
                // Which of several numbers that are not one it is, nobody promises.
                all.extend(stored.map(|value| if value.is_nan() { u32::MAX } else { value.to_bits() }));
            }
            all
        }
    }

    #[test]
    fn what_is_asked_for_in_vain_is_told() {
        for used in Level::ALL {
            for asked in Level::ALL {
                let warning = warning_of(asked.name(), used);
                assert_eq!(warning.is_some(), asked > used, "{asked:?} {used:?}");
                assert!(warning.is_none_or(|text| text.contains(used.name())), "{asked:?} {used:?}");
            }
            assert_eq!(warning_of("", used), None);
            let unknown = "MENISCUS_SIMD=xyz is not baseline, avx2 or avx512: it is ignored";
            assert_eq!(warning_of("xyz", used).as_deref(), Some(unknown));
        }
    }

    #[test]
    fn every_level_gives_the_same_bits() {
        let wave = |scale: f32| std::array::from_fn(|k| (k as f32 * scale).sin() * 1.7);
        let odd = [f32::NAN, f32::INFINITY, -0.0, 0.0, -f32::INFINITY, f32::MIN_POSITIVE, 1.0, -1.0];
        for rows in [
            [wave(0.7), wave(1.3), wave(2.9)],
            [odd, wave(0.7), odd],
            [wave(0.7), odd, wave(0.7)],
            [[0.0; 8], [-0.0; 8], odd],
        ] {
            let baseline = Everything(rows).run::<Portable>();
            for level in Level::ALL {
                assert_eq!(dispatch_at(level, Everything(rows)), baseline, "{level:?} {rows:?}");
            }
        }
    }
}
