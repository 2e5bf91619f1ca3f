"""Checks that Blender and OpenEXR open the .exr picture of a ball, and that every layer exists with the
ball's values.

    OpenEXR    a part of the file for each layer, channels with the usual names
    Blender    image type MULTILAYER; the compositor has an output for each layer, with the same values

The ball has radius 1, is at the origin, and has a velocity. The camera is on the z axis, at a distance of 5
from the origin. So in the middle of the picture, the depth is 4, and the normal points at the camera.
Everywhere on the ball, the normal equals the position, and the mean curvature is 1. The corners of the
picture are empty.
"""

import logging
import os
import shutil
import subprocess
import sys

import bpy
import numpy as np
import OpenEXR

from project import PROGRAM, WORK, Check

FOLDER = WORK / "layers"
SIZE = (321, 201)
VOXEL_SIZE = 0.05
FLIGHT = (1.0, 2.0, 3.0)
EYE_Z = 5.0
CAMERA = f"eye=0:0:{EYE_Z:g},target=0:0:0,view=40,up=y"

# For each layer: its channels; the layer and the name of the output of Blender's image node; the type of its
# values.
LAYERS = {
    "beauty": ("RGBA", ("", "beauty"), np.float16),
    "coverage": (["Y"], ("", "coverage"), np.float16),
    "depth": (["Z"], ("", "depth"), np.float32),
    "normals": (["N.X", "N.Y", "N.Z"], ("normals", "N"), np.float16),
    "position": (["P.X", "P.Y", "P.Z"], ("position", "P"), np.float32),
    "velocity": (["V.X", "V.Y", "V.Z"], ("velocity", "V"), np.float32),
    "curvature": (["Y"], ("", "curvature"), np.float32),
}
# Largest allowed errors: distances in voxels; components of normals; curvature, which has a larger limit
# because it is a second derivative.
DISTANCE_VOXELS = 0.05
NORMAL_OFF = 0.02
CURVATURE_OFF = 0.1


def main():
    sys.stdout.flush()
    sys.stdout = os.fdopen(os.dup(1), "w")
    check = Check(f"layers: OpenEXR {OpenEXR.__version__} and Blender {bpy.app.version_string} open the .exr")
    to_log(WORK / "blender_layers.log")
    picture = render()
    read = {}
    try:
        read, faults = by_openexr(picture)
        check.line("OpenEXR", ", ".join(read), faults or wrong_of_a_ball(read))
    except Exception as error:
        check.line("OpenEXR", "could not read it", [f"{type(error).__name__}: {error}"])
    try:
        figures, faults = by_blender(picture, read)
        check.line("Blender", figures, faults)
    except Exception as error:
        check.line("Blender", "could not read it", [f"{type(error).__name__}: {error}"])
    check.end()


def to_log(path):
    """Redirects the output of Blender to a file."""
    os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), 1)
    logging.disable(logging.INFO)


def render():
    """Renders one particle whose r_min and r_max are 1: its surface is a ball."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    columns = ["x", "y", "z", "vx", "vy", "vz"]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property float {c}" for c in columns)]
    values = np.array([0, 0, 0, *FLIGHT], "<f4").tobytes()
    (FOLDER / "ball.ply").write_bytes("\n".join([*header, "end_header", ""]).encode() + values)
    picture = FOLDER / "ball.exr"
    words = ["--preset", "paper", "--voxel-size", VOXEL_SIZE, "--radius-min", 1, "--radius-ratio", 1, "--attributes", "all"]
    words += ["--size", f"{SIZE[0]}x{SIZE[1]}", "--camera", CAMERA]
    command = [PROGRAM, "render", FOLDER / "ball.ply", "-o", picture, *words]
    subprocess.run([str(word) for word in command], check=True, capture_output=True, timeout=300)
    return picture


def by_openexr(picture):
    """Returns each layer as an array (rows, columns, channels), and faults of names and types."""
    faults, read = [], {}
    parts = {part.name(): part.channels for part in OpenEXR.File(str(picture), separate_channels=True).parts}
    if set(parts) != set(LAYERS):
        faults.append(f"the parts are {', '.join(parts)}")
    for name, (channels, _, dtype) in LAYERS.items():
        found = parts.get(name, {})
        if set(found) != set(channels):
            faults.append(f"{name} has the channels {', '.join(found)}")
            continue
        if any(channel.pixels.dtype != dtype for channel in found.values()):
            faults.append(f"{name} is not of {dtype.__name__}")
        read[name] = np.stack([found[channel].pixels for channel in channels], axis=-1).astype(float)
    return read, faults


def wrong_of_a_ball(read):
    """Compares these layers with the values of the ball, and returns the faults."""
    faults = []

    def expect(what, found, expected, off):
        away = float(np.abs(np.asarray(found) - expected).max())
        if not away <= off:
            faults.append(f"{what} is off by {away:.4g}")

    on_ball = read["coverage"][..., 0] == 1
    # Near the rim, the ray through the middle of a pixel may miss the ball although other rays of the pixel
    # hit it: leave these pixels out.
    inner = on_ball & (np.isfinite(read["depth"][..., 0]))
    middle = (SIZE[1] // 2, SIZE[0] // 2)
    share = on_ball.mean()
    if not 0.05 < share < 0.9:
        faults.append(f"the ball covers {share:.1%} of the picture")
    position, normals = read["position"][inner], read["normals"][inner]
    distance = DISTANCE_VOXELS * VOXEL_SIZE
    expect("the depth at the middle", read["depth"][middle], EYE_Z - 1, distance)
    expect("the normal at the middle", read["normals"][middle], [0, 0, 1], NORMAL_OFF)
    expect("the radius", np.linalg.norm(position, axis=1), 1, distance)
    expect("a normal", normals, position, NORMAL_OFF)
    expect("the depth", read["depth"][inner][:, 0], EYE_Z - position[:, 2], distance)
    expect("the velocity", read["velocity"][inner], FLIGHT, 1e-5)
    expect("the curvature", read["curvature"][inner], 1, CURVATURE_OFF)
    expect("alpha", read["beauty"][..., 3], 1, 0)
    expect("the coverage of the corner", read["coverage"][0, 0], 0, 0)
    if np.ptp(read["beauty"][..., :3], axis=(0, 1)).min() < 0.05:
        faults.append("the beauty is of one colour")
    if not np.abs(read["position"][-1, 0]).max() == 0 or not np.abs(read["normals"][0, -1]).max() == 0:
        faults.append("there is something in the corners")
    return faults


def by_blender(picture, read):
    """Returns the layers that Blender finds, and faults: wrong names, and values that differ from those in
    `read`."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    image = bpy.data.images.load(str(picture))
    faults = []
    # Blender sets the type of the image only after a node has read the image.
    outputs, found = passed_on(image)
    if image.type != "MULTILAYER":
        faults.append(f"its type is {image.type}")
    for name in LAYERS:
        if name not in found:
            faults.append(f"{name} is not there")
            continue
        away = np.abs(found[name] - read[name]).max()
        # The compositor changes neither 16-bit nor 32-bit values.
        if not away <= 1e-6:
            faults.append(f"{name} is off by {away:.3g} from what OpenEXR reads")
    return f"{image.type}: {', '.join(outputs)}", faults


def passed_on(image):
    """Returns the outputs of an image node, and each layer as the compositor writes it."""
    scene = bpy.context.scene
    scene.use_nodes = True
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    tree = scene.node_tree
    tree.nodes.clear()
    outputs, written = [], {}
    for name, (channels, (layer, output), _) in LAYERS.items():
        node = tree.nodes.new("CompositorNodeImage")
        node.image = image
        if layer:
            node.layer = layer
        found = next((each for each in node.outputs if each.enabled and each.name == output), None)
        if found is None:
            continue
        outputs.append(f"{layer}.{output}" if layer else output)
        writer = tree.nodes.new("CompositorNodeOutputFile")
        writer.base_path = str(FOLDER)
        writer.format.file_format = "OPEN_EXR"
        writer.format.color_depth = "32"
        writer.format.exr_codec = "ZIP"
        writer.file_slots[0].path = f"{name}_"
        tree.links.new(found, writer.inputs[0])
        written[name] = len(channels)
    bpy.ops.render.render()
    return outputs, {name: blenders(name, count) for name, count in written.items()}


def blenders(name, count):
    """A layer that Blender wrote: one channel, or as many of R, G, B and A as `count`."""
    (path,) = FOLDER.glob(f"{name}_*.exr")
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    ordered = next(names for names in ("RGBA", "RGB", "XYZ", "V", "Y") if set(names) <= set(channels))
    return np.stack([channels[channel].pixels for channel in ordered], axis=-1).astype(float)[..., :count]


main()
