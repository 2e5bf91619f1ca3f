"""Imports a sequence of meniscus' surfaces into Blender, finished or still growing.

    blender --python import_sequence.py -- out                    opens Blender with the sequence
    blender --python import_sequence.py                           only adds the panel: 3D view, sidebar, meniscus
    python import_sequence.py out --save dam.blend                with Blender as a module (bpy), without a window

A path is a folder with one sequence, a file of a sequence, or a pattern such as `out/dam.####.vdb`.

    .glb    One mesh, whose geometry is replaced by that of the current frame's file. The object, its
            materials and its modifiers belong to the scene and stay. Cycles uses the attribute `velocity`
            for motion blur.
    .vdb    A volume with Blender's own file sequence, and a mesh object that shows it with Volume to Mesh.

The frame is the number in the file's name, divided by N with `--step N`. In place of a missing frame, the
sequence shows the last frame before it, or the first frame if no earlier one exists; the console and the
panel report this. The script looks for new files when the playhead reaches an unknown frame, on the button
Reload, and every few seconds if Blender has a window. A frame-change handler shows the frames. So a saved
.blend contains this script as a text, which Blender must be allowed to run. Only a .vdb sequence without gaps
plays without the script.
"""

import argparse
import atexit
import bisect
import json
import math
import os
import re
import struct
import sys
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Quaternion

KINDS = (".glb", ".vdb")
NAME = re.compile(r"([^.].*)(\.(?:glb|vdb))", re.IGNORECASE)
# Text before the number of a frame, text before the number of a version, text after a count, and the end of a
# name with a subframe.
FRAME = re.compile(r"(?:^|[^a-z])(?:frame|frm|step|timestep)[._ -]?$", re.IGNORECASE)
VERSION = re.compile(r"(?:^|[^a-z])(?:v|ver|version|rev|take|wedge)$", re.IGNORECASE)
COUNT = re.compile(r"[._ -]?(?:particles?|points?|pts|parts|vertices|atoms|spheres)(?![a-z])", re.IGNORECASE)
SUBFRAME = re.compile(r"(?:^|[^0-9a-z])(\d{4,})\.(\d+)$", re.IGNORECASE)
FRAME_MAX = 1048574
FOLLOW_SECONDS = 5.0
# Rotates coordinates with Y up to Z up.
TURN = Matrix.Rotation(math.radians(90), 4, "X")
UPS = [("Y", "Y", "As in glTF: turned to Z up"), ("Z", "Z", "As in Blender: not turned")]


# Files


def ends_of(name):
    """The text before and after a name's frame number, or None.

    As in meniscus, a version or a count is the frame only if the name has no other number. Subframes are ignored: for
    names such as shot.0100.1.glb, whose last number is the frame, give the pattern shot.0100.#.glb.
    """
    match = NAME.fullmatch(name)
    if not match:
        return None
    stem, extension = match.groups()
    if "#" in stem:
        before, after = re.split("#+", stem, maxsplit=1)
        return before, after + extension
    subframe = SUBFRAME.search(stem)
    if subframe and len(subframe[1]) > len(subframe[2]):
        return None

    def rank(number):
        before, after = stem[: number.start()], stem[number.end() :]
        if FRAME.search(before):
            return 3
        if VERSION.search(before):
            return 0
        is_padded = len(number[0]) > 1 and number[0].startswith("0")
        return 1 if COUNT.match(after) and not is_padded else 2

    numbers = list(re.finditer("[0-9]+", stem))
    # If several numbers have the highest rank, the last of them.
    number = max(reversed(numbers), key=rank, default=None)
    return number and (stem[: number.start()], stem[number.end() :] + extension)


def number_in(name, ends):
    """The digits between these ends of a name, or None."""
    match = re.fullmatch(f"{re.escape(ends[0])}([0-9]+){re.escape(ends[1])}", name)
    return match and match[1]


def files_of(folder, ends):
    """The file names by number."""
    names = {number_in(name, ends): name for name in os.listdir(folder)}
    return dict(sorted((int(number), name) for number, name in names.items() if number))


def sequences_in(folder):
    """The sequences of a folder, by the text before and after the number: each maps numbers to file names."""
    found = {}
    for name in os.listdir(folder):
        ends = ends_of(name)
        number = ends and number_in(name, ends)
        if number:
            found.setdefault(ends, {})[int(number)] = name
    return {ends: dict(sorted(names.items())) for ends, names in sorted(found.items())}


def chosen(path, kind=None):
    """The folder, the name parts and the files of the sequence at a path."""
    path = Path(bpy.path.abspath(str(path))).absolute()
    if not path.is_dir():
        folder, ends = path.parent, ends_of(path.name)
        files = files_of(folder, ends) if ends else {}
        if not files:
            raise ValueError(f"{path} is neither a folder nor a frame of a .glb or .vdb sequence")
        if kind and not ends[1].lower().endswith(kind):
            raise ValueError(f"{path} is not a {kind}")
        return folder, ends, files
    folder, sequences = path, sequences_in(path)
    wanted = [ends for ends in sequences if kind is None or ends[1].lower().endswith(kind)]
    # If a name exists in both formats, the mesh is used: it comes first.
    if len({(before, after[:-4]) for before, after in wanted}) == 1:
        return folder, wanted[0], sequences[wanted[0]]
    if not wanted:
        raise ValueError(f"{folder} contains no numbered {kind or '.glb or .vdb'} files")
    raise ValueError(f"{folder} contains several sequences; choose one: {', '.join(map(pattern_of, wanted))}")


def pattern_of(ends):
    return f"{ends[0]}####{ends[1]}"


def read_glb(path, up):
    """The triangles and the vertex attributes, by name, of a .glb that meniscus wrote, in Blender's axes.

    Blender's importer is not suitable: it makes new objects each time, which a handler must not do, and before 5.1 it
    fails on files with both vectors and single numbers.
    """
    data = np.fromfile(path, np.uint8)
    if len(data) < 20 or struct.unpack_from("<4s2I", data) != (b"glTF", 2, len(data)):
        raise ValueError("incomplete .glb")
    (json_bytes,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + json_bytes].tobytes())
    if not document.get("meshes"):
        return np.empty((0, 3), np.int32), {"POSITION": np.empty((0, 3), np.float32)}
    if len(document["meshes"]) != 1 or "animations" in document:
        raise ValueError("not a single surface; import this file with File > Import > glTF")

    def column(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = np.dtype({5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]])
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = 20 + json_bytes + 8 + view["byteOffset"]
        return np.ndarray((accessor["count"], width), kind, data, start)

    primitive = document["meshes"][0]["primitives"][0]
    columns = {name: column(index) for name, index in primitive["attributes"].items()}
    node = document["nodes"][0]
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    place = Matrix.LocRotScale(node.get("translation", (0, 0, 0)), Quaternion((w, x, y, z)), node.get("scale", (1, 1, 1)))
    # With `--up z`, meniscus has rotated the mesh to Y up, and stored a rotation in the node. Without it, the
    # coordinates of particles with Z up are in the file as they are, and need no rotation here.
    if up == "Y" or "rotation" in node:
        place = TURN @ place
    turned = np.array(place.to_3x3().normalized())
    columns["POSITION"] = columns["POSITION"] @ np.array(place)[:3, :3].T + np.array(place)[:3, 3]
    for name in columns.keys() & {"NORMAL", "_VELOCITY"}:
        columns[name] = columns[name] @ turned.T
    return column(primitive["indices"]).reshape(-1, 3), columns


# Display


def refill(mesh, triangles, columns):
    """Replaces the vertices and triangles of a mesh, and keeps its materials, name and users."""
    mesh.clear_geometry()
    mesh.vertices.add(len(columns["POSITION"]))
    mesh.vertices.foreach_set("co", flat(columns["POSITION"]))
    mesh.loops.add(triangles.size)
    mesh.polygons.add(len(triangles))
    mesh.loops.foreach_set("vertex_index", triangles.ravel().astype(np.int32))
    mesh.polygons.foreach_set("loop_start", np.arange(0, triangles.size, 3, dtype=np.int32))
    for name, values in columns.items():
        if name == "COLOR_0":
            opaque = np.ones((len(values), 4 - values.shape[1]), np.float32)
            values = np.concatenate([values, opaque], axis=1)
        if name != "POSITION":
            kind, key = ATTRIBUTES[values.shape[1]]
            # Blender reserves some names, such as `id`. An attribute with such a name gets the name in the
            # file, `_ID`.
            plain = NAMES.get(name, name[1:].lower())
            attribute = mesh.attributes.new(plain, kind, "POINT") or mesh.attributes.new(name, kind, "POINT")
            attribute.data.foreach_set(key, flat(values))
    mesh.update(calc_edges=True)


NAMES = {"NORMAL": "custom_normal", "COLOR_0": "Color"}
# Blender's attribute type and the name of its values, by the count of numbers per vertex.
ATTRIBUTES = {1: ("FLOAT", "value"), 2: ("FLOAT2", "vector"), 3: ("FLOAT_VECTOR", "vector"), 4: ("FLOAT_COLOR", "color")}


def flat(values):
    return np.ascontiguousarray(values, np.float32).ravel()


def show(obj, scene):
    """Shows the file for the current frame of the scene, or for the nearest frame before it."""
    source = obj.meniscus
    if obj.type == "MESH" and obj.data.is_editmode:
        return
    # Motion blur requests times between frames; they are rounded.
    frame = round(scene.frame_current_final)
    number = number_for(source, frame, known_files(source))
    if number is None or number // source.step != frame:
        look_again(obj, scene)
        number = number_for(source, frame, known_files(source))
    if number is None:
        log_once(f"{source.folder} has no {pattern_of((source.before, source.after))}; {obj.name} is unchanged")
        return
    path = Path(bpy.path.abspath(source.folder), known_files(source)[number])
    if number // source.step != frame:
        log_once(f"frame {frame} is missing: {obj.name} shows {path.name}")
    try:
        stat = path.stat()
        stamp = f"{path} {stat.st_size} {stat.st_mtime_ns}"
        if obj.type == "VOLUME":
            count_files(obj.data, source, path, number, frame)
            if source.shown.startswith(f"{path} ") and stamp != source.shown:
                log_once(f"{path} was written again, but Blender has cached it: use Reload")
        elif stamp != source.shown:
            refill(obj.data, *read_glb(path, source.up))
        source.shown = stamp
    except (OSError, ValueError, LookupError, AttributeError, TypeError, OverflowError) as error:
        log_once(f"cannot read {path}: {error}; {obj.name} is unchanged")


def number_for(source, frame, files):
    """The last number for this frame or an earlier one, otherwise the first number."""
    numbers = list(files)
    return numbers[max(bisect.bisect_left(numbers, (frame + 1) * source.step) - 1, 0)] if numbers else None


def count_files(volume, source, path, number, frame):
    """Sets the frame offset of Blender's own file sequence so that the volume shows this file.

    Blender counts files from the first frame and adds an offset. In a sequence without gaps, the offset is
    the same for all frames.
    """
    first, last = range_of(source)
    place = min(max(frame - first + 1, 1), last - first + 1)
    counted = number_in(Path(volume.filepath).name, (source.before, source.after))
    is_counted = counted and f"{source.before}{number:0{len(counted)}}{source.after}" == path.name
    settings = {"frame_start": first, "frame_duration": last - first + 1, "frame_offset": number - place}
    if not is_counted:
        settings["filepath"] = str(path)
    for name, value in settings.items():
        if getattr(volume, name) != value:
            setattr(volume, name, value)


# The known files of each sequence, by folder and name parts.
_files = {}
_logged = set()


def known_files(source):
    return _files.get((source.folder, source.before, source.after)) or files_now(source)


def files_now(source):
    try:
        files = files_of(bpy.path.abspath(source.folder), (source.before, source.after))
    except OSError as error:
        log_once(str(error))
        files = {}
    _files[source.folder, source.before, source.after] = files
    return files


def range_of(source):
    """The first and the last existing frame."""
    numbers = list(known_files(source))
    return numbers[0] // source.step, min(numbers[-1] // source.step, FRAME_MAX)


def look_again(obj, scene):
    """Finds new files. If the scene ended with the sequence, extends the scene to the new end."""
    source = obj.meniscus
    if files_now(source):
        last = range_of(source)[1]
        if scene.frame_end == source.last < last:
            scene.frame_end = last
        source.last = last


def log_once(text):
    """Prints a text, unless it was printed before."""
    if text not in _logged:
        _logged.add(text)
        print(f"meniscus: {text}", flush=True)


def sequences_of(scene):
    return [obj for obj in scene.objects if obj.meniscus.folder]


# Import


def import_sequence(scene, path, kind=None, up="Y", step=1, is_bare_volume=False):
    """Adds a sequence to a scene, and returns its object."""
    folder, (before, after), files = chosen(path, kind)
    if max(files) // step > FRAME_MAX:
        raise ValueError(f"{files[max(files)]} is beyond Blender's last frame, {FRAME_MAX}: choose a step")
    is_mesh = after.lower().endswith(".glb")
    if is_mesh and is_bare_volume:
        raise ValueError(f"{pattern_of((before, after))} has no volume; use .vdb files")
    name = before.rstrip("._- ") or folder.name
    if is_mesh:
        source = shown = bpy.data.objects.new(name, bpy.data.meshes.new(name))
        scene.collection.objects.link(shown)
    else:
        shown, source = add_level_set(scene, name, folder / files[min(files)], up, is_bare_volume)
    for key, value in {"folder": str(folder), "before": before, "after": after, "up": up, "step": step}.items():
        setattr(source.meniscus, key, value)
    look_again(source, scene)
    scene.frame_start, scene.frame_end = range_of(source.meniscus)
    # Lock the interface during a render: the handler changes meshes, which the interface must not draw
    # meanwhile.
    scene.render.use_lock_interface = True
    scene.frame_set(min(max(scene.frame_current, scene.frame_start), scene.frame_end))
    stay_in_file()
    log_once(f"{name}: {summary(source.meniscus)}")
    gaps = np.diff(list(files))
    if len(gaps) and (apart := math.gcd(*gaps.tolist())) > step:
        log_once(f"numbers are {apart} apart; with a step of {apart} each file is a frame")
    return shown


def add_level_set(scene, name, first, up, is_bare_volume):
    """Adds a volume with Blender's file sequence, and a mesh around it; returns the visible object and the volume."""
    data = bpy.data.volumes.new(name)
    data.filepath = str(first)
    if not data.grids.load() or "surface" not in data.grids:
        why = data.grids.error_message or f"its grids are {', '.join(data.grids.keys())}"
        bpy.data.volumes.remove(data)
        raise ValueError(f"{first} has no grid “surface”: {why}")
    h = Matrix(data.grids["surface"].matrix_object).to_scale().x
    if "velocity" in data.grids:
        data.velocity_grid, data.velocity_unit = "velocity", "SECOND"
    data.grids.unload()
    data.is_sequence, data.sequence_mode = True, "EXTEND"
    volume = bpy.data.objects.new(f"{name} level set", data)
    volume.matrix_world = TURN if up == "Y" else Matrix()
    scene.collection.objects.link(volume)
    if is_bare_volume:
        return volume, volume
    mesh = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    scene.collection.objects.link(mesh)
    modifier = mesh.modifiers.new("surface", "VOLUME_TO_MESH")
    modifier.object, modifier.grid_name, modifier.threshold = volume, "surface", 0.0
    modifier.resolution_mode, modifier.use_smooth_shade = "GRID", True
    if bpy.app.version < (5, 0, 0):
        # The modifier assumes that values are at cell centres, as those of smoke. So it moves surfaces by half a
        # voxel along each axis of the mesh; move the volume back.
        volume.matrix_world = Matrix.Translation((-h / 2,) * 3) @ volume.matrix_world
    # Parent the volume to the mesh, so that it follows when the user moves the mesh.
    volume.parent, volume.hide_viewport, volume.hide_render = mesh, True, True
    return mesh, volume


def summary(source):
    files = known_files(source)
    if not files:
        return "no files"
    first, last = range_of(source)
    missing = last - first + 1 - len({number // source.step for number in files})
    return f"{pattern_of((source.before, source.after))}, frames {first} to {last}, {missing} missing"


def stay_in_file():
    """Stores a copy of this script in the .blend; Blender runs the copy when it opens the file."""
    script = Path(__file__)
    text = bpy.data.texts.get(script.name) or bpy.data.texts.new(script.name)
    if script.is_file():
        text.from_string(script.read_text(encoding="utf-8"))
    text.use_module = True


# Blender interface


class MeniscusSequence(bpy.types.PropertyGroup):
    """The source of an object's frames."""

    folder: StringProperty(name="Folder", subtype="DIR_PATH")
    before: StringProperty()
    after: StringProperty()
    up: EnumProperty(items=UPS)
    step: IntProperty(default=1, min=1)
    last: IntProperty()
    shown: StringProperty()


class MENISCUS_OT_import(bpy.types.Operator, ImportHelper):
    """Import a .glb or .vdb sequence of meniscus: choose one of its files"""

    bl_idname = "meniscus.import_sequence"
    bl_label = "Import sequence"
    bl_options = {"REGISTER", "UNDO"}

    filter_glob: StringProperty(default="*.glb;*.vdb", options={"HIDDEN"})
    up: EnumProperty(name="Up", items=UPS, description="The axis of the particles that points up")
    step: IntProperty(name="Step", default=1, min=1, description="Difference between the numbers of consecutive frames")
    is_bare_volume: BoolProperty(name="Bare volume", description="For .vdb: no mesh around the volume")

    def execute(self, context):
        try:
            import_sequence(context.scene, self.filepath, None, self.up, self.step, self.is_bare_volume)
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class MENISCUS_OT_reload(bpy.types.Operator):
    """Look for new files, and read the current files again"""

    bl_idname = "meniscus.reload"
    bl_label = "Reload"

    def execute(self, context):
        _logged.clear()
        # Blender caches .vdb files up to a limit, even if the file has changed: a limit of 0 empties the cache.
        system = context.preferences.system
        limit, system.memory_cache_limit = system.memory_cache_limit, 0
        try:
            for obj in sequences_of(context.scene):
                look_again(obj, context.scene)
                if obj.type == "VOLUME":
                    obj.data.filepath = obj.data.filepath
                obj.meniscus.shown = ""
                show(obj, context.scene)
            context.view_layer.update()
        finally:
            system.memory_cache_limit = limit
        return {"FINISHED"}


class MENISCUS_PT_sequences(bpy.types.Panel):
    bl_label = "Sequences"
    bl_category = "meniscus"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"

    def draw(self, context):
        self.layout.operator(MENISCUS_OT_import.bl_idname)
        self.layout.operator(MENISCUS_OT_reload.bl_idname)
        for obj in sequences_of(context.scene):
            box = self.layout.box()
            box.label(text=f"{obj.name}: {summary(obj.meniscus)}")
            number = number_for(obj.meniscus, context.scene.frame_current, known_files(obj.meniscus))
            if number is not None and number // obj.meniscus.step != context.scene.frame_current:
                box.label(text=f"Frame {context.scene.frame_current} is missing: shows {number}", icon="ERROR")
            box.prop(obj.meniscus, "folder", text="")


@persistent
def show_sequences(scene, _graph=None):
    for obj in sequences_of(scene):
        show(obj, scene)


def follow():
    """Looks for new files every few seconds, until this script is run again."""
    if show_sequences not in bpy.app.handlers.frame_change_pre:
        return None
    if not bpy.app.is_job_running("RENDER"):
        for window in bpy.context.window_manager.windows:
            for obj in sequences_of(window.scene):
                look_again(obj, window.scene)
                show(obj, window.scene)
    return FOLLOW_SECONDS


CLASSES = (MeniscusSequence, MENISCUS_OT_import, MENISCUS_OT_reload, MENISCUS_PT_sequences)


def register():
    """Registers the classes and the handler, and replaces those of an earlier run of this script."""
    handlers = bpy.app.handlers.frame_change_pre
    handlers[:] = [handler for handler in handlers if handler.__name__ != show_sequences.__name__] + [show_sequences]
    for kind in CLASSES:
        if earlier := getattr(bpy.types, kind.__name__, None):
            bpy.utils.unregister_class(earlier)
        bpy.utils.register_class(kind)
    bpy.types.Object.meniscus = PointerProperty(type=MeniscusSequence)
    if not bpy.app.background:
        bpy.app.timers.register(follow, first_interval=FOLLOW_SECONDS, persistent=True)
    if bpy.app.module:
        # Without this, Blender as a module does not exit.
        atexit.register(unregister)


def unregister():
    if show_sequences in bpy.app.handlers.frame_change_pre:
        bpy.app.handlers.frame_change_pre.remove(show_sequences)
        for kind in CLASSES:
            bpy.utils.unregister_class(kind)


def main():
    words = sys.argv[1:] if bpy.app.module else sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    if not words and not bpy.app.background:
        return
    parser = argparse.ArgumentParser(prog="import_sequence.py", description="Imports a sequence of meniscus' surfaces.")
    parser.add_argument("path", help="a folder, a file of the sequence, or a pattern such as out/dam.####.vdb")
    parser.add_argument("--format", choices=[kind[1:] for kind in KINDS], help="format to import if a folder has both [default: glb]")
    parser.add_argument("--up", choices=["y", "z"], default="y", help="up axis of the particles [default: y]")
    parser.add_argument("--step", type=int, default=1, help="difference between the numbers of consecutive frames [default: 1]")
    parser.add_argument("--fps", type=float, help="frames per second of the scene")
    parser.add_argument("--bare-volume", action="store_true", help="for .vdb: no mesh around the volume")
    parser.add_argument("--save", metavar="FILE.blend", help="save the scene")
    options = parser.parse_args(words)
    if options.step < 1 or (options.fps is not None and not options.fps > 0):
        parser.error("--step and --fps must be positive")
    if bpy.app.module:
        bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    if options.fps:
        scene.render.fps = math.ceil(options.fps)
        scene.render.fps_base = math.ceil(options.fps) / options.fps
    kind = f".{options.format}" if options.format else None
    try:
        import_sequence(scene, options.path, kind, options.up.upper(), options.step, options.bare_volume)
    except (OSError, ValueError) as error:
        # Exit only without a window: with one, the scene may contain unsaved work.
        if bpy.app.background:
            sys.exit(f"import_sequence.py: {error}")
        print(f"import_sequence.py: {error}", file=sys.stderr)
        return
    if options.save:
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(options.save).absolute()))


register()
# When the script runs as a text in a .blend, it is not a file, and the command line is not for it.
if __name__ == "__main__" and Path(__file__).is_file():
    main()
