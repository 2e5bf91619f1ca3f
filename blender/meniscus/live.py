"""Live surfaces: a mesh object that follows the points of another object.

The surface is an ordinary mesh object with a `source`. Handlers notice changes of the points, and copy them.
A thread computes the surface, and a timer writes it into the mesh, so that the interface never waits. A
render computes the surface of each frame itself, and waits for it.

The mesh stores the hash of its points and options. Whatever changes either of them (a drag, undo, another
frame, a file that is opened), the hash shows whether the mesh is still right.
"""

import atexit
import contextlib
import functools
import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from typing import Any

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, FloatProperty, PointerProperty, StringProperty

from . import meshes, options
from .panel import Panel, draw_text
from .points import HiddenPointsError, PointsError, read, varies
from .timers import lasting
from .worker import Request, Result, Worker, compute

TICK_SECONDS = 0.02
# How long a render waits for the main thread to write a mesh, before it reports an error.
WRITE_SECONDS = 30.0

worker = Worker()


@dataclass
class Status:
    """What the panel shows of a surface. `is_shown` is about its points, and `render_errors` are those of the last render,
    with their frames."""

    error: str = ""
    is_shown: bool = True
    render_errors: list[str] = field(default_factory=list)
    note: str = ""
    made: str = ""


statuses: dict[int, Status] = {}


# Surfaces


def surfaces_in(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The live surfaces of a scene."""
    return [obj for obj in scene.objects if obj.type == "MESH" and obj.meniscus.source is not None]


def surface_of(obj: bpy.types.Object | None, scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The surface that an object is, or the first one that it is the source of."""
    if obj is None or obj.meniscus.source is not None:
        return obj
    return next((each for each in surfaces_in(scene) if each.meniscus.source == obj), None)


def status_of(surface: bpy.types.Object) -> Status:
    return statuses.setdefault(surface.session_uid, Status())


def request_of(surface: bpy.types.Object, graph: bpy.types.Depsgraph) -> Request:
    """A copy of the points and options of a surface.

    Raises
    ------
    PointsError
        If the source has no points.
    """
    settings = surface.meniscus
    radius = settings.radius_attribute if settings.use_radius else ""
    values = options.values_of(settings.options)
    # A condition may name any attribute.
    has_attributes = settings.use_attributes or "where" in values
    points = read(settings.source, graph, radius, settings.velocity_attribute, has_attributes)
    if settings.spacing > 0:
        values["spacing"] = options.text_of(settings.spacing)
    return Request(surface.session_uid, points, values, surface.data.get(meshes.SIGNATURE, ""))


def update(surface: bpy.types.Object, graph: bpy.types.Depsgraph, has_preview: bool = True) -> None:
    """Requests a new mesh. Without an event loop (`blender --background`) the mesh is made at once, because no
    timer would collect it."""
    status = status_of(surface)
    try:
        request = request_of(surface, graph)
    except PointsError as error:
        worker.forget(surface.session_uid)
        status.error, status.is_shown = str(error), not isinstance(error, HiddenPointsError)
        return
    status.is_shown = True
    request.has_preview = has_preview
    if not has_event_loop() or surface.meniscus.is_waiting:
        show(surface, compute(request))
        return
    worker.submit(request)


def show(surface: bpy.types.Object, result: Result) -> None:
    """Writes a result into the mesh of a surface, and its messages into the status."""
    status = status_of(surface)
    status.error = result.error
    status.note = "; ".join(part for part in (result.request.points.note, *result.warnings) if part)
    if result.error:
        return
    if surface.mode == "EDIT" and result.arrays is not None:
        status.error = "the surface is in edit mode: leave it, then choose Update"
        return
    if result.spacing is not None and surface.meniscus.spacing == 0:
        with quiet():
            surface.meniscus.spacing = result.spacing
    if result.arrays is not None:
        meshes.write(surface.data, result.arrays, result.signature)
        quality = "preview" if result.is_coarse else "full quality"
        status.made = f"{len(surface.data.polygons):,} triangles, {quality}, {result.seconds:.2f} s"


# The main thread

_main = threading.main_thread().ident
_writes: "queue.SimpleQueue[tuple[Callable[[], None], Future[None]]]" = queue.SimpleQueue()
_is_stale = False
_was_busy = False
_is_quiet = False


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Sets properties without a request for a new surface."""
    global _is_quiet
    _is_quiet = True
    try:
        yield
    finally:
        _is_quiet = False


def has_event_loop() -> bool:
    """Whether timers run: not in `blender --background`, nor with Blender as a module."""
    return not bpy.app.background


def is_rendering() -> bool:
    return bpy.app.is_job_running("RENDER")


@lasting
def tick() -> float:
    """Collects results, and writes the meshes of a render."""
    global _is_stale, _was_busy
    while not _writes.empty():
        write, done = _writes.get()
        if not done.set_running_or_notify_cancel():
            continue
        try:
            write()
        except Exception as error:
            done.set_exception(error)
        else:
            done.set_result(None)
    if is_rendering():
        return TICK_SECONDS
    if _is_stale:
        _is_stale = False
        update_all()
    is_busy = worker.is_busy
    for result in worker.results():
        surface = next((obj for obj in bpy.data.objects if obj.session_uid == result.request.key), None)
        if surface is None or surface.type != "MESH":
            continue
        try:
            show(surface, result)
        except Exception as error:
            # Blender removes a timer that raises an error.
            status_of(surface).error = str(error) or type(error).__name__
    if is_busy or _was_busy:
        redraw()
    _was_busy = is_busy
    return TICK_SECONDS


def update_all() -> None:
    """Requests the surfaces of all scenes that are shown."""
    for window in bpy.context.window_manager.windows:
        # After undo, and after a file was opened, the dependency graph is not evaluated before the next redraw.
        window.view_layer.update()
        for surface in surfaces_in(window.scene):
            if surface.meniscus.is_live:
                update(surface, window.view_layer.depsgraph)


def redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()
        # Redraws the status bar; during a modal operator it would remove the hints of the operator.
        if not window.modal_operators:
            window.workspace.status_text_set(None)


def on_main_thread(write: Callable[[], None]) -> None:
    """Runs a function that changes Blender's data, on the main thread.

    A render with a window runs handlers on its own thread, while the main thread draws: data that changed
    meanwhile could crash Blender, or the user would have to lock the interface.

    Raises
    ------
    TimeoutError
        If the main thread does not respond. The function will not run then.
    """
    if threading.get_ident() == _main:
        write()
        return
    done: Future[None] = Future()
    _writes.put((write, done))
    wait([done], WRITE_SECONDS)
    if done.cancel():
        raise TimeoutError(f"Blender's window did not respond for {WRITE_SECONDS:g} s")
    done.result()


# Handlers

# The frame and the part of a frame that a render makes; None outside renders.
_rendered: tuple[int, float] | None = None


@persistent
def on_depsgraph_update(scene: bpy.types.Scene, graph: bpy.types.Depsgraph) -> None:
    """Follows changes of the points: an edit, a node, a modifier."""
    if graph.mode == "RENDER" or _rendered is not None or is_rendering():
        return
    changed = {each.id.original for each in graph.updates if each.is_updated_geometry}
    # Blender reports no update of points that are shown again.
    if not changed and all(status.is_shown for status in statuses.values()):
        return
    for surface in surfaces_in(scene):
        source = surface.meniscus.source
        is_changed = source in changed or source.data in changed or not status_of(surface).is_shown
        if surface.meniscus.is_live and is_changed:
            update(surface, graph)


@persistent
def on_frame_change(scene: bpy.types.Scene, graph: bpy.types.Depsgraph) -> None:
    """Makes the surface of another frame: at once in a render, on the thread otherwise.

    For motion blur, a render also visits times around the frame. The mesh stays that of the frame: Cycles
    moves its vertices by their velocities.
    """
    if graph.mode == "RENDER":
        if _rendered == (scene.frame_current, scene.frame_subframe):
            render_surfaces(scene, graph)
    elif _rendered is None and not is_rendering():
        for surface in surfaces_in(scene):
            if surface.meniscus.is_live:
                update(surface, graph)


def render_surfaces(scene: bpy.types.Scene, graph: bpy.types.Depsgraph) -> None:
    """Makes the surfaces for a render, and waits for them. The render has several dependency graphs; those
    without objects are skipped."""
    for surface in surfaces_in(scene):
        settings = surface.meniscus
        if not settings.is_live or not surface.evaluated_get(graph).is_evaluated:
            continue
        status = status_of(surface)
        error = ""
        try:
            result = compute(request_of(surface, graph))
            if result.arrays is not None or result.error:
                on_main_thread(functools.partial(show, surface, result))
                error = status.error
        except Exception as failure:
            # The render goes on with the other surfaces and frames.
            error = status.error = str(failure) or type(failure).__name__
        if error:
            status.render_errors.append(f"frame {scene.frame_current}: {error}")
            print(f"meniscus: frame {scene.frame_current}: {surface.name}: {error}", flush=True)


@persistent
def on_render_init(*_: Any) -> None:
    for status in statuses.values():
        status.render_errors.clear()


@persistent
def on_render_pre(scene: bpy.types.Scene, *_: Any) -> None:
    global _rendered
    _rendered = (scene.frame_current, scene.frame_subframe)
    if has_event_loop():
        worker.clear()


@persistent
def on_render_end(*_: Any) -> None:
    global _rendered, _is_stale
    _rendered, _is_stale = None, True


@persistent
def on_load(*_: Any) -> None:
    """After a file was opened, or undo: the mesh or its options may be those of another time."""
    global _is_stale
    worker.clear()
    if has_event_loop():
        _is_stale = True


HANDLERS: dict[str, Callable[..., None]] = {
    "depsgraph_update_post": on_depsgraph_update,
    "frame_change_post": on_frame_change,
    "render_init": on_render_init,
    "render_pre": on_render_pre,
    "render_complete": on_render_end,
    "render_cancel": on_render_end,
    "load_post": on_load,
    "undo_post": on_load,
    "redo_post": on_load,
}


# Properties


def on_property(group: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Makes a new surface when a value in the panel changes."""
    surface = group.id_data
    settings = surface.meniscus
    if not _is_quiet and settings.is_live and settings.source is not None and not is_rendering():
        update(surface, context.evaluated_depsgraph_get())


def can_be_source(group: bpy.types.PropertyGroup, obj: bpy.types.Object) -> bool:
    return obj.type in SOURCES and obj != group.id_data


# Types of objects whose modifiers can make points.
SOURCES = {"MESH", "POINTCLOUD", "CURVE", "CURVES", "VOLUME"}


class MeniscusOptions(bpy.types.PropertyGroup):
    """The options of the method."""

    __annotations__ = options.all_properties(on_property)


class MeniscusSurface(bpy.types.PropertyGroup):
    """What a live surface is made of."""

    source: PointerProperty(
        type=bpy.types.Object,
        name="Points",
        description="The object with the points: a point cloud, Geometry Nodes, or the vertices of a mesh",
        poll=can_be_source,
        update=on_property,
    )
    is_live: BoolProperty(
        name="Live", default=True, description="Follow the points and the options", update=on_property
    )
    is_waiting: BoolProperty(
        name="Wait for each frame",
        description="Block the interface until each surface is made, for viewport renders of an animation",
    )
    spacing: FloatProperty(
        name="Particle spacing",
        min=0.0,
        precision=5,
        step=0.1,
        description="Distance between neighbouring points, in their unit. The same in all frames, so that the "
        "surface does not flicker; 0 measures it on the current frame",
        update=on_property,
    )
    use_radius: BoolProperty(
        name="Radius from points", description="Give each point its own radius", update=on_property
    )
    radius_attribute: StringProperty(name="Radius", default="radius", update=on_property)
    velocity_attribute: StringProperty(
        name="Velocity",
        default="velocity",
        description="Vector attribute of the points in units per second, for motion blur; empty for none",
        update=on_property,
    )
    use_attributes: BoolProperty(
        name="Other attributes",
        default=True,
        description="Transfer colours and the other attributes of the points to the surface",
        update=on_property,
    )
    options: PointerProperty(type=MeniscusOptions)


# Operators


class MENISCUS_OT_add_surface(bpy.types.Operator):
    """Add a mesh that follows the points of the active object"""

    bl_idname = "meniscus.add_surface"
    bl_label = "Add live surface"
    bl_options = {"REGISTER", "UNDO"}

    hide_source: BoolProperty(
        name="Hide points",
        default=True,
        description="Show the points as bounds in the viewport, and make them invisible in renders. "
        "A hidden object would have no points",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        obj = context.object
        return obj is not None and obj.type in SOURCES and obj.meniscus.source is None

    def execute(self, context: bpy.types.Context) -> set[str]:
        source = context.object
        graph = context.evaluated_depsgraph_get()
        try:
            read(source, graph, "", "", False)
        except PointsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        surface = bpy.data.objects.new(f"{source.name} surface", bpy.data.meshes.new(f"{source.name} surface"))
        # Points and surface have the same local space. A move of the source needs no new surface.
        surface.parent = source
        for collection in source.users_collection:
            collection.objects.link(surface)
        with quiet():
            surface.meniscus.use_radius = varies(source, graph, surface.meniscus.radius_attribute)
            surface.meniscus.source = source
        if self.hide_source:
            source.display_type = "BOUNDS"
            for ray in ("camera", "diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
                setattr(source, f"visible_{ray}", False)
        for obj in context.selected_objects:
            obj.select_set(False)
        context.view_layer.update()
        surface.select_set(True)
        context.view_layer.objects.active = surface
        update(surface, context.evaluated_depsgraph_get())
        return {"FINISHED"}


class MENISCUS_OT_update(bpy.types.Operator):
    """Make the surface again"""

    bl_idname = "meniscus.update"
    bl_label = "Update"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return surface_of(context.object, context.scene) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        surface = surface_of(context.object, context.scene)
        surface.data.pop(meshes.SIGNATURE, None)
        update(surface, context.evaluated_depsgraph_get(), has_preview=False)
        if status_of(surface).error and not has_event_loop():
            self.report({"ERROR"}, status_of(surface).error)
            return {"CANCELLED"}
        return {"FINISHED"}


class MENISCUS_OT_measure_spacing(bpy.types.Operator):
    """Measure the particle spacing on the current frame, and use it for all frames"""

    bl_idname = "meniscus.measure_spacing"
    bl_label = "Measure"
    bl_options = {"REGISTER", "UNDO"}

    poll = MENISCUS_OT_update.poll

    def execute(self, context: bpy.types.Context) -> set[str]:
        surface_of(context.object, context.scene).meniscus.spacing = 0.0
        return {"FINISHED"}


# Panels


class MENISCUS_PT_surface(Panel, bpy.types.Panel):
    bl_label = "Live surface"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        surface = surface_of(context.object, context.scene)
        if surface is None:
            layout.operator(MENISCUS_OT_add_surface.bl_idname, icon="OUTLINER_OB_POINTCLOUD")
            if not MENISCUS_OT_add_surface.poll(context):
                layout.label(text="Select an object with points", icon="INFO")
            return
        settings = surface.meniscus
        draw_status(layout, surface)
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(settings, "is_live")
        layout.prop(settings, "source")
        layout.prop(settings.options, "preset")
        row = layout.row(align=True)
        row.prop(settings, "spacing")
        row.operator(MENISCUS_OT_measure_spacing.bl_idname, text="", icon="DRIVER_DISTANCE")
        by_name = {info.name: info for info in options.SHOWN}
        options.draw(layout.column(align=True), settings.options, [by_name[name] for name in options.MAIN])
        layout.operator(MENISCUS_OT_update.bl_idname, icon="FILE_REFRESH")


def draw_status(layout: bpy.types.UILayout, surface: bpy.types.Object) -> None:
    status = status_of(surface)
    if found := worker.progress.get(surface.session_uid):
        layout.progress(factor=found[1], text=found[0])
    elif status.made:
        layout.label(text=status.made)
    for text, icon in ((status.error, "ERROR"), (render_error(status), "ERROR"), (status.note, "INFO")):
        draw_text(layout, text, icon)


def render_error(status: Status) -> str:
    """Why the last render does not show this surface in its frames."""
    errors = status.render_errors
    others = f" (and {len(errors) - 1} more frames)" if len(errors) > 1 else ""
    return f"render, {errors[0]}{others}" if errors else ""


class SurfacePanel(Panel):
    """A closed panel below that of the surface."""

    bl_parent_id = "MENISCUS_PT_surface"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return surface_of(context.object, context.scene) is not None


class MENISCUS_PT_attributes(SurfacePanel, bpy.types.Panel):
    bl_label = "Attributes"

    def draw(self, context: bpy.types.Context) -> None:
        settings = surface_of(context.object, context.scene).meniscus
        layout = self.layout
        row = layout.row(align=True)
        row.prop(settings, "use_radius")
        value = row.row()
        value.enabled = settings.use_radius
        value.prop(settings, "radius_attribute", text="")
        layout.prop(settings, "velocity_attribute")
        layout.prop(settings, "use_attributes")
        layout.prop(settings, "is_waiting")


class MENISCUS_PT_options(SurfacePanel, bpy.types.Panel):
    bl_label = "More options"

    def draw(self, context: bpy.types.Context) -> None:
        group = surface_of(context.object, context.scene).meniscus.options
        others = [info for info in options.SHOWN if info.name not in options.MAIN]
        for title in dict.fromkeys(info.group for info in others):
            self.layout.label(text=title)
            options.draw(self.layout.column(align=True), group, [info for info in others if info.group == title])


def draw_progress(self: Any, _context: bpy.types.Context) -> None:
    """Progress in the status bar."""
    for phase, part in list(worker.progress.values()):
        self.layout.progress(factor=part, text=f"Surface: {phase}")


CLASSES = (
    MeniscusOptions,
    MeniscusSurface,
    MENISCUS_OT_add_surface,
    MENISCUS_OT_update,
    MENISCUS_OT_measure_spacing,
    MENISCUS_PT_surface,
    MENISCUS_PT_attributes,
    MENISCUS_PT_options,
)


def register() -> None:
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Object.meniscus = PointerProperty(type=MeniscusSurface)
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    bpy.types.STATUSBAR_HT_header.append(draw_progress)
    bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)
    atexit.register(worker.clear)


def unregister() -> None:
    atexit.unregister(worker.clear)
    bpy.types.STATUSBAR_HT_header.remove(draw_progress)
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    worker.clear(wait=5.0)
    statuses.clear()
    del bpy.types.Object.meniscus
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
