"""The points of an object, as arrays: what its modifiers and Geometry Nodes made of it."""

import hashlib
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

# Blender's types of attributes: number of values, name of the values, and type of the array.
KINDS: dict[str, tuple[int, str, Any]] = {
    "FLOAT": (1, "value", np.float32),
    "INT": (1, "value", np.int32),
    "INT8": (1, "value", np.int32),
    "BOOLEAN": (1, "value", bool),
    "FLOAT2": (2, "vector", np.float32),
    "FLOAT_VECTOR": (3, "vector", np.float32),
    "FLOAT_COLOR": (4, "color", np.float32),
    "BYTE_COLOR": (4, "color", np.float32),
}
NO_INDEX = 2**31 - 1
# Attributes that Blender itself makes.
RESERVED = {"position", "radius", "id", "rest_position", "material_index", "sharp_face", "sharp_edge"}


class PointsError(Exception):
    """An object has no points that can be read; the message says why, and what to do."""


class HiddenPointsError(PointsError):
    """The points are hidden, so Blender does not compute them."""


@dataclass
class Points:
    """Copies of the arrays of a frame, which a thread may read while Blender goes on."""

    positions: NDArray[np.float32]
    radii: NDArray[np.float32] | None = None
    velocity: NDArray[np.float32] | None = None
    attributes: dict[str, NDArray[Any]] = field(default_factory=dict)
    note: str = ""

    def hash(self) -> str:
        """A hash of all arrays that a surface depends on. It takes a second for a gigabyte: compute it on a thread."""
        state = hashlib.blake2b(digest_size=16)
        named = {"P": self.positions, "R": self.radii, "V": self.velocity, **self.attributes}
        for name, values in named.items():
            state.update(f"{name} {None if values is None else (values.shape, values.dtype.str)}".encode())
            if values is not None:
                state.update(values.data)
        return state.hexdigest()


def array_of(attribute: bpy.types.Attribute) -> NDArray[Any]:
    width, key, kind = KINDS[attribute.data_type]
    values = np.empty(len(attribute.data) * width, kind)
    attribute.data.foreach_get(key, values)
    if kind is bool:
        values = values.astype(np.int32)
    return values if width == 1 else values.reshape(-1, width)


def read(
    source: bpy.types.Object,
    graph: bpy.types.Depsgraph,
    radius: str = "",
    velocity: str = "velocity",
    has_attributes: bool = True,
) -> Points:
    """Reads the points of an evaluated object: those of its point cloud, else the vertices of its mesh.

    `radius` and `velocity` are names of attributes; an empty name reads none. The main thread calls this; it
    only copies arrays.

    Raises
    ------
    PointsError
        If there are no points.
    """
    evaluated = source.evaluated_get(graph)
    is_render = graph.mode == "RENDER"
    state = "in renders" if is_render else "in the viewport"
    hidden = HiddenPointsError(f"“{source.name}” is hidden {state}: show it (it can be invisible to the camera)")
    # The points are the parent of their surface. Of a hidden parent Blender evaluates only the transform: its geometry
    # is missing, or in the viewport it is that of the time when it was hidden.
    is_shown = not source.hide_render if is_render else source.visible_get(view_layer=graph.view_layer)
    if not evaluated.is_evaluated or not is_shown:
        raise hidden
    try:
        holder, data, instances = component_of(evaluated, graph)
    except TypeError:
        # One of its collections is hidden.
        raise hidden from None
    if data is None:
        if instances:
            raise PointsError(
                f"“{source.name}” has {instances} instances and no points: add the node Realize Instances "
                "or Instances to Points"
            )
        raise PointsError(f"“{source.name}” has no points: neither a point cloud nor mesh vertices")
    attributes = data.attributes
    points = Points(array_of(attributes["position"]).reshape(-1, 3))
    notes = [f"{instances} instances are left out (realize them)"] if instances else []
    if radius:
        points.radii = named(attributes, radius, "FLOAT")
        if points.radii is None:
            raise PointsError(f"“{source.name}” has no attribute “{radius}” of decimal numbers for the radius")
    if velocity:
        points.velocity = named(attributes, velocity, "FLOAT_VECTOR")
        if points.velocity is None:
            notes.append(f"no vector attribute “{velocity}”: no motion blur")
    if has_attributes:
        left_out = []
        for attribute in attributes:
            name = attribute.name
            is_other = name.startswith(".") or name in RESERVED or name in (radius, velocity)
            if is_other:
                continue
            if attribute.domain == "POINT" and attribute.data_type in KINDS:
                points.attributes[name] = array_of(attribute)
            else:
                left_out.append(f"“{name}”")
        if left_out:
            notes.append(f"left out: {', '.join(left_out)}: store them on points, as numbers, vectors or colours")
    points.note = "; ".join(notes)
    del holder
    return points


def named(attributes: Any, name: str, kind: str) -> NDArray[np.float32] | None:
    attribute = attributes.get(name)
    if attribute is None or attribute.domain != "POINT" or attribute.data_type != kind:
        return None
    return array_of(attribute)


def component_of(evaluated: bpy.types.Object, graph: bpy.types.Depsgraph) -> tuple[Any, Any, int]:
    """The owner of the data, the point cloud or mesh with points (None if neither has any), and the number of
    instances."""
    if hasattr(evaluated, "evaluated_geometry"):
        geometry = evaluated.evaluated_geometry()
        found = geometry.instances_pointcloud()
        data = next((data for data in (geometry.pointcloud, geometry.mesh) if has_points(data)), None)
        return geometry, data, 0 if found is None else len(found.points)
    # Blender 4.2 to 4.4: an iteration over the scene gives each component as an object, which counts as an
    # instance, but has only one index.
    found, instances = {}, 0
    for each in graph.object_instances:
        owner = each.parent if each.is_instance else each.object
        if owner is None or owner.original != evaluated.original:
            continue
        if each.is_instance and (each.object.original != owner.original or each.persistent_id[1] != NO_INDEX):
            instances += 1
        elif has_points(each.object.data):
            found[each.object.type] = each.object.data
    return evaluated, found.get("POINTCLOUD") or found.get("MESH"), instances


def has_points(data: Any) -> bool:
    return isinstance(data, (bpy.types.PointCloud, bpy.types.Mesh)) and bool(data.attributes["position"].data)


def varies(source: bpy.types.Object, graph: bpy.types.Depsgraph, radius: str) -> bool:
    """Whether the points have radii of their own: Blender gives all point clouds an attribute `radius`, mostly
    with one value that has nothing to do with the spacing."""
    try:
        values = read(source, graph, radius, "", False).radii
    except PointsError:
        return False
    return values is not None and values.size > 0 and bool(np.ptp(values) > 1e-4 * abs(values).max())
