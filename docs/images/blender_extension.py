"""Makes blender_live.jpg: points, their live surface, and a render with motion blur. Needs Blender as a Python
module and pymeniscus (`pip install bpy ./python`); run it in the root of the repository:

    python docs/images/blender_extension.py
"""

import os
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

sys.dont_write_bytecode = True
sys.path.insert(0, "blender")
import meniscus
import pymeniscus

PANEL = (420, 340)
PICTURE = Path("docs/images/blender_live.jpg")
FRAME = Path("examples/frames/dam.0005.bgeo")


def main():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    meniscus.register()
    source = add_points()
    light()
    panels = [panel()]
    bpy.context.view_layer.objects.active = source
    bpy.ops.meniscus.add_surface()
    surface = bpy.context.object
    surface.data.materials.append(material((0.05, 0.25, 0.55), 0.08))
    panels.append(panel())
    scene = bpy.context.scene
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    panels.append(panel())
    whole = np.concatenate(panels, axis=1)
    picture = bpy.data.images.new("whole", whole.shape[1], whole.shape[0])
    picture.pixels.foreach_set(whole.ravel())
    picture.filepath_raw, picture.file_format = str(PICTURE), "JPEG"
    picture.save(quality=80)
    meniscus.unregister()
    sys.stdout.flush()
    # Blender as a module does not always exit.
    os._exit(0)


def add_points():
    """The particles of a frame as a point cloud of Geometry Nodes, with Z up."""
    particles = pymeniscus.read(FRAME)
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    points = (particles.positions @ turn.T).astype(np.float32)
    name = next(name for name, role in particles.roles.items() if role == "velocity")
    velocity = (particles[name] @ turn.T).astype(np.float32)
    mesh = bpy.data.meshes.new("dam")
    mesh.vertices.add(len(points))
    mesh.attributes["position"].data.foreach_set("vector", points.ravel())
    mesh.attributes.new("velocity", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", velocity.ravel())
    source = bpy.data.objects.new("dam", mesh)
    bpy.context.collection.objects.link(source)
    tree = bpy.data.node_groups.new("points", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    names = ("NodeGroupInput", "GeometryNodeMeshToPoints", "GeometryNodeSetMaterial", "NodeGroupOutput")
    nodes = [tree.nodes.new(each) for each in names]
    nodes[1].inputs["Radius"].default_value = 0.008
    nodes[2].inputs["Material"].default_value = material((0.05, 0.25, 0.55), 0.4)
    for a, b in zip(nodes, nodes[1:]):
        tree.links.new(a.outputs[0], b.inputs[0])
    source.modifiers.new("points", "NODES").node_group = tree
    bpy.context.view_layer.update()
    return source


def light():
    scene = bpy.context.scene
    scene.world = world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.85, 0.9, 1, 1)
    world.node_tree.nodes["Background"].inputs[1].default_value = 0.6
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 3.5, Vector((1, -0.6, 1.4)).to_track_quat("Z", "Y").to_euler()
    bpy.ops.mesh.primitive_plane_add(size=20, location=(0, 0, -0.02))
    bpy.context.object.data.materials.append(material((0.6, 0.57, 0.52), 0.6))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    points = np.array([corner[:] for corner in bpy.data.objects["dam"].bound_box])
    center = Vector(points.mean(axis=0))
    camera.location = center + Vector((0.5, -1, 0.55)).normalized() * 2.7 * np.ptp(points, axis=0).max()
    camera.rotation_euler = (center - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens = 62
    for each in (sun, camera):
        scene.collection.objects.link(each)
    scene.camera = camera
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 24
    scene.render.resolution_x, scene.render.resolution_y = PANEL
    scene.render.fps = 24


def material(color, roughness):
    made = bpy.data.materials.new("material")
    made.use_nodes = True
    inputs = made.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value, inputs["Roughness"].default_value = (*color, 1), roughness
    return made


def panel():
    """Renders the scene. Returns rows of pixels from the bottom, four numbers per pixel."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "panel.png"
        bpy.context.scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(path))
        pixels = np.empty(PANEL[0] * PANEL[1] * 4, np.float32)
        image.pixels.foreach_get(pixels)
    return pixels.reshape(PANEL[1], PANEL[0], 4)


main()
