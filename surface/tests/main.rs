//! Tests the method from outside, against the paper, the geometry of spheres, and plain implementations.

mod adaptive; // explicit steps as large as stability allows (paper, §3.5)
mod invariance; // changes of the input that keep the surface bit for bit; bounds
mod oracle; // the method, compared with the paper's algorithms on a plain dense grid, in double precision
mod per_particle_shapes; // per-particle radii and shapes (paper, Fig. 11 and 13)
mod random_ball; // the surface of 50 000 random particles in a ball is nearly spherical (paper, Fig. 12)
mod shapes; // shapes of particles, the method with its defaults, values of level sets
mod sphere_flow; // a noisy sphere under both flows (paper, Fig. 5)
mod surface; // meshes are sound, and in the right position
mod thin_fluid; // drops, clusters, threads and sheets with the default settings
mod union_of_spheres; // rasterization, compared with the geometry of spheres
