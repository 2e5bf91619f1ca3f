//! The camera of a sequence whose frames are not all known yet: it stays while frames fit into the picture,
//! and is refitted when one does not.
//!
//! ```text
//!   frame in the picture      ─▶ the camera stays
//!   frame would be cropped    ─▶ refit around the previous bounds and the frame, with a margin where it grew
//! ```
//!
//! The margin makes refits rare: a splash that keeps growing causes a refit only each time it has grown by
//! about a quarter (`GROWTH`). Earlier pictures stay as they are. The camera of a frame depends on the frames
//! written before it, so it may differ between runs if several frames are in flight.

use std::sync::{Mutex, MutexGuard, PoisonError};

use glam::DVec3;

use crate::render::Up;
use crate::surface::space::joined;

use super::outputs::OutputOptions;
use super::viewpoint::CameraChoice;

/// The camera of a sequence, shared by the frames in flight.
#[derive(Debug)]
pub struct Framing {
    /// The requested camera.
    requested: CameraChoice,
    aspect: f64,
    up: Up,
    framed: Mutex<Framed>,
}

/// The camera of a sequence at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Framed {
    /// The current camera.
    pub camera: CameraChoice,
    /// The bounds that the camera was placed around, world units.
    pub around: [DVec3; 2],
    /// The cameras before this one: pictures rendered with them are still valid.
    pub earlier: Vec<CameraChoice>,
}

/// The margin on a side on which the bounds grew, as a fraction of their extent.
const GROWTH: f64 = 0.25;

impl Framed {
    /// The camera for these bounds, as requested in `outputs`.
    pub fn around(bounds: [DVec3; 2], outputs: &OutputOptions) -> Framed {
        let camera = outputs.with_camera_around(bounds).picture.camera;
        Framed { camera, around: bounds, earlier: Vec::new() }
    }
}

impl Framing {
    /// Starts with the camera in `framed`; refits use the camera that `outputs` requests.
    pub fn new(outputs: &OutputOptions, framed: Framed) -> Framing {
        Framing {
            requested: outputs.picture.camera,
            aspect: outputs.picture.aspect(),
            up: outputs.up(),
            framed: Mutex::new(framed),
        }
    }

    /// The current camera.
    pub fn framed(&self) -> Framed {
        self.lock().clone()
    }

    /// The camera for a frame with these bounds; refits it if the frame does not fit into the picture.
    pub(crate) fn camera_for(&self, bounds: Option<[DVec3; 2]>) -> CameraChoice {
        let mut framed = self.lock();
        let Some(bounds) = bounds.filter(|bounds| !self.contains(&framed, *bounds)) else {
            return framed.camera;
        };
        let around = with_margin(joined(framed.around, bounds), framed.around);
        let camera = self.requested.viewpoint(around, self.aspect, self.up).into();
        let before = std::mem::replace(&mut framed.camera, camera);
        framed.earlier.push(before);
        framed.around = around;
        camera
    }

    /// Whether these bounds are in the picture.
    fn contains(&self, framed: &Framed, bounds: [DVec3; 2]) -> bool {
        if !self.requested.is_orbit() {
            return true;
        }
        // A user who zooms in wants only a part in the picture, so the check ignores the zoom.
        let viewpoint = self.requested.not_zoomed_in().viewpoint(framed.around, self.aspect, self.up);
        viewpoint.contains(bounds, self.aspect)
    }

    /// Fields are replaced one by one by code that does not panic, so they are consistent even if the lock is
    /// poisoned.
    fn lock(&self) -> MutexGuard<'_, Framed> {
        self.framed.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The box with a margin on those sides on which it is larger than before.
fn with_margin([least, greatest]: [DVec3; 2], [least_before, greatest_before]: [DVec3; 2]) -> [DVec3; 2] {
    let margin = GROWTH * (greatest - least);
    [
        DVec3::select(least.cmplt(least_before), least - margin, least),
        DVec3::select(greatest.cmpgt(greatest_before), greatest + margin, greatest),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::OutputFormat;

    fn boxed(least: f64, greatest: f64) -> [DVec3; 2] {
        [DVec3::splat(least), DVec3::splat(greatest)]
    }

    fn framing(camera: &str) -> Framing {
        let mut outputs = OutputOptions::new("out", &[OutputFormat::Png]);
        outputs.picture.camera = camera.parse().expect("a camera");
        Framing::new(&outputs, Framed::around(boxed(0.0, 1.0), &outputs))
    }

    fn shows(framing: &Framing, camera: CameraChoice, bounds: [DVec3; 2]) -> bool {
        camera.viewpoint(bounds, framing.aspect, framing.up).contains(bounds, framing.aspect)
    }

    #[test]
    fn camera_stays_while_frames_are_in_the_picture() {
        let framing = framing("auto");
        let before = framing.framed();
        for bounds in [Some(boxed(0.0, 1.0)), Some(boxed(0.3, 0.5)), Some(boxed(-0.01, 1.01)), None] {
            assert_eq!(framing.camera_for(bounds), before.camera, "{bounds:?}");
        }
        assert_eq!(framing.framed(), before);
    }

    #[test]
    fn growing_splash_is_never_cropped_and_refits_are_rare() {
        for choice in ["auto", "azimuth=120,elevation=60,view=60", "zoom=0.5"] {
            let framing = framing(choice);
            for frame in 0..200 {
                let reach = 1.0 + 0.1 * f64::from(frame);
                let bounds = [DVec3::new(-reach, 0.0, -reach), DVec3::new(reach, 0.5 * reach, reach)];
                let camera = framing.camera_for(Some(bounds));
                assert!(shows(&framing, camera, bounds), "{choice}: frame {frame} is cropped");
            }
            let Framed { earlier, around, .. } = framing.framed();
            assert!(earlier.len() < 20, "{choice}: {} refits", earlier.len());
            // Everything that was in view before still is.
            assert!(around[0].cmple(DVec3::ZERO).all() && around[1].cmpge(DVec3::ONE).all());
        }
    }

    #[test]
    fn zoomed_or_fixed_camera_is_not_refitted_when_it_crops() {
        let zoomed = framing("zoom=3");
        assert_eq!(zoomed.camera_for(Some(boxed(0.0, 1.0))), zoomed.framed().camera);
        assert!(zoomed.framed().earlier.is_empty());
        let fixed = framing("eye=1:2:3,target=0:0:0");
        fixed.camera_for(Some(boxed(-50.0, 50.0)));
        assert!(fixed.framed().earlier.is_empty());
    }
}
