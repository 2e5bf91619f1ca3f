//! The adaptive integrator: explicit steps as large as stability allows (paper, §3.5). They have the same
//! total pseudo-time, and so the same surface, in fewer steps.

use meniscus_surface::smooth::{Integrator, SmoothConfig, SmoothSteps, smooth};

use crate::shapes::{ball_with_finger, bending_energy, default_config, rasterized, sheet_and_drops, voxels};

/// Number of steps for 5 h⁴ if all steps are as large as stability allows: 0.0125 h⁴.
const FEWEST_STEPS: usize = 400;

#[test]
fn adaptive_steps_give_the_result_of_explicit_ones() {
    for positions in [ball_with_finger(), sheet_and_drops()] {
        let smoothed = |config: SmoothConfig| {
            let (mut band, bounds) = rasterized(&positions);
            let report = smooth(&mut band, &bounds, &config, &mut |_| {});
            assert_eq!(bounds.violation_count(&band.phi), 0);
            (band, report)
        };
        let (explicit, many) = smoothed(default_config(Integrator::Explicit));
        let (adaptive, fewer) = smoothed(default_config(Integrator::Adaptive));
        assert_eq!(many.pass_count, 500);
        assert!((FEWEST_STEPS..450).contains(&fewer.pass_count), "{fewer:?}");
        assert_eq!((fewer.reach_voxels, fewer.cfl_exceeded_count), (None, 0));
        assert!(
            fewer.voxel_update_count < many.voxel_update_count
                && fewer.free_voxel_count == many.free_voxel_count
        );
        let near = voxels(&explicit).zip(voxels(&adaptive)).filter(|((_, phi), _)| phi.abs() < 1.0);
        let (mut sum, mut count, mut worst) = (0.0, 0.0, 0.0f32);
        for ((_, one), (_, other)) in near {
            sum += (one - other).abs();
            count += 1.0;
            worst = worst.max((one - other).abs());
        }
        assert!(sum / count < 1e-3 && worst < 0.05, "{} {worst}", sum / count);
        let [one, other] = [&explicit, &adaptive].map(bending_energy);
        assert!((one / other - 1.0).abs() < 1e-3, "{one} {other}");
    }
}

/// Only the total pseudo-time affects the result, also if the given steps would be unstable.
#[test]
fn total_time_is_the_number_of_steps_times_their_size() {
    let (start, bounds) = rasterized(&ball_with_finger());
    let smoothed = |steps, step_size, redistance_every| {
        let config = default_config(Integrator::Adaptive);
        let steps = SmoothSteps { steps, step_size, redistance_every, ..config.smoothing };
        let config = SmoothConfig { smoothing: steps, ..config };
        let mut band = start.clone();
        let report = smooth(&mut band, &bounds, &config, &mut |_| {});
        (bending_energy(&band), report.pass_count)
    };
    let (energy, count) = smoothed(64, 1.0 / 64.0, 32);
    assert_eq!((energy, count), smoothed(2, 0.5, 1));
    assert_eq!(count, 80);
    let (longer, count) = smoothed(4, 0.5, 1);
    assert!(longer < energy && count == 160);
    assert_eq!(smoothed(0, 0.5, 1).1, 0);
}
