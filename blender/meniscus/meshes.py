"""Surfaces as Blender meshes: arrays made on a thread, and written in some milliseconds on the main thread."""

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray
from pymeniscus import Surface

# The mesh's custom property with the hash of the points and options that it was made from.
SIGNATURE = "meniscus"
KINDS = {
    (1, "f"): ("FLOAT", "value", np.float32),
    (2, "f"): ("FLOAT2", "vector", np.float32),
    (3, "f"): ("FLOAT_VECTOR", "vector", np.float32),
    (4, "f"): ("FLOAT_COLOR", "color", np.float32),
    (1, "i"): ("INT", "value", np.int32),
}


@dataclass(frozen=True)
class MeshArrays:
    """All that a Blender mesh stores, in Blender's types."""

    positions: NDArray[np.float32]
    corner_verts: NDArray[np.int32]
    corner_edges: NDArray[np.int32]
    edges: NDArray[np.int32]
    starts: NDArray[np.int32]
    normals: NDArray[np.float32]
    attributes: dict[str, tuple[str, str, NDArray[Any]]]


def arrays_of(surface: Surface) -> MeshArrays:
    """The arrays of a surface. The edges are found here, because Blender would need the main thread for it."""
    triangles = surface.triangles.astype(np.int64)
    positions = surface.vertices
    if surface.origin != (0.0, 0.0, 0.0):
        positions = (positions + np.asarray(surface.origin)).astype(np.float32)
    ends = np.roll(triangles, -1, axis=1).reshape(-1)
    starts = triangles.reshape(-1)
    least, greatest = np.minimum(starts, ends), np.maximum(starts, ends)
    keys, corner_edges = np.unique(least << 32 | greatest, return_inverse=True)
    edges = np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1).astype(np.int32)
    attributes: dict[str, tuple[str, str, NDArray[Any]]] = {}
    velocities = surface.velocities
    for name, values in surface.attributes.items():
        kind = KINDS.get((1 if values.ndim == 1 else values.shape[1], values.dtype.kind))
        if kind is not None:
            attributes[name] = (*kind[:2], values.astype(kind[2]).reshape(-1))
    if velocities is not None:
        # Cycles looks for this name, and expects units per second.
        attributes["velocity"] = ("FLOAT_VECTOR", "vector", velocities.reshape(-1))
    return MeshArrays(
        positions.reshape(-1),
        starts.astype(np.int32),
        corner_edges.reshape(-1).astype(np.int32),
        edges.reshape(-1),
        np.arange(0, triangles.size, 3, dtype=np.int32),
        surface.normals.reshape(-1),
        attributes,
    )


def write(mesh: bpy.types.Mesh, arrays: MeshArrays, signature: str) -> None:
    """Replaces the geometry of a mesh; its materials and name stay.

    It writes the arrays of the mesh as attributes, which copies memory. Blender's properties of edges and
    corners call a function for each element.
    """
    mesh.clear_geometry()
    mesh.vertices.add(arrays.positions.size // 3)
    mesh.edges.add(arrays.edges.size // 2)
    mesh.loops.add(arrays.corner_verts.size)
    mesh.polygons.add(arrays.starts.size)
    if arrays.starts.size:
        mesh.polygons.foreach_set("loop_start", arrays.starts)
        for name, key, values in (
            ("position", "vector", arrays.positions),
            (".edge_verts", "value", arrays.edges),
            (".corner_vert", "value", arrays.corner_verts),
            (".corner_edge", "value", arrays.corner_edges),
        ):
            mesh.attributes[name].data.foreach_set(key, values)
        add_normals(mesh, arrays)
        for name, (kind, key, values) in arrays.attributes.items():
            mesh.attributes.new(name, kind, "POINT").data.foreach_set(key, values)
        colors = [name for name, (kind, _, _) in arrays.attributes.items() if kind == "FLOAT_COLOR"]
        if colors:
            mesh.attributes.active_color_name = mesh.attributes.default_color_name = colors[0]
    mesh[SIGNATURE] = signature
    mesh.update()


def add_normals(mesh: bpy.types.Mesh, arrays: MeshArrays) -> None:
    """Adds the normals of the level set. Before 4.5, Blender stores normals in a form that takes long to
    compute: there, it shades the mesh smooth by its own normals."""
    if bpy.app.version >= (4, 5):
        mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", arrays.normals)
