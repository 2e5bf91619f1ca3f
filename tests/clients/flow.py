"""A frame of particles whose attributes are known fields, for checks of the attributes of surfaces.

The particles form a ball that moves along x, and a sheet below it, which shears:

    velocity     (3, 2 x, −z)      constant along one axis, linear along the others
    colour       (0.25, ramp, 0.75) ramp: x from 0 to 1
    temperature  10 + y
    id           the index of the particle
"""

import numpy as np

VOXEL_SIZE = 0.05
SPACING = 2 * VOXEL_SIZE
NAMES = ["v", "color", "temperature", "id"]
# An attribute of the surface is a mean over nearby particles, which are inside of the surface: the mean is
# the value of the field at a point no farther away than this.
REACH = 6 * VOXEL_SIZE
# The largest gradient of the fields.
SLOPE = 2.0


def positions():
    rng = np.random.default_rng(5)
    along = np.arange(-20, 21)
    lattice = np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = (lattice + rng.uniform(-0.2, 0.2, lattice.shape)) * SPACING
    ball = lattice[np.linalg.norm(lattice, axis=1) < 0.6] + [0, 1, 0]
    sheet = lattice[abs(lattice[:, 1]) < 1.5 * SPACING] * [0.9, 1, 0.5]
    return np.concatenate([ball, sheet]).astype(np.float32)


def velocity(points):
    return np.stack([np.full(len(points), 3.0), 2 * points[:, 0], -points[:, 2]], axis=1)


def color(points):
    ramp = (points[:, 0] + 2.25) / 4.5
    return np.stack([np.full(len(points), 0.25), ramp, np.full(len(points), 0.75)], axis=1)


def temperature(points):
    return 10 + points[:, 1]


# The fields by the names of their grids in the .vdb.
GRIDS = {"velocity": velocity, "color": color, "temperature": temperature}


def write_particles(path):
    points = positions()
    columns = ["x", "y", "z", "vx", "vy", "vz", "r", "g", "b", "temperature"]
    rows = np.empty(len(points), [(name, "<f4") for name in columns] + [("id", "<i4")])
    rows["x"], rows["y"], rows["z"] = points.T
    rows["vx"], rows["vy"], rows["vz"] = velocity(points).T
    rows["r"], rows["g"], rows["b"] = color(points).T
    rows["temperature"] = temperature(points)
    rows["id"] = np.arange(len(points))
    properties = [f"property float {name}" for name in columns] + ["property int id"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    path.write_bytes("\n".join([*header, ""]).encode() + rows.tobytes())


def faults_of(what, points, found, field, rounding=0.0, reach=REACH):
    """Finds faults of the values of a linear or constant field at some points. The values must be within the
    range of the particles, and differ from the field by no more than it changes within `reach`, plus
    `rounding`."""
    found, expected = np.asarray(found, float), field(points)
    particles = field(positions().astype(float))
    faults = []
    rounding += 1e-6 * (1 + abs(particles).max())
    if (found < particles.min(axis=0) - rounding).any() or (found > particles.max(axis=0) + rounding).any():
        faults.append(f"{what} is beyond the particles' range: {found.min(axis=0)} to {found.max(axis=0)}")
    away = abs(found - expected).max()
    if away > SLOPE * reach + rounding:
        faults.append(f"{what} is off by {away:.3f}")
    return faults
