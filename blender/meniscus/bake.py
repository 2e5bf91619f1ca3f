"""Bakes a live surface into a .abc file, and shows the file in place of the live surface.

The result needs no extension: Blender's modifier Mesh Sequence Cache reads it.
"""

import contextlib
import shutil
import tempfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import bpy
import pymeniscus
from bpy.props import BoolProperty, IntProperty, StringProperty

from . import live, program, sequence
from .options import text_of
from .panel import reason_of
from .points import PointsError
from .worker import Request, compute, measured

MODIFIER = "Baked surface"
TICK_SECONDS = 0.05


class Bake:
    """One bake. The main thread visits the frames and copies points; a thread computes and writes.

    A frame that fails is left out: the file holds the frame before it. `errors` has the reasons. `warnings` has those
    about averaged surfaces, with the first frame of each. The files of the frames are in a temporary folder beside the
    result, which is removed at the end. `temporal` is the number of frames on each side with which a surface is averaged.
    """

    def __init__(
        self, surface: bpy.types.Object, scene: bpy.types.Scene, file: Path, first: int, last: int, temporal: int = 0
    ) -> None:
        self.surface, self.scene, self.file = surface, scene, file
        self.frames = list(range(first, last + 1))
        self.count = len(self.frames)
        self.errors: list[str] = []
        self.written = 0
        self.is_done = False
        self.is_cancelled = False
        self._has_combined = False
        self._before = scene.frame_current
        # The thread must not read Blender's data.
        self._fps = scene.render.fps / scene.render.fps_base
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="meniscus-bake")
        self._future: Future[str] | None = None
        self._averages = Averages(temporal, 1 / self._fps) if temporal else None
        self.warnings: dict[str, int] = {}
        file.parent.mkdir(parents=True, exist_ok=True)
        self._folder = Path(tempfile.mkdtemp(prefix=f".{file.stem}-", dir=file.parent))

    def step(self) -> bool:
        """Starts the next piece of work, unless one is in progress. Returns whether the bake goes on."""
        if self._future is not None:
            if not self._future.done():
                return True
            if error := self._future.result():
                self.errors.append(error)
            self._future = None
        if self.is_cancelled:
            self.end()
            return False
        if self.frames:
            try:
                self._start(self.frames.pop(0))
            except ReferenceError:
                self.errors.append("the surface or its scene was removed")
                self.end()
                return False
        elif self._averages and self._averages.count:
            self._future = self._pool.submit(self._write_averages, 0)
        elif self.written and not self._has_combined:
            self._has_combined = True
            self._future = self._pool.submit(self._combine)
        else:
            self.end()
            return False
        return True

    def wait(self) -> None:
        if self._future is not None:
            self._future.exception()

    def cancel(self) -> None:
        """Asks for an early end: `step` ends the bake when the work in progress has ended."""
        self.is_cancelled = True
        self.frames.clear()

    def close(self) -> None:
        """Removes the files of the frames, after the work in progress, without waiting for it."""
        self.cancel()
        self._pool.submit(shutil.rmtree, self._folder, ignore_errors=True)
        self._pool.shutdown(wait=False)

    def end(self) -> None:
        """Removes the files of the frames, and returns to the frame before the bake."""
        self.frames.clear()
        self._pool.shutdown()
        shutil.rmtree(self._folder, ignore_errors=True)
        # The scene may have been removed.
        with live.paused(), contextlib.suppress(ReferenceError):
            self.scene.frame_set(self._before)

    def _start(self, frame: int) -> None:
        with live.paused():
            self.scene.frame_set(frame)
        try:
            request = live.request_of(self.surface, bpy.context.evaluated_depsgraph_get())
        except PointsError as error:
            self.errors.append(f"frame {frame}: {error}")
            return
        request.known = ""
        self._future = self._pool.submit(self._write, frame, request)

    def _write(self, frame: int, request: Request) -> str:
        if self._averages:
            # The frames before a gap have no others after them.
            errors = [self._write_averages(0)] if self._averages.has_gap_before(frame) else []
            try:
                self._averages.add(frame, request)
            except Exception as error:
                errors.append(f"frame {frame}: {error}")
            errors.append(self._write_averages(self._averages.temporal))
            return "\n".join(filter(None, errors))
        result = compute(request, progress=self._on_progress)
        if result.surface is None:
            return f"frame {frame}: {result.error}"
        return self._save(frame, result.surface)

    def _write_averages(self, waiting: int) -> str:
        """Writes the averaged surfaces that do not wait for frames after them. Returns the errors."""
        errors = []
        while self._averages.count > waiting and not self.is_cancelled:
            frame, found = self._averages.next()
            if isinstance(found, Exception):
                errors.append(f"frame {frame}: {found}")
                continue
            errors.append(self._save(frame, found))
            for warning in found.warnings:
                self.warnings.setdefault(warning, frame)
        return "\n".join(filter(None, errors))

    def _save(self, frame: int, surface: pymeniscus.Surface) -> str:
        path = self._folder / f"{self.file.stem}.{frame:04}.abc"
        try:
            # Not turned: the modifier shows the coordinates as they are.
            surface.write(path, up="y")
        except (OSError, pymeniscus.MeniscusError) as error:
            return f"frame {frame}: {error}"
        self.written += 1
        return ""

    def _on_progress(self, *_: Any) -> None:
        if self.is_cancelled:
            raise InterruptedError("cancelled")

    def _combine(self) -> str:
        """Combines the frames with the command line."""
        words = [str(self._folder), "-o", str(self.file), "--fps", f"{self._fps:.9g}"]
        try:
            ran = program.run(["sequence", *words])
        except OSError as error:
            return f"the command `sequence` did not start: {error}"
        # With status 1 the file lacks some frames; with others it was not written.
        self.is_done = ran.returncode in (0, 1)
        if ran.returncode == 0:
            return ""
        return ran.stderr.strip() or f"the command `sequence` ended with status {ran.returncode}"


class Averages:
    """Surfaces that are averaged with those of the frames around them. All have the options of the first frame.

    `temporal` frames must be added, beside a frame, before its surface is made, unless no more will come.
    """

    def __init__(self, temporal: int, time_step: float) -> None:
        self.temporal, self._time_step = temporal, time_step
        self._sequence: pymeniscus.Sequence | None = None
        # The frames without surfaces, and those of them that were not read yet.
        self._unmade: deque[tuple[int, dict[str, Any]]] = deque()
        self._unread: deque[dict[str, Any]] = deque()
        self._surfaces: Iterator[pymeniscus.Surface] | None = None
        self._last: int | None = None

    @property
    def count(self) -> int:
        """The number of frames that have no surface yet."""
        return len(self._unmade)

    def has_gap_before(self, frame: int) -> bool:
        """Whether a frame does not follow the last one."""
        return self._last is not None and self._last != frame - 1

    def add(self, frame: int, request: Request) -> None:
        """Adds the next frame. Before a gap, all surfaces must be made."""
        if self.has_gap_before(frame):
            self._surfaces = None
        points = request.points
        if self._sequence is None:
            options = dict(request.options)
            if not options.get("spacing"):
                options["spacing"] = text_of(measured(points, {**options, "spacing": None}))
            self._sequence = pymeniscus.Sequence(temporal=self.temporal, time_step=self._time_step, **options)
        given = {"points": points.positions, "radii": points.radii, "velocity": points.velocity, "ids": points.ids}
        given["attributes"] = points.attributes or None
        self._unmade.append((frame, given))
        self._unread.append(given)
        self._last = frame

    def next(self) -> tuple[int, pymeniscus.Surface | Exception]:
        """The next frame, and its surface or why it has none."""
        frame, _ = self._unmade[0]
        if self._surfaces is None:
            self._surfaces = self._sequence.averaged(self._read())
        try:
            return frame, next(self._surfaces)
        except Exception as error:
            # The frames after it begin anew.
            self._unread = deque(given for _, given in islice(self._unmade, 1, None))
            self._surfaces = None
            return frame, error
        finally:
            self._unmade.popleft()

    def _read(self) -> Iterator[dict[str, Any]]:
        while self._unread:
            yield self._unread.popleft()


def link(surface: bpy.types.Object, file: Path, context: bpy.types.Context) -> None:
    """Shows a baked file on the surface object, which then is no longer live."""
    cache = cache_of(file)
    if cache is not None:
        sequence.reload_cache(cache)
    else:
        bpy.ops.cachefile.open(filepath=str(file), relative_path=False)
        cache = cache_of(file)
    if cache is None:
        raise RuntimeError(f"Blender could not open {file}")
    modifier = surface.modifiers.get(MODIFIER) or surface.modifiers.new(MODIFIER, "MESH_SEQUENCE_CACHE")
    modifier.cache_file = cache
    cache.velocity_name = ".velocities"
    # All kinds of data. Which kinds exist depends on the version of Blender.
    modifier.read_data = {item.identifier for item in modifier.bl_rna.properties["read_data"].enum_items}
    context.view_layer.update()
    modifier.object_path = mesh_path(cache)
    # The modifier comes first, so that those of the user apply to the baked mesh.
    surface.modifiers.move(surface.modifiers.find(MODIFIER), 0)
    with live.quiet():
        surface.meniscus.is_live = False


def cache_of(file: Path) -> bpy.types.CacheFile | None:
    """Blender's cache of a file."""
    return next((each for each in bpy.data.cache_files if sequence.absolute(each.filepath, each.library) == file), None)


def mesh_path(cache: bpy.types.CacheFile) -> str:
    """The path of the mesh in the file: the longest one, because its parents are in the list as well."""
    return max((entry.path for entry in cache.object_paths), key=len, default="")


class MENISCUS_OT_bake(bpy.types.Operator):
    """Write the live surface of a range of frames to a .abc file"""

    bl_idname = "meniscus.bake"
    bl_label = "Bake"
    # Not "REGISTER": a change in the panel of the last operator would bake again.
    bl_options = {"UNDO"}

    filepath: StringProperty(name="File", subtype="FILE_PATH", description="The .abc file to write")
    filter_glob: StringProperty(default="*.abc", options={"HIDDEN"})
    first: IntProperty(name="First frame", default=1, min=0)
    last: IntProperty(name="Last frame", default=250, min=0)
    temporal: IntProperty(
        name="Average over time",
        default=0,
        min=0,
        max=3,
        description="Average each surface with those of this many frames before and after it, along the motion of the "
        "points. They need an attribute id, or velocities per second. All frames have the options of the first",
    )
    is_linked: BoolProperty(
        name="Show the result", default=True, description="Show the baked file in place of the live surface"
    )

    poll = live.MENISCUS_OT_update.poll

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        surface = live.surface_of(context.object, context.scene)
        self.first, self.last = context.scene.frame_start, context.scene.frame_end
        self.filepath = str(Path(bpy.path.abspath("//") or Path.home()) / f"{surface.name}.abc")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        file = sequence.absolute(self.filepath)
        if file.suffix != ".abc":
            self.report({"ERROR"}, f"{Path(self.filepath).name or 'the file'} must end in .abc")
            return {"CANCELLED"}
        if self.last < self.first:
            self.report({"ERROR"}, f"the last frame, {self.last}, is before the first, {self.first}")
            return {"CANCELLED"}
        surface = live.surface_of(context.object, context.scene)
        try:
            if self.is_linked:
                sequence.require("Alembic")
            self._bake = Bake(surface, context.scene, file, self.first, self.last, self.temporal)
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, reason_of(error))
            return {"CANCELLED"}
        manager = context.window_manager
        if not live.has_event_loop():
            while self._bake.step():
                self._bake.wait()
            return self._finish(context)
        manager.progress_begin(0, self._bake.count)
        self._timer = manager.event_timer_add(TICK_SECONDS, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self._bake.cancel()
            context.workspace.status_text_set("Bake: cancelling")
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        # A render visits frames itself, on its own thread.
        if live.is_rendering():
            return {"RUNNING_MODAL"}
        if self._bake.step():
            done = self._bake.count - len(self._bake.frames)
            if not self._bake.is_cancelled:
                context.window_manager.progress_update(done)
                context.workspace.status_text_set(f"Bake: frame {done} of {self._bake.count}, Esc cancels")
            return {"RUNNING_MODAL"}
        self._stop(context)
        return self._finish(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender calls this when it closes the window or opens another file."""
        self._bake.close()
        self._stop(context)

    def _stop(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.progress_end()
        if context.workspace is not None:
            context.workspace.status_text_set(None)

    def _finish(self, context: bpy.types.Context) -> set[str]:
        bake = self._bake
        if bake.is_cancelled and not bake.is_done:
            self.report({"WARNING"}, "the bake was cancelled")
            return {"CANCELLED"}
        for error in bake.errors:
            self.report({"WARNING" if bake.is_done else "ERROR"}, error)
        if not bake.is_done:
            return {"CANCELLED"}
        if self.is_linked:
            try:
                link(bake.surface, bake.file, context)
            except (ReferenceError, RuntimeError) as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
        for warning, frame in bake.warnings.items():
            self.report({"WARNING"}, f"frame {frame}: {warning}")
        self.report({"INFO"}, f"{bake.written} frames are in {bake.file}")
        return {"FINISHED"}


class MENISCUS_PT_bake(live.SurfacePanel, bpy.types.Panel):
    bl_label = "Bake"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.operator(MENISCUS_OT_bake.bl_idname, text="Bake to .abc", icon="FILE_CACHE")
        if MODIFIER in live.surface_of(context.object, context.scene).modifiers:
            self.layout.operator(MENISCUS_OT_unlink.bl_idname, icon="UNLINKED")


class MENISCUS_OT_unlink(bpy.types.Operator):
    """Stop showing the baked file, and make the surface live again"""

    bl_idname = "meniscus.unlink"
    bl_label = "Back to live"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        surface = live.surface_of(context.object, context.scene)
        return surface is not None and MODIFIER in surface.modifiers

    def execute(self, context: bpy.types.Context) -> set[str]:
        surface = live.surface_of(context.object, context.scene)
        surface.modifiers.remove(surface.modifiers[MODIFIER])
        surface.meniscus.is_live = True
        return {"FINISHED"}


CLASSES = (MENISCUS_OT_bake, MENISCUS_OT_unlink, MENISCUS_PT_bake)


def register() -> None:
    for each in CLASSES:
        bpy.utils.register_class(each)


def unregister() -> None:
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
