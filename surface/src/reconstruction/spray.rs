//! Takes the spray out of a frame before its surface is made, as the settings require.

use std::sync::Arc;

use glam::DVec3;

use super::shape::scales;
use crate::options::Settings;
use crate::particles::{Attribute, AttributeValues, OwnedPositions, find_attribute, ids_of};
use crate::report::ShapeStats;
use crate::space::INDEX_LIMIT;
use crate::spray::{
    FrameSides, Links, Spray, SpraySides, radius_of_volume, small_pieces, steady_sides, take_spray,
};

/// Which particles of a frame are apart from all larger pieces, regardless of other frames.
#[derive(Clone, Debug)]
pub struct ApartParticles {
    links: Links,
    /// `None` for those that the surface cannot have, either: see [`Neighbors::dropped_count`](crate::neighbors::Neighbors).
    is_apart: Vec<Option<bool>>,
    /// `None` without ids, or if the frame alone decides.
    by_ids: Option<Arc<FrameSides>>,
}

impl ApartParticles {
    /// Finds them. Of the attributes, only the particles' own radii matter, if the settings use them.
    pub fn find(positions: &OwnedPositions, attributes: &[Attribute], settings: &Settings) -> ApartParticles {
        let count = positions.len();
        let scales = |own| scales(count, attributes, own, settings, &mut ShapeStats::default());
        let scales = settings.per_particle_radius.as_ref().and_then(scales);
        let links = Links { radius_world: settings.radius_init, scales };
        let has_voxel = |particle: usize| {
            let voxel = positions.position(particle) / settings.voxel_size;
            voxel.abs().max_element() < f64::from(INDEX_LIMIT) && voxel.is_finite()
        };
        let mut is_apart: Vec<Option<bool>> =
            (0..count).map(|particle| has_voxel(particle).then_some(false)).collect();
        for member in small_pieces(positions, &links, settings.spray).iter().flat_map(|piece| &piece.members)
        {
            is_apart[*member as usize] = is_apart[*member as usize].map(|_| true);
        }
        let ids = ids_of(attributes).filter(|_| settings.spray_reach() > 0);
        let by_ids = ids.map(|ids| Arc::new(FrameSides::of(ids, &is_apart)));
        ApartParticles { links, is_apart, by_ids }
    }

    /// The same by ids, for the frames around; `None` without ids, or if each frame alone decides.
    pub fn by_ids(&self) -> Option<Arc<FrameSides>> {
        self.by_ids.clone()
    }

    /// Takes the spray out of the frame. `around` are frames before and after it, each with the number of frames by
    /// which it is later. Without ids, the frame alone decides.
    pub fn take_spray(
        self,
        positions: &OwnedPositions,
        attributes: &[Attribute],
        around: &[(i32, &FrameSides)],
        settings: &Settings,
    ) -> (OwnedPositions, Vec<Attribute>, Spray) {
        let ApartParticles { links, is_apart, by_ids } = self;
        let sides = match ids_of(attributes).zip(by_ids) {
            Some((ids, own)) => {
                let (is_spray, ages) = steady_sides(ids, &is_apart, &own, around, settings.spray_keep);
                SpraySides { is_spray, ages: Some(ages) }
            }
            None => {
                let is_spray = is_apart.into_iter().map(|is_apart| is_apart == Some(true)).collect();
                SpraySides { is_spray, ages: None }
            }
        };
        let radii = radii(positions.len(), attributes, settings);
        let of_pieces = (&links, settings.spacing);
        let (fluid, of_fluid, mut spray) = take_spray(positions, attributes, &sides, &radii, of_pieces);
        if let Some(clip) = &settings.clip {
            let is_inside = |index: usize| {
                let position = spray.positions.position(index);
                (DVec3::from(clip.min).cmple(position) & position.cmple(DVec3::from(clip.max))).all()
            };
            let is_kept: Vec<bool> = (0..spray.positions.len()).map(is_inside).collect();
            spray.retain(&is_kept);
        }
        for Attribute { role, values, .. } in &mut spray.attributes {
            match role.scale(settings.velocity_scale) {
                1.0 => {}
                factor => values.scale(factor),
            }
        }
        (fluid, of_fluid, spray)
    }
}

/// The radius of the ball that has the volume of each particle: that of a cube whose edge is the spacing, or twice the
/// particle's own radius.
fn radii(count: usize, attributes: &[Attribute], settings: &Settings) -> Vec<f32> {
    let uniform = radius_of_volume(settings.spacing) as f32;
    let own = settings.per_particle_radius.as_ref();
    let own = own.and_then(|own| find_attribute(attributes, &own.attribute, 1));
    let own = own.and_then(|attribute: &Attribute| AttributeValues::numbers(&attribute.values));
    let Some(own) = own else { return vec![uniform; count] };
    let of_own = |radius: &f32| {
        let radius = radius_of_volume(2.0 * f64::from(*radius)) as f32;
        if radius.is_finite() && radius > 0.0 { radius } else { uniform }
    };
    own.iter().map(of_own).collect()
}
