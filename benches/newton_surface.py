"""Reconstructs a mesh for each frame in a folder with Newton's ParticleSurface, on its CPU backend.

    newton_surface.py water|isotropic CELL PARTICLES MESHES

It reads the .ply files in PARTICLES, which `examples/paper quality write=PARTICLES` writes with the particle
spacing in their headers. For each it writes a mesh of the same name into MESHES. CELL is the edge length of a
surface voxel in spacings. `benches/quality` runs this script in a virtual environment for Newton.
"""

import re
import sys
from pathlib import Path

import numpy
import warp
from newton.geometry import ParticleSurface

# The settings of Newton's dam-break example. It has three particles along the edge of a simulation cell, and
# surface voxels of 0.3 cells, which are 0.9 spacings. Lengths are in particle spacings.
WATER = {
    "kernel_radius": 3.0,
    "threshold": 0.25,
    "smooth_lambda": 0.0,
    "anisotropic": True,
    "kernel_scale": 0.6,
    "anisotropy_ratio": 16.0,
    "anisotropy_scale": 2.0,
    "anisotropy_min_neighbors": 4,
    "anisotropy_binning": True,
    "anisotropy_strength": 0.95,
    "field_smooth_iterations": 1,
    "field_smooth_radius": 2,
    "field_mode": "sdf",
    "redistance_iterations": 1,
    "mesh_smooth_iterations": 1,
}
SETTINGS = {"water": WATER, "isotropic": WATER | {"anisotropic": False, "anisotropy_binning": False, "threshold": 0.1}}
LENGTHS = ("voxel_size", "kernel_radius")


def main():
    settings = SETTINGS[sys.argv[1]] | {"voxel_size": float(sys.argv[2])}
    particles, meshes = map(Path, sys.argv[3:])
    warp.config.quiet = True
    warp.init()
    meshes.mkdir(parents=True, exist_ok=True)
    for path in sorted(particles.glob("*.ply")):
        write(meshes / path.name, *surface_of(*read(path), settings))


def surface_of(positions, spacing, settings):
    """Returns vertices and triangles."""
    with warp.ScopedDevice("cpu"):
        settings = settings | {length: settings[length] * spacing for length in LENGTHS}
        radii = warp.full(len(positions), 0.5 * spacing, dtype=float)
        mesh = ParticleSurface(**settings).extract(warp.array(positions, dtype=warp.vec3), radii)
        vertices, corners, _ = mesh.to_arrays()
    if vertices is None:
        return numpy.zeros((0, 3)), numpy.zeros((0, 3))
    return vertices.numpy(), corners.numpy().reshape(-1, 3)


def read(path):
    """Returns the positions in a file of single-precision x, y, z, and their spacing."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", header)[1])
    spacing = float(re.search(rb"spacing: (\S+)", header)[1])
    return numpy.frombuffer(body, "<f4", 3 * count).reshape(-1, 3), spacing


def write(path, vertices, triangles):
    header = (
        f"ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    faces = numpy.empty(len(triangles), [("count", "u1"), ("corners", "<u4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    path.write_bytes(header.encode("ascii") + vertices.astype("<f4").tobytes() + faces.tobytes())


if __name__ == "__main__":
    main()
