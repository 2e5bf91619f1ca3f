//! A smooth solid full of particles, of any number, made plane by plane.
//!
//! ```text
//!       ▒▒▒▒   ▒▒▒▒▒▒         a gyroid, one of the two labyrinths that sin x cos y + sin y cos z + sin z cos x
//!     ▒▒▒  ▒▒▒▒▒   ▒▒▒        parts space into, closed by a ball:
//!     ▒▒▒▒   ▒▒▒   ▒▒▒▒
//!       ▒▒▒▒▒▒ ▒▒▒▒▒▒           gyroid(p) + ½ max(0, |p| − R)²  <  0
//! ```
//!
//! Why this one: it is one smooth piece; it bends in and out by the same amount, so the space around it has as
//! much surface as it has itself; and along a row of the lattice it costs three products a point, for the
//! sines come from tables.
//!
//! Particles are the points of a cubic lattice inside it, each moved by up to a fifth of the spacing along each
//! axis. By how much depends on the point's indices alone: the same particles on any machine.

/// The solid ends nearer than this beyond R, where ½ (|p| − R)² has outgrown the gyroid's 1.5.
const CLOSED_WITHIN: f64 = 1.75;

/// A particle is moved along each axis by up to so many spacings.
const JITTER: f32 = 0.2;

/// A solid and the lattice in it.
pub(crate) struct Sponge {
    /// Distance of lattice points.
    pub(crate) spacing: f64,
    /// R.
    radius: f64,
    /// Along each axis what the gyroid needs of each lattice plane.
    planes: [Vec<Plane>; 3],
}

/// What all points of a lattice plane share.
#[derive(Clone, Copy)]
struct Plane {
    position: f32,
    square: f32,
    sin: f32,
    cos: f32,
}

/// Where the gyroid begins, along each axis: anywhere but at one of its points of symmetry.
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

    /// How many planes across x the lattice has.
    pub(crate) fn plane_count(&self) -> usize {
        self.planes[0].len()
    }

    /// How many particles a plane has.
    pub(crate) fn count_in_plane(&self, x: usize) -> usize {
        let mut count = 0;
        self.for_each_inside(x, |_, _| count += 1);
        count
    }

    /// Hands over the particles of a plane, in the order of the lattice.
    pub(crate) fn for_each_in_plane(&self, x: usize, mut particle: impl FnMut([f32; 3])) {
        let spacing = self.spacing as f32;
        self.for_each_inside(x, |y, z| {
            let moves = jitter([x, y, z]);
            let place = [x, y, z];
            particle(std::array::from_fn(|axis| {
                self.planes[axis][place[axis]].position + moves[axis] * JITTER * spacing
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

/// Three numbers from −1 to 1 that look random, made of a lattice point's indices.
fn jitter(place: [usize; 3]) -> [f32; 3] {
    // SplitMix64: the finalizer of MurmurHash3, whose bits are as good as independent.
    let mut bits = place.iter().fold(0, |bits: u64, &index| bits << 21 ^ index as u64);
    bits = bits.wrapping_add(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^= bits >> 31;
    [0, 21, 42].map(|shift| {
        let part = bits >> shift & 0x1f_ffff;
        part as f32 / 1_048_576.0 - 1.0
    })
}
