"""OpenVDB 10 reads every .vdb that was written, and finds a level set in it.

Of each file:

    class, name, background 3 h, transform, the counts and bounds in its metadata
    active exactly where |φ| < background, and exactly ± background elsewhere
    no leak of sign: φ changes sign only between two active voxels, also where tiles meet leaves
    the inside is inside: the sum of negative voxels is the volume of the mesh
    |∇φ| near 1 in the band
    OpenVDB's own mesher makes the same surface of it as our .ply and .glb, within 0.1 h in the mean

Runs in Debian's own Python, for which Debian builds OpenVDB's module.
"""

import math
import multiprocessing
import re
from pathlib import Path

import numpy as np
import pyopenvdb as vdb

from mesh_files import read_glb, read_ply
from project import OUT, Check, frame_of
from surface import distances, openvdb_surface, volume

# Of two frames of a long sequence that are alike, one is enough for the surfaces' distance.
SEQUENCE_STRIDE = 8
# A leaf around all leaves shows what tiles and background are beyond them.
MARGIN = 8


def main():
    check = Check("openvdb: OpenVDB 10 finds level sets")
    paths = sorted(OUT.rglob("*.vdb"))
    with multiprocessing.Pool(2) as pool:
        for label, figures, faults in pool.imap(examined, paths):
            check.line(label, figures, faults)
    check.end()


def examined(path):
    """The line of one file."""
    label = str(path.relative_to(OUT))
    try:
        return (label, *examine(path))
    except Exception as error:
        return label, "could not be examined", [f"{type(error).__name__}: {error}"]


def examine(path):
    grids, metadata = vdb.readAll(str(path))
    if [grid.name for grid in grids] != ["surface"]:
        return "", [f"its grids are {[grid.name for grid in grids]}"]
    grid, frame = grids[0], frame_of(path)
    h = frame["settings"]["voxel_size"]
    faults = header_faults(grid, frame, h)
    if not frame["triangles"]:
        if grid.activeVoxelCount() or not grid.empty():
            faults.append("a mesh without triangles, but a grid with voxels")
        return "empty", faults
    phi, first = dense(grid)
    faults += band_faults(grid, phi) + sign_faults(grid, phi)
    gradients = gradient_lengths(phi, grid.background) / h
    away = abs(gradients.mean() - 1)
    if away > 0.05:
        faults.append(f"the mean of |∇φ| is {gradients.mean():.4f}")
    inside = (phi < 0).sum() * h**3
    # A sum over voxels is off by a fraction of a voxel's depth on the whole area.
    if abs(inside - frame["volume"]) > 0.1 * h * frame["area"]:
        faults.append(f"the negative voxels sum up to {inside:.6g}, the mesh holds {frame['volume']:.6g}")
    figures = (
        f"{grid.activeVoxelCount()} active of {phi.size}, |∇φ| mean {gradients.mean():.4f}, "
        f"99 % within {np.percentile(abs(gradients - 1), 99):.3f} of 1"
    )
    if is_compared(path):
        more, worse = compared(path, grid, h)
        figures, faults = f"{figures}, {more}", faults + worse
    return figures, faults


def header_faults(grid, frame, h):
    """What the header says, against what was reported and what is in the tree."""
    faults = []

    def expect(what, is_value, value):
        if is_value != value:
            faults.append(f"{what}: {is_value!r}, not {value!r}")

    expect("class", grid.gridClass, vdb.GridClass.LEVEL_SET)
    expect("type", grid.valueTypeName, "float")
    expect("transform", grid.transform.typeName, "UniformScaleTranslateMap" if is_shifted(grid) else "UniformScaleMap")
    expect("voxel size", grid.transform.voxelSize(), (h, h, h))
    origin = grid.transform.indexToWorld((0, 0, 0))
    expect("origin in voxels", [abs(x / h - round(x / h)) < 1e-6 for x in origin], [True] * 3)
    precision = 1e-3 if grid.saveFloatAsHalf else 1e-6
    if not math.isclose(grid.background, 3 * h, rel_tol=precision):
        faults.append(f"background: {grid.background}, not {3 * h}")
    metadata = grid.metadata
    expect("file_voxel_count", metadata.get("file_voxel_count"), grid.activeVoxelCount())
    if grid.activeVoxelCount():
        bounds = grid.evalActiveVoxelBoundingBox()
        expect("file_bbox", (metadata.get("file_bbox_min"), metadata.get("file_bbox_max")), bounds)
    return faults


def is_shifted(grid):
    return any(grid.transform.indexToWorld((0, 0, 0)))


def dense(grid):
    """All values around the leaves, and the coordinate of the first."""
    low, high = grid.evalLeafBoundingBox()
    first = [x - MARGIN for x in low]
    phi = np.empty([b - a + 2 * MARGIN + 1 for a, b in zip(low, high)], np.float32)
    grid.copyToArray(phi, ijk=tuple(first))
    return phi, first


def band_faults(grid, phi):
    """Active exactly where |φ| < background, exactly ± background elsewhere.

    All active values lie within the background, and there are as many of them as there are such
    values: so they are the same voxels.
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


def sign_faults(grid, phi):
    """Leaks: a sign that changes without an interface, or an outside that is not outside."""
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


def gradient_lengths(phi, background):
    """|∇φ| by central differences, wherever all six neighbours are in the band."""
    core = tuple([slice(1, -1)] * 3)
    usable = abs(phi[core]) < background
    square = np.zeros(usable.shape)
    for axis in range(3):
        ahead, behind = (tuple(s if a == axis else slice(1, -1) for a in range(3)) for s in (slice(2, None), slice(0, -2)))
        usable &= (abs(phi[ahead]) < background) & (abs(phi[behind]) < background)
        square += (0.5 * (phi[ahead] - phi[behind])) ** 2
    return np.sqrt(square[usable])


def is_compared(path):
    siblings = len(list(path.parent.glob("*.vdb")))
    number = re.search(r"(\d+)$", path.stem)
    return siblings < 20 or not number or int(number[1]) % SEQUENCE_STRIDE == 1


def compared(path, grid, h):
    """How far OpenVDB's surface is from our meshes, both ways."""
    faults = []
    theirs = openvdb_surface(grid)
    ours = read_ply(path.with_suffix(".ply"))
    if not volume(*ours) > 0:
        faults.append(f"the .ply has volume {volume(*ours)}")
    ways = [distances(*pair) / h for pair in ((ours, theirs), (theirs, ours))]
    if max(way.mean() for way in ways) > 0.1:
        faults.append("its surface is not ours")
    positions, triangles = read_glb(path.with_suffix(".glb"))
    if path.parent.name.endswith("-up-z"):
        positions = positions[:, [0, 2, 1]] * [1, -1, 1]
    if not np.array_equal(triangles, ours[1]) or abs(positions - ours[0]).max() > 1e-6 * abs(ours[0]).max():
        faults.append("the .glb and the .ply are not the same mesh")
    means, largest = [way.mean() for way in ways], max(way.max() for way in ways)
    return f"distance of OpenVDB's mesh {means[0]:.3f} h / {means[1]:.3f} h in the mean, {largest:.2f} h at most", faults


if __name__ == "__main__":
    main()
