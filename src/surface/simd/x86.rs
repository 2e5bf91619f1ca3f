//! Rows in AVX2 registers, and the entry points compiled for more than the baseline.
#![allow(unsafe_code, reason = "AVX intrinsics: only the entry points use this type")]

use std::arch::x86_64::*;

use super::Kernel;
use super::lanes::Lanes;

/// Runs a kernel with AVX2.
///
/// # Safety
/// The processor must have the features that the function enables.
#[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt,f16c")]
pub(super) fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Ymm>()
}

/// Runs a kernel with AVX2 and the masks and additional registers of AVX-512.
///
/// # Safety
/// The processor must have the features that the function enables.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,bmi1,bmi2,lzcnt,popcnt,f16c")]
pub(super) fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Ymm>()
}

/// A row in an AVX register. Only the entry points above use this type, so the processor supports it.
#[derive(Clone, Copy)]
struct Ymm(__m256);

/// An operation on registers.
macro_rules! ymm {
    ($operation:expr) => {
        // SAFETY: the entry points are the only callers, and the processor has the features they are compiled
        // for.
        Ymm(unsafe { $operation })
    };
}

impl Lanes for Ymm {
    type Mask = __m256;

    #[inline(always)]
    fn load(row: &[f32; 8]) -> Ymm {
        ymm!(_mm256_loadu_ps(row.as_ptr()))
    }

    #[inline(always)]
    fn splat(value: f32) -> Ymm {
        ymm!(_mm256_set1_ps(value))
    }

    #[inline(always)]
    fn store(self, row: &mut [f32; 8]) {
        // SAFETY: as in `ymm!`; the row is as long as the register.
        unsafe { _mm256_storeu_ps(row.as_mut_ptr(), self.0) }
    }

    #[inline(always)]
    fn add(self, other: Ymm) -> Ymm {
        ymm!(_mm256_add_ps(self.0, other.0))
    }

    #[inline(always)]
    fn sub(self, other: Ymm) -> Ymm {
        ymm!(_mm256_sub_ps(self.0, other.0))
    }

    #[inline(always)]
    fn mul(self, other: Ymm) -> Ymm {
        ymm!(_mm256_mul_ps(self.0, other.0))
    }

    #[inline(always)]
    fn div(self, other: Ymm) -> Ymm {
        ymm!(_mm256_div_ps(self.0, other.0))
    }

    #[inline(always)]
    fn sqrt(self) -> Ymm {
        ymm!(_mm256_sqrt_ps(self.0))
    }

    #[inline(always)]
    fn abs(self) -> Ymm {
        ymm!(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0))
    }

    #[inline(always)]
    fn copysign(self, sign: Ymm) -> Ymm {
        ymm!({
            let sign_bit = _mm256_set1_ps(-0.0);
            _mm256_or_ps(_mm256_andnot_ps(sign_bit, self.0), _mm256_and_ps(sign_bit, sign.0))
        })
    }

    #[inline(always)]
    fn min(self, other: Ymm) -> Ymm {
        ymm!(_mm256_min_ps(self.0, other.0))
    }

    #[inline(always)]
    fn max(self, other: Ymm) -> Ymm {
        ymm!(_mm256_max_ps(self.0, other.0))
    }

    #[inline(always)]
    fn lt(self, other: Ymm) -> __m256 {
        ymm!(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)).0
    }

    #[inline(always)]
    fn ne(self, other: Ymm) -> __m256 {
        ymm!(_mm256_cmp_ps::<_CMP_NEQ_UQ>(self.0, other.0)).0
    }

    #[inline(always)]
    fn mask(bits: u8) -> __m256 {
        ymm!({
            let of_lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let set = _mm256_and_si256(_mm256_set1_epi32(i32::from(bits)), of_lane);
            _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, of_lane))
        })
        .0
    }

    #[inline(always)]
    fn bits(mask: __m256) -> u8 {
        // SAFETY: as in `ymm!`.
        (unsafe { _mm256_movemask_ps(mask) }) as u8
    }

    #[inline(always)]
    fn both(one: __m256, other: __m256) -> __m256 {
        ymm!(_mm256_and_ps(one, other)).0
    }

    #[inline(always)]
    fn not(mask: __m256) -> __m256 {
        ymm!(_mm256_xor_ps(mask, _mm256_castsi256_ps(_mm256_set1_epi32(-1)))).0
    }

    #[inline(always)]
    fn select(mask: __m256, then: Ymm, otherwise: Ymm) -> Ymm {
        ymm!(_mm256_blendv_ps(otherwise.0, then.0, mask))
    }

    #[inline(always)]
    fn shift_up(self, first: f32) -> Ymm {
        ymm!({
            let rotated = _mm256_permutevar8x32_ps(self.0, _mm256_setr_epi32(7, 0, 1, 2, 3, 4, 5, 6));
            _mm256_blend_ps::<0x01>(rotated, _mm256_set1_ps(first))
        })
    }

    #[inline(always)]
    fn shift_down(self, last: f32) -> Ymm {
        ymm!({
            let rotated = _mm256_permutevar8x32_ps(self.0, _mm256_setr_epi32(1, 2, 3, 4, 5, 6, 7, 0));
            _mm256_blend_ps::<0x80>(rotated, _mm256_set1_ps(last))
        })
    }
}
