//! Attributes that are computed and not read: what a particle does, and the shape of the surface.
//!
//! ```text
//!   speed              |v|
//!   vorticity          |∇ × v|, from the linear field that fits the velocities of the particles within R best
//!   normal_curvature   of the mesh: see mesh/curvature.rs
//! ```
//!
//! An attribute of this name in the file takes precedence.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::radius_world;
use crate::cancel::checkpoint;
use crate::neighbors::Neighbors;
use crate::options::{AttributeSelection, Settings};
use crate::parallel::Loops as _;
use crate::particles::{Attribute, AttributeValues, OwnedPositions, Role, find_attribute};

/// An attribute that can be computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ComputedAttribute {
    /// The length of the velocity.
    Speed,
    /// The length of the curl of the velocity.
    Vorticity,
    /// The mean curvature of the surface.
    NormalCurvature,
}

impl ComputedAttribute {
    /// All of them.
    pub const ALL: [ComputedAttribute; 3] =
        [ComputedAttribute::Speed, ComputedAttribute::Vorticity, ComputedAttribute::NormalCurvature];

    /// The name by which users ask for it, and in files.
    pub fn name(self) -> &'static str {
        match self {
            ComputedAttribute::Speed => "speed",
            ComputedAttribute::Vorticity => "vorticity",
            ComputedAttribute::NormalCurvature => "normal_curvature",
        }
    }

    /// Whether the particles need velocities for it.
    pub fn needs_velocities(self) -> bool {
        OF_VELOCITIES.contains(&self)
    }

    /// The attribute with these values, one for each particle or vertex.
    pub fn with_values(self, values: Vec<f32>) -> Attribute {
        let (name, values) = (self.name().to_owned(), AttributeValues::Numbers(values));
        Attribute { name, role: Role::Other, arity: 1, values }
    }

    /// Whether the selection names it, and none of these attributes has its name.
    pub fn is_wanted(self, selection: Option<&AttributeSelection>, given: &[Attribute]) -> bool {
        let Some(AttributeSelection::Named(names)) = selection else { return false };
        names.iter().any(|name| name.eq_ignore_ascii_case(self.name()))
            && !given.iter().any(|attribute| attribute.name.eq_ignore_ascii_case(self.name()))
    }
}

/// Whether [`add_computed`] has something to do.
pub fn wants_computed(settings: &Settings, attributes: &[Attribute]) -> bool {
    OF_VELOCITIES.iter().any(|wanted| wanted.is_wanted(settings.attributes.as_ref(), attributes))
}

pub(super) const OF_VELOCITIES: [ComputedAttribute; 2] =
    [ComputedAttribute::Speed, ComputedAttribute::Vorticity];

/// Adds the speed and the vorticity of particles to their attributes, if the settings select them and there are velocities.
pub fn add_computed(positions: &OwnedPositions, attributes: &mut Vec<Attribute>, settings: &Settings) {
    let is_wanted = |wanted: ComputedAttribute| wanted.is_wanted(settings.attributes.as_ref(), attributes);
    let wanted: Vec<ComputedAttribute> = OF_VELOCITIES.into_iter().filter(|one| is_wanted(*one)).collect();
    if wanted.is_empty() {
        return;
    }
    let velocities = find_attribute(attributes, "velocity", 3);
    let Some(velocities) = velocities.and_then(|attribute| attribute.values.numbers()) else { return };
    let velocities: Vec<[f32; 3]> = velocities.as_chunks().0.to_vec();
    for attribute in wanted {
        let mut found = attribute.with_values(match attribute {
            ComputedAttribute::Vorticity => vorticities(positions, &velocities, radius_world(settings)),
            _ => velocities
                .iter()
                .map(|velocity| DVec3::from(velocity.map(f64::from)).length() as f32)
                .collect(),
        });
        match settings.velocity_scale {
            1.0 => {}
            scale => found.values.scale(scale),
        }
        attributes.push(found);
    }
}

/// The length of the curl of the velocities at each particle, in the unit of velocities per world unit. It is 0 for
/// particles that have none within the radius, and not finite if the velocity is not.
fn vorticities(positions: &OwnedPositions, velocities: &[[f32; 3]], radius_world: f64) -> Vec<f32> {
    let neighbors = Neighbors::new(positions, radius_world);
    let count = neighbors.indices().len();
    let vorticity = |slot: usize| {
        if slot.is_multiple_of(CHECKED_EVERY) {
            checkpoint();
        }
        (neighbors.indices()[slot], vorticity_at(&neighbors, slot, velocities))
    };
    let found: Vec<(u32, f32)> = (0..count).into_par_iter().halved().map(vorticity).collect();
    let mut vorticities = vec![0.0; positions.len()];
    found.into_iter().for_each(|(particle, vorticity)| vorticities[particle as usize] = vorticity);
    vorticities
}

fn vorticity_at(neighbors: &Neighbors, slot: usize, velocities: &[[f32; 3]]) -> f32 {
    let velocity = |slot: usize| DVec3::from(velocities[neighbors.indices()[slot] as usize].map(f64::from));
    let own = velocity(slot);
    if !own.is_finite() {
        return f32::NAN;
    }
    let [x, y, z] = neighbors.locals();
    let local = |slot: usize| DVec3::new(x[slot].into(), y[slot].into(), z[slot].into());
    let here = local(slot);
    // The sums of offset ⊗ offset and velocity ⊗ offset.
    let (mut of_offsets, mut of_velocities) = (DMat3::ZERO, DMat3::ZERO);
    for run in neighbors.runs(neighbors.cells()[neighbors.cell_at(slot)]) {
        let step = run.step.as_dvec3() - here;
        let (slots, multiplicity) = run.sampled();
        for other in slots {
            let offset = local(other) + step;
            let change = velocity(other) - own;
            let nearness = 1.0 - offset.length_squared();
            if nearness > 0.0 && change.is_finite() {
                let weighted = multiplicity * nearness * nearness * nearness * offset;
                of_offsets += DMat3::from_cols(offset * weighted.x, offset * weighted.y, offset * weighted.z);
                of_velocities +=
                    DMat3::from_cols(change * weighted.x, change * weighted.y, change * weighted.z);
            }
        }
    }
    let trace = of_offsets.x_axis.x + of_offsets.y_axis.y + of_offsets.z_axis.z;
    if trace <= 0.0 {
        return 0.0;
    }
    // In sheets and threads velocities do not determine the gradient across: it is as small as possible.
    let regular = of_offsets + DMat3::from_diagonal(DVec3::splat(RIDGE * trace));
    let gradient = of_velocities * regular.inverse();
    let curl = DVec3::new(
        gradient.y_axis.z - gradient.z_axis.y,
        gradient.z_axis.x - gradient.x_axis.z,
        gradient.x_axis.y - gradient.y_axis.x,
    );
    (curl.length() / neighbors.edge_world()) as f32
}

/// By how much the fit is kept regular, relative to the sum of the squared offsets.
const RIDGE: f64 = 1e-4;

/// Particles between two looks whether the computation is cancelled.
const CHECKED_EVERY: usize = 1 << 12;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::options::MethodOptions;

    fn block() -> Vec<[f64; 3]> {
        let wobble = |index: usize, axis: usize| 0.02 * ((7 * index + 3 * axis) as f64).sin();
        let at = |index: usize| {
            [0, 1, 2].map(|axis| 0.1 * (index / 10usize.pow(axis as u32) % 10) as f64 + wobble(index, axis))
        };
        (0..1000).map(at).collect()
    }

    fn computed(
        names: &str,
        positions: &[[f64; 3]],
        velocity: impl Fn([f64; 3]) -> [f64; 3],
    ) -> Vec<Attribute> {
        let velocities = positions.iter().flat_map(|at| velocity(*at)).map(|part| part as f32).collect();
        let mut attributes = vec![Attribute {
            name: "v".to_owned(),
            role: Role::Velocity,
            arity: 3,
            values: AttributeValues::Numbers(velocities),
        }];
        let options = MethodOptions {
            attributes: Some(names.parse().expect("names")),
            velocity_scale: Some(2.0),
            ..MethodOptions::default()
        };
        let settings = Settings::paper(0.05, &options).expect("settings");
        add_computed(&OwnedPositions::F64(positions.to_vec()), &mut attributes, &settings);
        attributes
    }

    fn numbers(attribute: &Attribute) -> Vec<f32> {
        attribute.values.numbers().expect("numbers").into_owned()
    }

    #[test]
    fn vorticity_of_a_rigid_rotation_is_twice_its_rate() {
        let axis = DVec3::new(1.0, -2.0, 2.0);
        let found = computed("speed,Vorticity", &block(), |at| axis.cross(DVec3::from(at)).to_array());
        let [_, speed, vorticity] = &found[..] else { panic!("{} attributes", found.len()) };
        assert_eq!((&*speed.name, &*vorticity.name), ("speed", "vorticity"));
        for (at, speed) in block().iter().zip(numbers(speed)) {
            let expected = 2.0 * axis.cross(DVec3::from(*at)).length();
            assert!((f64::from(speed) - expected).abs() < 1e-6 * expected.max(1.0));
        }
        for vorticity in numbers(vorticity) {
            assert!((vorticity / 12.0 - 1.0).abs() < 2e-3, "{vorticity}");
        }
    }

    #[test]
    fn strain_has_no_vorticity_and_lone_particles_neither() {
        let mut positions = block();
        positions.push([50.0, 0.0, 0.0]);
        let found = computed("vorticity", &positions, |[x, y, z]| [x + y, x - y + 3.0 * z, 3.0 * y]);
        assert!(numbers(&found[1]).iter().all(|vorticity| *vorticity < 0.02));
        assert_eq!(numbers(&found[1])[1000], 0.0);
    }

    #[test]
    fn sheets_and_piles_are_finite() {
        let sheet: Vec<[f64; 3]> = block().iter().map(|[x, y, _]| [*x, *y, 0.0]).collect();
        for positions in [sheet, vec![[0.1, 0.2, 0.3]; 3000]] {
            let found = computed("vorticity", &positions, |[x, y, _]| [-y, x, 0.0]);
            assert!(numbers(&found[1]).iter().all(|vorticity| vorticity.is_finite()));
        }
    }

    #[test]
    fn attributes_of_the_file_take_precedence() {
        assert_eq!(computed("vorticity", &block()[..5], |at| at).len(), 2);
        let mut given = computed("speed", &block()[..5], |at| at);
        let options =
            MethodOptions { attributes: Some("speed".parse().expect("name")), ..MethodOptions::default() };
        let settings = Settings::paper(0.05, &options).expect("settings");
        let before = given.clone();
        add_computed(&OwnedPositions::F64(block()[..5].to_vec()), &mut given, &settings);
        assert_eq!(given, before);
    }
}
