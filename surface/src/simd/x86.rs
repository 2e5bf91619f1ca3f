//! Rows in AVX registers, and the entry points compiled for more than the baseline.
#![allow(unsafe_code, reason = "AVX intrinsics: only the entry points use this type")]

use std::arch::x86_64::*;

use super::lanes::{Lanes, Vector};
use super::{Kernel, WideKernel};

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

/// Runs a kernel with AVX-512, two rows at a time.
///
/// # Safety
/// The processor must have the features that the function enables.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,bmi1,bmi2,lzcnt,popcnt,f16c")]
pub(super) fn run_avx512_wide<K: WideKernel>(kernel: K) -> K::Output {
    kernel.run::<Zmm>()
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

/// Methods that apply an instruction to two registers.
macro_rules! binary {
    ($on_registers:ident: $($name:ident = $instruction:ident,)+) => {
        $(
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                $on_registers!($instruction(self.0, other.0))
            }
        )+
    };
}

impl Lanes for Ymm {
    #[inline(always)]
    fn store(self, row: &mut [f32; 8]) {
        // SAFETY: as in `ymm!`; the row is as long as the register.
        unsafe { _mm256_storeu_ps(row.as_mut_ptr(), self.0) }
    }
}

impl Vector for Ymm {
    type Mask = __m256;

    const ROWS: usize = 1;

    #[inline(always)]
    fn from_rows<'a>(row: impl Fn(usize) -> &'a [f32; 8]) -> Ymm {
        let row = row(0);
        ymm!(_mm256_loadu_ps(row.as_ptr()))
    }

    #[inline(always)]
    fn load_at(rows: &[[f32; 8]; 8], y: usize) -> Ymm {
        Ymm::load(&rows[y & 7])
    }

    #[inline(always)]
    fn store_at(self, rows: &mut [[f32; 8]; 8], y: usize) {
        self.store(&mut rows[y & 7]);
    }

    #[inline(always)]
    fn splat(value: f32) -> Ymm {
        ymm!(_mm256_set1_ps(value))
    }

    binary! {
        ymm:
        add = _mm256_add_ps,
        sub = _mm256_sub_ps,
        mul = _mm256_mul_ps,
        div = _mm256_div_ps,
        min = _mm256_min_ps,
        max = _mm256_max_ps,
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
    fn lt(self, other: Ymm) -> __m256 {
        ymm!(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)).0
    }

    #[inline(always)]
    fn ne(self, other: Ymm) -> __m256 {
        ymm!(_mm256_cmp_ps::<_CMP_NEQ_UQ>(self.0, other.0)).0
    }

    #[inline(always)]
    fn mask_at(rows: u64, y: usize) -> __m256 {
        let bits = (rows >> (8 * (y & 7))) as u8;
        ymm!({
            let of_lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let set = _mm256_and_si256(_mm256_set1_epi32(i32::from(bits)), of_lane);
            _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, of_lane))
        })
        .0
    }

    #[inline(always)]
    fn row_bits(mask: __m256) -> u64 {
        // SAFETY: as in `ymm!`.
        u64::from((unsafe { _mm256_movemask_ps(mask) }) as u8)
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
    fn shift_rows_up(self, first: impl Fn(usize) -> f32) -> Ymm {
        let first = first(0);
        ymm!({
            let rotated = _mm256_permutevar8x32_ps(self.0, _mm256_setr_epi32(7, 0, 1, 2, 3, 4, 5, 6));
            _mm256_blend_ps::<0x01>(rotated, _mm256_set1_ps(first))
        })
    }

    #[inline(always)]
    fn shift_rows_down(self, last: impl Fn(usize) -> f32) -> Ymm {
        let last = last(0);
        ymm!({
            let rotated = _mm256_permutevar8x32_ps(self.0, _mm256_setr_epi32(1, 2, 3, 4, 5, 6, 7, 0));
            _mm256_blend_ps::<0x80>(rotated, _mm256_set1_ps(last))
        })
    }
}

/// Two rows in an AVX-512 register. Only `run_avx512_wide` uses this type, so the processor supports it.
#[derive(Clone, Copy)]
struct Zmm(__m512);

/// An operation on registers.
macro_rules! zmm {
    ($operation:expr) => {
        // SAFETY: as in `ymm!`.
        Zmm(unsafe { $operation })
    };
}

impl Vector for Zmm {
    type Mask = __mmask16;

    const ROWS: usize = 2;

    #[inline(always)]
    fn from_rows<'a>(row: impl Fn(usize) -> &'a [f32; 8]) -> Zmm {
        let [first, second] = [row(0), row(1)];
        zmm!({
            let first = _mm512_castps256_ps512(_mm256_loadu_ps(first.as_ptr()));
            _mm512_insertf32x8::<1>(first, _mm256_loadu_ps(second.as_ptr()))
        })
    }

    #[inline(always)]
    fn load_at(rows: &[[f32; 8]; 8], y: usize) -> Zmm {
        let both: &[[f32; 8]; 2] = &rows.as_chunks().0[(y >> 1) & 3];
        zmm!(_mm512_loadu_ps(both.as_flattened().as_ptr()))
    }

    #[inline(always)]
    fn store_at(self, rows: &mut [[f32; 8]; 8], y: usize) {
        let both: &mut [[f32; 8]; 2] = &mut rows.as_chunks_mut().0[(y >> 1) & 3];
        // SAFETY: as in `ymm!`; the rows are as long as the register.
        unsafe { _mm512_storeu_ps(both.as_flattened_mut().as_mut_ptr(), self.0) }
    }

    #[inline(always)]
    fn splat(value: f32) -> Zmm {
        zmm!(_mm512_set1_ps(value))
    }

    binary! {
        zmm:
        add = _mm512_add_ps,
        sub = _mm512_sub_ps,
        mul = _mm512_mul_ps,
        div = _mm512_div_ps,
        min = _mm512_min_ps,
        max = _mm512_max_ps,
    }

    #[inline(always)]
    fn sqrt(self) -> Zmm {
        zmm!(_mm512_sqrt_ps(self.0))
    }

    #[inline(always)]
    fn abs(self) -> Zmm {
        zmm!(_mm512_andnot_ps(_mm512_set1_ps(-0.0), self.0))
    }

    #[inline(always)]
    fn copysign(self, sign: Zmm) -> Zmm {
        zmm!({
            let sign_bit = _mm512_set1_ps(-0.0);
            _mm512_or_ps(_mm512_andnot_ps(sign_bit, self.0), _mm512_and_ps(sign_bit, sign.0))
        })
    }

    #[inline(always)]
    fn lt(self, other: Zmm) -> __mmask16 {
        // SAFETY: as in `ymm!`.
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) }
    }

    #[inline(always)]
    fn ne(self, other: Zmm) -> __mmask16 {
        // SAFETY: as in `ymm!`.
        unsafe { _mm512_cmp_ps_mask::<_CMP_NEQ_UQ>(self.0, other.0) }
    }

    #[inline(always)]
    fn mask_at(rows: u64, y: usize) -> __mmask16 {
        (rows >> (8 * (y & 6))) as u16
    }

    #[inline(always)]
    fn row_bits(mask: __mmask16) -> u64 {
        u64::from(mask)
    }

    #[inline(always)]
    fn both(one: __mmask16, other: __mmask16) -> __mmask16 {
        one & other
    }

    #[inline(always)]
    fn not(mask: __mmask16) -> __mmask16 {
        !mask
    }

    #[inline(always)]
    fn select(mask: __mmask16, then: Zmm, otherwise: Zmm) -> Zmm {
        zmm!(_mm512_mask_blend_ps(mask, otherwise.0, then.0))
    }

    #[inline(always)]
    fn shift_rows_up(self, first: impl Fn(usize) -> f32) -> Zmm {
        let [first, second] = [first(0), first(1)];
        zmm!({
            let previous = _mm512_setr_epi32(7, 0, 1, 2, 3, 4, 5, 6, 15, 8, 9, 10, 11, 12, 13, 14);
            let rotated = _mm512_permutexvar_ps(previous, self.0);
            let with_first = _mm512_mask_broadcastss_ps(rotated, 1, _mm_set_ss(first));
            _mm512_mask_broadcastss_ps(with_first, 1 << 8, _mm_set_ss(second))
        })
    }

    #[inline(always)]
    fn shift_rows_down(self, last: impl Fn(usize) -> f32) -> Zmm {
        let [first, second] = [last(0), last(1)];
        zmm!({
            let next = _mm512_setr_epi32(1, 2, 3, 4, 5, 6, 7, 0, 9, 10, 11, 12, 13, 14, 15, 8);
            let rotated = _mm512_permutexvar_ps(next, self.0);
            let with_first = _mm512_mask_broadcastss_ps(rotated, 1 << 7, _mm_set_ss(first));
            _mm512_mask_broadcastss_ps(with_first, 1 << 15, _mm_set_ss(second))
        })
    }
}
