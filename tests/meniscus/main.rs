//! What the program promises, tested from outside: through the command, and through the library.

mod adaptive; // explicit steps as large as may be (paper, §3.5)
mod attributes; // what particles know, on the surface, from file to files
mod certified; // certificates are about what is written
mod cli; // the command: exit codes, messages, names, what is refused
mod convert; // the command on real frames: the same bytes, reports, what is done already
#[cfg(unix)]
mod escaping; // names and contents of files neither forge lines nor control the terminal
mod farm; // frames dealt to many machines: plans, shards, and whether all is there
mod flicker; // how much surfaces flicker: spheres that are known, in meshes of every format
mod info; // the command that tells what files hold
mod invariance; // what must not change the surface, to the last bit; bounds; particles stay inside
mod layers; // the house: no module imports its own row or a higher one, and none in a cycle
mod level_sets; // level sets in .vdb as inputs
mod library; // the example for other programs does what the command does
mod manual; // pages for man and completions for shells: of every command and option
mod names; // names of frames and results: frame numbers, single files, pipes, clashes
mod obstacles; // what stands in the way: contact without gaps, from meshes to reports (paper, Fig. 15 and 16)
mod offset; // the finished surface moved: where it ends up, and what it still guarantees
mod oracle; // the method against the paper's algorithms on a plain dense grid, in double precision
mod own_shapes; // particles of their own sizes and shapes (paper, Fig. 11 and 13)
mod particles_only; // particles from one format to another, without a surface
mod pictures; // of balls, of which all is known; their files, and the command that makes them
mod pipeline; // frames through the stages, with a quick method in place of the real one
mod random_ball; // 50 000 random particles in a ball come out nearly spherical (paper, Fig. 12)
mod raw_vdb; // level sets as no program writes them
mod scene; // small frames of particles, and a way to run the command
mod service; // the daemon as a service: what systemd hears, and what signals do
mod shapes; // particles to skin, the method with its defaults, and level sets read at a place
mod shared; // files of real programs: each is converted, or refused for a reason
mod sheets; // many pictures on one: what is on them, and that commands do what cells show
mod shots; // meshes in other programs' formats, and all frames of a shot in one file
mod spacings; // how far apart particles are, against what is known of them
mod sphere_flow; // a noisy sphere under both flows (paper, Fig. 5)
mod steps; // files with several frames: LAMMPS dumps and atoms
mod stream; // frames that come one by one: order, bounds, and what goes wrong on the way
mod surface; // is the mesh sound, and in the right place?
mod union_of_spheres; // rasterization against what is known of spheres
#[cfg(target_os = "linux")]
mod unreadable; // frames that the system refuses to describe: failed, never dropped
mod vdb_file; // what small .vdb files share
mod voxel_sizes; // voxels and radii that do not fit the particles: refused, or told, and no others
mod watch; // the daemon's command, and those that ask what it did: what they take, refuse and tell
mod ways;
