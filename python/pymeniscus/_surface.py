"""Surfaces: their arrays, their level sets, their files, and conversions to the meshes of other libraries."""

from __future__ import annotations

import json
import operator
import os
import warnings
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._arrays import as_points, words_of
from ._options import as_values
from ._particles import Particles, particles_of


class Certificate(Mapping[str, Any]):
    """The checks that a surface passed or failed.

    It is a mapping with the entries of ``certificate`` in a report, which docs/report.md explains.

    Attributes
    ----------
    holds : bool
        Whether all checks passed: every particle is inside, the surface is within its bounds at every voxel,
        and the mesh is closed and 2-manifold.
    violations : str
        The checks that failed; empty if all passed.
    """

    def __init__(self, entries: dict[str, Any], violations: str) -> None:
        self._entries = entries
        self.violations = violations

    @property
    def holds(self) -> bool:
        """Whether all checks passed."""
        return bool(self._entries["holds"])

    def __getitem__(self, name: str) -> Any:
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __repr__(self) -> str:
        return "<Certificate: holds>" if self.holds else f"<Certificate: {self.violations}>"


class LevelSet:
    """The level set that was meshed: signed distances near the surface, in voxels, negative inside.

    Voxel (x, y, z) is centred at (x, y, z) times the voxel size in world space. Multiply distances by the
    voxel size for world units.
    """

    __slots__ = ("_native",)

    def __init__(self, native: _native.Surface) -> None:
        self._native = native

    @property
    def voxel_size(self) -> float:
        """Edge length of a voxel, world units."""
        return self._native.voxel_size

    @property
    def half_width(self) -> float:
        """The largest stored distance, in voxels. Points outside the stored leaves are farther from the
        surface."""
        return self._native.half_width

    @property
    def origins(self) -> NDArray[np.int32]:
        """The voxel with the least indices in each stored leaf of 8 × 8 × 8 voxels: (L, 3) int32, read-only,
        not copied."""
        return self._native.leaf_origins()

    @property
    def values(self) -> NDArray[np.float32]:
        """Signed distances in the leaves, in voxels: (L, 8, 8, 8) float32, indexed by leaf, x, y and z;
        read-only, not copied."""
        return self._native.leaf_values()

    def dense(
        self, box: tuple[ArrayLike, ArrayLike] | None = None
    ) -> tuple[NDArray[np.float32], tuple[int, int, int]]:
        """Signed distances at all voxels of a box, also where no leaf is stored.

        Parameters
        ----------
        box : pair of array_like, shape (3,), optional
            Least and greatest corner of the box in world units; by default, the box around all stored leaves.
            The result has the voxels whose centres are in the box or on its faces.

        Returns
        -------
        values : ndarray, shape (X, Y, Z), float32
            Signed distances in voxels, within ± `half_width`.
        least : tuple of int
            The index of the first voxel: ``values[i, j, k]`` is at ``(least + (i, j, k)) * voxel_size``.

        Raises
        ------
        ValueError
            If a corner is not finite, or the box is too large.
        MemoryError
            If the system has not enough memory for the values. The message has their size in bytes.
        """
        if box is None:
            origins = self.origins
            if len(origins) == 0:
                return np.empty((0, 0, 0), np.float32), (0, 0, 0)
            least, greatest = origins.min(axis=0).astype(np.int64), origins.max(axis=0).astype(np.int64) + 7
        else:
            try:
                corners = np.asarray(box, np.float64)
            except (TypeError, ValueError):
                corners = np.empty(0)
            if corners.shape != (2, 3) or not np.isfinite(corners).all():
                raise ValueError("a box is two corners of three finite numbers")
            # A corner at the centre of a voxel may miss it by a rounding error: tolerate that.
            indices = corners / self.voxel_size
            if np.abs(indices).max() >= 2**30:
                raise ValueError("the box is too large")
            least = np.ceil(indices[0] - 1e-9).astype(np.int64)
            greatest = np.floor(indices[1] + 1e-9).astype(np.int64)
        x, y, z = (int(edge) for edge in np.maximum(greatest - least + 1, 0))
        first = (int(least[0]), int(least[1]), int(least[2]))
        return self._native.dense(first, (x, y, z)), first

    def sample(self, points: Any) -> NDArray[np.float32]:
        """Signed distances at points, by trilinear interpolation, on all cores.

        Parameters
        ----------
        points : array_like, shape (N, 3)
            Positions in world units.

        Returns
        -------
        ndarray, shape (N,), float32
            Signed distances in voxels, within ± `half_width`; NaN for points that are not finite, or 2**30
            voxels or more from the world's origin along an axis.

        Raises
        ------
        TypeError
            If the points are not real numbers, or are in the memory of a device.
        ValueError
            If the shape is not (N, 3).
        """
        return self._native.sample(as_points(points).astype(np.float64, copy=False))

    def __len__(self) -> int:
        """The number of stored leaves."""
        return len(self.origins)

    def __repr__(self) -> str:
        return f"<LevelSet: {len(self)} leaves, voxel size {self.voxel_size}>"


class Surface:
    """The surface of a frame: a mesh, its level set, a report and a certificate.

    Arrays are views of the memory of the surface, which they keep alive. They are read-only: copy an array to
    change it. An array that you keep, such as `vertices`, therefore keeps the whole surface with its level set
    in memory: keep a copy to free the rest.
    """

    def __init__(self, native: _native.Surface, source: tuple[str, str] | None = None) -> None:
        self._native = native
        self._source = source

    @property
    def vertices(self) -> NDArray[np.float32]:
        """Vertex positions: (V, 3) float32, world units relative to `origin`, which is zero for nearly all
        frames."""
        return self._native.vertices()

    @property
    def origin(self) -> tuple[float, float, float]:
        """The world position that `vertices` are relative to.

        It is (0, 0, 0) unless the frame is more than 16384 voxels from the world's origin. There, 32-bit
        world positions would be too coarse.
        """
        x, y, z = self._native.origin()
        return x, y, z

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """Three vertex indices for each triangle, counter-clockwise seen from outside: (T, 3) uint32."""
        return self._native.triangles()

    @property
    def normals(self) -> NDArray[np.float32]:
        """Unit normals, outward, one for each vertex: (V, 3) float32."""
        return self._native.normals()

    @cached_property
    def _quads(self) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        return self._native.quads()

    @property
    def quads(self) -> NDArray[np.uint32]:
        """The quads of dual contouring, each of which is two of the `triangles`: (Q, 4) uint32. The other
        triangles are in `loose_triangles`."""
        return self._quads[0]

    @property
    def loose_triangles(self) -> NDArray[np.uint32]:
        """The triangles that are not part of a quad: (L, 3) uint32. Together with `quads` they form the
        mesh."""
        return self._quads[1]

    @cached_property
    def attributes(self) -> dict[str, NDArray[Any]]:
        """Attributes of the vertices by name: arrays (V,) or (V, K) of float32, int64 or text.

        Real numbers are means over the particles around the vertex; integers and text are those of the
        nearest particle. Values of colours are from 0 to 1.
        """
        attributes: dict[str, NDArray[Any]] = {}
        for index, (name, _, arity, table) in enumerate(self._native.attributes()):
            values = self._native.attribute(index)
            if table is not None:
                values = words_of(values, table)
            attributes[name] = values[:, 0] if arity == 1 else values
        return attributes

    @property
    def velocities(self) -> NDArray[np.float32] | None:
        """Velocities of the vertices: (V, 3) float32, world units per second; None if the surface has no
        velocities."""
        for index, (_, role, arity, _) in enumerate(self._native.attributes()):
            if role == "velocity" and arity == 3:
                return self._native.attribute(index)
        return None

    @cached_property
    def spray(self) -> Particles | None:
        """The particles that are not in the mesh, because their pieces of fluid are smaller than the option `spray`;
        None without this option.

        They have the attributes of the files that the command writes, such as ``radius`` and
        ``spray_class``: see docs/formats.md. Frames in memory are decided one by one.
        """
        found = self._native.spray()
        return None if found is None else particles_of(*found)

    @property
    def level_set(self) -> LevelSet:
        """The level set that was meshed."""
        return LevelSet(self._native)

    @cached_property
    def report(self) -> dict[str, Any]:
        """Measurements of the surface: the same entries as those of a frame in the command's report
        (``frames``), without files and times. See docs/report.md."""
        report: dict[str, Any] = json.loads(self._native.report_json())
        return report

    @property
    def certificate(self) -> Certificate:
        """The checks that the surface passed or failed."""
        return Certificate(self.report["certificate"], self._native.fault())

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The resolved options by name: numbers, True or False, or words. Lengths are in world units.

        ``reconstruct(points, **surface.settings)`` gives the same surface, with the same `radii`, `velocity`,
        `attributes`, `obstacles` and mask (`where`), which are not in the settings. Options without effect are
        left out.
        """
        return as_values(self._native.settings())

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the surface, a sentence each. `reconstruct` also issues them as `UserWarning`."""
        return tuple(self._native.warnings())

    def write(
        self,
        path: str | os.PathLike[str],
        *,
        format: str | None = None,
        source: str | os.PathLike[str] | Particles | None = None,
        up: str = "y",
        meters_per_unit: float = 1.0,
        vdb: str = "blosc",
        size: tuple[int, int] = (1280, 720),
        camera: str = "auto",
    ) -> None:
        """Write the surface to a file, on all cores. The file appears when it is complete, and replaces an
        existing file.

        The file has the same bytes as that of ``meniscus convert`` with the same options and the same
        `source`. If `origin` is not zero, pass ``stl`` also to the argument `formats` of `reconstruct`: such a
        file has rounded positions, which must be checked there. Pass ``vdb`` and ``exr`` to `formats` if they
        are to have attributes.

        Parameters
        ----------
        path : path-like
            The file. Its folder must exist.
        format : str, optional
            The extension of a format that meniscus writes, such as ``glb``, ``vdb`` or ``png``; by default
            that of `path`. The error about an unknown one lists all.
        source : path-like or Particles, optional
            The file that the particles came from; the output records its name and hash. By default, the file
            that `read` read the `Particles` from.
        up : {"y", "z"}
            The up axis of the particles, for glTF, USD and pictures.
        meters_per_unit : float
            Length of a world unit in metres, 1e-9 to 1e9, for USD.
        vdb : str
            How .vdb files store values: the compression ``none``, ``active`` or ``blosc``, and ``half`` for 16
            bits, separated by commas, such as ``half,blosc``.
        size : tuple of int
            Width and height of a picture in pixels, 16 to 8192.
        camera : str
            The camera of a picture, in the form of ``meniscus render --camera``.

        Raises
        ------
        ValueError
            For an unknown format, choice or size, and for a file with positions at which `reconstruct` did not
            check the surface: see `formats` there.
        TypeError
            If an argument has the wrong type.
        FormatError
            If the format cannot store the mesh.
        OSError
            If the file cannot be written.
        KeyboardInterrupt
            On Ctrl-C. Then an existing file is unchanged.

        Warns
        -----
        UserWarning
            About positions and attributes that the format cannot store exactly.
        """
        path = os.fsdecode(path)
        if format is not None and not isinstance(format, str):
            raise TypeError(f"format must be text, not {type(format).__name__}")
        extension = format or os.path.splitext(path)[1]
        extension = extension.lstrip(".").lower()
        if not extension:
            raise ValueError(f"{path} has no extension: give format=")
        options = _write_options(up, meters_per_unit, vdb, size, camera)
        for warning in self._native.write(path, extension, options, self._source_of(source)):
            warnings.warn(warning, stacklevel=2)

    def _source_of(self, source: str | os.PathLike[str] | Particles | None) -> tuple[str, str] | None:
        if source is None:
            return self._source
        if isinstance(source, Particles):
            if source.path is None or source._hash is None:
                raise ValueError("these particles were not read from a file")
            return source.path, source._hash
        return os.fspath(source), _native.file_hash(source)

    def render(
        self, *, size: tuple[int, int] = (1280, 720), camera: str = "auto", up: str = "y", format: str = "png"
    ) -> bytes:
        """A picture of the level set.

        Parameters
        ----------
        size : tuple of int
            Width and height in pixels, 16 to 8192.
        camera : str
            The camera, in the form of ``meniscus render --camera``, such as ``"azimuth=60,zoom=2"``.
        up : {"y", "z"}
            The up axis, unless the camera sets one.
        format : {"png", "exr"}
            The format; .exr also has depth, normals, positions and curvature.

        Returns
        -------
        bytes
            The contents of the file.

        Raises
        ------
        ValueError
            For an unknown format, camera, up axis or size.
        TypeError
            If an argument has the wrong type.
        """
        if format not in ("png", "exr"):
            raise ValueError(f"format is `{format}`; it must be png or exr")
        return bytes(self._native.picture(format, _write_options(up, 1.0, "blosc", size, camera)))

    def to_trimesh(self) -> Any:
        """A ``trimesh.Trimesh`` in world coordinates and units, with normals, and with the attributes of the
        vertices. Needs the package trimesh.

        Returns
        -------
        trimesh.Trimesh
            A mesh with copies: float64 positions and int64 faces. It is made with ``process=False``, which
            keeps all vertices and their order. ``vertex_attributes`` has the types of `attributes`.

        Raises
        ------
        ImportError
            If trimesh is not installed.
        """
        import trimesh

        mesh = trimesh.Trimesh(
            self._world_vertices(), self.triangles.astype(np.int64), vertex_normals=self.normals, process=False
        )
        mesh.vertex_attributes.update(self.attributes)
        return mesh

    def to_pyvista(self) -> Any:
        """A ``pyvista.PolyData`` in world coordinates and units, with normals and attributes as point data.
        Needs the package pyvista.

        Returns
        -------
        pyvista.PolyData
            A mesh with float32 positions, float64 ones if `origin` is not zero, and float32 ``Normals``. Other
            point data has the types of `attributes`.

        Raises
        ------
        ImportError
            If pyvista is not installed.
        """
        import pyvista

        faces = np.empty((len(self.triangles), 4), np.int64)
        faces[:, 0], faces[:, 1:] = 3, self.triangles
        mesh = pyvista.PolyData(self._world_vertices(), faces.reshape(-1))
        mesh.point_data["Normals"] = self.normals
        for name, values in self.attributes.items():
            mesh.point_data[name] = values
        return mesh

    def to_open3d(self) -> Any:
        """An ``open3d.geometry.TriangleMesh`` in world coordinates and units, with normals. Such a mesh has no
        other attributes. Needs the package open3d.

        Returns
        -------
        open3d.geometry.TriangleMesh
            A mesh with copies: float64 positions and normals, and int32 triangles.

        Raises
        ------
        ImportError
            If open3d is not installed.
        """
        import open3d

        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(self._world_vertices().astype(np.float64)),
            open3d.utility.Vector3iVector(self.triangles.astype(np.int32)),
        )
        mesh.vertex_normals = open3d.utility.Vector3dVector(self.normals.astype(np.float64))
        return mesh

    def to_blender(self, name: str = "surface") -> Any:
        """A Blender mesh data-block of this name. The contents of an existing data-block are replaced. Needs
        Blender's ``bpy``.

        Coordinates are unchanged, and Blender's up axis is Z: rotate the object by 90° about X if the
        simulation's up axis is Y. Positions are float32 in world units.

        Velocities become the attribute ``velocity``, which Cycles reads for motion blur. Other real numbers
        become point attributes of 1 to 4 components, and integers become 32-bit integers. An attribute whose
        name Blender reserves, such as ``id``, gets the name with ``_`` before it.

        Parameters
        ----------
        name : str
            The name of the data-block.

        Returns
        -------
        bpy.types.Mesh

        Raises
        ------
        ImportError
            Outside Blender.

        Warns
        -----
        UserWarning
            About each attribute that is left out: text, integers of several components or beyond 32 bits, real
            numbers of more than 4 components, and names that Blender refuses.
        """
        import bpy

        mesh = bpy.data.meshes.get(name) or bpy.data.meshes.new(name)
        mesh.clear_geometry()
        count, triangles = len(self.vertices), self.triangles
        mesh.vertices.add(count)
        mesh.vertices.foreach_set("co", self._world_vertices().astype(np.float32).reshape(-1))
        mesh.loops.add(triangles.size)
        mesh.loops.foreach_set("vertex_index", triangles.reshape(-1).astype(np.int32))
        mesh.polygons.add(len(triangles))
        mesh.polygons.foreach_set("loop_start", np.arange(0, triangles.size, 3, dtype=np.int32))
        mesh.polygons.foreach_set("use_smooth", np.ones(len(triangles), bool))
        mesh.update(calc_edges=True)
        if hasattr(mesh, "normals_split_custom_set_from_vertices") and count:
            mesh.normals_split_custom_set_from_vertices(self.normals)
        velocity_name = next((entry[0] for entry in self._native.attributes() if entry[1] == "velocity"), None)
        for attribute, values in self.attributes.items():
            reason = _add_to_blender(mesh, "velocity" if attribute == velocity_name else attribute, values)
            if reason is not None:
                warnings.warn(f"left out the attribute `{attribute}`: {reason}", stacklevel=2)
        return mesh

    def _world_vertices(self) -> NDArray[Any]:
        """Positions in world space: float32 and not copied if the origin is zero, otherwise float64."""
        if self.origin == (0.0, 0.0, 0.0):
            return self.vertices
        world: NDArray[np.float64] = self.vertices.astype(np.float64) + np.asarray(self.origin)
        return world

    def __repr__(self) -> str:
        state = "" if self.certificate.holds else f", not valid: {self.certificate.violations}"
        return f"<Surface: {len(self.vertices)} vertices, {len(self.triangles)} triangles{state}>"

    @cached_property
    def _picture(self) -> bytes | None:
        # Cached, because a notebook asks for both representations of one output.
        return self.render(size=(640, 360)) if len(self.triangles) else None

    def _repr_png_(self) -> bytes | None:
        """The picture that a notebook shows."""
        return self._picture

    def _repr_html_(self) -> str:
        """The table that a notebook shows, with the picture."""
        import base64
        import html

        rows = {
            "vertices": f"{len(self.vertices):,}",
            "triangles": f"{len(self.triangles):,}",
            "voxel size": f"{self.level_set.voxel_size:g}",
            "certificate": "holds" if self.certificate.holds else self.certificate.violations,
        }
        picture = self._picture
        image = "" if picture is None else (
            f'<img alt="surface" src="data:image/png;base64,{base64.b64encode(picture).decode()}"/>'
        )
        cells = "".join(f"<tr><th>{name}</th><td>{html.escape(value)}</td></tr>" for name, value in rows.items())
        return f"<div>{image}<table>{cells}</table></div>"


#: Blender's type of an attribute and the name of its values, by the number of components.
_BLENDER_REALS = {1: ("FLOAT", "value"), 2: ("FLOAT2", "vector"), 3: ("FLOAT_VECTOR", "vector"), 4: ("FLOAT_COLOR", "color")}


def _add_to_blender(mesh: Any, name: str, values: NDArray[Any]) -> str | None:
    """Add an attribute to a Blender mesh. Returns why that is impossible, or None."""
    arity = 1 if values.ndim == 1 else values.shape[1]
    if values.dtype.kind == "f":
        if arity not in _BLENDER_REALS:
            return f"Blender has no attributes of {arity} components"
        kind, member = _BLENDER_REALS[arity]
        values = values.astype(np.float32)
    elif values.dtype.kind == "i" and arity == 1:
        limits = np.iinfo(np.int32)
        if len(values) and (values.min() < limits.min or values.max() > limits.max):
            return "Blender's integers have 32 bits"
        kind, member = "INT", "value"
        values = values.astype(np.int32)
    else:
        return "Blender can store it neither as real numbers nor as single integers"
    for candidate in (name, f"_{name}"):
        # Blender refuses names that it reserves, and renames an attribute whose name is taken.
        target = None if candidate in mesh.attributes else mesh.attributes.new(candidate, kind, "POINT")
        if target is not None:
            target.data.foreach_set(member, values.reshape(-1))
            return None
    return "Blender refuses its name"


def _write_options(
    up: str,
    meters_per_unit: float,
    vdb: str,
    size: tuple[int, int],
    camera: str,
) -> _native._WriteOptions:
    for name, value in (("up", up), ("vdb", vdb), ("camera", camera)):
        if not isinstance(value, str):
            raise TypeError(f"{name} must be text, not {type(value).__name__}")
    try:
        width, height = (operator.index(edge) for edge in size)
    except (TypeError, ValueError):
        raise TypeError(f"size must be two integers, such as (1920, 1080), not {size!r}") from None
    if not (16 <= width <= 8192 and 16 <= height <= 8192):
        raise ValueError(f"size is {width} × {height}; both must be from 16 to 8192")
    return {
        "up": up.lower(),
        "meters_per_unit": float(meters_per_unit),
        "vdb": vdb,
        "size": (width, height),
        "camera": camera,
    }
