"""Checks the guarantees of meniscus for obstacles with trimesh: dam breaks around an obstacle, and a
tetrahedron covered with particles (paper, Fig. 15 and 16).

    clear       no vertex is deeper in the obstacle than a quarter of a voxel
    no void     wherever fluid covers the obstacle, the mesh is within a quarter of a voxel of the obstacle,
                except next to the contact line, where its edge is rounded
    certified   the frame's certificate holds, and the report states the same depth of the deepest vertex

The obstacle in the dam breaks is splashsurf's icosphere, scaled and moved to where most of the water is. The
particles in it are removed, as if the simulation had the obstacle, too. Runs in a separate Python, with
trimesh.
"""

import gzip
import shutil
import struct

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from mesh_files import read_ply
from project import DATA, WORK, Check, convert, data_is_there

FOLDER = WORK / "obstacles"
# Largest depth of a vertex in the obstacle, and largest distance of the mesh from a wet wall, in voxels.
DEPTH_MAX = 0.25
# Fluid covers a point of the obstacle if the surface without the obstacle contains the place at this distance in
# front of the point, in voxels. Thinner films end where the mesh meets the obstacle; a void below the place is
# narrower than the threshold, and so gets filled.
FILM = 1.25
VOID_THRESHOLD = 2.0
# Points so near to the contact line, in voxels, are not checked: the edge of the fluid is rounded.
CONTACT_WIDTH = 1.0
# The number of points that are measured together.
PART = 500
# The mesh rounds sharp edges of the obstacle up to this distance, in voxels: wet points near them are not
# checked.
EDGE_WIDTH = 1.0
FRAMES = {
    "dam_break_frame_23_24389_particles.bgeo": 0.025,
    "double_dam_break_frame_26_4732_particles.csv": 0.05,
}


def main():
    check = Check(f"obstacles: trimesh {trimesh.__version__} measures depths and gaps")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    if data_is_there():
        for name, voxel_size in FRAMES.items():
            check.line(name, *dam_break(name, voxel_size))
    check.line("tetrahedron", *tetrahedron("tetrahedron", 0.02))
    check.line("tetrahedron, particles apart", *tetrahedron("apart", 0.08, has_void=True))
    check.end()


def dam_break(name, voxel_size):
    """Checks an icosphere in a dam break."""
    folder = DATA / "third-party" / "splashsurf"
    particles = (read_bgeo if name.endswith("bgeo") else read_csv)(folder / name)
    obstacle = trimesh.load_mesh(folder / "icosphere.obj", process=True)
    radius = 6 * voxel_size
    tree = cKDTree(particles)
    counts = [len(near) for near in tree.query_ball_point(particles, 1.5 * radius)]
    obstacle.apply_scale(radius)
    obstacle.apply_translation(particles[int(np.argmax(counts))])
    outside = ~obstacle.contains(particles)
    return measured(name.split(".")[0], particles[outside], obstacle, voxel_size)


def tetrahedron(name, lift, has_void=False):
    """Checks a tetrahedron with particles at a distance of `lift` from its faces, as in the paper."""
    corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], float)
    faces = [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]
    obstacle = trimesh.Trimesh(corners, faces, process=False)
    particles, _ = trimesh.sample.sample_surface_even(obstacle, 4000, seed=7)
    closest, _, triangles = obstacle.nearest.on_surface(particles)
    particles = closest + lift * obstacle.face_normals[triangles]
    return measured(name, particles, obstacle, 0.04, has_void)


def measured(name, particles, obstacle, voxel_size, has_void=False):
    """Reconstructs the surface of the particles around the obstacle. Returns figures and faults."""
    points, wall, out = FOLDER / f"{name}.csv", FOLDER / f"{name}.obj", FOLDER / "out"
    np.savetxt(points, particles, delimiter=",", header="x,y,z", comments="", fmt="%.9g")
    obstacle.export(wall)
    options = ["--voxel-size", str(voxel_size), "--format", "ply,glb"]
    at_wall = ["--obstacle", wall, "--void-threshold", str(VOID_THRESHOLD)]
    surfaces = []
    for more in [], at_wall:
        status, said, frames = convert([points], out, *options, *more)
        frame = frames.get(points.name, {})
        if status or frame.get("status") != "converted":
            return f"exit status {status}", [said.strip()]
        vertices, triangles = read_ply(out / f"{name}.ply")
        surfaces.append(trimesh.Trimesh(vertices, triangles, process=False))
    depth = deepest(obstacle, vertices, voxel_size)
    gap, wet_count = widest_gap(obstacle, *surfaces, voxel_size)
    report = frame["obstacles"]
    faults = []
    if depth > DEPTH_MAX:
        faults.append(f"a vertex is {depth:.3f} h deep in the obstacle")
    if gap > DEPTH_MAX:
        faults.append(f"the surface is {gap:.3f} h from the obstacle where there is fluid")
    if wet_count < 200:
        faults.append(f"only {wet_count} places of the obstacle are wet")
    if not frame["certificate"]["holds"]:
        faults.append(f"not certified: {frame['certificate']}")
    if abs(report["deepest_vertex_voxels"] - depth) > 0.02:
        faults.append(f"the report says {report['deepest_vertex_voxels']} h deep")
    if has_void and not report["void_voxels_filled"]:
        faults.append("the report counts no filled void")
    figures = f"{depth:.3f} h deep, gaps of {gap:.3f} h at {wet_count} wet places, {report['void_voxels_filled']} voxels filled"
    return figures, faults


def deepest(obstacle, vertices, voxel_size):
    """The largest depth of a vertex in the obstacle, in voxels."""
    low, high = obstacle.bounds
    near = ((vertices > low - voxel_size) & (vertices < high + voxel_size)).all(axis=1)
    # trimesh's signed distances are positive inside.
    return max(trimesh.proximity.signed_distance(obstacle, vertices[near]).max(), 0.0) / voxel_size


def widest_gap(obstacle, without, surface, voxel_size):
    """The largest distance of the surface from a wet point of the obstacle, in voxels; and the number of wet
    points. `without` is the surface without the obstacle."""
    places, faces = trimesh.sample.sample_surface(obstacle, 6000, seed=1)
    in_front = places + FILM * voxel_size * obstacle.face_normals[faces]
    # trimesh's signed distances are positive inside.
    is_wet = in_parts(lambda part: trimesh.proximity.signed_distance(without, part) > 0, in_front)
    from_dry, _ = cKDTree(places[~is_wet]).query(places) if not is_wet.all() else (np.inf, None)
    is_flat = edge_distances(obstacle, places) > EDGE_WIDTH * voxel_size
    wet = places[is_wet & is_flat & (from_dry > CONTACT_WIDTH * voxel_size)]
    if len(wet) == 0:
        return 0.0, 0
    gaps = in_parts(lambda part: trimesh.proximity.closest_point(surface, part)[1], wet)
    return gaps.max() / voxel_size, len(wet)


def in_parts(measure, points):
    """Measures points in parts, because trimesh takes megabytes for each."""
    return np.concatenate([measure(part) for part in np.array_split(points, len(points) // PART + 1)])


def edge_distances(obstacle, places):
    """The distances of points from the nearest edge whose faces have normals more than 60 degrees apart."""
    sharp = obstacle.face_adjacency_edges[obstacle.face_adjacency_angles > np.pi / 3]
    nearest = np.full(len(places), np.inf)
    for start, end in obstacle.vertices[sharp]:
        along = (places - start) @ (end - start) / ((end - start) @ (end - start))
        feet = start + np.clip(along, 0, 1)[:, None] * (end - start)
        nearest = np.minimum(nearest, np.linalg.norm(places - feet, axis=1))
    return nearest


def read_csv(path):
    """The positions in a .csv file whose first line has names."""
    return np.genfromtxt(path, delimiter=",", skip_header=1)[:, :3]


def read_bgeo(path):
    """The positions in a gzipped classic BGEO file whose attributes are four-byte numbers."""
    data = gzip.decompress(path.read_bytes())
    point_count, _, _, _, attribute_count, *_ = struct.unpack(">8i", data[9:41])
    at, words = 41, 4
    for _ in range(attribute_count):
        (name_bytes,) = struct.unpack_from(">H", data, at)
        size, _ = struct.unpack_from(">Hi", data, at + 2 + name_bytes)
        at += 2 + name_bytes + 6 + 4 * size
        words += size
    points = np.frombuffer(data, ">f4", point_count * words, at).reshape(-1, words)
    return points[:, :3].astype(float)


main()
