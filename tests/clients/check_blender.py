"""Checks that Blender imports the .glb, .obj, .ply and .vdb of one frame, and renders two pictures of it.

    imported      the number of vertices, the bounds in Blender's axes, outward triangles, and normals that
                  agree with the triangles
    rendered      blender_glb.png     the mesh, with the normals that we wrote
                  blender_vdb.png     the grid, through Blender's Volume to Mesh modifier
                  neither is empty, and both show the same
    attributes    velocity and colour of the .glb and the .ply are attributes with the particles' values
    blurred       blender_still.png, blender_blurred.png
                  the same grid at rest, and with motion blur by the grid `velocity`: blurred along x, sharp
                  along y

Blender has Z up. Its importers rotate .glb and .obj, which have Y up, and do not rotate .ply and .vdb. So the
check rotates all of them to the axes of the particles before it compares them.

Runs in a separate Python, with Blender as a module.
"""

import itertools
import logging
import math
import os
import sys

import bpy
import numpy as np
from mathutils import Matrix, Vector

import flow
from mesh_files import read_ply
from project import DAM_BREAK, DATA, OUT, OWN, WORK, Check, frame_of

SIZE = (640, 480)
SAMPLES = 32
# Largest difference of two pictures by different meshers: the mean over all pixels, of colours from 0 to 1.
PICTURE_DIFFERENCE_MAX = 0.01
# Rotates Z-up coordinates back to those of a file with Y up.
TO_Y_UP = Matrix.Rotation(math.radians(-90), 4, "X")


def main():
    check = Check(f"blender: Blender {bpy.app.version_string} imports and renders")
    to_log(WORK / "blender.log")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    files = frame_files()
    frame = frame_of(files["vdb"])
    points, _ = read_ply(files["ply"])
    low, high = points.min(axis=0), points.max(axis=0)
    surfaces = {}
    for kind in ("glb", "obj", "ply", "vdb"):
        try:
            surfaces[kind] = imported(kind, files[kind])
            examine = examined_volume if kind == "vdb" else examined_mesh
            check.line(files[kind].name, *examine(surfaces[kind], kind, frame, low, high))
        except Exception as error:
            check.line(files[kind].name, "could not be imported", [f"{type(error).__name__}: {error}"])
    if not check.failed:
        check.line("pictures", *rendered(surfaces, frame["settings"]["voxel_size"], low, high))
    for kind in ("glb", "ply"):
        check.line(f"flowing.{kind}", *examined_attributes(kind))
    check.line("motion blur", *blurred())
    check.end()


def to_log(path):
    """Redirects the output of Blender to a file, but not the output of this check."""
    sys.stdout.flush()
    sys.stdout = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), 1)
    logging.disable(logging.INFO)


def frame_files():
    """The files of the dam break, or if they are missing, those of the project's own frame."""
    folder = OUT / "third-party" / "splashsurf" / f"{DAM_BREAK}.bgeo"
    if not (DATA.is_dir() and folder.is_dir()):
        folder = OUT / "own"
    vdb = sorted(folder.glob("*.vdb"))[-1]
    return {kind: vdb.with_suffix(f".{kind}") for kind in ("glb", "obj", "ply", "vdb")}


def imported(kind, path):
    """Imports a file into an otherwise empty scene, and returns its object."""
    before = set(bpy.data.objects)
    importers = {
        "glb": lambda: bpy.ops.import_scene.gltf(filepath=str(path)),
        "obj": lambda: bpy.ops.wm.obj_import(filepath=str(path)),
        "ply": lambda: bpy.ops.wm.ply_import(filepath=str(path), import_colors="LINEAR"),
        "vdb": lambda: bpy.ops.object.volume_import(filepath=str(path)),
    }
    importers[kind]()
    bpy.context.view_layer.update()
    found = [obj for obj in set(bpy.data.objects) - before if obj.type in ("MESH", "VOLUME")]
    if len(found) != 1:
        raise RuntimeError(f"{len(found)} objects instead of one")
    return found[0]


def examined_mesh(obj, kind, frame, low, high):
    mesh = obj.data
    faults = []
    to_particles = (TO_Y_UP if kind in ("glb", "obj") else Matrix()) @ obj.matrix_world
    points = transformed(positions_of(mesh), to_particles)
    triangles = np.empty(3 * len(mesh.polygons), np.int64)
    if len(mesh.loops) != 3 * len(mesh.polygons):
        faults.append("not all faces are triangles")
        return "", faults
    mesh.loops.foreach_get("vertex_index", triangles)
    corners = points[triangles.reshape(-1, 3)]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = np.einsum("ij,ij->i", corners[:, 0], face_normals).sum() / 6
    if (len(points), len(corners)) != (frame["vertices"], frame["triangles"]):
        faults.append(f"{frame['vertices']} vertices and {frame['triangles']} triangles were reported")
    size = (high - low).max()
    off = max(abs(points.min(axis=0) - low).max(), abs(points.max(axis=0) - high).max())
    if off > 1e-5 * size:
        faults.append(f"its bounds are off by {off / size:.2g} of its size")
    if abs(inside / frame["volume"] - 1) > 1e-3:
        faults.append(f"its volume is {inside}, {frame['volume']} was reported")
    agree = normals_agree(mesh)
    if agree < 0.99:
        faults.append(f"only {agree:.2%} of the normals point to the outside of their triangles")
    if mesh.validate():
        faults.append("Blender had to repair it")
    figures = f"{len(points)} vertices, {len(corners)} triangles, volume {inside:.4f}, {agree:.2%} of normals outward"
    return figures, faults


def normals_agree(mesh):
    """The fraction of corners whose normal points to the same side as the normal of the triangle."""
    corner_normals = np.empty(3 * len(mesh.loops), np.float32)
    mesh.corner_normals.foreach_get("vector", corner_normals)
    face_normals = np.empty(3 * len(mesh.polygons), np.float32)
    mesh.polygon_normals.foreach_get("vector", face_normals)
    sides = np.einsum("ijk,ik->ij", corner_normals.reshape(-1, 3, 3), face_normals.reshape(-1, 3))
    return (sides > 0).mean()


def examined_volume(obj, _kind, frame, low, high):
    faults = []
    grids = obj.data.grids
    if not grids.load():
        return "", [f"Blender could not load it: {grids.error_message}"]
    names = [(grid.name, grid.data_type, grid.channels) for grid in grids]
    if names != [("surface", "FLOAT", 1)]:
        faults.append(f"its grids are {names}")
    h = frame["settings"]["voxel_size"]
    to_world = obj.matrix_world @ Matrix(grids[0].matrix_object)
    edges = [to_world.to_3x3() @ Vector(axis) for axis in np.eye(3)]
    if max(abs(edge.length - h) for edge in edges) > 1e-6 * h:
        faults.append(f"its voxels are {[edge.length for edge in edges]}, not {h}")
    bounds = np.array([obj.matrix_world @ Vector(corner) for corner in obj.bound_box])
    # Blender's bounds are those of the leaves, from the first to the last voxel. The band reaches three
    # voxels beyond the surface, and a leaf reaches up to seven voxels beyond the band.
    margins = np.concatenate([low - bounds.min(axis=0), bounds.max(axis=0) - high]) / h
    if margins.min() < 2 or margins.max() > 11:
        faults.append(f"its bounds are {margins.round(2)} voxels outside the mesh's")
    leaves = np.array([bounds.min(axis=0) / h, bounds.max(axis=0) / h + 1]) / 8
    if abs(leaves - leaves.round()).max() > 1e-3:
        faults.append(f"its bounds are {leaves} leaves of voxels")
    return f"grid {names[0][0]}, {margins.min():.2f} to {margins.max():.2f} voxels around the mesh", faults


def examined_attributes(kind):
    """Compares the vertex attributes in Blender with the fields that the particles have."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # Before 5.1, Blender's importer of glTF sometimes fails on files with both vectors and single numbers.
    folder = OUT / ("flowing-vectors" if kind == "glb" else "flowing")
    mesh = imported(kind, folder / f"flowing.{kind}").data
    there = {attribute.name: f"{attribute.data_type} {attribute.domain}" for attribute in mesh.attributes}
    # The importer rotates positions, but not attributes that it does not know.
    points = positions_of(mesh)
    faults = []
    if kind == "glb":
        points = points[:, [0, 2, 1]] * [1, 1, -1]
        velocity = numbers_of(mesh, "_VELOCITY")
    else:
        velocity = np.concatenate([numbers_of(mesh, name) for name in ("vx", "vy", "vz")], axis=1)
        temperature = numbers_of(mesh, "temperature")[:, 0]
        faults += flow.faults_of("temperature", points, temperature, flow.temperature)
    faults += flow.faults_of("velocity", points, velocity, flow.velocity)
    if abs(velocity[:, 0] - 3).max() != 0:
        faults.append(f"a constant is {velocity[:, 0].min()} to {velocity[:, 0].max()}")
    colors, corners = colors_of(mesh)
    # Colours are bytes; those of the .glb have sRGB encoding.
    faults += flow.faults_of("colour", points[corners], colors, flow.color, rounding=0.01)
    return f"{len(points)} vertices, {', '.join(f'{name}: {there[name]}' for name in sorted(there) if name[0] != '.')}", faults


def numbers_of(mesh, name):
    """The values of a scalar or vector attribute at the vertices, as rows."""
    attribute = mesh.attributes[name]
    width, key = (3, "vector") if attribute.data_type == "FLOAT_VECTOR" else (1, "value")
    numbers = np.empty(width * len(attribute.data), np.float32)
    attribute.data.foreach_get(key, numbers)
    return numbers.reshape(-1, width)


def colors_of(mesh):
    """The colours of a mesh (red, green, blue), and the vertex that each belongs to."""
    layer = mesh.color_attributes[0]
    colors = np.empty(4 * len(layer.data), np.float32)
    layer.data.foreach_get("color", colors)
    corners = np.arange(len(mesh.vertices))
    if layer.domain == "CORNER":
        corners = np.empty(len(mesh.loops), np.int64)
        mesh.loops.foreach_get("vertex_index", corners)
    return colors.reshape(-1, 4)[:, :3], corners


def blurred():
    """Renders the grid as smoke, at rest and in motion. The camera looks along z; x is to the right."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    volume = imported("vdb", OUT / "flowing" / "flowing.vdb")
    volume.data.velocity_grid = "velocity"
    volume.data.velocity_unit = "SECOND"
    volume.data.materials.append(smoke())
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type, camera.data.ortho_scale = "ORTHO", 6
    camera.location = (0, 0.4, 10)
    light = bpy.data.objects.new("light", bpy.data.lights.new("light", "SUN"))
    light.data.energy = 5
    for obj in (camera, light):
        scene.collection.objects.link(obj)
    scene.camera = camera
    # The motion during the exposure is two voxels before and after the frame: voxels farther from the surface
    # have no velocity.
    scene.render.fps = 15
    scene.render.motion_blur_shutter = 1.0
    steepest = {}
    for name, motion in (("still", False), ("blurred", True)):
        scene.render.use_motion_blur = motion
        picture = render(WORK / f"blender_{name}.png").mean(axis=1).reshape(SIZE[1], SIZE[0])
        # Profiles through the middle of the ball, along x and along y. Nothing moves up or down there.
        pixels = SIZE[0] / camera.data.ortho_scale
        column, row = SIZE[0] // 2, int(SIZE[1] / 2 + (1 - camera.location[1]) * pixels)
        profiles = picture[row - 8 : row + 8].mean(axis=0), picture[row:, column - 8 : column + 8].mean(axis=1)
        steepest[name] = np.array([abs(np.diff(profile)).max() for profile in profiles])
    along, across = steepest["blurred"] / steepest["still"]
    faults = []
    if steepest["still"].min() < 0.1:
        faults.append("blender_still.png has no edges")
    if along > 0.4 or across < 0.6:
        faults.append("it is not smeared along x, or along y, too")
    figures = f"edges along x are {along:.2f} as steep as at rest, along y {across:.2f}"
    return f"{figures}: {WORK.name}/blender_still.png, {WORK.name}/blender_blurred.png", faults


def smoke():
    """A volume material that is dense where the level set is negative."""
    material = bpy.data.materials.new("smoke")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output = nodes.new("ShaderNodeOutputMaterial")
    scatter = nodes.new("ShaderNodeVolumeScatter")
    inside = nodes.new("ShaderNodeMath")
    inside.operation = "LESS_THAN"
    inside.inputs[1].default_value = 0
    dense = nodes.new("ShaderNodeMath")
    dense.operation = "MULTIPLY"
    dense.inputs[1].default_value = 15
    phi = nodes.new("ShaderNodeAttribute")
    phi.attribute_name = "surface"
    links.new(phi.outputs["Fac"], inside.inputs[0])
    links.new(inside.outputs[0], dense.inputs[0])
    links.new(dense.outputs[0], scatter.inputs["Density"])
    links.new(scatter.outputs[0], output.inputs["Volume"])
    return material


def rendered(surfaces, h, low, high):
    """Renders the mesh and the volume from the same camera. Returns figures, and the faults of the
    pictures."""
    for name in ("obj", "ply"):
        bpy.data.objects.remove(surfaces[name])
    mesh, volume = surfaces["glb"], surfaces["vdb"]
    # Blender rotated the mesh, not the grid: rotate the grid the same way. Volume to Mesh of Blender 4 assumes that
    # values are at cell centres, as those of Blender's fog volumes, and so moves surfaces by half a voxel: move
    # the grid back.
    shift = -h / 2 if bpy.app.version < (5, 0, 0) else 0.0
    volume.matrix_world = Matrix.Translation((shift,) * 3) @ TO_Y_UP.inverted() @ volume.matrix_world
    volume.hide_render = True
    through = as_mesh(volume)
    # The outermost points are drops, which its mesher makes smaller: see check_openvdb.py.
    away = bounds_away(through, low, high) / h
    faults = [f"through Volume to Mesh, the bounds are off by {away:.2f} voxels"] if away > 0.6 else []
    material = clay()
    for obj in (mesh, through):
        obj.data.materials.clear()
        obj.data.materials.append(material)
    stage(TO_Y_UP.inverted(), low, high)
    pictures = {}
    for name, shown, hidden in (("glb", mesh, through), ("vdb", through, mesh)):
        shown.hide_render, hidden.hide_render = False, True
        pictures[name] = render(WORK / f"blender_{name}.png")
    faults += [f"blender_{name}.png shows nothing" for name, picture in pictures.items() if picture.std() < 0.05]
    difference = abs(pictures["glb"] - pictures["vdb"]).mean()
    if difference > PICTURE_DIFFERENCE_MAX:
        faults.append(f"the pictures differ by {difference:.4f} in the mean")
    figures = f"contrast {pictures['glb'].std():.3f}, mean difference {difference:.4f}, bounds {away:.2f} h apart"
    return f"{figures}: {WORK.name}/blender_glb.png, {WORK.name}/blender_vdb.png", faults


def as_mesh(volume):
    """An object that shows a volume, at its position, through Blender's own mesher."""
    obj = bpy.data.objects.new("through_volume", bpy.data.meshes.new("through_volume"))
    bpy.context.scene.collection.objects.link(obj)
    modifier = obj.modifiers.new("mesh", "VOLUME_TO_MESH")
    modifier.object = volume
    modifier.grid_name = "surface"
    modifier.resolution_mode = "GRID"
    modifier.threshold = 0.0
    modifier.use_smooth_shade = True
    return obj


def bounds_away(obj, low, high):
    """The largest distance between the bounds of the mesh that an object shows and these bounds, `low` and
    `high`."""
    bpy.context.view_layer.update()
    shown = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = transformed(positions_of(shown.to_mesh()), TO_Y_UP @ obj.matrix_world)
    shown.to_mesh_clear()
    return max(abs(points.min(axis=0) - low).max(), abs(points.max(axis=0) - high).max())


def clay():
    """A coloured material, with enough gloss to show every fold and step of the surface."""
    material, shader = new_material("clay")
    shader.inputs["Base Color"].default_value = (0.10, 0.35, 0.60, 1)
    shader.inputs["Roughness"].default_value = 0.3
    return material


def new_material(name):
    """A material with one shader, and that shader."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    shader, output = nodes.new("ShaderNodeBsdfPrincipled"), nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return material, shader


def stage(turn, low, high):
    """Adds camera, sun, sky and ground around a box. The box is in the axes of the particles; `turn` rotates
    it to Blender's axes."""
    scene = bpy.context.scene
    corners = np.array([turn @ Vector(corner) for corner in itertools.product(*zip(low, high))])
    bottom, top = corners.min(axis=0), corners.max(axis=0)
    center, radius = 0.5 * (bottom + top), 0.5 * np.linalg.norm(top - bottom)

    bpy.ops.mesh.primitive_plane_add(size=40 * radius, location=(center[0], center[1], bottom[2]))
    ground, shader = new_material("ground")
    shader.inputs["Base Color"].default_value = (0.6, 0.57, 0.52, 1)
    bpy.context.object.data.materials.append(ground)

    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle = 3.0, math.radians(2)
    sun.rotation_euler = (math.radians(50), 0, math.radians(40))
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    nodes = world.node_tree.nodes
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (0.6, 0.75, 1, 1)
    background.inputs["Strength"].default_value = 0.5
    world.node_tree.links.new(background.outputs["Background"], output.inputs["Surface"])
    scene.world = world

    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    view = Vector((0.8, -1.6, 1.0)).normalized()
    distance = 0.8 * radius / math.sin(camera.data.angle_y / 2)
    camera.location = Vector(center) + view * distance
    camera.rotation_euler = (-view).to_track_quat("-Z", "Y").to_euler()
    camera.data.clip_start, camera.data.clip_end = distance / 1000, distance * 100
    for obj in (sun, camera):
        scene.collection.objects.link(obj)
    scene.camera = camera


def render(path, size=SIZE, samples=SAMPLES):
    """Renders to a file, and returns the picture in the file."""
    scene = bpy.context.scene
    prepare_render(scene, size, samples)
    path.unlink(missing_ok=True)
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return pixels_of(path)


def prepare_render(scene, size, samples):
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_denoising = False
    scene.cycles.seed = 0
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "Standard"


def pixels_of(path):
    """Red, green and blue of a picture."""
    image = bpy.data.images.load(str(path))
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(-1, 4)[:, :3]


def positions_of(mesh):
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", points)
    return points.reshape(-1, 3).astype(float)


def transformed(points, matrix):
    matrix = np.array(matrix)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


if __name__ == "__main__":
    main()
