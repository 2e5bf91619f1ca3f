"""Converts a cache folder in the background, with the daemon of the bundled pymeniscus.

The daemon is a process of its own, which ends when Blender does, even if that crashes. One thread starts it
and reads its log; it has the address of the status API, and errors such as the lock of another daemon. A
second thread asks the API for counts, forecast and failures. A timer collects what they found, and links the
result when its first frame is there. Nothing here waits on the main thread.
"""

import http.client
import json
import subprocess
import threading
import time
import urllib.parse
import urllib.request
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from . import program, sequence
from .panel import Panel, draw_text, reason_of
from .timers import lasting

TICK_SECONDS = 0.5
#: The rate is that of this time.
RATE_SECONDS = 60
#: Frames in progress may end within this time when Blender exits; they are converted at the next start otherwise.
STOP_SECONDS = 2
#: The server is on this machine, so it answers at once or hangs.
ANSWER_SECONDS = 5
SHOWN_FAILURES = 8
#: A file may be out of reach for a moment.
LINK_AGAIN_SECONDS = 5
STAGE = "shot.usda"


# The daemon


@dataclass(frozen=True)
class Progress:
    """What is known about a conversion.

    Attributes
    ----------
    state : str
        ``"starting"``, ``"running"``, ``"stopping"`` or ``"ended"``.
    counts : dict
        The number of frames in each state, as in the status API.
    per_minute : float or None
        Frames per minute; None if none was converted in the last minute.
    seconds_left : float or None
        The daemon's estimate.
    failures : tuple
        Name and reason of each frame that failed, or will be retried.
    troubles : tuple
        Why frames wait: a full disk, a folder that is not there.
    error : str
        Why the daemon ended, if it failed.
    has_stage : bool
        Whether there is a frame to show.
    """

    state: str = "starting"
    counts: dict[str, int] | None = None
    per_minute: float | None = None
    seconds_left: float | None = None
    failures: tuple[tuple[str, str], ...] = ()
    troubles: tuple[str, ...] = ()
    error: str = ""
    has_stage: bool = False


class Conversion:
    """A daemon and what it reports. The threads replace `progress` whole, so it can be read at any time."""

    def __init__(self, folder: Path, out: Path, options: list[str]) -> None:
        self.folder, self.out, self.stage = folder, out, out / STAGE
        self.progress = Progress()
        self._arguments = [
            *("watch", f"--out={out}", f"--stage={self.stage}", "--log=json", "--listen=127.0.0.1:0"),
            *(*options, "--", str(folder)),
        ]
        self._process: subprocess.Popen[str] | None = None
        self._lock = threading.Lock()
        self._is_stopping = False
        self._has_ended = threading.Event()
        self._poller: threading.Thread | None = None
        self._thread = threading.Thread(target=self._run, name="meniscus-daemon", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        return self.progress.state != "ended"

    def stop(self) -> None:
        """Ask the daemon to end. It ends when its standard input does."""
        with self._lock:
            self._is_stopping = True
            if self._process and not self._process.stdin.closed:
                self._process.stdin.close()
        self._report(state="stopping")

    def stop_now(self) -> None:
        """Stop the daemon before Blender exits, and wait for it, but never long."""
        self.stop()
        self._thread.join(STOP_SECONDS + 1)
        if self._process and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        # A thread that is left when Python ends can keep Blender from exiting.
        self._has_ended.set()
        if self._poller:
            self._poller.join(ANSWER_SECONDS + 1)

    def _report(self, **changes: Any) -> None:
        with self._lock:
            # The answer to a last request may arrive after the end.
            if self.is_running:
                self.progress = replace(self.progress, **changes)

    def _run(self) -> None:
        """Start the daemon, and read its log to the end. Runs on a thread."""
        errors: deque[str] = deque(maxlen=3)
        try:
            with self._lock:
                if not self._is_stopping:
                    self._process = program.start(self._arguments)
            status = self._read_log(self._process, errors) if self._process else 0
        except OSError as error:
            errors.append(str(error))
            status = None
        failed = status != 0 and not self._is_stopping
        message = "\n".join(errors) or f"the daemon ended with status {status}"
        self._report(state="ended", seconds_left=None, per_minute=None, error=message if failed else "")

    def _read_log(self, process: subprocess.Popen[str], errors: deque[str]) -> int:
        for line in process.stderr:
            try:
                event = json.loads(line)
            except ValueError:
                # The command refuses a setting. Its advice is about the command line.
                if line.strip() and "--help" not in line:
                    errors.append(line.strip().removeprefix("error: "))
                continue
            if event.get("level") == "ERROR" and "frame" not in event:
                errors.append(str(event.get("message", "")))
            if "address" in event:
                self._poller = threading.Thread(
                    target=self._poll, args=[event["address"]], name="meniscus-status", daemon=True
                )
                self._poller.start()
        self._has_ended.set()
        process.stderr.close()
        return process.wait()

    def _poll(self, address: str) -> None:
        """Ask for the status until the daemon ends. Runs on a thread."""
        known: tuple[int, ...] = ()
        while not self._has_ended.wait(TICK_SECONDS):
            try:
                status = answer(address, "api/status")
                live, counts = status["status"], status["frames"]
                # The list of frames may be long, so it is read only when failures have come or gone.
                now = (status["failures"], status["retries"], counts["failed"], counts["retrying"])
                changes = {"failures": failures(address)} if now != known else {}
                known = now
                self._report(
                    state="stopping" if live["stopping"] or self._is_stopping else "running",
                    counts=counts,
                    per_minute=rate_of(status["samples"]),
                    seconds_left=status["forecast"]["seconds_left"],
                    troubles=tuple(filter(None, [live["paused"], *live["unavailable"]])),
                    has_stage=self.stage.exists(),
                    **changes,
                )
            except (OSError, http.client.HTTPException, ValueError, LookupError):
                # It stops, or answers the next time.
                pass


def answer(address: str, path: str) -> dict[str, Any]:
    """The status API's response. Without a proxy, which some machines have for other addresses."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(address + path, timeout=ANSWER_SECONDS) as response:
        return json.load(response)


def failures(address: str) -> tuple[tuple[str, str], ...]:
    """The frames that failed, or will be retried, and their reasons."""
    found, after = [], ""
    while after is not None:
        page = answer(address, f"api/frames?limit=2000{after}")
        for frame in page["frames"]:
            if frame["state"] in ("failed", "retrying"):
                # A reason begins with the path, which ends with the name.
                reason = str(frame["reason"]).rpartition(f"{frame['name']}: ")[2]
                again = " (will be retried)" if frame["state"] == "retrying" else ""
                found.append((frame["name"], reason + again))
        after = f"&after={urllib.parse.quote(page['next'])}" if page["next"] else None
    return tuple(found)


def rate_of(samples: list[dict[str, Any]]) -> float | None:
    """Frames per minute, from the samples of the last minute with work."""
    recent = [sample for sample in samples if sample["at_ms"] > samples[-1]["at_ms"] - 1000 * RATE_SECONDS]
    converted = recent[-1]["converted"] - recent[0]["converted"] if recent else 0
    return converted * 60_000 / (recent[-1]["at_ms"] - recent[0]["at_ms"]) if converted else None


# The conversion of this Blender, and the scene that gets its result. There is one at a time, because each
# takes all processors.
_conversion: Conversion | None = None
_scene_to_link: int | None = None
_shown: Progress | None = None
_link_error = ""
_next_link = 0.0


def start(scene: bpy.types.Scene) -> Conversion:
    """Start the daemon with the settings of a scene.

    Raises
    ------
    ValueError
        If a setting is missing.
    """
    global _conversion, _scene_to_link, _link_error, _next_link
    _link_error, _next_link = "", 0.0
    settings = scene.meniscus_conversion
    if not settings.folder or not settings.out:
        raise ValueError("choose the folder of the particles, and a folder for the results")
    folder, out = (sequence.absolute(path) for path in (settings.folder, settings.out))
    _conversion = Conversion(folder, out, options_of(settings))
    _scene_to_link = scene.session_uid if settings.links else None
    return _conversion


def options_of(settings: "MENISCUS_PG_conversion") -> list[str]:
    """The options of the command; those that are unset keep the command's defaults."""
    options = {
        "format": "usdc,vdb" if settings.has_volumes else "usdc",
        "preset": settings.preset,
        "spacing": f"{settings.spacing:.9g}" if settings.spacing else "",
        "voxel-size": settings.voxel_size,
        "attributes": settings.attributes,
        "pattern": settings.pattern,
        "up": settings.up.lower(),
        "fps": f"{settings.fps:.9g}",
        "temporal": str(settings.temporal) if settings.temporal else "",
        "time-step": f"{1 / settings.fps:.9g}" if settings.temporal else "",
        "threads": str(settings.threads) if settings.threads else "",
    }
    return [f"--{name}={value}" for name, value in options.items() if value]


@lasting
def tick() -> float:
    """Show what the threads have found, and link the result once."""
    global _shown
    if not _conversion:
        return TICK_SECONDS
    progress = _conversion.progress
    if progress is not _shown:
        _shown = progress
        sequence.redraw()
    if progress.has_stage and _scene_to_link is not None:
        # Only with a window does the context have a mode.
        with sequence.in_window():
            link_when_possible()
    return TICK_SECONDS


def link_when_possible() -> None:
    """Link the result, unless Blender is busy, another scene is in the window, or it failed just now."""
    global _scene_to_link, _link_error, _next_link
    can_link = bpy.context.mode == "OBJECT" and not bpy.app.is_job_running("RENDER")
    if not can_link or time.monotonic() < _next_link:
        return
    scene = next((scene for scene in bpy.data.scenes if scene.session_uid == _scene_to_link), None)
    # Another scene may be in the window now: it waits for its own. Another file may be open: there is none.
    if scene == bpy.context.scene and not is_linked(scene, _conversion.stage):
        _link_error = link(scene, _conversion.stage)
        _next_link = time.monotonic() + LINK_AGAIN_SECONDS
        sequence.redraw()
    if not _link_error and (scene is None or scene == bpy.context.scene):
        _scene_to_link = None


def is_linked(scene: bpy.types.Scene, stage: Path) -> bool:
    return any(obj.meniscus_sequence.path == str(stage) for obj in scene.objects)


def link(scene: bpy.types.Scene, stage: Path) -> str:
    """Import the stage, and keep the user's selection: a timer calls this. Returns why it failed."""
    layer = bpy.context.view_layer
    selected, active = layer.objects.selected[:], layer.objects.active
    try:
        objects = sequence.import_sequence(scene, stage)
    except (OSError, ValueError, RuntimeError) as error:
        return f"{stage.name} could not be imported: {reason_of(error)}"
    # The layer lacks the objects of excluded collections, which cannot be selected.
    for obj in layer.objects:
        obj.select_set(obj in selected)
    layer.objects.active = active or objects[0]
    if bpy.context.window:
        bpy.ops.ed.undo_push(message="Show the conversion")
    return ""


# Blender interface

PRESETS = ("fluid", "noisy", "splash", "granular", "preview", "paper", "auto")


class MENISCUS_PG_conversion(bpy.types.PropertyGroup):
    """The panel's values. The names and meanings are those of the command `watch`."""

    folder: StringProperty(
        name="Particles", subtype="DIR_PATH", description="The folder into which a simulation writes frames"
    )
    out: StringProperty(name="Results", subtype="DIR_PATH", description="The folder for the surfaces and the stage")
    preset: EnumProperty(
        name="Preset",
        items=[(name, name.capitalize(), "") for name in PRESETS],
        description="Defaults for a kind of particles",
    )
    spacing: FloatProperty(
        name="Spacing",
        min=0,
        precision=4,
        description="Distance of neighbouring particles; 0 measures it on the first frame",
    )
    voxel_size: StringProperty(
        name="Voxel size", description="A length, or 0.3d for 0.3 spacings; empty for the preset's"
    )
    attributes: StringProperty(
        name="Attributes",
        default="velocity",
        description="Names to transfer to the surface, separated by commas. Motion blur needs the velocity",
    )
    pattern: StringProperty(
        name="Only files", description="A pattern such as dam.*.bgeo; empty for all particle files"
    )
    up: EnumProperty(
        name="Up", items=[("Y", "Y", ""), ("Z", "Z", "")], description="The axis of the particles that points up"
    )
    fps: FloatProperty(
        name="Frame rate", default=24, min=0.001, max=10000, description="Frames per second of the simulation"
    )
    temporal: IntProperty(
        name="Average over time",
        min=0,
        max=3,
        description="Average each surface with those of this many frames before and after it, along the motion of the "
        "particles. They need ids, or velocities per second",
    )
    threads: IntProperty(name="Threads", min=0, max=1024, description="Processors to use; 0 uses all")
    has_volumes: BoolProperty(name="Level sets, too", description="Also write a .vdb of each frame")
    links: BoolProperty(
        name="Show the result", default=True, description="Import the stage when its first frame is there"
    )


class MENISCUS_OT_conversion_start(bpy.types.Operator):
    """Convert the particles, and those that a simulation still writes, until Stop"""

    bl_idname = "meniscus.conversion_start"
    bl_label = "Start"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not (_conversion and _conversion.is_running)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            start(context.scene)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class MENISCUS_OT_conversion_stop(bpy.types.Operator):
    """Stop the conversion; Start continues it"""

    bl_idname = "meniscus.conversion_stop"
    bl_label = "Stop"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(_conversion and _conversion.is_running)

    def execute(self, context: bpy.types.Context) -> set[str]:
        _conversion.stop()
        return {"FINISHED"}


class MENISCUS_PT_conversion(Panel, bpy.types.Panel):
    bl_label = "Convert in the background"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.meniscus_conversion
        is_running = bool(_conversion and _conversion.is_running)
        column = layout.column()
        column.use_property_split, column.use_property_decorate, column.enabled = True, False, not is_running
        for name in MENISCUS_PG_conversion.__annotations__:
            column.prop(settings, name)
        kind = MENISCUS_OT_conversion_stop if is_running else MENISCUS_OT_conversion_start
        layout.operator(kind.bl_idname)
        if _conversion:
            draw_progress(layout.box(), _conversion)


def draw_progress(box: bpy.types.UILayout, conversion: Conversion) -> None:
    progress = conversion.progress
    for line in lines_of(conversion):
        box.label(text=line)
    failed = [f"{name}: {reason}" for name, reason in progress.failures[:SHOWN_FAILURES]]
    for text in [*filter(None, [_link_error]), *progress.troubles, *progress.error.splitlines(), *failed]:
        draw_text(box, text)
    if len(progress.failures) > SHOWN_FAILURES:
        box.label(text=f"and {len(progress.failures) - SHOWN_FAILURES} more")


def lines_of(conversion: Conversion) -> list[str]:
    """The state in words: frames, rate and time left."""
    progress = conversion.progress
    lines = [f"{progress.state.capitalize()}: {conversion.folder}"]
    if counts := progress.counts:
        text = f"{counts['done']} of {sum(counts.values())} frames done"
        lines.append(f"{text}, {counts['failed']} failed" if counts["failed"] else text)
    if progress.per_minute:
        lines.append(f"{progress.per_minute:.1f} frames per minute")
    if progress.seconds_left is not None:
        minutes, seconds = divmod(round(progress.seconds_left), 60)
        hours, minutes = divmod(minutes, 60)
        lines.append(f"{hours}:{minutes:02}:{seconds:02} left")
    return lines


CLASSES = (MENISCUS_PG_conversion, MENISCUS_OT_conversion_start, MENISCUS_OT_conversion_stop, MENISCUS_PT_conversion)


def register() -> None:
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.meniscus_conversion = PointerProperty(type=MENISCUS_PG_conversion)
    bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)


def unregister() -> None:
    """Blender calls this when it exits, too."""
    global _conversion, _scene_to_link, _shown
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    if _conversion:
        _conversion.stop_now()
    _conversion = _scene_to_link = _shown = None
    del bpy.types.Scene.meniscus_conversion
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
