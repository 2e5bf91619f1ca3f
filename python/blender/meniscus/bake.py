"""Bakes a live surface into a .usdc file, and shows the file in place of the live surface.

The result needs no extension: Blender's modifier Mesh Sequence Cache reads it.
"""

import os
import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import bpy
import pymeniscus
from bpy.props import BoolProperty, IntProperty, StringProperty

from . import live
from .points import PointsError
from .worker import Request, compute

MODIFIER = "Baked surface"
TICK_SECONDS = 0.05


class Bake:
    """One bake. The main thread visits the frames and copies points; a thread computes and writes.

    A frame that fails is left out: the file holds the frame before it. `errors` has the reasons.
    """

    def __init__(self, surface: bpy.types.Object, scene: bpy.types.Scene, file: Path, first: int, last: int) -> None:
        self.surface, self.scene, self.file = surface, scene, file
        self.frames = list(range(first, last + 1))
        self.count = len(self.frames)
        self.errors: list[str] = []
        self.written: list[Path] = []
        self.is_done = False
        self._has_combined = False
        self._before = scene.frame_current
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="meniscus-bake")
        self._future: Future[str] | None = None
        file.parent.mkdir(parents=True, exist_ok=True)

    def step(self) -> bool:
        """Starts the next piece of work, unless one is in progress. Returns whether the bake goes on."""
        if self._future is not None:
            if not self._future.done():
                return True
            if error := self._future.result():
                self.errors.append(error)
            self._future = None
        if self.frames:
            self._start(self.frames.pop(0))
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

    def end(self) -> None:
        """Returns to the frame before the bake, and removes the files of the frames."""
        self.frames.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)
        for path in self.written:
            path.unlink(missing_ok=True)
        with live.paused():
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
        scale = self.scene.unit_settings.scale_length
        self._future = self._pool.submit(self._write, frame, request, scale)

    def _write(self, frame: int, request: Request, scale: float) -> str:
        result = compute(request)
        if result.surface is None:
            return f"frame {frame}: {result.error}"
        path = self.file.with_name(f"{self.file.stem}.{frame:04}.usdc")
        try:
            result.surface.write(path, up="z", meters_per_unit=scale)
        except (OSError, pymeniscus.MeniscusError) as error:
            return f"frame {frame}: {error}"
        self.written.append(path)
        return ""

    def _combine(self) -> str:
        """Combines the frames with the command line, in a Python that finds the package where Blender has it."""
        render = self.scene.render
        words = [*map(str, self.written), "-o", str(self.file), "--fps", f"{render.fps / render.fps_base:.9g}"]
        words += ["--meters-per-unit", f"{self.scene.unit_settings.scale_length:.9g}"]
        home = str(Path(pymeniscus.__file__).parents[1])
        ran = subprocess.run(
            [sys.executable, "-m", "pymeniscus", "sequence", *words],
            env={**os.environ, "PYTHONPATH": home},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        # With status 1 the file lacks some frames; with others it was not written.
        self.is_done = ran.returncode in (0, 1)
        if ran.returncode == 0:
            return ""
        return ran.stderr.strip() or f"the command `sequence` ended with status {ran.returncode}"


def link(surface: bpy.types.Object, file: Path, context: bpy.types.Context) -> None:
    """Shows a baked file on the surface object, which then is no longer live."""
    known = set(bpy.data.cache_files)
    bpy.ops.cachefile.open(filepath=str(file), relative_path=False)
    added = set(bpy.data.cache_files) - known
    if not added:
        raise RuntimeError(f"Blender could not open {file}")
    cache = added.pop()
    modifier = surface.modifiers.get(MODIFIER) or surface.modifiers.new(MODIFIER, "MESH_SEQUENCE_CACHE")
    modifier.cache_file = cache
    # All kinds of data. Which kinds exist depends on the version of Blender.
    modifier.read_data = {item.identifier for item in modifier.bl_rna.properties["read_data"].enum_items}
    context.view_layer.update()
    modifier.object_path = mesh_path(cache)
    # The modifier comes first, so that those of the user apply to the baked mesh.
    surface.modifiers.move(surface.modifiers.find(MODIFIER), 0)
    with live.quiet():
        surface.meniscus.is_live = False


def mesh_path(cache: bpy.types.CacheFile) -> str:
    """The path of the mesh in the file: the longest one, because its parents are in the list as well."""
    return max((entry.path for entry in cache.object_paths), key=len, default="")


class MENISCUS_OT_bake(bpy.types.Operator):
    """Write the live surface of a range of frames to a .usdc file"""

    bl_idname = "meniscus.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER"}

    filepath: StringProperty(name="File", subtype="FILE_PATH", description="The .usdc file to write")
    filter_glob: StringProperty(default="*.usdc", options={"HIDDEN"})
    first: IntProperty(name="First frame", default=1)
    last: IntProperty(name="Last frame", default=250)
    is_linked: BoolProperty(
        name="Show the result", default=True, description="Show the baked file in place of the live surface"
    )

    poll = live.MENISCUS_OT_update.poll

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        surface = live.surface_of(context.object, context.scene)
        self.first, self.last = context.scene.frame_start, context.scene.frame_end
        self.filepath = str(Path(bpy.path.abspath("//") or Path.home()) / f"{surface.name}.usdc")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        file = Path(bpy.path.abspath(self.filepath))
        if file.suffix != ".usdc":
            self.report({"ERROR"}, f"{file.name or 'the file'} must end in .usdc")
            return {"CANCELLED"}
        if self.last < self.first:
            self.report({"ERROR"}, f"the last frame, {self.last}, is before the first, {self.first}")
            return {"CANCELLED"}
        surface = live.surface_of(context.object, context.scene)
        try:
            self._bake = Bake(surface, context.scene, file, self.first, self.last)
        except OSError as error:
            self.report({"ERROR"}, str(error))
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
            self._bake.end()
            self._stop(context)
            self.report({"WARNING"}, "the bake was cancelled")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self._bake.step():
            done = self._bake.count - len(self._bake.frames)
            context.window_manager.progress_update(done)
            context.workspace.status_text_set(f"Bake: frame {done} of {self._bake.count}, Esc cancels")
            return {"RUNNING_MODAL"}
        self._stop(context)
        return self._finish(context)

    def _stop(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)

    def _finish(self, context: bpy.types.Context) -> set[str]:
        bake = self._bake
        for error in bake.errors:
            self.report({"WARNING" if bake.is_done else "ERROR"}, error)
        if not bake.is_done:
            return {"CANCELLED"}
        if self.is_linked:
            try:
                link(bake.surface, bake.file, context)
            except RuntimeError as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
        self.report({"INFO"}, f"{len(bake.written)} frames are in {bake.file}")
        return {"FINISHED"}


class MENISCUS_PT_bake(live.SurfacePanel, bpy.types.Panel):
    bl_label = "Bake"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.operator(MENISCUS_OT_bake.bl_idname, text="Bake to .usdc", icon="FILE_CACHE")
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
