"""Checks the Blender extension in blender, which Blender's own code builds, installs, updates and removes.

    lifecycle     Blender validates and installs the extension, updates, disables and removes it; nothing stays
    live          a point cloud of Geometry Nodes with a radius for each point: the mesh, its velocities and colours,
                  other options, undo, and a file that is saved and opened, also without the extension
    times         100,000 points, computed on the thread: the preview, full quality, and how long the main
                  thread is busy with a change and with a tick
    newest        of many changes, only the last one gets full quality; unregistering ends the thread
    errors        points that cannot be read, with the reason in the panel
    rendered      frames 1 to 10, each with its own surface, with motion blur
                  extension_0001.png and so on, extension_still.png: frame 5 without blur

Runs in separate Pythons, with Blender 4.5 and 5.0 as a module. The argument is the wheel of pymeniscus.
"""

import contextlib
import importlib
import io
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

# A folder of its own for what Blender installs. Blender reads it when it starts.
HOME = Path(tempfile.mkdtemp(prefix="meniscus-blender-"))
os.environ["BLENDER_USER_RESOURCES"] = str(HOME)

import bpy
import numpy as np

from check_blender import clay, numbers_of, pixels_of, positions_of, prepare_render, stage, to_log
from project import ROOT, STRICT_TIMES, WORK, Check
from mathutils import Matrix

FOLDER = WORK / "extension"
SIZE = (320, 240)
PREVIEW_SECONDS, FULL_SECONDS, MAIN_SECONDS = 0.3, 2.0, 0.05
MODULE = "bl_ext.user_default.meniscus"


def main():
    check = Check(f"blender_extension: Blender {bpy.app.version_string} surfaces points")
    to_log(WORK / "blender_extension.log")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    wheel = Path(sys.argv[1])
    try:
        for label, examine in (
            ("installed", lambda: installed(wheel)),
            ("live surface", live_surface),
            ("saved, opened", saved),
            ("times", times),
            ("newest request", newest),
            ("errors", errors),
            ("frames 1 to 10", rendered),
            ("removed", lambda: removed(wheel)),
        ):
            try:
                check.line(label, *examine())
            except Exception as error:
                check.line(label, "did not come to its end", [f"{type(error).__name__}: {error}"])
    finally:
        shutil.rmtree(HOME, ignore_errors=True)
    check.end()


# Installation


def blender_ext(*words):
    """Runs Blender's own command for extensions."""
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    ran = subprocess.run([sys.executable, tool, *map(str, words)], capture_output=True, text=True, timeout=120)
    return [] if ran.returncode == 0 else [f"blender_ext.py {words[0]}: {ran.stdout}{ran.stderr}"]


def built(wheel, out):
    ran = subprocess.run(
        [sys.executable, ROOT / "blender" / "build.py", "--out", out, wheel],
        capture_output=True, text=True, check=True, timeout=120,
    )
    return Path(ran.stdout.strip())


def part(name):
    return importlib.import_module(f"{MODULE}.{name}")


def installed(wheel):
    archive = built(wheel, FOLDER)
    faults = blender_ext("validate", archive)
    bpy.ops.preferences.addon_enable(module="bl_pkg")
    bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)
    if MODULE not in bpy.context.preferences.addons:
        faults.append("it is not enabled")
    import pymeniscus

    if not Path(pymeniscus.__file__).is_relative_to(HOME):
        faults.append(f"pymeniscus is that of {pymeniscus.__file__}")
    return f"{archive.name}, {archive.stat().st_size:,} bytes, valid", faults


def removed(wheel):
    """Updates, disables and removes the extension. Then Blender has no trace of it."""
    source = FOLDER / "newer"
    shutil.copytree(ROOT / "blender", source / "blender", dirs_exist_ok=True)
    shutil.copy(ROOT / "LICENSE-MIT", source)
    manifest = source / "blender" / "meniscus" / "blender_manifest.toml"
    manifest.write_text(manifest.read_text().replace('version = "0.1.0"', 'version = "0.1.1"', 1))
    ran = subprocess.run(
        [sys.executable, source / "blender" / "build.py", "--out", FOLDER, wheel],
        capture_output=True, text=True, check=True,
    )
    bpy.ops.extensions.package_install_files(
        filepath=ran.stdout.strip(), repo="user_default", enable_on_install=True
    )
    faults = []
    found = sorted(HOME.rglob("meniscus/blender_manifest.toml"))
    if len(found) != 1 or '"0.1.1"' not in found[0].read_text():
        faults.append(f"the update is not there: {found}")
    if MODULE not in bpy.context.preferences.addons:
        faults.append("the update disabled it")
    faults += traces(False)
    bpy.ops.preferences.addon_disable(module=MODULE)
    faults += traces(True)
    bpy.ops.extensions.package_uninstall(repo_index=repository(), pkg_id="meniscus")
    stays = [path for path in HOME.rglob("*") if "meniscus" in path.name]
    faults += [f"{path.relative_to(HOME)} stays" for path in stays]
    return "updated, disabled, removed: no file, class, property, handler, timer or thread stays", faults


def repository():
    repos = bpy.context.preferences.extensions.repos
    return next(index for index, repo in enumerate(repos) if repo.module == "user_default")


def traces(is_disabled):
    """What should not be there after the extension was disabled, or not be missing before."""
    found = [f"the type {name}" for name in dir(bpy.types) if "meniscus" in name.lower()]
    found += ["Object.meniscus"] if hasattr(bpy.types.Object, "meniscus") else []
    for name in dir(bpy.app.handlers):
        handlers = getattr(bpy.app.handlers, name)
        if isinstance(handlers, list):
            found += [f"a handler in {name}" for each in handlers if each.__module__.startswith(MODULE)]
    if not is_disabled:
        return [] if len(found) > 10 else ["the update is not registered"]
    found += [f"the thread {each.name}" for each in threading.enumerate() if "meniscus" in each.name]
    draws = getattr(bpy.types.STATUSBAR_HT_header.draw, "_draw_funcs", [])
    found += ["a function in the status bar" for each in draws if each.__module__.startswith(MODULE)]
    return [f"{what} stays" for what in found]


# Scenes


def water(count):
    """Points on a jittered lattice under a wave, their spacing, velocities and colours."""
    spacing, chance = 0.02, np.random.default_rng(1)
    n = round((count / 4) ** (1 / 3))
    points = np.stack(np.meshgrid(*(np.arange(k) for k in (2 * n, 2 * n, n)), indexing="ij"), -1).reshape(-1, 3)
    points = (points + chance.uniform(-0.15, 0.15, points.shape)) * spacing
    points[:, 2] *= 1 + 0.3 * np.sin(8 * points[:, 0])
    velocity = np.zeros_like(points)
    velocity[:, 0] = 3 * points[:, 2]
    colors = np.concatenate([points / points.max(axis=0), np.ones((len(points), 1))], axis=1)
    return points.astype(np.float32), velocity.astype(np.float32), colors.astype(np.float32)


def empty_scene():
    # Factory settings would disable the extension.
    bpy.ops.wm.read_homefile(use_empty=True)
    return bpy.context.scene


def add_points(scene, count, is_moving=False):
    """An object whose Geometry Nodes make a point cloud, with a random radius for each point. If `is_moving`, the
    points drift with the frame."""
    points, velocity, colors = water(count)
    mesh = bpy.data.meshes.new("points")
    mesh.vertices.add(len(points))
    mesh.attributes["position"].data.foreach_set("vector", points.ravel())
    mesh.attributes.new("velocity", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", velocity.ravel())
    mesh.attributes.new("dye", "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
    obj = bpy.data.objects.new("water", mesh)
    scene.collection.objects.link(obj)
    tree = bpy.data.node_groups.new("points", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    node = {name: tree.nodes.new(name) for name in (
        "NodeGroupInput", "NodeGroupOutput", "GeometryNodeMeshToPoints", "FunctionNodeRandomValue",
        "GeometryNodeSetPosition", "GeometryNodeInputSceneTime", "ShaderNodeCombineXYZ",
    )}
    low, high = node["FunctionNodeRandomValue"].inputs[2:4]
    low.default_value, high.default_value = 0.022, 0.026
    make = tree.links.new
    make(node["NodeGroupInput"].outputs[0], node["GeometryNodeMeshToPoints"].inputs["Mesh"])
    make(node["FunctionNodeRandomValue"].outputs[1], node["GeometryNodeMeshToPoints"].inputs["Radius"])
    make(node["GeometryNodeMeshToPoints"].outputs[0], node["GeometryNodeSetPosition"].inputs["Geometry"])
    make(node["GeometryNodeSetPosition"].outputs[0], node["NodeGroupOutput"].inputs[0])
    if is_moving:
        make(node["GeometryNodeInputSceneTime"].outputs["Seconds"], node["ShaderNodeCombineXYZ"].inputs["X"])
        make(node["ShaderNodeCombineXYZ"].outputs[0], node["GeometryNodeSetPosition"].inputs["Offset"])
    obj.modifiers.new("points", "NODES").node_group = tree
    bpy.context.view_layer.objects.active = obj
    bpy.context.view_layer.update()
    return obj, high


def add_surface(count, is_moving=False):
    scene = empty_scene()
    source, high = add_points(scene, count, is_moving)
    bpy.ops.meniscus.add_surface()
    return scene, source, bpy.context.object, high


def expected(source, surface, **options):
    """The same surface by pymeniscus, without the extension."""
    import pymeniscus

    graph = bpy.context.evaluated_depsgraph_get()
    geometry = source.evaluated_get(graph).evaluated_geometry()
    cloud = geometry.pointcloud
    points, radii = np.empty(3 * len(cloud.points), np.float32), np.empty(len(cloud.points), np.float32)
    cloud.attributes["position"].data.foreach_get("vector", points)
    cloud.attributes["radius"].data.foreach_get("value", radii)
    spacing = f"{surface.meniscus.spacing:.7g}"
    return pymeniscus.reconstruct(points.reshape(-1, 3), radii=radii, spacing=spacing, preset="fluid", **options)


def faults_against(mesh, wanted):
    """Compares a mesh with a surface of pymeniscus: positions to the bit, and triangles."""
    positions, faults = positions_of(mesh), []
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    if positions.shape != wanted.vertices.shape or not (positions == wanted.vertices).all():
        faults.append(f"{len(positions)} vertices instead of {len(wanted.vertices)}, or at other positions")
    if not np.array_equal(corners, wanted.triangles.ravel()):
        faults.append("its triangles are others")
    if not len(positions):
        faults.append("it is empty")
    return faults


# Live surfaces


def live_surface():
    scene, source, surface, high = add_surface(20_000)
    mesh, settings, faults = surface.data, surface.meniscus, []
    if mesh.validate():
        faults.append("Blender had to repair it")
    if surface.type != "MESH" or not settings.use_radius:
        faults.append("the radii of the points are not used")
    faults += faults_against(mesh, expected(source, surface))
    first = len(mesh.vertices)
    # Fields that are linear in space: their means over the particles around a vertex are close to them.
    points, velocity = positions_of(mesh), numbers_of(mesh, "velocity")
    off = abs(velocity - np.stack([3 * points[:, 2], 0 * points[:, 0], 0 * points[:, 0]], axis=1)).max()
    if not off <= 0.2:
        faults.append(f"velocities are off by {off:.2g}")
    if mesh.attributes["dye"].data_type != "FLOAT_COLOR" or mesh.attributes.active_color_name != "dye":
        faults.append("the colours are missing")
    dye = np.empty(4 * len(points), np.float32)
    mesh.attributes["dye"].data.foreach_get("color", dye)
    red, span = dye[::4], points[:, 0].max()
    if not abs(red - np.clip(points[:, 0] / span, 0, 1)).max() <= 0.1:
        faults.append("the colours are others")
    normals = np.empty(3 * len(mesh.loops), np.float32)
    mesh.corner_normals.foreach_get("vector", normals)
    if not np.isfinite(normals).all() or not abs(np.linalg.norm(normals.reshape(-1, 3), axis=1) - 1).max() < 1e-3:
        faults.append("normals are wrong")

    # A parameter, a node, and undo.
    settings.options.voxel_size = 0.6
    settings.options.use_voxel_size = True
    faults += [f"voxel size: {fault}" for fault in faults_against(mesh, expected(source, surface, voxel_size="0.6d"))]
    coarser = len(surface.data.vertices)
    high.default_value = 0.04
    bpy.context.view_layer.update()
    faults += [f"radius: {fault}" for fault in faults_against(mesh, expected(source, surface, voxel_size="0.6d"))]
    if not first > coarser > 0:
        faults.append(f"a larger voxel size gave {coarser} vertices instead of {first}")
    faults += undone()
    faults += panel_faults()
    faults += undone_in_window()
    return f"{first} vertices, velocity, dye; {coarser} with larger voxels", faults


def undone():
    """Undo returns to the former option and to its mesh."""
    _, source, surface, _ = add_surface(5_000)
    bpy.ops.ed.undo_push(message="surface")
    first = len(surface.data.vertices)
    surface.meniscus.options.voxel_size = 0.7
    surface.meniscus.options.use_voxel_size = True
    bpy.ops.ed.undo_push(message="voxel size")
    second = len(surface.data.vertices)
    bpy.ops.ed.undo()
    surface = bpy.data.objects["water surface"]
    faults = []
    if surface.meniscus.options.use_voxel_size or len(surface.data.vertices) != first or second == first:
        faults.append(f"undo: {first}, then {second}, then {len(surface.data.vertices)} vertices")
    bpy.ops.ed.redo()
    surface = bpy.data.objects["water surface"]
    if not surface.meniscus.options.use_voxel_size or len(surface.data.vertices) != second:
        faults.append(f"redo: {len(surface.data.vertices)} vertices instead of {second}")
    return faults


def undone_in_window():
    """With a window, the mesh may be older than its options after undo, and Blender evaluates the scene only when it
    draws: so also in a view layer that was never shown. The timer makes the mesh."""
    with event_loop() as live:
        scene, _, surface, _ = add_surface(5_000)
        until(live, lambda: "full quality" in live.status_of(surface).made)
        surface.data.clear_geometry()
        del surface.data[part("meshes").SIGNATURE]
        bpy.context.window.view_layer = scene.view_layers.new("never shown")
        live.on_load()
        try:
            until(live, lambda: len(surface.data.vertices), 10)
        except Exception as error:
            return [f"after undo: {type(error).__name__}: {error}"]
    return []


def drawn(name):
    """The labels and properties that a panel draws. Without a window, it draws on a mock layout."""
    layout = MagicMock()
    for nested in ("row", "column", "box"):
        getattr(layout, nested).return_value = layout
    panel = next(each for each in part("live").CLASSES if each.__name__ == name)
    panel.draw(SimpleNamespace(layout=layout), bpy.context)
    labels = " ".join(call.kwargs["text"] for call in layout.label.call_args_list)
    return labels, [call.args[1] for call in layout.prop.call_args_list]


def panel_faults():
    """The panels draw, and show every option of the method that is a property, with its help and range."""
    import pymeniscus

    faults = []
    labels, props = drawn("MENISCUS_PT_surface")
    if "triangles" not in labels or "preset" not in props or "voxel_size" not in props:
        faults.append(f"the panel shows {labels}, {props}")
    props += drawn("MENISCUS_PT_options")[1] + drawn("MENISCUS_PT_attributes")[1]
    surface = bpy.context.object
    known = surface.meniscus.options.bl_rna.properties
    others = part("options").OTHERS | {"void_threshold"}
    for info in pymeniscus.option_table():
        if info.name not in others and (info.name not in props or known[info.name].description != info.help):
            faults.append(f"the panel lacks {info.name}")
    if (known["max_stretch"].hard_min, known["max_stretch"].hard_max) != (1, 8):
        faults.append("max_stretch has another range")
    return faults


def saved():
    """A saved file shows the last mesh, also in a Blender without the extension; with it, the surface goes on."""
    scene, source, surface, _ = add_surface(5_000)
    count = len(surface.data.vertices)
    path = FOLDER / "saved.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    empty_scene()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    surface = bpy.data.objects["water surface"]
    faults = []
    if len(surface.data.vertices) != count or surface.meniscus.source != bpy.data.objects["water"]:
        faults.append("the opened file has another surface")
    surface.meniscus.options.voxel_size = 0.7
    surface.meniscus.options.use_voxel_size = True
    if not 0 < len(surface.data.vertices) < count:
        faults.append("it does not follow after the file was opened")
    look = (
        f"import bpy, os; bpy.ops.wm.open_mainfile(filepath={str(path)!r}); "
        "obj = bpy.data.objects['water surface']; "
        "print('seen', len(obj.data.vertices), 'velocity' in obj.data.attributes, flush=True); os._exit(0)"
    )
    with tempfile.TemporaryDirectory() as home:
        ran = subprocess.run(
            [sys.executable, "-c", look], capture_output=True, text=True, timeout=120,
            env={**os.environ, "BLENDER_USER_RESOURCES": home},
        )
    if f"seen {count} True" not in ran.stdout:
        faults.append(f"without the extension: {ran.stdout}{ran.stderr}")
    return f"{count} vertices", faults


@contextlib.contextmanager
def event_loop():
    """Lets the extension compute on its thread; this check calls the tick in place of Blender's timers."""
    live = part("live")
    before, live.has_event_loop = live.has_event_loop, lambda: True
    try:
        yield live
    finally:
        live.has_event_loop = before
        live.worker.clear(wait=10)


def until(live, wanted, limit=60.0):
    """Ticks until something is true. Returns the seconds until then, and the longest tick."""
    start, longest = time.perf_counter(), 0.0
    while time.perf_counter() - start < limit:
        before = time.perf_counter()
        live.tick()
        longest = max(longest, time.perf_counter() - before)
        if wanted():
            return time.perf_counter() - start, longest
        time.sleep(0.01)
    raise TimeoutError(f"not within {limit} s")


def times():
    _, _, surface, high = add_surface(100_000)
    settings = surface.meniscus
    status = part("live").status_of(surface)
    best = [np.inf, np.inf, np.inf, np.inf]
    with event_loop() as live:
        for number in range(3):
            status.made = ""
            before = time.perf_counter()
            high.default_value = 0.027 + 0.001 * number
            bpy.context.view_layer.update()
            change = time.perf_counter() - before
            coarse, tick = until(live, lambda: "preview" in status.made)
            vertices = len(surface.data.vertices)
            full, longer = until(live, lambda: "full quality" in status.made)
            # The rest before full quality is part of `full`.
            full += coarse - part("worker").REST
            best = np.minimum(best, [change, coarse, full, max(tick, longer)])
    change, coarse, full, tick = best
    faults = []
    for what, seconds, limit in (
        ("the preview", coarse, PREVIEW_SECONDS), ("full quality", full, FULL_SECONDS),
        ("a change", change, MAIN_SECONDS), ("a tick", tick, MAIN_SECONDS),
    ):
        if STRICT_TIMES and not seconds <= limit:
            faults.append(f"{what} takes {seconds:.3f} s; the limit is {limit} s")
    if not 0 < vertices < len(surface.data.vertices):
        faults.append("the preview is not coarser")
    figures = f"preview {coarse:.2f} s, full {full:.2f} s; main thread: change {1e3 * change:.0f} ms, tick {1e3 * tick:.0f} ms"
    return f"{len(water(100_000)[0])} points: {figures}", faults


def newest():
    """Changes that follow fast: previews come meanwhile, and only the last value gets full quality."""
    _, source, surface, _ = add_surface(20_000)
    settings, faults, seen = surface.meniscus, [], []
    with event_loop() as live:
        status = live.status_of(surface)
        status.made = ""
        settings.options.use_offset = True
        for number in range(20):
            settings.options.offset = 0.01 * number
            live.tick()
            seen.append(status.made)
            time.sleep(0.05)
        until(live, lambda: "full quality" in status.made)
        faults += faults_against(surface.data, expected(source, surface, offset="0.19d"))
        if not any("preview" in made for made in seen):
            faults.append("no preview during the changes")
        if any("full quality" in made for made in seen):
            faults.append("full quality for a value that did not stay")
        faults += kept(live, source, surface)
        settings.options.offset = 0.0
        live.worker.clear(wait=10)
        if live.worker.is_busy:
            faults.append("the thread does not end")
    return f"{len({made for made in seen if made})} previews during 20 changes in one second", faults


def kept(live, source, surface):
    """An update without a change keeps full quality; so does a change that is taken back before its result is
    read. An error of any kind ends neither the thread nor the timer."""
    options, worker, faults = surface.meniscus.options, live.worker, []

    def compare(label, offset):
        until(live, lambda: not worker.is_busy)
        wanted = expected(source, surface, offset=offset)
        return [f"{label}: {fault}" for fault in faults_against(surface.data, wanted)]

    live.update(surface, bpy.context.evaluated_depsgraph_get())
    faults += compare("an update without a change", "0.19d")
    options.offset = 0.05
    limit = time.perf_counter() + 60
    # The preview of the change, not yet written.
    while not worker._results and time.perf_counter() < limit:
        time.sleep(0.01)
    options.offset = 0.19
    faults += compare("a change that was taken back", "0.19d")
    module = part("worker")
    before, module.arrays_of = module.arrays_of, MagicMock(side_effect=RuntimeError("odd"))
    try:
        options.offset = 0.1
        until(live, lambda: not worker.is_busy)
    finally:
        module.arrays_of = before
    if live.status_of(surface).error != "odd":
        faults.append(f"an unexpected error is shown as {live.status_of(surface).error!r}")
    options.offset = 0.15
    faults += compare("after an error", "0.15d")
    options.offset = 0.1
    surface.meniscus.radius_attribute = "pscale"
    if worker._pending:
        faults.append("a request goes on, though the points cannot be read")
    surface.meniscus.radius_attribute = "radius"
    # A render waits for its mesh no longer than until the error of the main thread.
    seen = []

    def render():
        try:
            live.on_main_thread(MagicMock(side_effect=RuntimeError("odd")))
        except RuntimeError as error:
            seen.append(str(error))

    thread = threading.Thread(target=render)
    thread.start()
    until(live, lambda: not thread.is_alive())
    if seen != ["odd"]:
        faults.append(f"a render gets {seen} as the error of its mesh")
    return faults


def errors():
    """What cannot be read, and options that cannot be."""
    faults, said = [], []

    def labels():
        return drawn("MENISCUS_PT_surface")[0]

    _, source, surface, _ = add_surface(2_000)
    count = len(surface.data.vertices)
    settings = surface.meniscus
    settings.radius_attribute = "pscale"
    said.append(("“pscale”", labels()))
    settings.radius_attribute = "radius"
    settings.options.blend_unit, settings.options.blend = "h", 500
    settings.options.use_blend = True
    said.append(("to 64 voxels", labels()))
    settings.options.use_blend = False
    settings.velocity_attribute = "speed"
    said.append(("no motion blur", labels()))
    settings.velocity_attribute = "velocity"
    source.data.attributes.new("turn", "QUATERNION", "POINT")
    bpy.context.view_layer.update()
    settings.use_attributes = False
    settings.use_attributes = True
    said.append(("left out: “turn”", labels()))
    source.modifiers[0].node_group.nodes["Mesh to Points"].mute = True
    bpy.context.view_layer.update()
    source.data.clear_geometry()
    source.data.update()
    bpy.context.view_layer.update()
    said.append(("has no points", labels()))
    faults += [f"no {word} in: {text}" for word, text in said if word not in text]
    if len(surface.data.vertices) == 0 or not count:
        faults.append("an error has emptied the surface")
    faults += hidden_points()
    scene = empty_scene()
    source, _ = add_points(scene, 500)
    tree = source.modifiers[0].node_group
    cube, instances = tree.nodes.new("GeometryNodeMeshCube"), tree.nodes.new("GeometryNodeInstanceOnPoints")
    tree.links.new(tree.nodes["Set Position"].outputs[0], instances.inputs["Points"])
    tree.links.new(cube.outputs[0], instances.inputs["Instance"])
    tree.links.new(instances.outputs[0], tree.nodes["Group Output"].inputs[0])
    bpy.context.view_layer.update()
    with contextlib.suppress(RuntimeError), contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.meniscus.add_surface()
        faults.append("instances were read")
    return ", ".join(word for word, _ in said), faults


def hidden_points():
    """Points that are hidden in renders, or in the viewport. The panel shows the reason of a render until the next
    one, also after the surface was made again."""
    scene, source, surface, _ = add_surface(500)
    prepare_render(scene, (16, 16), 1)
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    faults = []
    for is_hidden in (True, False):
        source.hide_render = is_hidden
        with contextlib.redirect_stdout(io.StringIO()):
            bpy.ops.render.render()
        bpy.ops.meniscus.update()
        labels = drawn("MENISCUS_PT_surface")[0]
        if ("render, frame 1" in labels and "is hidden in renders" in labels.replace("  ", " ")) != is_hidden:
            faults.append(f"hide_render {is_hidden}: the panel shows {labels}")
    source.hide_viewport = True
    with contextlib.suppress(RuntimeError), contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.meniscus.update()
    labels = drawn("MENISCUS_PT_surface")[0]
    if "is hidden in the viewport" not in labels:
        faults.append(f"hide_viewport: the panel shows {labels}")
    source.hide_viewport = False
    bpy.context.view_layer.update()
    labels = drawn("MENISCUS_PT_surface")[0]
    if "is hidden" in labels:
        faults.append(f"shown again: the panel shows {labels}")
    return faults


# Renders


def rendered():
    scene, source, surface, _ = add_surface(20_000, is_moving=True)
    surface.data.materials.append(clay())
    points = positions_of(surface.data)
    stage(Matrix(), points.min(axis=0), points.max(axis=0) + (0.1, 0, 0))
    prepare_render(scene, SIZE, 8)
    scene.frame_start, scene.frame_end = 1, 10
    scene.render.use_motion_blur = True
    scene.render.motion_blur_shutter = 1.0
    scene.render.filepath = str(WORK / "extension_####")
    faults, seen = [], {}

    def on_post(scene, *_):
        seen[scene.frame_current] = positions_of(surface.data)

    bpy.app.handlers.render_post.append(on_post)
    try:
        bpy.ops.render.render(animation=True)
    finally:
        bpy.app.handlers.render_post.remove(on_post)
    for frame in range(1, 11):
        scene.frame_set(frame)
        wanted = expected(source, surface).vertices
        if not np.array_equal(seen.get(frame), wanted):
            faults.append(f"frame {frame} has another surface")
        if not np.array_equal(positions_of(surface.data), wanted):
            faults.append(f"frame {frame} of the preview is another surface")
    images = [pixels_of(WORK / f"extension_{frame:04}.png") for frame in range(1, 11)]
    if not min(abs(a - b).mean() for a, b in zip(images, images[1:])) >= 1e-4:
        faults.append("consecutive pictures are the same")
    scene.frame_set(5)
    scene.render.use_motion_blur = False
    scene.render.filepath = str(WORK / "extension_still.png")
    bpy.ops.render.render(write_still=True)
    blur = abs(pixels_of(WORK / "extension_still.png") - images[4]).mean()
    if not blur >= 1e-3:
        faults.append("motion blur changes nothing")
    return f"each with its surface; blur changes pixels by {blur:.4f}: {WORK.name}/extension_0001.png to 0010", faults


if __name__ == "__main__":
    main()
