//! The reconstruction options, shared by all commands that convert and by the configuration file.
//!
//! No option has a default here: a default would look like a given option. On the command line it would
//! override the file, and in the file it would override the preset.

use std::path::PathBuf;

use clap::Args;

use super::merge::option_set;
use super::method_options::MethodOptionArgs;
use crate::surface::options::{MethodOptions, OptionGroup};

option_set! {
    /// The reconstruction options, and those that exist only on the command line.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct MethodArgs {
        #[command(flatten)]
        pub(in crate::cli) options: MethodOptionArgs,

        /// Obstacles that the surface must not enter: meshes such as .obj, .glb or .ply, or a .vdb level set;
        /// may be repeated
        ///
        /// A file applies to all frames. With a numbered pattern such as body.####.obj, each frame uses the
        /// file with its own number.
        #[arg(long, value_name = "FILE", help_heading = OptionGroup::Obstacles.heading())]
        pub(in crate::cli) obstacle: Vec<PathBuf>,
    }
}

impl MethodArgs {
    /// The reconstruction options.
    pub(in crate::cli) fn to_options(&self) -> MethodOptions {
        self.options.0.clone()
    }
}
