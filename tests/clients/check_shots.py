"""Checks that Blender imports meshes in the formats of other programs, and plays whole sequences in one file.

    frame         the .glb, the .stl, the .usda and the .abc of one frame: number of vertices or
                  triangles, bounds and volume
    shot.glb      one object for each frame; only the object of the current frame has a scale other than 0
    shot.abc      one object, whose mesh is that of the current frame, with velocities
    gliding       shot.abc and the stage: the mesh between two frames is that of the first, and motion
                  blur by the velocities is as long as the motion during the exposure
    volumes       a stage of level sets: one Volume, whose surface is that of the current frame, and which is rendered:
                  shots_volume.png
    rendered      shots_glb.png, shots_abc.png: the last frame of each shot; all show the same

Runs in separate Pythons, with Blender 4.5 and 5.0 as a module.
"""

import math

import bpy
import numpy as np
from mathutils import Matrix

import glide
from check_blender import PICTURE_DIFFERENCE_MAX, as_mesh, positions_of, render, stage, to_log, transformed
from mesh_files import read_ply
from project import OUT, WORK, Check, frame_of

FPS = 24


def main():
    check = Check(f"shots: Blender {bpy.app.version_string} imports, and plays")
    to_log(WORK / "blender_shots.log")
    for label in ("moving", "moving-quads"):
        folder = OUT / label
        last = sorted(folder.glob("moving.*.ply"))[-1]
        for kind in ("glb", "stl", "usda", "abc"):
            path = last.with_suffix(f".{kind}")
            check.line(f"{label}/{path.name}", *attempted(frame, path, last))
        check.line(f"{label}/shot.glb", *attempted(shot, folder, "glb"))
        check.line(f"{label}/shot.abc", *attempted(shot, folder, "abc"))
    for name in ("shot.abc", "stage.usda"):
        check.line(f"gliding/{name}", *attempted(glided, OUT / "gliding" / name))
    check.line("moving-volumes/stage.usda", *attempted(volumes, OUT / "moving-volumes" / "stage.usda", OUT / "moving"))
    check.line("pictures", *attempted(pictures, OUT / "moving"))
    check.end()


def attempted(examine, *arguments):
    try:
        return examine(*arguments)
    except Exception as error:
        return "could not be imported", [f"{type(error).__name__}: {error}"]


def imported(path, kind="MESH"):
    """The meshes or volumes of a file in an otherwise empty scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = FPS
    {
        ".glb": lambda: bpy.ops.import_scene.gltf(filepath=str(path)),
        ".stl": lambda: bpy.ops.wm.stl_import(filepath=str(path)),
        ".usda": lambda: bpy.ops.wm.usd_import(filepath=str(path)),
        ".abc": lambda: bpy.ops.wm.alembic_import(filepath=str(path)),
    }[path.suffix]()
    bpy.context.view_layer.update()
    found = [obj for obj in bpy.data.objects if obj.type == kind]
    if not found:
        raise RuntimeError(f"no {kind.lower()}")
    return found


def shown(objects):
    """The world positions of the vertices that are visible at the current frame, and the volume inside."""
    graph = bpy.context.evaluated_depsgraph_get()
    points, volume = [], 0.0
    for obj in objects:
        evaluated = obj.evaluated_get(graph)
        if min(evaluated.matrix_world.to_scale()) == 0:
            continue
        mesh = evaluated.to_mesh()
        mesh.calc_loop_triangles()
        vertices = transformed(positions_of(mesh), evaluated.matrix_world)
        triangles = np.empty(3 * len(mesh.loop_triangles), np.int64)
        mesh.loop_triangles.foreach_get("vertices", triangles)
        corners = vertices[triangles.reshape(-1, 3)]
        volume += np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        points.append(vertices)
        evaluated.to_mesh_clear()
    return (np.concatenate(points) if points else np.empty((0, 3))), volume


def faults_of(objects, ply):
    """Compares the surface that is visible at the current frame of the scene with the mesh in a .ply. Both
    have Z up."""
    points, volume = shown(objects)
    expected, _ = read_ply(ply)
    report = frame_of(ply)
    faults = []
    if len(points) != len(expected):
        faults.append(f"{len(points)} vertices instead of {len(expected)}")
    size = np.ptp(expected, axis=0).max()
    for bound in ("min", "max"):
        off = abs(getattr(points, bound)(axis=0) - getattr(expected, bound)(axis=0)).max() if len(points) else np.inf
        if off > 2e-5 * size:
            faults.append(f"its {bound} is off by {off / size:.2g} of its size")
    if abs(volume / report["volume"] - 1) > 1e-3:
        faults.append(f"its volume is {volume}, {report['volume']} was reported")
    return faults


def frame(path, ply):
    objects = imported(path)
    faults = faults_of(objects, ply)
    if len(objects) != 1:
        faults.append(f"{len(objects)} objects")
    mesh = objects[0].data
    if path.suffix in (".usda", ".abc") and "quads" in str(path) and len(mesh.polygons) == len(mesh.loops) // 3:
        faults.append("it has no quads")
    return f"{len(mesh.vertices)} vertices, {len(mesh.polygons)} faces", faults


def shot(folder, kind):
    objects = imported(folder / f"shot.{kind}")
    plys = sorted(folder.glob("moving.*.ply"))
    codes = [int(ply.stem.split(".")[1]) for ply in plys]
    faults, seen = [], []
    for code, ply in zip(codes, plys):
        # A .glb starts at frame 1 of the scene; in Alembic, frames keep their numbers.
        bpy.context.scene.frame_set(code - codes[0] + 1 if kind == "glb" else code)
        faults += [f"frame {code}: {fault}" for fault in faults_of(objects, ply)]
        seen.append(len(shown(objects)[0]))
    # The frame before a missing frame stays visible at the time of the missing one.
    bpy.context.scene.frame_set(3 - codes[0] + 1 if kind == "glb" else 3)
    faults += [f"frame 3: {fault}" for fault in faults_of(objects, plys[1])]
    if kind == "abc" and "velocity" not in evaluated_attributes(objects[0]):
        faults.append("it has no velocities, so its motion is not blurred")
    if len(set(seen)) != len(seen):
        faults.append("frames that should differ are the same")
    return f"{len(objects)} objects, {' '.join(map(str, seen))} vertices at {' '.join(map(str, codes))}", faults


def glided(path):
    """Compares the mesh between two frames with that of the first, and measures motion blur in pictures. The camera
    looks along y; x is to the right."""
    objects = imported(path)
    scene = bpy.context.scene
    plys = sorted(path.parent.glob("gliding.*.ply"))
    counts = [len(read_ply(ply)[0]) for ply in plys]
    faults = [] if len(set(counts)) == 1 else [f"the frames have {counts} vertices, and should have equally many"]
    for frame, subframe in ((1, 0.0), (1, 0.5), (2, 0.0), (2, 0.75), (3, 0.0)):
        scene.frame_set(frame, subframe=subframe)
        faults += [f"at {frame + subframe}: {fault}" for fault in faults_of(objects, plys[frame - 1])]

    scene.frame_set(2)
    points, _ = read_ply(plys[1])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, width = (low + high) / 2, 4.0
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type, camera.data.ortho_scale = "ORTHO", width
    camera.location, camera.rotation_euler = (middle[0], low[1] - 5, middle[2]), (math.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    objects[0].data.materials.append(glowing())
    scene.render.motion_blur_shutter = SHUTTER
    scene.view_settings.view_transform = "Raw"  # the brightness of a pixel is the part of the exposure that is bright
    seen = {}
    for name, motion in (("still", False), ("blurred", True)):
        scene.render.use_motion_blur = motion
        picture = WORK / f"shots_gliding_{path.stem}_{path.suffix[1:]}_{name}.png"
        seen[name] = render(picture, (480, 320), 256).mean(axis=1).reshape(320, 480)
    # The length of the blur: the width in which a row or a column changes from dark to bright, beyond that of the
    # picture at rest.
    rows, columns = (slice(150, 170), slice(None)), (slice(None), slice(230, 250))
    ramps = {name: [partial(image[part]).sum(axis).mean() for part, axis in ((rows, 1), (columns, 0))]
             for name, image in seen.items()}
    along, across = (np.array(ramps["blurred"]) - ramps["still"]) * (width / 480) / PARTIAL
    expected = 2 * SHUTTER * glide.STEP  # at both sides of the block
    if seen["still"].max() < 0.5:
        faults.append("the picture shows nothing")
    if abs(along / expected - 1) > 0.1 or across > 0.02 * expected:
        faults.append(f"it is blurred by {along:.3f} along x and {across:.3f} along z, not by {expected:.3f} and 0")
    return f"{counts[0]} vertices in each frame, blur {along / expected:.2f} as long as the motion", faults


# The exposure, in frames.
SHUTTER = 0.5


# The part of the range from dark to bright that counts: noise is outside.
PARTIAL = 0.8


def partial(image):
    """Which pixels are neither dark nor bright."""
    margin = (1 - PARTIAL) / 2
    return (image > margin * image.max()) & (image < (1 - margin) * image.max())


def glowing():
    """A material that is equally bright everywhere."""
    material = bpy.data.materials.new("glowing")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return material


def volumes(path, folder):
    """Compares the surface of a stage of level sets with the meshes in another folder, and renders it as a volume."""
    objects = imported(path, "VOLUME")
    faults = [] if len(objects) == 1 else [f"{len(objects)} volumes"]
    volume, through = objects[0], as_mesh(objects[0])
    through.hide_render = True
    plys = sorted(folder.glob("moving.*.ply"))
    for ply in plys:
        code = int(ply.stem.split(".")[1])
        bpy.context.scene.frame_set(code)
        volume.data.grids.load()
        names = [grid.name for grid in volume.data.grids]
        if names != ["surface", "velocity"]:
            faults.append(f"frame {code} has the grids {names}")
        points, expected = shown([through])[0], read_ply(ply)[0]
        off = [abs(getattr(points, end)(axis=0) - getattr(expected, end)(axis=0)).max() if len(points) else np.inf
               for end in ("min", "max")]
        # Volume to Mesh of Blender 4.5 moves surfaces by half a voxel. From frame to frame, the block grows by more.
        if max(off) > 0.6 * VOXEL_SIZE:
            faults.append(f"the bounds of frame {code} are off by {max(off) / VOXEL_SIZE:.2f} voxels")
    stage(Matrix(), expected.min(axis=0), expected.max(axis=0))
    volume.data.materials.append(fog())
    picture = render(WORK / "shots_volume.png", (320, 240), 32)
    volume.hide_render = True
    empty = render(WORK / "shots_volume_empty.png", (320, 240), 32)
    changed = (abs(picture - empty).max(axis=1) > 0.1).mean()
    if not 0.1 < changed < 0.9:
        faults.append(f"{100 * changed:.1f} % of the picture differ from that without the volume")
    return f"frames {' '.join(ply.stem[-1] for ply in plys)}, {100 * changed:.0f} % of shots_volume.png differ", faults


VOXEL_SIZE = 0.05


def fog():
    """A material that is dense where the level set is negative."""
    material = bpy.data.materials.new("fog")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    level = nodes.new("ShaderNodeAttribute")
    level.attribute_name = "surface"
    inside, density = nodes.new("ShaderNodeMath"), nodes.new("ShaderNodeMath")
    inside.operation, density.operation = "LESS_THAN", "MULTIPLY"
    inside.inputs[1].default_value, density.inputs[1].default_value = 0.0, 2 / VOXEL_SIZE
    shader, output = nodes.new("ShaderNodeVolumePrincipled"), nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Color"].default_value = (0.10, 0.35, 0.60, 1)
    shader.inputs["Density Attribute"].default_value = ""
    links.new(level.outputs["Fac"], inside.inputs[0])
    links.new(inside.outputs[0], density.inputs[0])
    links.new(density.outputs[0], shader.inputs["Density"])
    links.new(shader.outputs["Volume"], output.inputs["Volume"])
    return material


def evaluated_attributes(obj):
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.attributes.keys()


def pictures(folder):
    """Renders the last frame of each shot, all with the same camera."""
    points, _ = read_ply(sorted(folder.glob("moving.*.ply"))[-1])
    images = {}
    for kind, time in (("glb", 4), ("abc", 4)):
        imported(folder / f"shot.{kind}")
        bpy.context.scene.frame_set(time)
        stage(Matrix(), points.min(axis=0), points.max(axis=0))
        images[kind] = render(WORK / f"shots_{kind}.png")
    faults = [f"shots_{kind}.png shows nothing" for kind, image in images.items() if image.std() < 0.05]
    difference = abs(images["glb"] - images["abc"]).mean()
    if difference > PICTURE_DIFFERENCE_MAX:
        faults.append(f"the pictures differ by {difference:.4f} in the mean")
    return f"difference {difference:.4f} in the mean: {WORK.name}/shots_{{glb,abc}}.png", faults


if __name__ == "__main__":
    main()
