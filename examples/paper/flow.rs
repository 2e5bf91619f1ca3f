//! Two flows that are known everywhere and at all times, and return a body to its initial position.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use rayon::prelude::*;

/// A velocity field in the unit cube, and the body that it carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flow {
    /// Stretches a sphere into a thin curved sheet, and then reverses.
    ///
    /// Douglas Enright, Ronald Fedkiw, Joel Ferziger, Ian Mitchell. A hybrid particle level set method for
    /// improved interface capturing. 2002
    Enright,
    /// Rotates a sphere with a notch once: radius 0.15, notch 0.05 wide and 0.125 deep.
    ///
    /// Steven T. Zalesak. Fully multidimensional flux-corrected transport algorithms for fluids. 1979; as a
    /// body in the work above
    Zalesak,
}

/// Number of integration steps between two frames. 16 times as many steps would change no position by more
/// than 10⁻⁹.
const STEPS: usize = 8;

impl Flow {
    /// Time until the body is back at its initial position.
    pub(crate) fn period(self) -> f64 {
        match self {
            Flow::Enright => 3.0,
            Flow::Zalesak => 1.0,
        }
    }

    /// The velocity at this position and time.
    fn velocity(self, at: DVec3, time: f64) -> DVec3 {
        match self {
            Flow::Enright => {
                let (once, twice) = (at * PI, at * TAU);
                let [sine, wave] = [once, twice].map(|angles| angles.map(f64::sin));
                let square = sine * sine;
                let amplitude = (PI * time / self.period()).cos();
                amplitude
                    * DVec3::new(
                        2.0 * square.x * wave.y * wave.z,
                        -wave.x * square.y * wave.z,
                        -wave.x * wave.y * square.z,
                    )
            }
            Flow::Zalesak => TAU * DVec3::new(0.5 - at.y, at.x - 0.5, 0.0),
        }
    }

    /// Carries points from one time to another, by the classical Runge-Kutta method.
    pub(crate) fn carry(self, points: &mut [DVec3], from: f64, to: f64) {
        let step = (to - from) / STEPS as f64;
        points.par_iter_mut().for_each(|point| {
            for index in 0..STEPS {
                let time = from + step * index as f64;
                let first = self.velocity(*point, time);
                let second = self.velocity(*point + 0.5 * step * first, time + 0.5 * step);
                let third = self.velocity(*point + 0.5 * step * second, time + 0.5 * step);
                let last = self.velocity(*point + step * third, time + step);
                *point += step / 6.0 * (first + 2.0 * (second + third) + last);
            }
        });
    }

    /// Signed distance to the initial body: negative inside.
    pub(crate) fn distance(self, at: DVec3) -> f64 {
        let sphere = |center: DVec3, radius: f64| at.distance(center) - radius;
        match self {
            Flow::Enright => sphere(DVec3::splat(0.35), 0.15),
            Flow::Zalesak => {
                let center = DVec3::new(0.5, 0.75, 0.5);
                let across = (at.x - center.x).abs() - 0.025;
                let above = at.y - (center.y - 0.025);
                let notch = across.max(above);
                sphere(center, 0.15).max(-notch)
            }
        }
    }

    /// A point on the surface of the initial body that is near to this one.
    pub(crate) fn nearest(self, mut at: DVec3) -> DVec3 {
        const STEP: f64 = 1e-6;
        // One iteration is exact, except near edges of the body.
        for _ in 0..4 {
            let slope = |axis: DVec3| self.distance(at + STEP * axis) - self.distance(at - STEP * axis);
            let outward = DVec3::from(DVec3::AXES.map(slope)).normalize_or_zero();
            at -= self.distance(at) * outward;
        }
        at
    }

    /// A box around the initial body.
    pub(crate) fn bounds(self) -> [DVec3; 2] {
        let center = match self {
            Flow::Enright => DVec3::splat(0.35),
            Flow::Zalesak => DVec3::new(0.5, 0.75, 0.5),
        };
        [center - 0.15, center + 0.15]
    }
}
