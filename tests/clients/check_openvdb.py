"""Checks that OpenVDB 10 reads every .vdb, and finds a level set in it.

For each file, it checks these properties:

    class, name, background 3 h, transform, the counts and bounds in its metadata
    a voxel is active exactly if |φ| < background; other voxels are exactly ± background
    no sign leaks: φ changes sign only between two active voxels, also where tiles meet leaves
    every voxel's sign agrees with the winding number of our mesh around the voxel
    |∇φ| is near 1 in the band
    the surface by OpenVDB's own mesher is within 0.15 h of our .ply and .glb in the mean, of drops within 0.32 h
    other requested grids exist: they are active where the level set is, with the particles' values

Runs in Debian's own Python, because Debian's build of OpenVDB's Python module is for that Python.
"""

import math
import multiprocessing
import re
from pathlib import Path

import numpy as np
import pyopenvdb as vdb

import flow
from mesh_files import read_glb, read_ply
from project import OUT, Check, frame_of
from surface import distances, openvdb_surface, piece_sizes

# The distance between surfaces is measured only for every eighth frame of a long sequence, because its frames
# are alike.
SEQUENCE_STRIDE = 8
GRADIENT_TOLERANCE = 0.05
# Strongly curved surfaces differ: our vertices are within 0.02 h of the exact surface (φ interpolated by cubic splines),
# and OpenVDB's mesher averages the crossings of edges, so its surface is up to 0.3 h smaller, the more, the smaller the
# radius: 0.2 h for a radius of 1.5 h. Frames that are mostly spray differ by half of that.
DISTANCE_MAX_VOXELS = 0.15
# A piece of surface that is smaller than this counts as a droplet: one around a single particle is 2 to 4 voxels across.
DROPLET_VOXELS = 5
DROPLET_DISTANCE_MAX_VOXELS = 0.32
# Differences over a voxel do not resolve so small a sphere: with its exact distances, they give |∇φ| = 0.90.
DROPLET_GRADIENT_TOLERANCE = 0.12
# A part is thick near voxels that are this deep, in voxels. Sheets and threads of one layer of particles have
# none: in the voxels next to their surface φ is up to a fifth too steep.
THICK_DEPTH = 2.5
# Voxels are near if they are at most this far away along each axis: the depth, and the width of the band.
THICK_REACH = 5
THIN_GRADIENT_TOLERANCE = 0.25
# Voxels of the band have the attributes of the nearest surface, which is up to this many voxels away.
BAND_VOXELS = 3
# Margin around all leaves, in voxels: one leaf, so that the tiles and the background outside are checked,
# too.
MARGIN = 8

# All voxels but the outermost.
CORE = tuple([slice(1, -1)] * 3)

def main():
    check = Check("openvdb: OpenVDB 10 finds level sets")
    paths = sorted(OUT.rglob("*.vdb"))
    with multiprocessing.Pool(2) as pool:
        for label, figures, faults in pool.imap(examined, paths):
            check.line(label, figures, faults)
    check.end()


def examined(path):
    """The figures and the faults of one file."""
    label = str(path.relative_to(OUT))
    try:
        return (label, *examine(path))
    except Exception as error:
        return label, "could not be examined", [f"{type(error).__name__}: {error}"]


def examine(path):
    grids, metadata = vdb.readAll(str(path))
    grids = {grid.name: grid for grid in grids}
    others = flow.GRIDS if path.stem == "flowing" else {}
    if path.parent.name == "flowing-vectors":
        others = {name: flow.GRIDS[name] for name in ("velocity", "color")}
    meshes = path
    if path.parent.name == "moving-volumes":
        # A stage of level sets. The same frames are in another folder as meshes.
        others, meshes = {"velocity": None}, OUT / "moving" / path.name
    if grids.keys() != {"surface", *others}:
        return "", [f"its grids are {sorted(grids)}"]
    grid, frame = grids["surface"], frame_of(path)
    h = frame["settings"]["voxel_size"]
    faults = header_faults(grid, frame, h)
    if not frame["triangles"]:
        if grid.activeVoxelCount() or not grid.empty():
            faults.append("a mesh without triangles, but a grid with voxels")
        return "empty", faults
    phi, first = dense(grid)
    faults += band_faults(grid, phi) + sign_faults(grid, phi)
    for name, field in others.items():
        faults += attribute_faults(grids[name], grid, field)
    mesh = read_ply(meshes.with_suffix(".ply"))
    faults += side_faults(grid, phi, first, mesh)
    gradients = gradient_lengths(phi, grid.background) / h
    is_thick = near_depth(phi, THICK_DEPTH * h)[abs(phi[CORE]) < grid.background]
    only_droplets = piece_sizes(*mesh).max() < DROPLET_VOXELS * h
    thin_tolerance = DROPLET_GRADIENT_TOLERANCE if only_droplets else THIN_GRADIENT_TOLERANCE
    for name, part, tolerance in (
        ("thick", gradients[is_thick], GRADIENT_TOLERANCE),
        ("thin", gradients[~is_thick], thin_tolerance),
    ):
        if len(part) and abs(part.mean() - 1) > tolerance:
            faults.append(f"the mean of |∇φ| in {name} parts is {part.mean():.4f}")
    figures = (
        f"{grid.activeVoxelCount()} active of {phi.size}, |∇φ| mean {gradients.mean():.4f}, "
        f"99 % within {np.percentile(abs(gradients - 1), 99):.3f} of 1"
    )
    if is_compared(path):
        more, worse = compared(meshes, grid, phi, first, mesh, h)
        figures, faults = f"{figures}, {more}", faults + worse
    return figures, faults


def header_faults(grid, frame, h):
    """Compares the header with the report and with the tree."""
    faults = []

    def expect(what, is_value, value):
        if is_value != value:
            faults.append(f"{what}: {is_value!r}, not {value!r}")

    expect("class", grid.gridClass, vdb.GridClass.LEVEL_SET)
    expect("type", grid.valueTypeName, "float")
    expect("transform", grid.transform.typeName, "UniformScaleMap")
    expect("voxel size", grid.transform.voxelSize(), (h, h, h))
    expect("voxel (0, 0, 0)", grid.transform.indexToWorld((0, 0, 0)), (0, 0, 0))
    precision = 1e-3 if grid.saveFloatAsHalf else 1e-6
    if not math.isclose(grid.background, 3 * h, rel_tol=precision):
        faults.append(f"background: {grid.background}, not {3 * h}")
    metadata = grid.metadata
    expect("file_voxel_count", metadata.get("file_voxel_count"), grid.activeVoxelCount())
    if grid.activeVoxelCount():
        bounds = grid.evalActiveVoxelBoundingBox()
        expect("file_bbox", (metadata.get("file_bbox_min"), metadata.get("file_bbox_max")), bounds)
    return faults


def dense(grid):
    """All values in the box of the leaves with the margin, and the coordinate of the first value."""
    low, high = grid.evalLeafBoundingBox()
    first = [x - MARGIN for x in low]
    phi = np.empty([b - a + 2 * MARGIN + 1 for a, b in zip(low, high)], np.float32)
    grid.copyToArray(phi, ijk=tuple(first))
    return phi, first


def band_faults(grid, phi):
    """Checks that a voxel is active exactly if |φ| < background, and that others are exactly ± background.

    All active values are within ± background, and the number of active voxels is the number of values within
    ± background. So these are the same voxels.
    """
    faults = []
    background = np.float32(grid.background)
    low, high = grid.evalMinMax()
    if not (-background < low and high < background):
        faults.append(f"active values from {low} to {high}, background {background}")
    within = np.abs(phi) < background
    if within.sum() != grid.activeVoxelCount():
        faults.append(f"{within.sum()} voxels have |φ| < background, {grid.activeVoxelCount()} are active")
    others = np.count_nonzero(np.abs(phi[~within]) != background)
    if others:
        faults.append(f"{others} inactive values are not ± background")
    if not np.isfinite(phi).all():
        faults.append("not all values are finite")
    return faults


def attribute_faults(grid, surface, field):
    """Checks another grid of the file: it is active where the level set is, and has the values of nearby
    particles, which those of `field` are; None does not check the values."""
    faults = []
    active = {item.min for item in surface.citerOnValues()}
    found = {item.min: item.value for item in grid.citerOnValues()}
    if found.keys() != active:
        faults.append(f"{grid.name} is active at {len(found)} voxels, {len(found.keys() ^ active)} of them not the same")
    if grid.transform != surface.transform:
        faults.append(f"{grid.name} is elsewhere: {grid.transform}")
    if np.any(np.array(grid.background) != 0):
        faults.append(f"the background of {grid.name} is {grid.background}")
    if grid.name == "velocity" and grid.vectorType != "contravariant relative":
        faults.append(f"the velocity is of type {grid.vectorType}")
    if field is None:
        return faults
    points = np.array([surface.transform.indexToWorld(voxel) for voxel in found])
    rounding = 0.01 if grid.saveFloatAsHalf else 0.0
    reach = flow.REACH + BAND_VOXELS * flow.VOXEL_SIZE
    return faults + flow.faults_of(grid.name, points, list(found.values()), field, rounding, reach)


def sign_faults(grid, phi):
    """Finds sign leaks: sign changes far from the surface, and values other than the background around the
    leaves."""
    background = np.float32(grid.background)
    leaks = 0
    for axis in range(3):
        near, far = (np.take(phi, range(*part), axis) for part in ((0, phi.shape[axis] - 1), (1, phi.shape[axis])))
        leaks += np.count_nonzero(((near < 0) != (far < 0)) & (np.maximum(abs(near), abs(far)) >= background))
    faults = [f"{leaks} leaks of sign"] if leaks else []
    shell = np.ones(phi.shape, bool)
    shell[1:-1, 1:-1, 1:-1] = False
    if (phi[shell] != background).any():
        faults.append("the grid's surroundings are not its background")
    return faults


def side_faults(grid, phi, first, mesh):
    """Finds voxels on the wrong side of our mesh, among those that are at least a voxel from the surface."""
    h = grid.transform.voxelSize()[0]
    inside = winding_numbers(to_index(mesh[0], grid) - np.array(first), mesh[1], phi.shape)
    sure = abs(phi) >= h
    wrong = np.count_nonzero(((phi < 0) != (inside == 1)) & sure)
    strange = np.count_nonzero((inside != 0) & (inside != 1) & sure)
    faults = [f"{wrong} voxels have the wrong sign"] if wrong else []
    return faults + ([f"the mesh winds around {strange} voxels, but not once"] if strange else [])


def to_index(points, grid):
    """World points in the index coordinates of the grid, in double precision."""
    return points / grid.transform.voxelSize()[0]


def winding_numbers(points, triangles, shape):
    """The winding number of a closed mesh around each point of a lattice: the sum of signed crossings along
    x.

    The rays are displaced a little from the lattice, so that they meet no vertex of a symmetrical mesh.
    """
    corners = points[triangles] - [0, 0.0137, 0.0071]
    crossings = np.zeros(shape, np.int8)
    low = np.ceil(corners[:, :, 1:].min(axis=1)).astype(int)
    extent = (np.floor(corners[:, :, 1:].max(axis=1)).astype(int) - low).max(axis=0)
    a, b, c = (corners[:, k] for k in range(3))
    area = cross(b[:, 1:] - a[:, 1:], c[:, 1:] - a[:, 1:])
    for step in np.ndindex(*(extent + 1)):
        ray = low + step
        weights = [cross(q[:, 1:] - ray, r[:, 1:] - ray) for q, r in ((b, c), (c, a), (a, b))]
        hit = np.logical_and.reduce([weight * np.sign(area) > 0 for weight in weights])
        x = sum(weight[hit] * corner[hit, 0] for weight, corner in zip(weights, (a, b, c))) / area[hit]
        # A ray along x enters the mesh where the normal points to −x.
        np.add.at(crossings, (np.ceil(x).astype(int), *ray[hit].T), -np.sign(area[hit]).astype(np.int8))
    return np.cumsum(crossings, axis=0, dtype=np.int8)


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def gradient_lengths(phi, background):
    """|∇φ| at all active voxels by upwind differences, the usual discretization of the eikonal equation.

    Central differences would be wrong in sheets that are thinner than the band: in their middle, distances
    have a ridge without a gradient.
    """
    sign = np.where(phi[CORE] < 0, -1, 1)
    square = np.zeros(sign.shape)
    for axis in range(3):
        ahead, behind = (tuple(s if a == axis else slice(1, -1) for a in range(3)) for s in (slice(2, None), slice(0, -2)))
        slopes = [sign * (phi[CORE] - phi[side]) for side in (ahead, behind)]
        square += np.maximum(np.maximum(*slopes), 0) ** 2
    return np.sqrt(square[abs(phi[CORE]) < background])


def near_depth(phi, depth):
    """Whether a voxel of the core is near one that is at least this deep."""
    near = phi <= -depth
    for axis in range(3):
        for _ in range(THICK_REACH):
            ahead, behind = (tuple(s if a == axis else slice(None) for a in range(3)) for s in (slice(1, None), slice(0, -1)))
            grown = near.copy()
            grown[ahead] |= near[behind]
            grown[behind] |= near[ahead]
            near = grown
    return near[CORE]


def is_compared(path):
    siblings = len(list(path.parent.glob("*.vdb")))
    number = re.search(r"(\d+)$", path.stem)
    return siblings < 20 or not number or int(number[1]) % SEQUENCE_STRIDE == 1


def compared(path, grid, phi, first, ours, h):
    """Compares OpenVDB's surface with our meshes: distances in both directions."""
    faults = []
    grid, origin = near_origin(grid, phi, first)
    theirs = openvdb_surface(grid)
    ours = (ours[0] - origin, ours[1])
    figures = []
    # Compare the whole surface, and separately its droplets, which OpenVDB's mesher makes smaller.
    only_droplets = piece_sizes(*ours).max() < DROPLET_VOXELS * h
    for name, parts, limit in (
        ("", (ours, theirs), DROPLET_DISTANCE_MAX_VOXELS if only_droplets else DISTANCE_MAX_VOXELS),
        (" of droplets", (droplets(ours, h), droplets(theirs, h)), DROPLET_DISTANCE_MAX_VOXELS),
    ):
        ways = [distances(*pair) / h for pair in zip(parts, (theirs, ours)) if len(pair[0][1])]
        if not ways:
            continue
        means, largest = [way.mean() for way in ways], max(way.max() for way in ways)
        if max(means) > limit:
            faults.append(f"OpenVDB's surface{name} is {max(means):.3f} h from ours in the mean")
        figures.append(f"distance of OpenVDB's mesh{name} {' / '.join(f'{mean:.3f}' for mean in means)} h, {largest:.2f} h at most")
    positions, triangles = read_glb(path.with_suffix(".glb"))
    if path.parent.name == "moving" or path.parent.name.endswith("-up-z"):
        positions = positions[:, [0, 2, 1]] * [1, -1, 1]
    if not np.array_equal(triangles, ours[1]) or abs(positions - origin - ours[0]).max() > 1e-6 * abs(ours[0]).max():
        faults.append("the .glb and the .ply are not the same mesh")
    return ", ".join(figures), faults


def near_origin(grid, phi, first):
    """The grid, and the world position of its origin. A grid far from the origin is moved there: the vertices
    of its mesh are single-precision world positions, whose rounding would otherwise be a visible part of a
    voxel."""
    if np.abs(first).max() < 1 << 16:
        return grid, np.zeros(3)
    moved = vdb.FloatGrid(grid.background)
    moved.copyFromArray(phi)
    moved.gridClass = vdb.GridClass.LEVEL_SET
    moved.transform = vdb.createLinearTransform(grid.transform.voxelSize()[0])
    return moved, np.array(grid.transform.indexToWorld(tuple(first)))


def droplets(mesh, h):
    """The droplets of a mesh: its small pieces."""
    positions, triangles = mesh
    small = piece_sizes(positions, triangles)[triangles[:, 0]] < DROPLET_VOXELS * h
    used, renumbered = np.unique(triangles[small], return_inverse=True)
    return positions[used], renumbered.reshape(-1, 3)


if __name__ == "__main__":
    main()
