//! What the program promises, tested from outside: through the command, and through the library.

mod invariance; // what must not change the surface, to the last bit; bounds; particles stay inside
mod oracle; // the method against the paper's algorithms on a plain dense grid, in double precision
mod random_ball; // 50 000 random particles in a ball come out nearly spherical (paper, Fig. 12)
mod shapes; // particles to skin, the method with its defaults, and level sets read at a place
mod sphere_flow; // a noisy sphere under both flows (paper, Fig. 5)
mod union_of_spheres; // rasterization against what is known of spheres
