//! The options of the method: the same for every command that converts, and for the keys of a file.
//!
//! Nothing here has a default of its own, so that it is known what was given: an option overrides
//! what stands in a file, and that what a preset says.

use std::path::PathBuf;

use clap::Args;

use super::merge::option_set;
use crate::surface::options::{Length, MethodOptions, OptionGroup};

option_set! {
    /// The options of the method, and what only the command line knows beside them.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct MethodArgs {
        /// The spacing, as the radius of a particle in the simulation, positive: half the spacing
        #[arg(long, value_name = "R", allow_negative_numbers = true, conflicts_with = "spacing", value_parser = Length::parse_world)]
        pub(in crate::cli) particle_radius: Option<f64>,

        #[command(flatten)]
        pub(in crate::cli) options: MethodOptions,

        /// What the surface must not enter: .obj, .glb, .gltf, .ply, .stl, .vtk, .vtp, .vtu, or a level set in .vdb; more than one if given again
        ///
        /// One file for all frames, or a numbered pattern such as body.####.obj, of which each frame takes the file with its
        /// own number.
        #[arg(long, value_name = "FILE", help_heading = OptionGroup::Obstacles.heading())]
        pub(in crate::cli) obstacle: Vec<PathBuf>,
    }
}

impl MethodArgs {
    /// The options of the method, with the spacing whichever way it was given.
    pub(in crate::cli) fn to_options(&self) -> MethodOptions {
        let spacing = self.options.spacing.or(self.particle_radius.map(|radius| 2.0 * radius));
        MethodOptions { spacing, ..self.options.clone() }
    }
}
