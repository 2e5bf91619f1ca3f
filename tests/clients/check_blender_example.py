"""Checks that examples/blender/import_sequence.py shows the right file at each frame, also while a sequence
grows, and in a saved .blend that is opened again.

    frames        numbers without padding and with a gap; vertices, bounds, velocities and normals are those of the file;
                  the panel lists missing frames; the material stays
    grown         a new frame is shown and extends the scene; a rewritten frame is shown, too
    attributes    scalars and vectors in one .glb, and colours
    chosen        a folder, a file, a pattern; the error lists several sequences; steps; Z up
    command line  frames per second; the saved scene plays in a Blender that has only the .blend
    rendered      example_glb.png, example_vdb.png: one frame, with the same picture from both formats
                  example_glb_0003.png and so on: an animation from each format, each frame with its surface
                  example_blurred.png: the attribute `velocity` blurs the mesh

Runs in a separate Python, with Blender as a module.
"""

import contextlib
import importlib.util
import io
import os
import re
import shutil
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
from mathutils import Matrix

import flow
from check_blender import (
    PICTURE_DIFFERENCE_MAX, clay, numbers_of, pixels_of, positions_of, prepare_render, render, stage, to_log, transformed,
)
from mesh_files import read_ply
from project import OWN, ROOT, WORK, Check, convert, frame_of

SCRIPT = ROOT / "examples" / "blender" / "import_sequence.py"
FOLDER = WORK / "example"
SIZE, SAMPLES = (480, 360), 16
TURN = Matrix.Rotation(np.pi / 2, 4, "X")


def main():
    check = Check(f"blender_example: Blender {bpy.app.version_string} imports sequences")
    to_log(WORK / "blender_example.log")
    shutil.rmtree(FOLDER, ignore_errors=True)
    global example
    example = loaded()
    # The paper's meshes have one vertex for each cell, as those that Blender makes of a .vdb.
    options = ["--preset", "paper", "--format", "glb,vdb,ply", "--attributes", "velocity"]
    status, said, _ = convert([OWN], FOLDER / "own", *options)
    check.line("own frames", f"exit status {status}", [said] if status else [])
    for label, examine, *wanted in (
        ("dam.####.glb", lambda: frames("glb"), "frame 11 is missing: dam shows dam.10.glb", "frame 3 is missing"),
        ("dam.####.vdb", lambda: frames("vdb"), "frame 11 is missing", "dam.13.vdb was written again"),
        ("attributes", attributes),
        ("choices", choices, "with a step of 2", "splash.7.glb: incomplete .glb; splash is unchanged"),
        ("Z up", turned),
        ("command line", command_line),
        ("pictures", pictures),
        ("animation of .glb", lambda: animation("glb")),
        ("animation of .vdb", lambda: animation("vdb")),
        ("motion blur", blurred),
    ):
        try:
            with contextlib.redirect_stdout(io.StringIO()) as said:
                figures, faults = examine()
            check.line(label, figures, faults + [f"not said: {words}" for words in wanted if words not in said.getvalue()])
        except Exception as error:
            check.line(label, "did not come to its end", [f"{type(error).__name__}: {error}"])
    check.end()


def loaded():
    """The script, loaded as a module."""
    spec = importlib.util.spec_from_file_location("import_sequence", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def empty_scene():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def own(number, kind):
    return FOLDER / "own" / f"dam.{number:04}.{kind}"


def put(number, folder, kind, as_number):
    """Puts one of our frames into a folder under another number, with a rename, as meniscus does."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(own(number, kind), folder / ".coming")
    os.replace(folder / ".coming", folder / f"dam.{as_number}.{kind}")


def voxel_size():
    return frame_of(own(1, "ply"))["settings"]["voxel_size"]


def faults_of(obj, number, turn=TURN):
    """Compares the mesh that an object shows at the current frame with the mesh of one of our frames."""
    graph = bpy.context.evaluated_depsgraph_get()
    evaluated = obj.evaluated_get(graph)
    mesh = evaluated.to_mesh()
    points = transformed(positions_of(mesh), obj.matrix_world)
    expected, _ = read_ply(own(number, "ply"))
    expected = transformed(expected, turn)
    h = voxel_size()
    is_level_set = bool(obj.modifiers)
    faults = []
    if not is_count(len(points), len(expected), is_level_set):
        faults.append(f"{len(points)} vertices instead of {len(expected)}")
    else:
        # Blender's mesher puts vertices at other positions in their cells, so the bounds differ, too.
        allowed = (0.3 if is_level_set else 1e-4) * h
        off = max(abs(getattr(points, end)(axis=0) - getattr(expected, end)(axis=0)).max() for end in ("min", "max"))
        if not off <= allowed:
            faults.append(f"its bounds are off by {off / h:.2g} voxels")
    if not is_level_set and not faults:
        faults += vertex_faults(mesh, points, expected, number, turn)
    evaluated.to_mesh_clear()
    return faults


def is_count(found, expected, is_level_set):
    """Whether this number of vertices is right. Where sheets of fluid meet in a cell, Blender's mesher of level sets
    puts other numbers of vertices into it."""
    return abs(found - expected) <= (0.001 * expected if is_level_set else 0)


def vertex_faults(mesh, points, expected, number, turn):
    h = voxel_size()
    turn = np.array(turn)[:3, :3]
    faults = []
    if not abs(points - expected).max() <= 1e-4 * h:
        faults.append("its vertices are elsewhere")
    velocity = np.stack([read_column(number, name) for name in ("vx", "vy", "vz")], axis=1) @ turn.T
    away = abs(numbers_of(mesh, "velocity") - velocity).max()
    if not away <= 1e-5 * (1 + abs(velocity).max()):
        faults.append(f"velocities are off by {away:.2g}")
    normals = np.stack([read_column(number, name) for name in ("nx", "ny", "nz")], axis=1) @ turn.T
    corners = np.empty(3 * len(mesh.loops), np.float32)
    mesh.corner_normals.foreach_get("vector", corners)
    vertices = np.empty(len(mesh.loops), np.int64)
    mesh.loops.foreach_get("vertex_index", vertices)
    if not abs(corners.reshape(-1, 3) - normals[vertices]).max() <= 1e-4:
        faults.append("normals are not the file's")
    if mesh.validate():
        faults.append("Blender had to repair it")
    return faults


def read_column(number, name):
    """A vertex property of a binary .ply in which all vertex properties are floats."""
    data = own(number, "ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().split("element face")[0].splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property")]
    rows = np.frombuffer(body, "<f4", count * len(names)).reshape(count, -1)
    return rows[:, names.index(name)].astype(float)


def frames(kind):
    """Checks a growing sequence: our frames 1, 2, 3 and 5 are its frames 8, 9, 10 and 12. Then our frame 6
    becomes frame 13, and our frame 8 replaces it; our frame 4 fills the gap at 11."""
    folder = FOLDER / f"growing-{kind}"
    for number in (1, 2, 3, 5):
        put(number, folder, kind, number + 7)
    scene = empty_scene()
    obj = example.import_sequence(scene, folder)
    material = clay()
    obj.data.materials.append(material)
    faults = []
    if (scene.frame_start, scene.frame_end) != (8, 12):
        faults.append(f"the scene is {scene.frame_start} to {scene.frame_end}")

    def look(frame, number):
        scene.frame_set(frame)
        faults.extend(f"frame {frame}: {fault}" for fault in faults_of(obj, number))

    # In place of a missing frame, the object shows the last frame before it, or the first frame if no earlier
    # one exists. The order of the visits must not matter.
    for frame, number in ((8, 1), (9, 2), (10, 3), (11, 3), (12, 5), (13, 5), (3, 1), (9, 2), (13, 5)):
        look(frame, number)
        if frame == 11:
            faults.extend(panel_faults("Frame 11 is missing: shows 10"))
    put(6, folder, kind, 13)
    look(13, 6)
    if scene.frame_end != 13:
        faults.append(f"the scene ends at {scene.frame_end} although frame 13 exists")
    put(8, folder, kind, 13)
    put(4, folder, kind, 11)
    scene.frame_set(13)
    bpy.ops.meniscus.reload()
    faults += [f"written again: {fault}" for fault in faults_of(obj, 8)]
    look(11, 4)
    if list(obj.data.materials) != [material]:
        faults.append("it has lost its material")
    return "8 9 10 (11) 12 (13), then 13, 13 again and 11", faults


def panel_faults(words):
    """Whether the panel has this label. Without a window, it draws on a mock layout."""
    layout = MagicMock()
    example.MENISCUS_PT_sequences.draw(SimpleNamespace(layout=layout), bpy.context)
    labels = [call.kwargs["text"] for call in layout.box().label.call_args_list]
    return [] if words in labels else [f"the panel says {labels}"]


def attributes():
    """Checks attributes against the known fields of `flow.py`, in the axes of the particles: Z is up."""
    folder = FOLDER / "flowing"
    folder.mkdir()
    flow.write_particles(folder / "flowing.7.ply")
    options = ["--format", "glb", "--attributes", "all", "--voxel-size", str(flow.VOXEL_SIZE)]
    status, said, _ = convert([folder / "flowing.7.ply"], folder, *options)
    mesh = example.import_sequence(empty_scene(), folder, None, "Z").data
    points = positions_of(mesh)
    colors = np.empty(4 * len(points), np.float32)
    mesh.color_attributes["Color"].data.foreach_get("color", colors)
    faults = [said] if status else []
    faults += flow.faults_of("velocity", points, numbers_of(mesh, "velocity"), flow.velocity)
    faults += flow.faults_of("temperature", points, numbers_of(mesh, "temperature")[:, 0], flow.temperature)
    faults += flow.faults_of("colour", points, colors.reshape(-1, 4)[:, :3], flow.color)
    for which in ("active_color_name", "default_color_name"):
        if getattr(mesh.attributes, which) != "Color":
            faults.append(f"{which} is “{getattr(mesh.attributes, which)}”")
    names = sorted(name for name in mesh.attributes.keys() if name[0] != ".")
    if names != ["Color", "_ID", "custom_normal", "position", "temperature", "velocity"]:
        faults.append(f"the attributes are {names}")
    return ", ".join(names), faults


def choices():
    faults = []

    def refused(path, words, *options):
        try:
            example.import_sequence(empty_scene(), path, *options)
            faults.append(f"{path.name} {options} was imported")
        except ValueError as error:
            faults.extend(f"no “{word}” in “{error}”" for word in words if word not in str(error))

    def taken(path, number, *options, frame=2):
        scene = empty_scene()
        obj = example.import_sequence(scene, path, *options)
        scene.frame_set(frame)
        faults.extend(f"{path.name} {options}: {fault}" for fault in faults_of(obj, number))
        return obj

    folder = FOLDER / "several"
    for name in ("dam.0002.glb", "dam.0004.glb", "dam.0002.vdb"):
        folder.mkdir(exist_ok=True)
        shutil.copy(own(2, "glb").with_name(name), folder / name)
    for path, options in ((folder, ()), (folder, (".vdb",)), (folder / "dam.####.vdb", ()), (folder / "dam.0004.glb", ())):
        obj = taken(path, 2, *options)
        if bool(obj.modifiers) != ("vdb" in f"{path.name}{options}"):
            faults.append(f"{path.name} {options} is the other format")
    taken(folder, 4, None, "Y", 2)
    (folder / "splash.7.glb").write_bytes(b"glTF")
    refused(folder, ["dam.####.glb", "splash.####.glb"])
    refused(folder / "wave.####.glb", ["wave.####.glb"])
    refused(folder / "dam.0002.vdb", ["not a .glb"], ".glb")
    refused(folder / "dam.0002.glb", ["no volume"], None, "Y", 1, True)
    shutil.copy(own(2, "glb"), folder / "broken.1.vdb")
    refused(folder / "broken.1.vdb", ["surface"])
    refused(WORK / "venv", ["contains no numbered"])
    (folder / "steps.3000000.glb").write_bytes(b"glTF")
    refused(folder / "steps.3000000.glb", ["beyond Blender's last frame"])
    scene = empty_scene()
    obj = example.import_sequence(scene, folder / "splash.7.glb")
    if len(obj.data.vertices):
        faults.append("a file that is cut off was shown")
    bpy.ops.meniscus.import_sequence(filepath=str(folder / "dam.0002.glb"), step=2)
    if [obj.name for obj in scene.objects] != ["splash", "dam"]:
        faults.append(f"the operator imported {[obj.name for obj in scene.objects]}")
    bare = example.import_sequence(empty_scene(), own(3, "vdb"), None, "Z", 1, True)
    if bare.type != "VOLUME" or bare.data.velocity_grid != "velocity" or bare.matrix_world != Matrix():
        faults.append("the volume alone is imported wrongly")
    return "folder, file, pattern, format, step; several, none, cut off", faults


def turned():
    """Checks Z up: with `--up z` the .glb records the axis, and the script sets it for a .vdb. Both must be
    at the positions of the particles."""
    out = FOLDER / "turned"
    options = ["--preset", "paper", "--format", "glb", "--up", "z", "--voxel-size", repr(voxel_size())]
    status, said, _ = convert([OWN / "dam.0005.bgeo"], out, *options)
    faults = [said] if status else []
    scene = empty_scene()
    for up in ("Y", "Z"):
        obj = example.import_sequence(scene, out, None, up)
        points, _ = read_ply(own(5, "ply"))
        off = abs(transformed(positions_of(obj.data), obj.matrix_world) - points).max() / np.ptp(points)
        if not off <= 2e-5:
            faults.append(f"up {up}: off by {off:.2g} of its size")
    obj = example.import_sequence(scene, own(5, "vdb"), None, "Z")
    return "vertices are where those of the .ply are", faults + faults_of(obj, 5, Matrix())


def command_line():
    """Checks a saved scene in a separate Blender, where the script runs as a text of the .blend."""
    seen, faults = [], []
    for kind in ("glb", "vdb"):
        scene = FOLDER / f"{kind}.blend"
        command = [SCRIPT, FOLDER / "own", "--format", kind, "--fps", "23.976", "--save", scene]
        said = run(*command)
        if f"dam.####.{kind}, frames 1 to 8, 0 missing" not in said:
            faults.append(said)
        look = (
            f"import bpy; bpy.ops.wm.open_mainfile(filepath={str(scene)!r}, use_scripts={kind == 'glb'}); "
            "scene = bpy.context.scene; scene.frame_set(6); obj = bpy.data.objects['dam']; "
            "mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh(); "
            "print('seen', scene.frame_start, scene.frame_end, round(scene.render.fps / scene.render.fps_base, 6), len(mesh.vertices))"
        )
        said = run("-c", look)
        found = re.search(r"seen 1 8 23\.976 (\d+)", said)
        seen.append(found and found[0])
        expected = frame_of(own(6, "ply"))["vertices"]
        if not found or not is_count(int(found[1]), expected, is_level_set=kind == "vdb"):
            faults.append(f"{scene.name}: {expected} vertices expected: {said}")
    # A .vdb sequence without gaps needs no script: Blender's own file sequence shows it.
    return f"{seen[0]}; the .vdb without the script", faults


def run(*words):
    command = [sys.executable, *map(str, words)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL)
    return f"{ran.stdout}{ran.stderr}{f' exit status {ran.returncode}' if ran.returncode else ''}"


def placed(path, frame):
    """A sequence with a material in an otherwise empty scene, with a camera for pictures of our fifth
    frame."""
    scene = empty_scene()
    obj = example.import_sequence(scene, path)
    obj.data.materials.append(clay())
    scene.frame_set(frame)
    points, _ = read_ply(own(5, "ply"))
    stage(TURN, points.min(axis=0), points.max(axis=0))
    prepare_render(scene, SIZE, SAMPLES)
    return scene, obj


def pictures():
    images = {}
    for kind in ("glb", "vdb"):
        placed(own(1, kind), 5)
        images[kind] = render(WORK / f"example_{kind}.png", SIZE, SAMPLES)
    faults = [f"example_{kind}.png shows nothing" for kind, image in images.items() if not image.std() >= 0.05]
    difference = abs(images["glb"] - images["vdb"]).mean()
    if not difference <= PICTURE_DIFFERENCE_MAX:
        faults.append(f"the pictures differ by {difference:.4f} in the mean")
    return f"mean difference {difference:.4f}: {WORK.name}/example_glb.png, {WORK.name}/example_vdb.png", faults


def animation(kind):
    """Renders an animation of three frames: the handler must also run during a render."""
    scene, _ = placed(own(1, kind), 1)
    prepare_render(scene, SIZE, 2)
    scene.frame_start, scene.frame_end = 3, 5
    scene.render.filepath = str(WORK / f"example_{kind}_####")
    bpy.ops.render.render(animation=True)
    images = [pixels_of(WORK / f"example_{kind}_{frame:04}.png") for frame in (3, 4, 5)]
    expected = []
    for frame in (3, 4, 5):
        scene.frame_set(frame)
        expected.append(render(WORK / "example_still.png", SIZE, 2))
    (WORK / "example_still.png").unlink()
    away = [[abs(image - still).mean() for still in expected] for image in images]
    is_each = [np.argmin(row) == index and row[index] < 1e-3 for index, row in enumerate(away)]
    changes = min(away[0][1], away[1][2])
    faults = [f"frame {frame} is another" for frame, is_own in zip((3, 4, 5), is_each) if not is_own]
    if not changes >= 5e-3:
        faults.append("frames that should differ are the same")
    return f"neighbours differ by {changes:.4f}: {WORK.name}/example_{kind}_0003.png to 0005", faults


def blurred():
    """Renders our fifth frame with and without motion blur: at the right, the water rises fast; at the left,
    it hardly moves."""
    scene, _ = placed(own(1, "glb"), 5)
    still = render(WORK / "example_glb.png", SIZE, SAMPLES)
    scene.render.use_motion_blur = True
    scene.render.motion_blur_shutter = 1.0
    scene.render.fps = 12
    moved = render(WORK / "example_blurred.png", SIZE, SAMPLES)
    changes = abs(moved - still).mean(axis=1).reshape(SIZE[1], SIZE[0])
    left, right = changes[:, : SIZE[0] // 3].mean(), changes[:, 2 * SIZE[0] // 3 :].mean()
    faults = [] if right > max(3 * left, 0.003) else ["it is not smeared where it moves, or also where it does not"]
    return f"pixels change by {left:.4f} where water rests, {right:.4f} where it rises: {WORK.name}/example_blurred.png", faults


if __name__ == "__main__":
    main()
