//! A smooth solid filled with any number of particles, made plane by plane.
//!
//! ```text
//!       ▒▒▒▒   ▒▒▒▒▒▒         a gyroid, one of the two labyrinths that sin x cos y + sin y cos z + sin z cos x
//!     ▒▒▒  ▒▒▒▒▒   ▒▒▒        divides space into, closed by a ball:
//!     ▒▒▒▒   ▒▒▒   ▒▒▒▒
//!       ▒▒▒▒▒▒ ▒▒▒▒▒▒           gyroid(p) + ½ max(0, |p| − R)²  <  0
//! ```
//!
//! The shape has three advantages. It is one smooth piece. It curves inward as much as outward, because the
//! solid and the space around it are alike. The gyroid at a lattice point needs only three multiplications,
//! because the sines come from tables.
//!
//! Particles are the points of a cubic lattice inside the solid, each displaced by up to a fifth of the
//! spacing along each axis. The displacement depends only on the point's indices, so the particles are the
//! same on any machine.

/// The solid ends at a distance of less than R + this: there ½ (|p| − R)² exceeds 1.5, the maximum of the
/// gyroid.
const CLOSED_WITHIN: f64 = 1.75;

/// Upper limit of a particle's displacement along each axis, in spacings.
const JITTER: f32 = 0.2;

/// A solid and the lattice in it.
pub(crate) struct Sponge {
    /// Spacing of the lattice.
    pub(crate) spacing: f64,
    /// R in the formula of the shape.
    radius: f64,
    /// For each axis, the values at each of its lattice planes.
    planes: [Vec<Plane>; 3],
}

/// The values that all points of a lattice plane share.
#[derive(Clone, Copy)]
struct Plane {
    position: f32,
    square: f32,
    sin: f32,
    cos: f32,
}

/// The phase of the gyroid along each axis: arbitrary, so that the ball's centre is not at a symmetric point
/// of the gyroid.
const PHASE: [f64; 3] = [0.7, 1.9, 3.1];

impl Sponge {
    /// The solid with this R on a lattice of this spacing.
    pub(crate) fn new(radius: f64, spacing: f64) -> Sponge {
        let reach = ((radius + CLOSED_WITHIN) / spacing).ceil() as i32;
        let planes = PHASE.map(|phase| {
            let plane = |index: i32| {
                let position = f64::from(index) * spacing;
                let (sin, cos) = (position + phase).sin_cos();
                let [position, square, sin, cos] =
                    [position, position * position, sin, cos].map(|value| value as f32);
                Plane { position, square, sin, cos }
            };
            (-reach..=reach).map(plane).collect()
        });
        Sponge { spacing, radius, planes }
    }

    /// Number of lattice planes along x.
    pub(crate) fn plane_count(&self) -> usize {
        self.planes[0].len()
    }

    /// Number of particles in a plane.
    pub(crate) fn count_in_plane(&self, x: usize) -> usize {
        let mut count = 0;
        self.for_each_inside(x, |_, _| count += 1);
        count
    }

    /// Calls `particle` for the particles of a plane, in the order of the lattice.
    pub(crate) fn for_each_in_plane(&self, x: usize, mut particle: impl FnMut([f32; 3])) {
        let spacing = self.spacing as f32;
        self.for_each_inside(x, |y, z| {
            let moves = jitter([x, y, z]);
            let cell = [x, y, z];
            particle(std::array::from_fn(|axis| {
                self.planes[axis][cell[axis]].position + moves[axis] * JITTER * spacing
            }));
        });
    }

    /// The lattice points of a plane that are in the solid.
    fn for_each_inside(&self, x: usize, mut point: impl FnMut(usize, usize)) {
        let [along_x, along_y, along_z] = &self.planes;
        let (a, radius) = (along_x[x], self.radius as f32);
        for (y, b) in along_y.iter().enumerate() {
            for (z, c) in along_z.iter().enumerate() {
                let gyroid = a.sin * b.cos + b.sin * c.cos + c.sin * a.cos;
                let beyond = ((a.square + b.square + c.square).sqrt() - radius).max(0.0);
                if gyroid + 0.5 * beyond * beyond < 0.0 {
                    point(y, z);
                }
            }
        }
    }
}

/// Three pseudo-random numbers from −1 to 1, derived from a lattice point's indices.
fn jitter(cell: [usize; 3]) -> [f32; 3] {
    // SplitMix64, with the finalizer of MurmurHash3, whose bits are nearly independent.
    let mut bits = cell.iter().fold(0, |bits: u64, &index| bits << 21 ^ index as u64);
    bits = bits.wrapping_add(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^= bits >> 31;
    [0, 21, 42].map(|shift| {
        let part = bits >> shift & 0x1f_ffff;
        part as f32 / 1_048_576.0 - 1.0
    })
}
