"""The functions of pysplashsurf 0.14 that make surfaces, with the method of this package.

>>> import pymeniscus.compat.splashsurf as pysplashsurf

`reconstruct_surface`, `reconstruction_pipeline` and `check_mesh_consistency` take the arguments of their
namesakes, and return objects with the same attributes. An argument that has no effect here causes one warning
in each process. docs/python.md has a table of the arguments.

Positions, radii and boxes are in the unit of the particles. `smoothing_length` and `cube_size` are in particle
radii in both functions, as pysplashsurf 0.14 uses them.
"""

from __future__ import annotations

import enum
import os
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._arrays import as_points
from .._reconstruct import reconstruct
from .._surface import LevelSet, Surface

__all__ = [
    "Aabb3d",
    "MeshType",
    "MeshWithData",
    "MixedTriQuadMesh3d",
    "SurfaceReconstruction",
    "TriMesh3d",
    "UniformGrid",
    "check_mesh_consistency",
    "reconstruct_surface",
    "reconstruction_pipeline",
]

Reals: TypeAlias = "Sequence[float] | NDArray[Any]"
Path: TypeAlias = "str | os.PathLike[str]"

#: How far the face of a block of particles moves outward if the threshold is 1 lower, in particle spacings:
#: measured with pysplashsurf 0.14.1 and a smoothing length of 2, within 0.02 for thresholds from 0.3 to 0.8.
_OFFSET_PER_THRESHOLD = 1.1
_DEFAULT_THRESHOLD = 0.6
#: The least voxel size, in particle radii: the method blends over 1.7 spacings, which may be at most 64 voxels.
_LEAST_CUBE_SIZE = 0.0532

_BLOCKS = "space is always divided into blocks, whose size is fixed"
_QUADS = "the quads are those of dual contouring, and not pairs of triangles that are chosen by their shape"

#: Arguments without effect: the values that nothing is lost with, and why others have none.
_IGNORED: dict[str, tuple[tuple[Any, ...], str]] = {
    "smoothing_length": (
        (2,),
        "the method has no kernel; `neighbor_radius` of pymeniscus.reconstruct is how far particles see each other",
    ),
    "simd": ((True,), "vector instructions are always used, and results do not depend on them"),
    "global_neighborhood_list": ((False,), "the method makes no such list, so `particle_neighbors` is None"),
    "subdomain_grid": ((True,), _BLOCKS),
    "subdomain_grid_auto_disable": ((True,), _BLOCKS),
    "subdomain_num_cubes_per_dim": ((64,), _BLOCKS),
    "check_mesh_debug": ((False,), "the checks print nothing"),
    "mesh_cleanup_snap_dist": (
        (None,),
        "no vertices are snapped; `decimate` of pymeniscus.reconstruct removes triangles within a tolerance",
    ),
    "mesh_smoothing_iters": (
        (None, 0),
        "the level set is smoothed as far as its bounds allow, and not the mesh; for a smoother surface, give "
        "`preset`, `blend` or `laplacian_steps` to pymeniscus.reconstruct",
    ),
    "mesh_smoothing_weights": ((True,), "bounds keep small features, and not weights"),
    "mesh_smoothing_weights_normalization": ((13,), "bounds keep small features, and not weights"),
    "output_mesh_smoothing_weights": ((False,), "there are no weights"),
    "quad_max_edge_diag_ratio": ((1.75,), _QUADS),
    "quad_max_normal_angle": ((10,), _QUADS),
    "quad_max_interior_angle": ((135,), _QUADS),
}
_warned: set[str] = set()

#: What to use instead of other names of pysplashsurf.
_INSTEAD = {
    "MeshAttribute": "attributes are arrays, in `point_attributes` and `cell_attributes` of MeshWithData",
    "NeighborhoodLists": "pymeniscus makes no lists of neighbours",
    "SphInterpolator": "give `attributes_to_interpolate` to reconstruction_pipeline",
    "VertexVertexConnectivity": "the edges are those of `triangles`",
    "barnacle_decimation": "the mesh has no such triangles",
    "bgeo": "pymeniscus.read reads BGEO files",
    "convert_tris_to_quads": "give `generate_quads=True` to reconstruction_pipeline",
    "laplacian_smoothing_normals_parallel": "give `normals_smoothing_iters` to reconstruction_pipeline",
    "laplacian_smoothing_parallel": "the surface is smooth without it",
    "marching_cubes": "pymeniscus makes surfaces of particles only",
    "marching_cubes_cleanup": "the mesh needs no cleanup; pymeniscus.reconstruct has `decimate`",
    "neighborhood_search_spatial_hashing_parallel": "pymeniscus makes no lists of neighbours",
    "run_pysplashsurf": "pymeniscus.convert runs the command of this package",
    "run_splashsurf": "pymeniscus.convert runs the command of this package",
}


def __getattr__(name: str) -> Any:
    instead = f": {_INSTEAD[name]}" if name in _INSTEAD else ""
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{instead}")


class MeshType(enum.Enum):
    """The kind of a mesh: of triangles, or of triangles and quads."""

    Tri3d = 0
    MixedTriQuad3d = 1


@dataclass(frozen=True, eq=False)
class Aabb3d:
    """A box along the axes: the corners `min` and `max`, (3,) float64, in world units.

    Give it as ``aabb_min=box.min, aabb_max=box.max``, or as ``mesh_aabb_min`` and ``mesh_aabb_max``.
    """

    min: NDArray[np.float64]
    max: NDArray[np.float64]

    @staticmethod
    def from_min_max(min: Reals, max: Reals) -> Aabb3d:
        """The box with copies of these corners, three numbers each in world units. Raises `ValueError` for another
        shape. If `min` is not less than `max` along every axis, the box contains no point."""
        return Aabb3d(_corner("min", min), _corner("max", max))

    @staticmethod
    def from_points(points: Any) -> Aabb3d:
        """The smallest box around points, (N, 3) real numbers in world units.

        NaN is ignored, and without points both corners are zero. The greatest points are on the upper faces, so
        `contains_point`, `aabb_min` and `aabb_max` leave them out. Raises `ValueError` for another shape, and
        `TypeError` if the points are not real numbers.
        """
        array = as_points(points).astype(np.float64)
        if len(array) == 0:
            return Aabb3d(np.zeros(3), np.zeros(3))
        return Aabb3d(np.fmin.reduce(array), np.fmax.reduce(array))

    def contains_point(self, point: Reals) -> bool:
        """Whether a point, three numbers, is in the box. Points on the upper faces are not. Raises `ValueError` for
        another shape."""
        position = _corner("point", point)
        return bool(((self.min <= position) & (position < self.max)).all())


@dataclass(frozen=True, eq=False)
class UniformGrid:
    """The part of the voxel grid around the surface.

    Attributes
    ----------
    aabb : Aabb3d
        The box between the first and the last centres of voxels.
    cell_size : float
        The edge length of a voxel, world units.
    ncells_per_dim, npoints_per_dim : list of int
        The number of cells between centres of voxels, and the number of these centres, along each axis.
    """

    aabb: Aabb3d
    cell_size: float
    ncells_per_dim: list[int]
    npoints_per_dim: list[int]


class _Mesh:
    """What the meshes have in common."""

    vertices: NDArray[Any]

    def _cells(self) -> list[tuple[str, NDArray[np.uint64]]]:
        raise NotImplementedError

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the positions: float32 or float64, that of the particles."""
        return self.vertices.dtype

    def write_to_file(self, path: Path, *, file_format: str | None = "vtk42") -> None:
        """Write the mesh with the package meshio. See `MeshWithData.write_to_file`."""
        _write(self, path, file_format)


@dataclass(eq=False)
class TriMesh3d(_Mesh):
    """A mesh of triangles.

    Attributes
    ----------
    vertices : ndarray, shape (V, 3), float32 or float64
        Positions in world units.
    triangles : ndarray, shape (T, 3), uint64
        Three vertex indices for each triangle, counter-clockwise seen from outside.
    """

    vertices: NDArray[Any]
    triangles: NDArray[np.uint64]

    def _cells(self) -> list[tuple[str, NDArray[np.uint64]]]:
        return [("triangle", self.triangles)]

    def copy(self) -> TriMesh3d:
        """A copy with its own arrays."""
        return deepcopy(self)

    def vertex_normals_parallel(self) -> NDArray[Any]:
        """Unit normals, (V, 3): means of the normals of the triangles around each vertex, weighted by their areas."""
        corners = self.vertices[self.triangles].astype(np.float64)
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sums = np.zeros((len(self.vertices), 3))
        for axis in range(3):
            weights = np.repeat(doubled[:, axis], 3)
            sums[:, axis] = np.bincount(self.triangles.reshape(-1).astype(np.int64), weights, len(sums))
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        normals: NDArray[Any] = np.divide(sums, lengths, out=sums, where=lengths > 0).astype(self.dtype)
        return normals

    def take_vertices_and_triangles(self) -> tuple[NDArray[Any], NDArray[np.uint64]]:
        """The vertices and the triangles, as in older versions of pysplashsurf. The mesh keeps them."""
        return self.vertices, self.triangles


@dataclass(eq=False)
class MixedTriQuadMesh3d(_Mesh):
    """A mesh of triangles and quads: `vertices` are as in `TriMesh3d`."""

    vertices: NDArray[Any]
    _triangles: NDArray[np.uint64]
    _quads: NDArray[np.uint64]

    def _cells(self) -> list[tuple[str, NDArray[np.uint64]]]:
        return [("triangle", self._triangles), ("quad", self._quads)]

    def copy(self) -> MixedTriQuadMesh3d:
        """A copy with its own arrays."""
        return deepcopy(self)

    def get_triangles(self) -> NDArray[np.uint64]:
        """A copy of the triangles that are not part of a quad, (T, 3) uint64."""
        return self._triangles.copy()

    def get_quads(self) -> NDArray[np.uint64]:
        """A copy of the quads, (Q, 4) uint64."""
        return self._quads.copy()


@dataclass(eq=False)
class MeshWithData:
    """A mesh, with attributes of its vertices and cells.

    Attributes
    ----------
    mesh : TriMesh3d or MixedTriQuadMesh3d
        The mesh.
    point_attributes, cell_attributes : dict of str to ndarray
        Arrays by name, with a row for each vertex or cell. Triangles come before quads.
    """

    mesh: TriMesh3d | MixedTriQuadMesh3d
    point_attributes: dict[str, NDArray[Any]] = field(default_factory=dict)
    cell_attributes: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the positions: float32 or float64."""
        return self.mesh.dtype

    @property
    def nvertices(self) -> int:
        """The number of vertices."""
        return len(self.mesh.vertices)

    @property
    def ncells(self) -> int:
        """The number of triangles and quads."""
        return sum(len(cells) for _, cells in self.mesh._cells())

    @property
    def mesh_type(self) -> MeshType:
        """The kind of the mesh."""
        return MeshType.Tri3d if isinstance(self.mesh, TriMesh3d) else MeshType.MixedTriQuad3d

    def copy(self) -> MeshWithData:
        """A copy with its own arrays."""
        return deepcopy(self)

    def copy_mesh(self) -> TriMesh3d | MixedTriQuadMesh3d:
        """A copy of the mesh without attributes."""
        return self.mesh.copy()

    def take_mesh(self) -> TriMesh3d | MixedTriQuadMesh3d:
        """The mesh, as in older versions of pysplashsurf. The object keeps it."""
        return self.mesh

    def get_point_attribute(self, name: str) -> NDArray[Any]:
        """An attribute of the vertices, as in older versions of pysplashsurf. Raises `KeyError` if there is none."""
        return self.point_attributes[name]

    def add_point_attribute(self, name: str, attribute: ArrayLike) -> None:
        """Add a copy of an array with a row for each vertex. Raises `ValueError` for another number of rows."""
        self.point_attributes[name] = _rows(name, attribute, self.nvertices)

    def add_cell_attribute(self, name: str, attribute: ArrayLike) -> None:
        """Add a copy of an array with a row for each cell. Raises `ValueError` for another number of rows."""
        self.cell_attributes[name] = _rows(name, attribute, self.ncells)

    def write_to_file(self, path: Path, *, file_format: str | None = "vtk42") -> None:
        """Write the mesh and its attributes with the package meshio.

        Parameters
        ----------
        path : path-like
            The file.
        file_format : str or None
            A format of meshio: VTK 4.2 by default, whatever the extension of `path`. None chooses the format by
            the extension.

        Raises
        ------
        ImportError
            If meshio is not installed.
        """
        _write(self.mesh, path, file_format, self.point_attributes, self.cell_attributes)


@dataclass(frozen=True, eq=False)
class SurfaceReconstruction:
    """A surface of particles.

    Attributes
    ----------
    mesh : TriMesh3d
        The whole surface in triangles, also if the pipeline returns quads or a part of it.
    grid : UniformGrid
        The grid of the level set.
    particle_inside_aabb : ndarray, shape (N,), bool, or None
        The particles that form the surface; None without `aabb_min` and `aabb_max`.
    particle_densities, particle_neighbors : None
        The method computes neither.
    """

    mesh: TriMesh3d
    grid: UniformGrid
    particle_inside_aabb: NDArray[np.bool_] | None
    particle_densities: None = None
    particle_neighbors: None = None

    @property
    def vertices(self) -> NDArray[Any]:
        """The vertices of `mesh`."""
        return self.mesh.vertices

    @property
    def triangles(self) -> NDArray[np.uint64]:
        """The triangles of `mesh`."""
        return self.mesh.triangles


def reconstruct_surface(
    particles: Any,
    *,
    particle_radius: float,
    rest_density: float = 1000.0,
    smoothing_length: float,
    cube_size: float,
    iso_surface_threshold: float = 0.6,
    aabb_min: Reals | None = None,
    aabb_max: Reals | None = None,
    multi_threading: bool = True,
    simd: bool = True,
    global_neighborhood_list: bool = False,
    subdomain_grid: bool = True,
    subdomain_grid_auto_disable: bool = True,
    subdomain_num_cubes_per_dim: int = 64,
) -> SurfaceReconstruction:
    """The surface of particles, with the arguments of pysplashsurf.

    Parameters
    ----------
    particles : array_like, shape (N, 3)
        Positions. The vertices have the type of float32 or float64 positions.
    particle_radius : float
        Half of the particle spacing, in world units.
    rest_density : float
        Has no effect, as in pysplashsurf: it cancels out.
    smoothing_length : float
        Has no effect. 2 is the usual value, and any other causes a warning.
    cube_size : float
        Edge length of a voxel, in particle radii, at least 0.0532. An absolute length, the older convention, must
        be divided by `particle_radius`; one that would make smaller voxels raises `ValueError`.
    iso_surface_threshold : float
        Between 0 and 1. Each 0.1 less than 0.6 moves the surface outward by 0.11 particle spacings, but by at
        most 2 voxels, and more moves it inward.
    aabb_min, aabb_max : array_like, shape (3,), optional
        The box of the particles that form the surface. Particles on its upper faces are outside.
    multi_threading : bool
        Whether to use all cores. The result does not depend on it.
    simd, global_neighborhood_list, subdomain_grid, subdomain_grid_auto_disable, subdomain_num_cubes_per_dim
        Have no effect. Values other than the default cause a warning.

    Returns
    -------
    SurfaceReconstruction

    Raises
    ------
    ValueError
        If a number is out of its range, a box is empty or has one corner, or the particles have another shape.
    TypeError
        If the particles are not real numbers.
    MemoryLimitError
        If the frame needs more than half of the machine's memory.

    Warns
    -----
    UserWarning
        About an argument without effect, or with less, once in each process; and what `pymeniscus.reconstruct` warns
        of.
    """
    arguments = locals()
    _check(arguments)
    return _reconstruct(arguments)[1]


def reconstruction_pipeline(
    particles: Any,
    *,
    attributes_to_interpolate: Mapping[str, Any] | None = None,
    particle_radius: float,
    rest_density: float = 1000.0,
    smoothing_length: float,
    cube_size: float,
    iso_surface_threshold: float = 0.6,
    aabb_min: Reals | None = None,
    aabb_max: Reals | None = None,
    multi_threading: bool = True,
    simd: bool = True,
    subdomain_grid: bool = True,
    subdomain_grid_auto_disable: bool = True,
    subdomain_num_cubes_per_dim: int = 64,
    check_mesh_closed: bool = False,
    check_mesh_manifold: bool = False,
    check_mesh_orientation: bool = False,
    check_mesh_debug: bool = False,
    mesh_cleanup: bool = False,
    mesh_cleanup_snap_dist: float | None = None,
    decimate_barnacles: bool = False,
    keep_vertices: bool = False,
    compute_normals: bool = False,
    sph_normals: bool = False,
    normals_smoothing_iters: int | None = None,
    mesh_smoothing_iters: int | None = None,
    mesh_smoothing_weights: bool = True,
    mesh_smoothing_weights_normalization: float = 13.0,
    generate_quads: bool = False,
    quad_max_edge_diag_ratio: float = 1.75,
    quad_max_normal_angle: float = 10.0,
    quad_max_interior_angle: float = 135.0,
    output_mesh_smoothing_weights: bool = False,
    output_raw_normals: bool = False,
    output_raw_mesh: bool = False,
    mesh_aabb_min: Reals | None = None,
    mesh_aabb_max: Reals | None = None,
    mesh_aabb_clamp_vertices: bool = True,
    enable_multi_threading: bool = True,
) -> tuple[MeshWithData, SurfaceReconstruction]:
    """The surface of particles with attributes, with the arguments of pysplashsurf.

    Parameters
    ----------
    particles, particle_radius, rest_density, smoothing_length, cube_size, iso_surface_threshold, aabb_min, \
aabb_max, multi_threading, simd, subdomain_grid, subdomain_grid_auto_disable, subdomain_num_cubes_per_dim
        As for `reconstruct_surface`. `enable_multi_threading` is the older name of `multi_threading`.
    attributes_to_interpolate : mapping of str to array_like, optional
        Attributes of the particles by name, shape (N,) or (N, K). A vertex gets the mean of real numbers over the
        particles around it, in the type of the positions, and the integers of the nearest particle.
    check_mesh_closed, check_mesh_manifold, check_mesh_orientation : bool
        Check the returned mesh with `check_mesh_consistency`; the last two are one check here.
    mesh_cleanup, decimate_barnacles, keep_vertices : bool
        Have no effect: the mesh has no triangles to clean up, and no vertices are removed.
    compute_normals : bool
        Add the attribute ``"normals"``: unit normals of the level set.
    sph_normals : bool
        Has no effect: the normals are always those of the level set.
    normals_smoothing_iters : int, optional
        Average the normals with their neighbours this many times, 0 to 1000.
    generate_quads : bool
        Return a `MixedTriQuadMesh3d` with the quads of dual contouring.
    output_raw_normals : bool
        With smoothed normals, also add ``"raw_normals"``: those of `TriMesh3d.vertex_normals_parallel`.
    output_raw_mesh : bool
        Has no effect: `SurfaceReconstruction.mesh` is always the whole mesh.
    mesh_aabb_min, mesh_aabb_max : array_like, shape (3,), optional
        Remove triangles and quads without a vertex in this box. The mesh is then open.
    mesh_aabb_clamp_vertices : bool
        Move the vertices that are outside the box to its faces.
    check_mesh_debug, mesh_cleanup_snap_dist, mesh_smoothing_iters, mesh_smoothing_weights, \
mesh_smoothing_weights_normalization, quad_max_edge_diag_ratio, quad_max_normal_angle, quad_max_interior_angle, \
output_mesh_smoothing_weights
        Have no effect. Values other than the default cause a warning.

    Returns
    -------
    mesh_with_data : MeshWithData
        The mesh, with the attributes of its vertices.
    reconstruction : SurfaceReconstruction
        The whole mesh in triangles, and the grid.

    Raises
    ------
    ValueError, TypeError, MemoryLimitError
        As for `reconstruct_surface`.
    RuntimeError
        If a check of the mesh fails.

    Warns
    -----
    UserWarning
        As for `reconstruct_surface`.
    """
    arguments = locals()
    _check(arguments)
    crop = _box("mesh_aabb", mesh_aabb_min, mesh_aabb_max)
    surface, reconstruction = _reconstruct(arguments)
    whole = reconstruction.mesh
    attributes: dict[str, NDArray[Any]] = {}
    if compute_normals:
        attributes["normals"] = surface.normals.astype(whole.dtype)
        if output_raw_normals and normals_smoothing_iters:
            attributes["raw_normals"] = whole.vertex_normals_parallel()
    for name, values in surface.attributes.items():
        given = np.asarray((attributes_to_interpolate or {})[name]).dtype
        attributes[name] = values.astype(whole.dtype if values.dtype.kind == "f" else given)
    mesh: TriMesh3d | MixedTriQuadMesh3d
    if generate_quads:
        loose, quads = surface.loose_triangles.astype(np.uint64), surface.quads.astype(np.uint64)
        mesh = MixedTriQuadMesh3d(whole.vertices.copy(), loose, quads)
    else:
        mesh = whole.copy()
    if crop is not None:
        mesh, attributes = _cropped(mesh, attributes, crop, mesh_aabb_clamp_vertices)
    result = MeshWithData(mesh, attributes)
    is_oriented = check_mesh_manifold or check_mesh_orientation
    if check_mesh_closed or is_oriented:
        problem = check_mesh_consistency(result, check_closed=check_mesh_closed, check_manifold=is_oriented)
        if problem is not None:
            raise RuntimeError(f"the mesh failed its check: {problem}")
    return result, reconstruction


def check_mesh_consistency(
    mesh: TriMesh3d | MixedTriQuadMesh3d | MeshWithData,
    grid: UniformGrid | None = None,
    *,
    check_closed: bool = True,
    check_manifold: bool = True,
    debug: bool = False,
) -> str | None:
    """Check the edges of a mesh.

    Parameters
    ----------
    mesh : TriMesh3d, MixedTriQuadMesh3d or MeshWithData
        The mesh.
    grid : UniformGrid, optional
        Has no effect.
    check_closed : bool
        Every edge of a cell is an edge of another cell, too.
    check_manifold : bool
        No two cells have an edge in the same direction: so at most two cells meet at an edge, and they face the
        same side.
    debug : bool
        Has no effect: the check prints nothing.

    Returns
    -------
    str or None
        The problem; None if there is none.
    """
    cells = (mesh.mesh if isinstance(mesh, MeshWithData) else mesh)._cells()
    edges = np.concatenate([
        np.stack([corners, np.roll(corners, -1, axis=1)], -1).reshape(-1, 2).astype(np.int64) for _, corners in cells
    ])  # fmt: skip
    count = int(edges.max(initial=0)) + 1
    directed, uses = np.unique(edges @ (count, 1), return_counts=True)
    reverse = directed % count * count + directed // count
    boundary = int((~np.isin(reverse, directed)).sum()) if check_closed else 0
    repeated = int((uses > 1).sum()) if check_manifold else 0
    problems = [f"{boundary} edges have a cell on one side only"] if boundary else []
    problems += [f"{repeated} edges have several cells on one side"] if repeated else []
    return "; ".join(problems) or None


def _check(arguments: Mapping[str, Any]) -> None:
    """Check the numbers, and warn about arguments without effect. The warnings point to the caller of the public
    function."""
    for name in ("particle_radius", "cube_size", "smoothing_length", "rest_density", "iso_surface_threshold"):
        if not 0 < arguments[name] < np.inf:
            raise ValueError(f"{name} must be a positive number, not {arguments[name]}")
    size, radius = arguments["cube_size"], arguments["particle_radius"]
    if size < _LEAST_CUBE_SIZE:
        raise ValueError(
            f"cube_size is in particle radii, and {size:g} is less than {_LEAST_CUBE_SIZE}, the least; 0.5 to 1 is usual. If it is an "
            "absolute length (the older convention, that of the library splashsurf_lib), give "
            f"cube_size / particle_radius, which is {size / radius:g}"
        )
    if arguments["iso_surface_threshold"] >= 1:
        raise ValueError(f"iso_surface_threshold must be less than 1, not {arguments['iso_surface_threshold']}")
    rounds = arguments.get("normals_smoothing_iters") or 0
    if not 0 <= rounds <= 1000:
        raise ValueError(f"normals_smoothing_iters must be from 0 to 1000, not {rounds}")
    for name, (harmless, reason) in _IGNORED.items():
        if name in arguments and arguments[name] not in harmless:
            _warn_once(name, f"`{name}={arguments[name]}` has no effect: {reason}")
    if _offset(arguments) > 2 * arguments["cube_size"]:
        _warn_once(
            "iso_surface_threshold",
            f"`iso_surface_threshold={arguments['iso_surface_threshold']}` has less effect: the surface is moved outward "
            "by two voxels, which is the most",
        )


def _warn_once(name: str, message: str) -> None:
    if name not in _warned:
        _warned.add(name)
        warnings.warn(message, stacklevel=4)


def _offset(arguments: Mapping[str, Any]) -> float:
    """How far the threshold moves the surface outward, in particle radii."""
    return 2 * _OFFSET_PER_THRESHOLD * (_DEFAULT_THRESHOLD - float(arguments["iso_surface_threshold"]))


def _reconstruct(arguments: Mapping[str, Any]) -> tuple[Surface, SurfaceReconstruction]:
    """The surface, from the arguments of a public function."""
    box = _box("aabb", arguments["aabb_min"], arguments["aabb_max"])
    points = as_points(arguments["particles"], "particles")
    inside = None if box is None else _is_inside(points, box, np.less)
    radius = float(arguments["particle_radius"])
    voxel_size = float(arguments["cube_size"]) * radius
    is_parallel = arguments["multi_threading"] and arguments.get("enable_multi_threading", True)
    surface = reconstruct(
        points,
        attributes=dict(arguments.get("attributes_to_interpolate") or {}) or None,
        where=inside,
        spacing=2 * radius,
        voxel_size=voxel_size,
        offset=min(_offset(arguments) * radius, 2 * voxel_size),
        smooth_normals=int(arguments.get("normals_smoothing_iters") or 0) if arguments.get("compute_normals") else 0,
        threads=None if is_parallel else 1,
    )
    # These copies let the surface and its level set be freed.
    mesh = TriMesh3d(surface._world_vertices().astype(points.dtype), surface.triangles.astype(np.uint64))
    return surface, SurfaceReconstruction(mesh, _grid_of(surface.level_set), inside)


def _grid_of(level_set: LevelSet) -> UniformGrid:
    origins, size = level_set.origins.astype(np.int64), level_set.voxel_size
    if len(origins) == 0:
        return UniformGrid(Aabb3d(np.zeros(3), np.zeros(3)), size, [0, 0, 0], [0, 0, 0])
    # A leaf has eight voxels along each axis.
    least, greatest = origins.min(axis=0), origins.max(axis=0) + 7
    cells: list[int] = (greatest - least).tolist()
    return UniformGrid(Aabb3d(least * size, greatest * size), size, cells, [count + 1 for count in cells])


def _box(name: str, least: Reals | None, greatest: Reals | None) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """A box with these corners, of which both or none are given."""
    if least is None and greatest is None:
        return None
    if least is None or greatest is None:
        raise ValueError(f"give both {name}_min and {name}_max, or neither")
    corners = _corner(f"{name}_min", least), _corner(f"{name}_max", greatest)
    if not (corners[0] < corners[1]).all():
        raise ValueError(f"{name}_min must be less than {name}_max along every axis, not {least} and {greatest}")
    return corners


def _corner(name: str, values: Reals) -> NDArray[np.float64]:
    """A copy of three numbers."""
    corner = np.array(values, np.float64)
    if corner.shape != (3,):
        raise ValueError(f"{name} must be three numbers, not an array of the shape {corner.shape}")
    return corner


def _is_inside(points: NDArray[Any], box: tuple[NDArray[Any], NDArray[Any]], is_below: np.ufunc) -> NDArray[np.bool_]:
    # In the precision of the points: otherwise a point on an upper face could be rounded into the box.
    least, greatest = (corner.astype(points.dtype) for corner in box)
    inside: NDArray[np.bool_] = np.logical_and.reduce((points >= least) & is_below(points, greatest), axis=1)
    return inside


def _cropped(
    mesh: TriMesh3d | MixedTriQuadMesh3d,
    attributes: Mapping[str, NDArray[Any]],
    box: tuple[NDArray[Any], NDArray[Any]],
    clamps: bool,
) -> tuple[TriMesh3d | MixedTriQuadMesh3d, dict[str, NDArray[Any]]]:
    """The cells with a vertex in the box, and their vertices."""
    is_inside = _is_inside(mesh.vertices, box, np.less_equal)
    kept = [corners[is_inside[corners].any(axis=1)] for _, corners in mesh._cells()]
    used = np.zeros(len(mesh.vertices), np.bool_)
    for corners in kept:
        used[corners] = True
    numbers = (np.cumsum(used) - 1).astype(np.uint64)
    vertices = mesh.vertices[used]
    if clamps:
        vertices = np.clip(vertices, *box).astype(mesh.dtype)
    cells = [numbers[corners] for corners in kept]
    cropped = TriMesh3d(vertices, *cells) if isinstance(mesh, TriMesh3d) else MixedTriQuadMesh3d(vertices, *cells)
    return cropped, {name: values[used] for name, values in attributes.items()}


def _rows(name: str, values: ArrayLike, count: int) -> NDArray[Any]:
    rows = np.array(values)
    if rows.ndim == 0 or len(rows) != count:
        raise ValueError(f"the attribute `{name}` must have {count} rows, not the shape {rows.shape}")
    return rows


def _write(
    mesh: _Mesh,
    path: Path,
    file_format: str | None,
    point_data: Mapping[str, NDArray[Any]] | None = None,
    cell_data: Mapping[str, NDArray[Any]] | None = None,
) -> None:
    import meshio

    cells = mesh._cells()
    # meshio takes the values of each kind of cells separately.
    ends = np.cumsum([len(corners) for _, corners in cells])[:-1]
    split = {name: np.split(values, ends) for name, values in (cell_data or {}).items()}
    meshio.write_points_cells(path, mesh.vertices, cells, dict(point_data or {}), split, file_format=file_format)
