//! Settings by name, as what they are: numbers, words, switches.

use std::collections::BTreeMap;

use super::{Anisotropy, Integrator, OwnRadii, Settings, contouring_name, integrator_name};

/// Names and values in a fixed order. A value reads as in `meniscus.toml`, but for words, which have no quotes.
pub type Pairs = Vec<(&'static str, String)>;

impl Settings {
    /// Every setting that a level set depends on, and those of the mesh where `has_mesh`. What does not matter to the
    /// result, or is not asked for, is left out: changing it would make the same bytes again.
    pub fn pairs(&self, has_mesh: bool) -> Pairs {
        let mut pairs = vec![
            ("voxel_size", self.voxel_size.to_string()),
            ("radius_min", self.radius_min.to_string()),
            ("radius_init", self.radius_init.to_string()),
            ("radius_max", self.radius_max.to_string()),
        ];
        self.push_particles(&mut pairs);
        pairs.extend([
            ("integrator", integrator_name(self.integrator).to_owned()),
            ("laplacian_steps", self.laplacian_steps.to_string()),
            ("steps", self.steps.to_string()),
            ("step_size", self.step_size.to_string()),
            ("redistance_every", self.redistance_every.to_string()),
        ]);
        if self.integrator == Integrator::Implicit {
            pairs.push(("cg_tolerance", self.cg_tolerance.to_string()));
        }
        self.push_edits(&mut pairs);
        // A level set is written as it is, before it becomes a mesh.
        if has_mesh {
            self.push_mesh(&mut pairs);
        }
        pairs
    }

    /// What was asked for beyond what every frame has.
    pub fn more(&self) -> BTreeMap<&'static str, String> {
        let mut pairs = Pairs::new();
        self.push_particles(&mut pairs);
        self.push_edits(&mut pairs);
        self.push_mesh(&mut pairs);
        pairs.into_iter().filter(|&(name, _)| name != "contour").collect()
    }

    fn push_particles(&self, pairs: &mut Pairs) {
        if let Some(OwnRadii { attribute, scale }) = &self.own_radii {
            pairs.push(("radius_attribute", attribute.clone()));
            pairs.push(("radius_scale", scale.to_string()));
        }
        match self.anisotropy {
            Anisotropy::None => {}
            Anisotropy::Neighbors { max_stretch, thin_radius, lone_radius } => pairs.extend([
                ("anisotropy", "neighbors".to_owned()),
                ("max_stretch", max_stretch.to_string()),
                ("thin_radius", thin_radius.to_string()),
                ("lone_radius", lone_radius.to_string()),
            ]),
            Anisotropy::Velocity { gain, max_stretch } => pairs.extend([
                ("anisotropy", "velocity".to_owned()),
                ("velocity_gain", gain.to_string()),
                ("max_stretch", max_stretch.to_string()),
            ]),
        }
        if self.uses_neighbors() {
            pairs.push(("neighbor_radius", self.neighbor_radius.to_string()));
            pairs.push(("position_smoothing", self.position_smoothing.to_string()));
        }
        if let Some(attributes) = &self.attributes {
            pairs.push(("attributes", attributes.to_string()));
        }
    }

    fn push_edits(&self, pairs: &mut Pairs) {
        if self.offset != 0.0 {
            pairs.push(("offset", self.offset.to_string()));
        }
        if self.drop_islands > 0 {
            pairs.push(("drop_islands", self.drop_islands.to_string()));
        }
        if self.fill_cavities > 0.0 {
            pairs.push(("fill_cavities", self.fill_cavities.to_string()));
        }
        if let Some(clip) = &self.clip {
            pairs.push(("clip", clip.to_string()));
        }
    }

    fn push_mesh(&self, pairs: &mut Pairs) {
        pairs.push(("contour", contouring_name(self.contouring).to_owned()));
        if self.decimate > 0.0 {
            pairs.push(("decimate", self.decimate.to_string()));
        }
        if self.smooth_normals > 0 {
            pairs.push(("smooth_normals", self.smooth_normals.to_string()));
        }
    }
}
