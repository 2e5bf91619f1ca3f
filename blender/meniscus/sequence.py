"""Imports sequences, finished or growing, and follows the growing ones.

Everything in the scene is Blender's own: a Mesh Sequence Cache for a stage or a shot, a volume for .vdb files,
and drivers that give the frame. So a saved .blend plays without this extension, which only

    imports          and sets rate, offset and frame range
    follows          reopens a stage that has grown, and extends the scene that began or ended with it

Files of a growing sequence are read on a thread. A timer collects what it found. Blender opens a stage in
milliseconds, but then reads the visible frame again, on the main thread and as slowly as at a change of the frame.
So a stage is reopened at the next change of the frame, or at once if another frame is visible then.
"""

import bisect
import math
import os
import re
import threading
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from mathutils import Matrix

from . import program
from .panel import Panel, draw_text, reason_of
from .timers import lasting

FOLLOW_SECONDS = 1.0
#: Rotates coordinates with Y up to Z up.
TO_Z_UP = Matrix.Rotation(math.radians(90), 4, "X")
#: Keeps a rounding error of a driver or of a key below the frame that it means.
TINY = 1e-3
#: The default prim of a stage, and where it has the mesh or the points of a sequence, by the sequence's name and the
#: type of the object.
ROOT = "root"
PATHS = {"MESH": f"/{ROOT}/{{}}/surface", "POINTCLOUD": f"/{ROOT}/{{}}/spray"}
BUILD = bpy.app.build_options


# Files


@dataclass(frozen=True)
class Shot:
    """What the files of a sequence say.

    Attributes
    ----------
    first, last : int
        The first and the last frame.
    fps : float or None
        Frames per second; None if the files do not record it.
    frames : dict
        The existing frames of each mesh, by its name. Empty for a file that cannot grow.
    stamp : tuple
        Differs if the files have changed.
    """

    first: int
    last: int
    fps: float | None
    frames: dict[str, tuple[int, ...]]
    stamp: tuple[float, ...]


def read_shot(path: Path) -> Shot:
    """Read the range of a sequence: of a stage or a shot, or of the numbered .vdb files beside this one.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read, or is not a sequence. The message says what to do.
    """
    if path.suffix == ".vdb":
        return read_volumes(path)
    stamp = stamp_of(path)
    if path.suffix == ".usda":
        text = path.read_text(encoding="utf-8", errors="replace")
        if "stage_frames" in text[:4096]:
            return read_stage(text, stamp)
    if path.suffix not in (".usda", ".usdc", ".abc"):
        raise ValueError(f"{path.name} is not a stage (.usda), a shot (.abc) or a frame in .vdb")
    about = program.info(path)
    if "shot" not in about:
        raise ValueError(
            f"{path.name} is a single frame: import the stage that plays all frames. To write it, convert again "
            "with --skip-done --stage stage.usda"
        )
    shot = about["shot"]
    return Shot(shot["first"], shot["last"], shot["fps"], {}, stamp)


def read_stage(text: str, stamp: tuple[float, ...]) -> Shot:
    """The range of a stage, and the frames of each of its sequences: the times at which a clip begins."""

    def number(name: str) -> float:
        found = re.search(rf"^\s*{name} = ([-+.0-9e]+)", text, re.MULTILINE)
        if not found:
            raise ValueError(f"the stage has no {name}")
        return float(found[1])

    frames = {}
    for part in re.split(r'\n    def Xform "', text)[1:]:
        active = re.search(r"double2\[\] active = \[(.*?)\]", part)
        begins: dict[str, int] = {}
        for code, clip in re.findall(r"\(([-+.0-9e]+), (\d+)\)", active[1] if active else ""):
            begins.setdefault(clip, math.floor(float(code)))
        frames[part.partition('"')[0]] = tuple(begins.values())
    first, last, fps = number("startTimeCode"), number("endTimeCode"), number("timeCodesPerSecond")
    return Shot(int(first), int(last), fps, frames, stamp)


def read_volumes(path: Path) -> Shot:
    """The frames of the numbered files that differ from this one in the number only."""
    ends = ends_of(path)
    names = re.compile(f"{re.escape(ends[0])}([0-9]+){re.escape(ends[1])}")
    found = [int(match[1]) for other in path.parent.iterdir() if (match := names.fullmatch(other.name))]
    if not found:
        raise ValueError(f"{path} does not exist")
    numbers = tuple(sorted(set(found)))
    return Shot(numbers[0], numbers[-1], None, {ends[0].rstrip("._- "): numbers}, tuple(map(float, numbers)))


def ends_of(path: Path) -> tuple[str, str]:
    """The text before and after the last number of a name: Blender counts frames by the last number, too."""
    match = re.fullmatch(r"(.*?)[0-9]+([^0-9]*)", path.name)
    if not match:
        raise ValueError(f"{path.name} has no number: choose a file such as dam.0001.vdb")
    return match[1], match[2]


def stamp_of(path: Path) -> tuple[float, ...]:
    stat = path.stat()
    return (stat.st_mtime_ns, stat.st_size, stat.st_ino)


# Import


def import_sequence(scene: bpy.types.Scene, path: Path) -> list[bpy.types.Object]:
    """Add a sequence to a scene, and return its objects: one for each mesh of a stage.

    Raises
    ------
    OSError, ValueError
        If there is no sequence. The scene is unchanged then.
    """
    settings = scene.meniscus_sequence
    shot = read_shot(path)
    add = add_volumes if path.suffix == ".vdb" else add_meshes
    objects = add(scene, path, shot)
    for obj in objects:
        source = obj.meniscus_sequence
        source.offset, source.keeps_rate, source.follows = settings.offset, settings.keeps_rate, bool(shot.frames)
        source.anchor, source.first, source.last = shot.first, shot.first, shot.last
        source.fps = shot.fps or settings.fps or rate_of(scene)
        _known[source.path] = shot
    if not settings.keeps_rate:
        set_rate(scene, objects[0].meniscus_sequence.fps)
    for obj in objects:
        set_times(obj, scene)
    scene.frame_start, scene.frame_end = range_of(objects[0].meniscus_sequence, scene)
    scene.frame_set(min(max(scene.frame_current, scene.frame_start), scene.frame_end))
    return objects


def add_meshes(_scene: bpy.types.Scene, path: Path, shot: Shot) -> list[bpy.types.Object]:
    """The objects that Blender's importer makes, meshes and point clouds, with its Mesh Sequence Cache."""
    require("Alembic" if path.suffix == ".abc" else "USD")
    before = set(bpy.data.objects)
    with in_window():
        if path.suffix == ".abc":
            bpy.ops.wm.alembic_import(filepath=str(path), set_frame_range=False, always_add_cache_reader=True)
        else:
            bpy.ops.wm.usd_import(filepath=str(path), set_frame_range=False)
    added = set(bpy.data.objects) - before
    if shot.first == shot.last:
        read_from_file(path, shot, added)
    meshes = sorted((obj for obj in added if modifier_of(obj)), key=lambda obj: modifier_of(obj).object_path)
    if not meshes:
        for obj in added:
            bpy.data.objects.remove(obj)
        raise ValueError(f"{path.name} has no meshes: of volumes, import one of the .vdb files")
    for obj in meshes:
        name = name_of(obj, path)
        # The parent, which has the name of the sequence, would add a number to that of the mesh.
        if obj.parent and obj.parent.name == name:
            obj.parent.name = f"{name} place"
        obj.name = name
        # Vertices of different frames are unrelated, even if they are equally many.
        modifier_of(obj).use_vertex_interpolation = False
        if obj.type == "POINTCLOUD":
            keep_material(obj)
    return meshes


def keep_material(points: bpy.types.Object) -> None:
    """Give a point cloud a material that it keeps: the object's own, because in each frame with points Blender takes the
    data from the file, without materials. Without a material, it is white foam."""
    if not points.material_slots:
        material = bpy.data.materials.new(points.name)
        material.use_nodes = True
        shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
        shader.inputs["Base Color"].default_value, shader.inputs["Roughness"].default_value = (1, 1, 1, 1), 0.35
        points.data.materials.append(material)
    for slot in points.material_slots:
        material, slot.link = slot.material, "OBJECT"
        slot.material = material


def require(library: str) -> None:
    """Checks that this Blender was built with a library, USD or Alembic: some distributions leave them out.

    Raises
    ------
    ValueError
        If it was built without the library.
    """
    if not getattr(BUILD, library.lower()):
        raise ValueError(
            f"this Blender was built without {library}: install the one from blender.org, or import .vdb files"
        )


def add_volumes(scene: bpy.types.Scene, path: Path, _shot: Shot) -> list[bpy.types.Object]:
    """A volume, which Blender loads by the number of a file, and the mesh around its level set."""
    settings = scene.meniscus_sequence
    name = ends_of(path)[0].rstrip("._- ") or path.stem
    data = bpy.data.volumes.new(name)
    data.filepath = str(path)
    if not data.grids.load() or "surface" not in data.grids:
        why = data.grids.error_message or f"its grids are {', '.join(data.grids.keys())}"
        bpy.data.volumes.remove(data)
        raise ValueError(f"{path.name} has no grid “surface”: {why}")
    voxel_size = Matrix(data.grids["surface"].matrix_object).to_scale().x
    if "velocity" in data.grids:
        data.velocity_grid, data.velocity_unit = "velocity", "SECOND"
    data.grids.unload()
    # With a duration of one frame, Blender shows the file with the number 1 + frame_offset, and `set_times`
    # drives that.
    data.is_sequence, data.sequence_mode, data.frame_start, data.frame_duration = True, "EXTEND", 0, 1
    volume = bpy.data.objects.new(f"{name} level set" if settings.has_mesh else name, data)
    scene.collection.objects.link(volume)
    volume.matrix_world = TO_Z_UP if settings.up == "Y" else Matrix()
    if settings.has_mesh:
        mesh = bpy.data.objects.new(name, bpy.data.meshes.new(name))
        scene.collection.objects.link(mesh)
        modifier = mesh.modifiers.new("surface", "VOLUME_TO_MESH")
        modifier.object, modifier.grid_name, modifier.threshold = volume, "surface", 0.0
        modifier.resolution_mode, modifier.use_smooth_shade = "GRID", True
        if bpy.app.version < (5, 0, 0):
            # The modifier reads grid values as cell centres, which moves the surface by half a voxel.
            volume.matrix_world = Matrix.Translation((-voxel_size / 2,) * 3) @ volume.matrix_world
        volume.parent, volume.hide_viewport, volume.hide_render = mesh, True, True
    return [volume]


def read_from_file(path: Path, shot: Shot, added: set[bpy.types.Object]) -> None:
    """Give the objects of a stage with a single frame what the importer gives them only if there are several."""
    still = [obj for obj in added if obj.type in PATHS and not modifier_of(obj)]
    if not still:
        return
    known = set(bpy.data.cache_files)
    with in_window():
        bpy.ops.cachefile.open(filepath=str(path))
    (cache,) = set(bpy.data.cache_files) - known
    for obj in still:
        # The parent has the name of the sequence, with a number if another object has it, too.
        parent = obj.parent.name if obj.parent else ""
        name = max((name for name in shot.frames if parent.startswith(name)), key=len, default=None)
        if name:
            prim = PATHS[obj.type].format(name)
            modifier = obj.modifiers.new("MeshSequenceCache", "MESH_SEQUENCE_CACHE")
            modifier.cache_file, modifier.object_path = cache, prim
            place = obj.constraints.new("TRANSFORM_CACHE")
            place.cache_file, place.object_path = cache, prim


def modifier_of(obj: bpy.types.Object) -> bpy.types.MeshSequenceCacheModifier | None:
    return next((modifier for modifier in obj.modifiers if modifier.type == "MESH_SEQUENCE_CACHE"), None)


def name_of(obj: bpy.types.Object, path: Path) -> str:
    """The sequence's name in a stage, from the path of its mesh; the name of the file for a shot of one mesh."""
    parts = modifier_of(obj).object_path.strip("/").split("/")
    return parts[1] if path.suffix != ".abc" and len(parts) > 2 else path.stem


def absolute(path: str, library: bpy.types.Library | None = None) -> Path:
    """A path of Blender, which may be relative to the .blend, or to the library that contains it."""
    return Path(os.path.abspath(bpy.path.abspath(path, library=library)))


def path_of(source: "MENISCUS_PG_sequence") -> str:
    """The file that the object of a sequence reads, wherever the project is now; empty for other objects."""
    obj = source.id_data
    modifier = modifier_of(obj)
    data = obj.data if obj.type == "VOLUME" else modifier and modifier.cache_file
    return str(absolute(data.filepath, data.library)) if source.fps and data else ""


def in_window() -> AbstractContextManager[None]:
    """A context for operators, which need a window; timers have none."""
    windows = bpy.context.window_manager.windows
    return bpy.context.temp_override(window=windows[0]) if windows and not bpy.context.window else nullcontext()


# Times


def rate_of(scene: bpy.types.Scene) -> float:
    return scene.render.fps / scene.render.fps_base


def set_rate(scene: bpy.types.Scene, fps: float) -> None:
    scene.render.fps = math.ceil(fps)
    scene.render.fps_base = math.ceil(fps) / fps


def ratio_of(source: "MENISCUS_PG_sequence", scene: bpy.types.Scene) -> float:
    """How many frames of the sequence pass in a frame of the scene."""
    return source.fps / rate_of(scene) if source.keeps_rate else 1.0


def scene_frame_of(number: int, source: "MENISCUS_PG_sequence", scene: bpy.types.Scene) -> float:
    """Where the scene shows a frame: the one that was the first at its number plus the offset."""
    return source.anchor + source.offset + (number - source.anchor) / ratio_of(source, scene)


def range_of(source: "MENISCUS_PG_sequence", scene: bpy.types.Scene) -> tuple[int, int]:
    first, last = (scene_frame_of(number, source, scene) for number in (source.first, source.last))
    # Blender's scenes have no negative start.
    return max(math.ceil(first - TINY), 0), max(math.ceil(last - TINY), 0)


def set_times(obj: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Show each frame of a sequence at its time, by offsets and drivers that Blender evaluates itself.

    A driver never names a frame between two: USD would blend their vertices.
    """
    source = obj.meniscus_sequence
    if obj.type == "VOLUME":
        drive_volume(obj.data, source, scene)
        return
    cache = modifier_of(obj) and modifier_of(obj).cache_file
    if not cache:
        return
    ratio = ratio_of(source, scene)
    if source.path.endswith(".abc"):
        # Alembic has seconds: Blender divides the scene's frame by the scene's rate.
        cache.frame_offset = source.offset + source.anchor * (1 - 1 / ratio)
        return
    cache.driver_remove("frame")
    # The importers store the time code as the frame, whatever the rates are.
    cache.override_frame, cache.frame_offset = ratio != 1, source.offset if ratio == 1 else 0
    if ratio != 1:
        begin = source.anchor + source.offset
        expression = f"{source.anchor} + floor((frame - {begin}) * {ratio:.9g} + {TINY})"
        cache.driver_add("frame").driver.expression = expression


def drive_volume(volume: bpy.types.Volume, source: "MENISCUS_PG_sequence", scene: bpy.types.Scene) -> None:
    """Drive the number of the file by the frame, through a key for each file that exists. A missing file has
    none, so the previous one is held."""
    shot = _known.get(source.path)
    if not shot:
        return
    (numbers,) = shot.frames.values()
    volume.driver_remove("frame_offset")
    curve = volume.driver_add("frame_offset")
    curve.driver.expression = "frame"
    while curve.modifiers:
        curve.modifiers.remove(curve.modifiers[0])
    keys = curve.keyframe_points
    keys.clear()
    keys.add(len(numbers))
    places = [(scene_frame_of(number, source, scene) - TINY, number - 1) for number in numbers]
    keys.foreach_set("co", [value for place in places for value in place])
    for key in keys:
        key.interpolation = "CONSTANT"
    curve.update()


def retime(source: "MENISCUS_PG_sequence", context: bpy.types.Context) -> None:
    """Follow a change of the offset or the rate in the panel."""
    if not source.path:
        return
    scene = context.scene
    if not source.keeps_rate:
        set_rate(scene, source.fps)
    for obj in scene.objects:
        other = obj.meniscus_sequence
        if other.path != source.path:
            continue
        # The objects of a stage share its times. Each change calls this function for the other object.
        if other.offset != source.offset:
            other.offset = source.offset
        if other.keeps_rate != source.keeps_rate:
            other.keeps_rate = source.keeps_rate
        set_times(obj, scene)
    scene.frame_start, scene.frame_end = range_of(source, scene)


# Follow


class Reading(threading.Thread):
    """A look at the files. A daemon thread, so that a disk that does not respond cannot keep Blender from exiting."""

    def __init__(self, paths: Iterable[str]) -> None:
        super().__init__(name="meniscus-sequence", daemon=True)
        self.paths, self.known = paths, dict(_known)
        self.changed: dict[str, Shot] = {}
        self.errors: dict[str, str] = {}
        self.start()

    def run(self) -> None:
        self.changed, self.errors = look(self.paths, self.known)


_known: dict[str, Shot] = {}
_reading: Reading | None = None
#: Why files cannot be read now.
_errors: dict[str, str] = {}
#: Why Blender could not show the sequences that have changed, and these: they will be shown the next time.
_grow_error = ""
_waiting: set[str] = set()
#: The stages that have grown since Blender opened them, as it has them open.
_open: dict[str, Shot] = {}


def followed() -> list[bpy.types.Object]:
    return [obj for obj in bpy.data.objects if obj.meniscus_sequence.path and obj.meniscus_sequence.follows]


def look(paths: Iterable[str], known: dict[str, Shot]) -> tuple[dict[str, Shot], dict[str, str]]:
    """The sequences that have changed, and why others cannot be read. Runs on the thread: touches no data of
    Blender."""
    changed, errors = {}, {}
    for name in paths:
        path = Path(name)
        try:
            before = known.get(name)
            if path.suffix != ".vdb" and before and before.stamp == stamp_of(path):
                continue
            shot = read_shot(path)
            if not before or shot.stamp != before.stamp:
                changed[name] = shot
        except (OSError, ValueError) as error:
            # It may be on a disk that is gone for now: the scene keeps what it shows.
            errors[name] = getattr(error, "strerror", None) or str(error)
    return changed, errors


@lasting
def tick() -> float:
    """Collect what the thread has read, and let it look again."""
    global _reading, _errors
    # Data must not change during a render; what was read waits.
    if bpy.app.is_job_running("RENDER"):
        return FOLLOW_SECONDS
    start = time.perf_counter()
    if _reading and not _reading.is_alive():
        for name in _reading.changed.keys() & _known.keys():
            _open.setdefault(name, _known[name])
        _known.update(_reading.changed)
        if _reading.errors != _errors:
            _errors = _reading.errors
            redraw()
        changed, _reading = set(_reading.changed) | _waiting, None
        # After an undo, an object may have the range of before.
        for obj in followed():
            source = obj.meniscus_sequence
            shot = _known.get(source.path)
            if shot and (source.first, source.last) != (shot.first, shot.last):
                changed.add(source.path)
        try_to_grow(changed)
    if not _reading and (paths := {obj.meniscus_sequence.path for obj in followed()}):
        _reading = Reading(paths)
    # A large frame takes long to read: that may take a twentieth of the time.
    return max(FOLLOW_SECONDS, 20 * (time.perf_counter() - start))


def try_to_grow(changed: set[str], is_forced: bool = False) -> None:
    """Show the sequences that have changed, now or the next time."""
    global _grow_error, _waiting
    was = _grow_error
    try:
        grow(changed, is_forced)
        _grow_error, _waiting = "", set()
    except RuntimeError as error:
        # An operator of Blender failed. A timer that raises would not be called again.
        _grow_error, _waiting = str(error).strip(), changed
    if was != _grow_error:
        redraw()


def grow(changed: set[str], is_forced: bool) -> None:
    """Extend the scenes that began or ended with the sequences that have changed. Read the sequences again whose
    visible frame is another one now; if `is_forced`, all."""
    caches = {}
    for obj in followed():
        source = obj.meniscus_sequence
        if source.path not in changed:
            continue
        shot = _known[source.path]
        scenes = [scene for scene in bpy.data.scenes if obj.name in scene.objects]
        before = {scene: range_of(source, scene) for scene in scenes}
        source.first, source.last = shot.first, shot.last
        for scene, (first, last) in before.items():
            # The first frame that is there may not be the first one of the simulation.
            is_first, is_last = scene.frame_start == first, scene.frame_end == last
            if is_first:
                scene.frame_start = range_of(source, scene)[0]
            if is_last:
                scene.frame_end = range_of(source, scene)[1]
        if obj.type == "VOLUME":
            set_times(obj, scenes[0] if scenes else bpy.context.scene)
        elif (modifier := modifier_of(obj)) and modifier.cache_file:
            if is_forced or any(shows_another(obj, scene) for scene in scenes):
                caches[modifier.cache_file] = source.path
    for cache, path in caches.items():
        reload_cache(cache)
        _open.pop(path, None)
    if changed:
        redraw()


def reload_cache(cache: bpy.types.CacheFile) -> None:
    """Read a file again: Blender keeps a stage open, with the frames that it had."""
    with in_window(), bpy.context.temp_override(edit_cachefile=cache):
        bpy.ops.cachefile.reload()


@persistent
def reopen(_scene: bpy.types.Scene, *_graph: bpy.types.Depsgraph) -> None:
    """Let Blender open the stages that have grown, just before it reads the frame that it changes to."""
    if not _open or bpy.app.is_job_running("RENDER"):
        return
    caches = {
        modifier.cache_file
        for obj in bpy.data.objects
        if obj.meniscus_sequence.path in _open and (modifier := modifier_of(obj))
    }
    for cache in caches - {None}:
        # The operator would read the frame twice more. Blender also opens a file whose path is spelled otherwise.
        folder, dot, name = re.fullmatch(r"((?:.*?[\\/])?)(\./)?([^\\/]*)", cache.filepath, re.DOTALL).groups()
        cache.filepath = folder + name if dot else f"{folder}./{name}"
    _open.clear()


def redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def frames_of(obj: bpy.types.Object, shots: dict[str, Shot]) -> tuple[int, ...]:
    """The frames of an object that can grow."""
    source = obj.meniscus_sequence
    shot = shots.get(source.path)
    if not shot:
        return ()
    if obj.type == "VOLUME":
        return next(iter(shot.frames.values()), ())
    modifier = modifier_of(obj)
    return shot.frames.get(name_of(obj, Path(source.path)) if modifier else "", ())


def number_at(source: "MENISCUS_PG_sequence", scene: bpy.types.Scene) -> int:
    """The frame of the sequence at the current time, if it exists."""
    passed = (scene.frame_current - source.anchor - source.offset) * ratio_of(source, scene)
    return min(max(source.anchor + math.floor(passed + TINY), source.first), source.last)


def held(number: int, frames: tuple[int, ...]) -> int | None:
    """The frame that is shown for a number: the one before, if it is missing."""
    return frames[max(bisect.bisect_right(frames, number) - 1, 0)] if frames else None


def shows_another(obj: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether the stage has another frame for the current time than Blender, which has opened it before."""
    source = obj.meniscus_sequence
    if source.path not in _open:
        return False
    number = number_at(source, scene)
    return held(number, frames_of(obj, _open)) != held(number, frames_of(obj, _known))


def shown_in_place(obj: bpy.types.Object, scene: bpy.types.Scene) -> tuple[int, int] | None:
    """The missing frame at the current time, and the one that is shown; None if nothing is missing."""
    number, frames = number_at(obj.meniscus_sequence, scene), frames_of(obj, _known)
    return None if not frames or number in frames else (number, held(number, frames))


# Blender interface

OFFSET = "Show frame n of the sequence at frame n plus this number"
KEEPS_RATE = (
    "Map times to the frame rate of the scene, which repeats or leaves out frames. "
    "Otherwise the scene gets the rate of the sequence"
)


class MENISCUS_PG_import(bpy.types.PropertyGroup):
    """The panel's values for the next import."""

    path: StringProperty(
        name="File",
        subtype="FILE_PATH",
        description="A stage (.usda), which may still grow, a shot (.abc), or one of the frames in .vdb",
    )
    offset: IntProperty(name="Offset", description=OFFSET)
    keeps_rate: BoolProperty(name="Keep scene rate", description=KEEPS_RATE)
    fps: FloatProperty(
        name="Frame rate",
        min=0,
        max=10000,
        description="Frames per second of .vdb files, which do not record it; 0 takes the scene's rate",
    )
    up: EnumProperty(
        name="Up",
        items=[("Y", "Y", "As in Houdini: turned to Z up"), ("Z", "Z", "As in Blender: not turned")],
        description="The axis of the particles that points up. Other files than .vdb record it",
    )
    has_mesh: BoolProperty(
        name="Surface of the level set", default=True, description="Show the surface in .vdb files by Volume to Mesh"
    )


class MENISCUS_PG_sequence(bpy.types.PropertyGroup):
    """The sequence that an object shows."""

    path: StringProperty(name="File", get=path_of)
    first: IntProperty(description="The first frame now")
    last: IntProperty(description="The last frame now")
    anchor: IntProperty(description="The first frame when it was imported, from which times are counted")
    fps: FloatProperty(name="Frame rate")
    offset: IntProperty(name="Offset", update=retime, description=OFFSET)
    keeps_rate: BoolProperty(name="Keep scene rate", update=retime, description=KEEPS_RATE)
    follows: BoolProperty(name="Follow", description="Show new frames as they are written")


class MENISCUS_OT_sequence_import(bpy.types.Operator):
    """Import a sequence, finished or still growing"""

    bl_idname = "meniscus.sequence_import"
    bl_label = "Import"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.scene.meniscus_sequence.path and context.mode == "OBJECT":
            return True
        cls.poll_message_set("Choose a file, in Object Mode")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        rate = rate_of(scene)
        try:
            objects = import_sequence(scene, absolute(scene.meniscus_sequence.path))
        except (OSError, ValueError, RuntimeError) as error:
            self.report({"ERROR"}, reason_of(error))
            return {"CANCELLED"}
        self.report({"INFO"}, summary(objects[0].meniscus_sequence, scene, rate))
        return {"FINISHED"}


def summary(source: "MENISCUS_PG_sequence", scene: bpy.types.Scene, rate: float) -> str:
    """What an import did to the times of the scene, whose rate was `rate` before."""
    text = f"Frames {source.first} to {source.last}, {source.fps:g} per second"
    if not math.isclose(rate_of(scene), rate, rel_tol=1e-6):
        return f"{text}: the scene's rate was {rate:g}, and is {rate_of(scene):g} now"
    if not math.isclose(source.fps, rate, rel_tol=1e-6):
        kind = "repeated" if source.fps < rate else "left out"
        return f"{text}: the scene keeps its rate, {rate:g}, so frames are {kind}"
    return text


class MENISCUS_OT_sequence_reload(bpy.types.Operator):
    """Read the sequences of the scene again, also frames that were replaced"""

    bl_idname = "meniscus.sequence_reload"
    bl_label = "Reload"

    def execute(self, context: bpy.types.Context) -> set[str]:
        global _errors
        # Blender keeps .vdb files in a cache even if they have changed: a limit of 0 empties it.
        system = context.preferences.system
        limit, system.memory_cache_limit = system.memory_cache_limit, 0
        try:
            found, _errors = look({obj.meniscus_sequence.path for obj in followed()}, {})
            _known.update(found)
            try_to_grow(set(found), is_forced=True)
            for volume in {obj.data for obj in followed() if obj.type == "VOLUME"}:
                volume.filepath = volume.filepath
            context.view_layer.update()
        finally:
            system.memory_cache_limit = limit
        return {"FINISHED"}


class MENISCUS_PT_sequence(Panel, bpy.types.Panel):
    bl_label = "Import sequence"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.meniscus_sequence
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(settings, "path")
        layout.prop(settings, "offset")
        layout.prop(settings, "keeps_rate")
        if settings.path.endswith(".vdb"):
            layout.prop(settings, "fps")
            layout.prop(settings, "up")
            layout.prop(settings, "has_mesh")
        layout.operator(MENISCUS_OT_sequence_import.bl_idname)
        objects = [obj for obj in context.scene.objects if obj.meniscus_sequence.path]
        for obj in objects:
            draw_sequence(layout.box(), obj, context.scene)
        if objects:
            layout.operator(MENISCUS_OT_sequence_reload.bl_idname)


def draw_sequence(box: bpy.types.UILayout, obj: bpy.types.Object, scene: bpy.types.Scene) -> None:
    source, frames = obj.meniscus_sequence, frames_of(obj, _known)
    missing = source.last - source.first + 1 - len(frames) if frames else 0
    words = f", {missing} missing" if missing else ""
    box.label(text=f"{obj.name}: frames {source.first} to {source.last}{words}")
    if held := shown_in_place(obj, scene):
        box.label(text=f"Frame {held[0]} is missing: shows {held[1]}", icon="ERROR")
    if source.path in _errors:
        draw_text(box, f"cannot read {source.path}: {_errors[source.path]}")
    if source.path in _waiting:
        draw_text(box, _grow_error)
    box.prop(source, "offset")
    box.prop(source, "keeps_rate")
    if frames:
        box.prop(source, "follows")


CLASSES = (
    MENISCUS_PG_import,
    MENISCUS_PG_sequence,
    MENISCUS_OT_sequence_import,
    MENISCUS_OT_sequence_reload,
    MENISCUS_PT_sequence,
)


def register() -> None:
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.meniscus_sequence = PointerProperty(type=MENISCUS_PG_import)
    bpy.types.Object.meniscus_sequence = PointerProperty(type=MENISCUS_PG_sequence)
    bpy.app.handlers.frame_change_pre.append(reopen)
    bpy.app.timers.register(tick, first_interval=FOLLOW_SECONDS, persistent=True)


def unregister() -> None:
    global _reading, _errors, _grow_error, _waiting
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    if reopen in bpy.app.handlers.frame_change_pre:
        bpy.app.handlers.frame_change_pre.remove(reopen)
    _reading, _errors, _grow_error, _waiting = None, {}, "", set()
    _known.clear()
    _open.clear()
    del bpy.types.Object.meniscus_sequence, bpy.types.Scene.meniscus_sequence
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
