"""Makes obstacles.jpg: Fig. 15 and 16 of the paper. Needs Blender as a Python module (`pip install bpy`); run
it in the root of the repository:

    cargo build --release && python docs/images/obstacles.py

The upper row has a layer of particles on the inner walls of a hollow tetrahedron; the block around the hollow
is the obstacle. The lower row has a frame of examples/frames with a ball in the water, cut open at the centre
of the ball.
"""

import os
import struct
import subprocess
import tempfile
from pathlib import Path

import bpy
import bmesh  # A module of Blender, which exists only after the import of bpy.
import numpy as np
from mathutils import Euler, Vector

PROGRAM = os.environ.get("MENISCUS", "target/release/meniscus")
PANEL = (460, 400)
PICTURE = Path("docs/images/obstacles.jpg")
WATER, WALL = (0.10, 0.32, 0.62), (0.80, 0.36, 0.12)
# Labels and options of the columns. By default, voids narrower than 1 h are filled.
WAYS = [("no obstacle", None), ("intersections removed", ["--void-threshold", "0"]), ("and voids filled", [])]


def main():
    with tempfile.TemporaryDirectory() as folder:
        rows = [tetrahedron(Path(folder)), ball(Path(folder))]
    whole = np.concatenate([np.concatenate(row, axis=1) for row in reversed(rows)], axis=0)
    picture = bpy.data.images.new("whole", whole.shape[1], whole.shape[0])
    picture.pixels.foreach_set(whole.ravel())
    picture.filepath_raw, picture.file_format = str(PICTURE), "JPEG"
    picture.save(quality=80)


def tetrahedron(folder):
    """Particles on the faces of a tetrahedron, at least 3.2 h apart."""
    voxel_size = 0.04
    turn = Euler((0.3, 0.2, 0.5)).to_matrix()
    corners = np.array([turn @ Vector(c) for c in [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]])
    faces = [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]
    chance = np.random.default_rng(7)
    weights = chance.dirichlet((1, 1, 1), 40000)
    places = np.einsum("nk,nkd->nd", weights, corners[np.array(faces)[chance.integers(4, size=40000)]])
    particles = []
    for place in places:
        if not particles or np.square(np.array(particles) - place).sum(axis=1).min() > (3.2 * voxel_size) ** 2:
            particles.append(place)
    # Displace particles: some are a little outside the tetrahedron, and more of them inside.
    particles = np.array(particles) * (1 - chance.uniform(-0.05, 0.06, (len(particles), 1)))
    # A block with a hole in the shape of the tetrahedron: the faces of the hole point into it.
    block = [(x, y, z) for x in (-2, 2) for y in (-2, 2) for z in (-2, 2)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face[::-1] for face in faces] + [[corner + 4 for corner in quad] for quad in quads]
    wall = write_obj(folder / "mould.obj", [*corners, *block], faces)
    points = write_csv(folder / "tetrahedron.csv", particles)
    view = ((-1, -1, 0.6), Vector((-0.15, 0, -0.1)), 4.8)
    panels = []
    for label, options in WAYS:
        start()
        show(reconstructed(points, wall, options, voxel_size), WATER)
        panels.append(rendered(folder / "panel.png", label, *view))
    return panels


def ball(folder):
    """A ball where the water is deep. The particles inside it are removed, as if the simulation had the ball,
    too."""
    voxel_size, center, radius = 0.0264, Vector((0.62, -0.3, 0.24)), 0.15
    particles = read_bgeo(Path("examples/frames/dam.0006.bgeo"))
    particles = particles[np.linalg.norm(particles - np.array(center), axis=1) > radius + 1.5 * voxel_size]
    points = write_csv(folder / "ball.csv", particles)
    wall = folder / "ball.obj"
    panels = []
    for label, options in WAYS:
        start()
        bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5, radius=radius, location=center)
        body = bpy.context.object
        bpy.ops.object.transform_apply()
        write_obj(wall, [v.co for v in body.data.vertices], [p.vertices for p in body.data.polygons])
        water = reconstructed(points, wall, options, voxel_size)
        # The cut plane of the water is a little in front of that of the ball, so that water inside the ball
        # is visible.
        cut_open(body, center.y + 2e-4, WALL)
        cut_open(water, center.y, WATER)
        panels.append(rendered(folder / "panel.png", label, (-0.25, -1, 0.35), center + Vector((0.02, 0, -0.03)), 0.72))
    return panels


def cut_open(thing, depth, color):
    """Removes everything in front of the plane y = `depth`, and closes the cut in a lighter color."""
    show(thing, color)
    thing.data.materials.append(material([0.3 + 0.5 * part for part in color]))
    mesh = bmesh.new()
    mesh.from_mesh(thing.data)
    everything = [*mesh.verts, *mesh.edges, *mesh.faces]
    cut = bmesh.ops.bisect_plane(mesh, geom=everything, plane_co=(0, depth, 0), plane_no=(0, -1, 0), clear_outer=True)
    edges = [part for part in cut["geom_cut"] if isinstance(part, bmesh.types.BMEdge)]
    filled = bmesh.ops.triangle_fill(mesh, use_beauty=True, edges=edges, normal=(0, -1, 0))
    for part in filled["geom"]:
        if isinstance(part, bmesh.types.BMFace):
            part.material_index, part.smooth = 1, False
    mesh.to_mesh(thing.data)
    mesh.free()


def reconstructed(points, wall, options, voxel_size):
    """The mesh of these particles. `options` is None for a surface without an obstacle."""
    obstacle = [] if options is None else ["--obstacle", wall, *options]
    out = points.with_suffix("")
    command = [PROGRAM, "convert", points, "--out", out, "--format", "ply", "--voxel-size", str(voxel_size), *obstacle]
    subprocess.run(command, check=True, capture_output=True)
    bpy.ops.wm.ply_import(filepath=str(out / f"{points.stem}.ply"))
    return bpy.context.object


def read_bgeo(path):
    """Positions of a classic BGEO file with velocities and Y up; returns them with Z up."""
    data = path.read_bytes()
    (count,) = struct.unpack_from(">i", data, 9)
    points = np.frombuffer(data, ">f4", count * 7, len(data) - 2 - count * 28).reshape(-1, 7)
    return points[:, [0, 2, 1]].astype(float) * (1, -1, 1)


def write_csv(path, points):
    np.savetxt(path, points, delimiter=",", header="x,y,z", comments="", fmt="%.7g")
    return path


def write_obj(path, corners, faces):
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def start():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    background = world.node_tree.nodes["Background"].inputs
    background[0].default_value, background[1].default_value = (0.9, 0.93, 0.97, 1), 0.7
    for direction, energy in [((-1, -1, 2), 3.0), ((2, -0.5, 1), 1.5)]:
        sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
        sun.data.energy = energy
        sun.rotation_euler = (-Vector(direction)).to_track_quat("-Z", "Y").to_euler()
        bpy.context.collection.objects.link(sun)


def show(thing, color):
    thing.data.materials.clear()
    thing.data.materials.append(material(color))
    thing.data.polygons.foreach_set("use_smooth", [True] * len(thing.data.polygons))


def material(color):
    made = bpy.data.materials.new("material")
    made.use_nodes = True
    surface = made.node_tree.nodes["Principled BSDF"].inputs
    surface["Base Color"].default_value, surface["Roughness"].default_value = (*color, 1), 0.3
    return made


def rendered(path, label, direction, center, distance):
    """Renders a panel of the picture to a file. Returns its rows of pixels from the bottom, four numbers per
    pixel."""
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens = 50
    camera.location = center + Vector(direction).normalized() * distance
    camera.rotation_euler = (center - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene = bpy.context.scene
    scene.collection.objects.link(camera)
    scene.camera = camera
    text = bpy.data.objects.new("label", bpy.data.curves.new("label", "FONT"))
    text.data.body, text.data.size = label, 0.0055
    text.parent, text.location = camera, (-0.067, -0.057, -0.2)
    text.data.materials.append(material((0.01, 0.01, 0.01)))
    scene.collection.objects.link(text)
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 32
    scene.render.resolution_x, scene.render.resolution_y = PANEL
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    panel = bpy.data.images.load(str(path))
    pixels = np.empty(PANEL[0] * PANEL[1] * 4, np.float32)
    panel.pixels.foreach_get(pixels)
    return pixels.reshape(PANEL[1], PANEL[0], 4)


main()
