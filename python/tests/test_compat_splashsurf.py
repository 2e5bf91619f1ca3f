"""Tests of the module for programs that use pysplashsurf, with the calls of such programs. Where pysplashsurf is
installed, also comparisons with it."""

from __future__ import annotations

import inspect
import os
import re
import warnings
from types import ModuleType

import numpy as np
import pytest
from conftest import ROOT, lattice
from numpy.typing import NDArray

import pymeniscus as pm
import pymeniscus.compat.splashsurf as compat

RADIUS = 0.05
#: The arguments that both functions need, for particles with a spacing of 0.1.
USUAL = {"particle_radius": RADIUS, "smoothing_length": 2.0, "cube_size": 0.8}
#: The call in particles_to_mesh of Genesis. Older versions of Genesis name the last argument enable_multi_threading.
GENESIS = {
    **USUAL,
    "iso_surface_threshold": 0.6,
    "mesh_smoothing_weights": True,
    "mesh_smoothing_iters": 25,
    "normals_smoothing_iters": 10,
    "mesh_cleanup": True,
    "compute_normals": True,
    "multi_threading": True,
}
#: The arguments of the example in the README of pysplashsurf.
README = {
    "rest_density": 1000.0,
    "smoothing_length": 2.0,
    "cube_size": 0.5,
    "iso_surface_threshold": 0.6,
    "mesh_smoothing_weights": True,
    "mesh_smoothing_weights_normalization": 13.0,
    "mesh_smoothing_iters": 25,
    "normals_smoothing_iters": 10,
    "mesh_cleanup": True,
    "compute_normals": True,
    "subdomain_grid": True,
    "subdomain_num_cubes_per_dim": 64,
    "output_mesh_smoothing_weights": True,
}


@pytest.fixture(autouse=True)
def nothing_warned(monkeypatch):
    monkeypatch.setattr(compat, "_warned", set())


@pytest.fixture(params=["pymeniscus", "pysplashsurf"])
def module(request) -> ModuleType:
    """This module and pysplashsurf, for tests that both must pass."""
    return compat if request.param == "pymeniscus" else pytest.importorskip("pysplashsurf")


def ball() -> NDArray:
    """A ball of particles on a lattice. No single particle sticks out of it."""
    particles = lattice(25, dtype=np.float64) - 1.2
    return particles[np.linalg.norm(particles, axis=1) < 1.07]


def volume(vertices: NDArray, triangles: NDArray) -> float:
    corners = vertices[triangles.astype(np.int64)].astype(np.float64)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def warned(caught: list[warnings.WarningMessage]) -> set[str]:
    """The arguments that warnings name, all of which must point to this file."""
    assert {warning.filename for warning in caught} <= {__file__}
    return {re.match(r"`(\w+)=.*` has no effect: ", str(warning.message))[1] for warning in caught}


@pytest.mark.filterwarnings("ignore:`")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_call_of_genesis(module, dtype):
    positions = ball().astype(dtype)
    mesh_with_data, _ = module.reconstruction_pipeline(positions, **GENESIS)
    normals = mesh_with_data.point_attributes["normals"]
    vertices, triangles = mesh_with_data.mesh.vertices, mesh_with_data.mesh.triangles
    assert vertices.dtype == normals.dtype == mesh_with_data.dtype == dtype and triangles.dtype == np.uint64
    assert vertices.shape == normals.shape == (mesh_with_data.nvertices, 3)
    assert triangles.shape == (mesh_with_data.ncells, 3) and vertices.flags.writeable
    # Outward normals of a ball are its directions.
    outward = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", outward, normals).min() > 0.9
    assert volume(vertices, triangles) / 0.1**3 == pytest.approx(len(positions), rel=0.05)


@pytest.mark.filterwarnings("ignore:`")
def test_call_of_older_versions_of_genesis():
    trimesh = pytest.importorskip("trimesh")
    arguments = {**GENESIS, "enable_multi_threading": True}
    del arguments["multi_threading"]
    mesh_with_data, _ = compat.reconstruction_pipeline(ball(), **arguments)
    normals = mesh_with_data.get_point_attribute("normals")
    vertices, triangles = mesh_with_data.take_mesh().take_vertices_and_triangles()
    mesh = trimesh.Trimesh(vertices=vertices, faces=triangles, face_normals=normals)
    assert mesh.is_watertight and mesh.volume == pytest.approx(volume(vertices, triangles))


@pytest.mark.filterwarnings("ignore:`")
@pytest.mark.parametrize("quads", [False, True])
def test_example_of_the_readme(module, tmp_path, quads):
    meshio = pytest.importorskip("meshio")
    particles = lattice(10, dtype=np.float64)
    mesh_with_data, _ = module.reconstruction_pipeline(
        particles, particle_radius=RADIUS, generate_quads=quads, attributes_to_interpolate={"x": particles}, **README
    )
    kind = module.MeshType.MixedTriQuad3d if quads else module.MeshType.Tri3d
    assert mesh_with_data.mesh_type == kind
    mesh_with_data.write_to_file(tmp_path / "surface.vtk")
    mesh_with_data.mesh.write_to_file(os.fspath(tmp_path / "mesh.ply"), file_format=None)
    assert (tmp_path / "surface.vtk").read_bytes().startswith(b"# vtk DataFile Version 4.2")
    assert (tmp_path / "mesh.ply").read_bytes().startswith(b"ply")
    read = meshio.read(tmp_path / "surface.vtk")
    assert np.array_equal(read.points, mesh_with_data.mesh.vertices)
    assert {"normals", "x"} <= set(read.point_data)
    if quads:
        mesh = mesh_with_data.mesh
        assert module is not compat or compat.check_mesh_consistency(mesh_with_data) is None
        assert np.array_equal(read.cells_dict["quad"], mesh.get_quads()) and len(mesh.get_quads()) > 100
        assert len(mesh.get_quads()) + len(mesh.get_triangles()) == mesh_with_data.ncells
    else:
        assert np.array_equal(read.cells_dict["triangle"], mesh_with_data.mesh.triangles)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_particles_in_a_box(module, dtype):
    particles = lattice(10, dtype=dtype)
    # Five layers of particles: those on the upper face are outside.
    made = module.reconstruct_surface(particles, **USUAL, aabb_min=np.array([0.2, -1, -1]), aabb_max=[0.7, 2, 2])
    inside = (particles[:, 0] >= dtype(0.2)) & (particles[:, 0] < dtype(0.7))
    assert made.particle_inside_aabb.dtype == bool and np.array_equal(made.particle_inside_aabb, inside)
    mesh = made.mesh
    # The faces of a regular block are a fifth of a spacing too far out: the level suits fluid that is spread out.
    assert mesh.vertices.min(axis=0) == pytest.approx([0.15, -0.05, -0.05], abs=0.025)
    assert mesh.vertices.max(axis=0) == pytest.approx([0.65, 0.95, 0.95], abs=0.025)
    assert module.check_mesh_consistency(mesh, made.grid) is None
    grid = made.grid
    assert grid.cell_size == pytest.approx(0.8 * RADIUS)
    assert (grid.aabb.min < mesh.vertices.min(axis=0)).all() and (grid.aabb.max > mesh.vertices.max(axis=0)).all()
    assert grid.aabb.min.dtype == np.float64 and not grid.aabb.contains_point(grid.aabb.max)
    assert grid.aabb.contains_point(grid.aabb.min) and grid.npoints_per_dim == [n + 1 for n in grid.ncells_per_dim]
    assert np.allclose((grid.aabb.max - grid.aabb.min) / grid.cell_size, grid.ncells_per_dim)


def test_box_of_two_corners(module):
    least = np.array([0, 1, 2])
    box = module.Aabb3d.from_min_max(min=least, max=[1, 2, 3.5])
    least[0] = 9
    assert (
        box.min.tolist() == [0, 1, 2] and box.max.tolist() == [1, 2, 3.5] and box.min.dtype == box.max.dtype == np.float64
    )
    assert box.contains_point([0, 1, 2]) and box.contains_point(np.array([0.5, 1.5, 3])) and not box.contains_point(box.max)
    assert not box.contains_point([0.5, 1.5, 3.5]) and not box.contains_point([-0.1, 1.5, 3])
    assert not module.Aabb3d.from_min_max([1, 0, 0], [0, 1, 1]).contains_point([0.5, 0.5, 0.5])
    for wrong in (lambda: module.Aabb3d.from_min_max([0, 0], [1, 1, 1]), lambda: box.contains_point([0])):
        with pytest.raises(ValueError, match="length 3|three numbers"):
            wrong()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_box_of_points(module, dtype):
    particles = lattice(10, dtype=dtype)
    box = module.Aabb3d.from_points(particles)
    assert box.min.tolist() == [0, 0, 0] and box.max.tolist() == [float(dtype(0.9))] * 3 and box.max.dtype == np.float64
    assert module.Aabb3d.from_points(np.zeros((0, 3), dtype)).max.tolist() == [0, 0, 0]
    holed = np.array([[np.nan, 0, 0], [1, 2, -3]], dtype)
    assert module.Aabb3d.from_points(holed).min.tolist() == [1, 0, -3]
    # A box of half of the particles, which leaves out those on its upper faces.
    box = module.Aabb3d.from_points(particles[particles[:, 0] < 0.55])
    made = module.reconstruct_surface(particles, **USUAL, aabb_min=box.min, aabb_max=box.max)
    assert np.array_equal(made.particle_inside_aabb, [box.contains_point(particle) for particle in particles])
    assert made.particle_inside_aabb.sum() == 5 * 9 * 9
    # And a box of a part of the surface.
    box = module.Aabb3d.from_points(made.mesh.vertices[made.mesh.vertices[:, 0] < 0.3])
    crop = {"mesh_aabb_min": box.min, "mesh_aabb_max": box.max}
    cropped = module.reconstruction_pipeline(particles, **USUAL, **crop)[0].mesh.vertices
    assert len(cropped) > 0 and (cropped >= box.min.astype(dtype)).all() and (cropped <= box.max.astype(dtype)).all()


def test_box_of_wrong_points():
    with pytest.raises(ValueError, match=r"points must have the shape \(N, 3\)"):
        compat.Aabb3d.from_points(np.zeros((2, 2)))
    with pytest.raises(TypeError, match="points"):
        compat.Aabb3d.from_points([["a", "b", "c"]])


def test_grid_is_that_of_the_level_set():
    grid = compat.reconstruct_surface(lattice(6), **USUAL).grid
    values, least = pm.reconstruct(lattice(6), spacing=0.1, voxel_size=0.8 * RADIUS).level_set.dense()
    assert grid.npoints_per_dim == [*values.shape] and grid.aabb.min == pytest.approx(np.multiply(least, 0.04))


def test_reconstruction_is_also_a_mesh():
    made = compat.reconstruct_surface(lattice(6), **USUAL)
    assert made.vertices is made.mesh.vertices and made.triangles is made.mesh.triangles
    assert made.particle_inside_aabb is None and made.particle_densities is None and made.particle_neighbors is None


def test_lengths_are_in_particle_radii(module):
    particles = lattice(6)
    for function in (module.reconstruct_surface, lambda *a, **k: module.reconstruction_pipeline(*a, **k)[1]):
        assert function(particles, **USUAL).grid.cell_size == pytest.approx(0.04)


@pytest.mark.parametrize("function", [compat.reconstruct_surface, compat.reconstruction_pipeline])
@pytest.mark.parametrize(
    ("radius", "size", "instead"), [(0.05, 0.04, "0.8"), (0.002, 0.001, "0.5"), (0.05, 0.0531, "1.062")]
)
def test_absolute_cube_sizes_are_refused(function, radius, size, instead):
    with pytest.raises(ValueError, match=r"particle radii.*older convention.*cube_size / particle_radius") as caught:
        function(lattice(2, 2 * radius), particle_radius=radius, smoothing_length=2.0, cube_size=size)
    assert f"{size:g} is less than" in str(caught.value) and str(caught.value).endswith(f"which is {instead}")


def test_least_cube_size_is_that_of_the_method():
    compat.reconstruct_surface(lattice(1), **{**USUAL, "cube_size": 0.0532})
    with pytest.raises(pm.OptionError, match="voxel"):
        pm.reconstruct(lattice(1), spacing=2 * RADIUS, voxel_size=0.0531 * RADIUS)


@pytest.mark.parametrize("density", [1.0, 8000.0])
def test_density_has_no_effect(module, density):
    # Sorted along each axis, because pysplashsurf has no fixed order of the vertices.
    one, other = (
        np.sort(module.reconstruct_surface(lattice(6), **USUAL, **extra).mesh.vertices, axis=0)
        for extra in ({}, {"rest_density": density})
    )
    assert one == pytest.approx(other, abs=1e-5)


def test_normals_of_triangles(module):
    mesh = module.reconstruct_surface(ball(), **USUAL).mesh
    normals = mesh.vertex_normals_parallel()
    assert normals.dtype == np.float64 and np.linalg.norm(normals, axis=1) == pytest.approx(1)
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    # A surface of marching cubes has triangles at all angles.
    assert np.mean(np.einsum("ij,ij->i", outward, normals)) > 0.9


def test_normals_are_smoothed(module):
    def normals(**extra):
        made, _ = module.reconstruction_pipeline(lattice(8, dtype=np.float64), **USUAL, compute_normals=True, **extra)
        return made.point_attributes

    raw, smooth = normals(), normals(normals_smoothing_iters=10, output_raw_normals=True)
    assert set(raw) == {"normals"} and set(smooth) == {"normals", "raw_normals"}
    assert np.abs(smooth["raw_normals"] - smooth["normals"]).max() > 0.1
    if module is compat:
        assert np.abs(raw["normals"] - smooth["normals"]).max() > 0.1
    assert np.einsum("ij,ij->i", smooth["raw_normals"], smooth["normals"]).mean() > 0.9
    assert np.linalg.norm(smooth["normals"], axis=1) == pytest.approx(1)
    assert "normals" not in module.reconstruction_pipeline(lattice(4), **USUAL)[0].point_attributes


def test_attributes_are_interpolated(module):
    particles = lattice(10)
    given = {"height": particles[:, 1].copy(), "v": particles * 2}
    if module is compat:
        # pysplashsurf interpolates no integers.
        given["id"] = np.arange(1000, dtype=np.uint64)
    made, _ = module.reconstruction_pipeline(particles, attributes_to_interpolate=given, **USUAL)
    attributes, vertices = made.point_attributes, made.mesh.vertices
    assert set(attributes) == set(given)
    assert attributes["height"].shape == (made.nvertices,) and attributes["v"].shape == vertices.shape
    assert attributes["height"].dtype == attributes["v"].dtype == np.float32
    # The mean at a vertex is over particles that are all on one side of it.
    assert np.abs(attributes["height"] - np.clip(vertices[:, 1], 0, 0.9)).max() < 0.06
    if module is compat:
        nearest = np.linalg.norm(particles[attributes["id"]] - vertices, axis=1)
        assert attributes["id"].dtype == np.uint64 and nearest.max() < 0.12
    made.add_point_attribute("one", np.ones(made.nvertices, np.float32))
    made.add_cell_attribute("two", np.ones((made.ncells, 3), np.float32))
    assert "one" in made.point_attributes and list(made.cell_attributes) == ["two"]


def test_copies_are_independent():
    made, _ = compat.reconstruction_pipeline(lattice(4), **USUAL, compute_normals=True, generate_quads=True)
    for mesh in (made.copy().mesh, made.copy_mesh(), made.mesh.copy()):
        assert np.array_equal(mesh.vertices, made.mesh.vertices) and np.array_equal(mesh.get_quads(), made.mesh.get_quads())
        mesh.vertices[:] = 7
    assert made.mesh.vertices.max() < 1
    with pytest.raises(ValueError, match=f"{made.nvertices} rows"):
        made.add_point_attribute("wrong", np.zeros(3))
    with pytest.raises(KeyError):
        made.get_point_attribute("nothing")


@pytest.mark.parametrize("clamp", [True, False])
def test_mesh_is_cropped(module, clamp):
    box = {"mesh_aabb_min": [0.22, -9, -9], "mesh_aabb_max": [9, 0.5, 9], "mesh_aabb_clamp_vertices": clamp}
    made, whole = module.reconstruction_pipeline(lattice(10), **USUAL, **box, attributes_to_interpolate={"p": lattice(10)})
    vertices, triangles = made.mesh.vertices, made.mesh.triangles
    assert 0 < made.ncells < len(whole.mesh.triangles) and np.array_equal(np.unique(triangles), np.arange(made.nvertices))
    assert made.point_attributes["p"].shape == vertices.shape
    # Without clamping, triangles stick out of the box by less than a voxel.
    reach = 1e-6 if clamp else 0.05
    assert 0.22 - reach <= vertices[:, 0].min() <= 0.22 + 1e-6 and 0.5 - 1e-6 <= vertices[:, 1].max() <= 0.5 + reach
    assert (vertices[:, 0].min() < 0.22 - 1e-3) != clamp
    assert module.check_mesh_consistency(made.mesh, whole.grid, check_closed=True, check_manifold=False) is not None
    assert module.check_mesh_consistency(made.mesh, whole.grid, check_closed=False, check_manifold=True) is None
    with pytest.raises(RuntimeError, match="mesh"):
        module.reconstruction_pipeline(lattice(10), **USUAL, **box, check_mesh_closed=True)


def test_quads_are_cropped():
    box = {"mesh_aabb_min": [0.22, -9, -9], "mesh_aabb_max": [9, 9, 9]}
    made, whole = compat.reconstruction_pipeline(lattice(10), **USUAL, **box, generate_quads=True)
    quads, loose = made.mesh.get_quads(), made.mesh.get_triangles()
    used = np.unique(np.concatenate([quads.ravel(), loose.ravel()]))
    assert np.array_equal(used, np.arange(made.nvertices)) and 0 < 2 * len(quads) + len(loose) < len(whole.triangles)


def test_checks_find_faults(module):
    made = module.reconstruct_surface(lattice(6), **USUAL)
    assert module.check_mesh_consistency(made.mesh, made.grid) is None
    checks = dict.fromkeys(("check_mesh_closed", "check_mesh_manifold", "check_mesh_orientation"), True)
    module.reconstruction_pipeline(lattice(6), **USUAL, **checks)
    if module is compat:
        opened = compat.TriMesh3d(made.vertices, made.triangles[1:])
        assert compat.check_mesh_consistency(opened) == "3 edges have a cell on one side only"
        assert compat.check_mesh_consistency(opened, check_closed=False) is None
        mixed = compat.reconstruction_pipeline(lattice(6), **USUAL, generate_quads=True)[0].mesh
        opened = compat.MixedTriQuadMesh3d(mixed.vertices, mixed.get_triangles(), mixed.get_quads()[1:])
        assert compat.check_mesh_consistency(opened) == "4 edges have a cell on one side only"
        turned = made.mesh.copy()
        turned.triangles[5] = turned.triangles[5][::-1]
        assert "3 edges have several cells on one side" in compat.check_mesh_consistency(turned)
        assert compat.check_mesh_consistency(turned, check_manifold=False, check_closed=False) is None


def test_no_particles(module):
    nothing = {"aabb_min": [5, 5, 5], "aabb_max": [6, 6, 6]}
    for particles, extra in ((np.zeros((0, 3)), {}), (lattice(4, dtype=np.float64), nothing)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made, whole = module.reconstruction_pipeline(particles, **USUAL, **extra, compute_normals=True)
        assert made.mesh.vertices.shape == (0, 3) and made.mesh.triangles.shape == (0, 3) and made.ncells == 0
        assert module.check_mesh_consistency(made.mesh, whole.grid) is None


def test_vertices_are_in_world_space_far_from_the_origin():
    far = lattice(6, dtype=np.float64) + [5000, 0, 0]
    vertices = compat.reconstruct_surface(far, **USUAL).vertices
    assert vertices[:, 0].min() == pytest.approx(4999.95, abs=0.02)


def test_one_warning_for_each_argument_without_effect():
    def arguments_warned(function, **extra):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            function(lattice(4), **{**USUAL, **extra})
        return warned(caught)

    surface, pipeline = compat.reconstruct_surface, compat.reconstruction_pipeline
    # What has a counterpart, and what nothing needs to be done for, causes no warning.
    silent = dict(multi_threading=False, rest_density=1.0, mesh_cleanup=True, decimate_barnacles=True, sph_normals=True,
                  keep_vertices=True, output_raw_mesh=True, mesh_smoothing_iters=0, check_mesh_closed=True,
                  iso_surface_threshold=0.5, compute_normals=True, normals_smoothing_iters=3)  # fmt: skip
    assert arguments_warned(pipeline, **silent) == set()
    assert arguments_warned(surface, smoothing_length=1.8, simd=False) == {"smoothing_length", "simd"}
    assert arguments_warned(pipeline, smoothing_length=1.5, simd=False) == set()
    values = dict(subdomain_grid=False, subdomain_grid_auto_disable=False, subdomain_num_cubes_per_dim=32,
                  check_mesh_debug=True, mesh_cleanup_snap_dist=0.3, mesh_smoothing_iters=5,
                  mesh_smoothing_weights=False, mesh_smoothing_weights_normalization=10.0,
                  output_mesh_smoothing_weights=True, quad_max_edge_diag_ratio=1.5, quad_max_normal_angle=5.0,
                  quad_max_interior_angle=120.0)  # fmt: skip
    assert arguments_warned(pipeline, **values) == set(values)
    assert arguments_warned(surface, global_neighborhood_list=True) == {"global_neighborhood_list"}
    assert compat._warned == set(compat._IGNORED)


def test_one_thread_makes_the_same_surface(monkeypatch):
    counts = []
    original = compat.reconstruct
    monkeypatch.setattr(compat, "reconstruct", lambda *a, **k: (counts.append(k["threads"]), original(*a, **k))[1])
    made = [compat.reconstruct_surface(lattice(6), **USUAL, multi_threading=many) for many in (True, False)]
    compat.reconstruction_pipeline(lattice(6), **USUAL, enable_multi_threading=False)
    assert counts == [None, 1, 1] and np.array_equal(made[0].vertices, made[1].vertices)


def test_thresholds_are_offsets():
    surfaces = {
        threshold: compat.reconstruct_surface(lattice(10), **USUAL, iso_surface_threshold=threshold).vertices[:, 0].min()
        for threshold in (0.4, 0.6, 0.8)
    }
    usual = pm.reconstruct(lattice(10), spacing=0.1, voxel_size=0.04)
    assert surfaces[0.6] == usual.vertices[:, 0].min()
    assert surfaces[0.6] - surfaces[0.4] == pytest.approx(0.022, abs=1e-3)
    assert surfaces[0.8] - surfaces[0.6] == pytest.approx(0.022, abs=1e-3)
    # Two voxels are the most that the method moves a surface outward.
    fine = {**USUAL, "cube_size": 0.3}
    with pytest.warns(UserWarning, match="`iso_surface_threshold=0.1` has less effect") as caught:
        least = [
            compat.reconstruct_surface(lattice(10), **fine, iso_surface_threshold=t).vertices.min() for t in (0.6, 0.1, 0.1)
        ]
    assert len(caught) == 1 and caught[0].filename == __file__
    assert least[0] - least[1] == pytest.approx(2 * 0.3 * RADIUS, abs=2e-3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"particle_radius": 0}, "particle_radius must be a positive number"),
        ({"cube_size": -1}, "cube_size"),
        ({"smoothing_length": float("nan")}, "smoothing_length"),
        ({"rest_density": float("inf")}, "rest_density"),
        ({"iso_surface_threshold": 1.0}, "iso_surface_threshold must be less than 1"),
        ({"aabb_min": [0, 0, 0]}, "give both aabb_min and aabb_max"),
        ({"aabb_min": [0, 0], "aabb_max": [1, 1, 1]}, "three numbers"),
        ({"aabb_min": [0, 2, 0], "aabb_max": [1, 1, 1]}, "aabb_min must be less than aabb_max"),
        ({"mesh_aabb_max": [0, 0, 0]}, "mesh_aabb_min"),
        ({"normals_smoothing_iters": 1001}, "normals_smoothing_iters"),
        ({"attributes_to_interpolate": {"a": np.zeros(3)}}, "the attribute `a` must have the shape"),
        ({"particles": np.zeros((4, 2))}, r"particles must have the shape \(N, 3\)"),
    ],
)
def test_wrong_arguments_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        compat.reconstruction_pipeline(**{"particles": lattice(4), **USUAL, **wrong})


def test_other_names_say_what_to_use():
    with pytest.raises(AttributeError, match="'SphInterpolator': give `attributes_to_interpolate`"):
        compat.SphInterpolator  # noqa: B018
    with pytest.raises(AttributeError, match="'nothing'$"):
        compat.nothing  # noqa: B018
    theirs = pytest.importorskip("pysplashsurf")
    missing = {name for name in dir(theirs) if not name.startswith("_") and not hasattr(compat, name)}
    assert missing - {"sys", "pysplashsurf"} == {*compat._INSTEAD}


def test_docstrings():
    for name in compat.__all__:
        value = getattr(compat, name)
        members = [member for member in vars(value).values() if inspect.isfunction(member) or isinstance(member, property)]
        for member in [value, *(m for m in members if not getattr(m, "__name__", "_").startswith("_"))]:
            assert len(inspect.getdoc(member) or "") > 20, (name, member)
    for function in (compat.reconstruct_surface, compat.reconstruction_pipeline, compat.check_mesh_consistency):
        text = inspect.getdoc(function)
        assert all(name in text for name in inspect.signature(function).parameters)


def test_page_has_an_example_and_every_argument(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    section = page.partition("### For users of pysplashsurf")[2].partition("\n## ")[0]
    pytest.importorskip("meshio")
    monkeypatch.chdir(tmp_path)
    exec(re.search(r"```python\n(.*?)```", section, re.DOTALL)[1], {"points": lattice(6, 0.05)})
    assert os.path.getsize("surface.vtk") > 1000
    missing = {*compat._INSTEAD, "vertex_vertex_connectivity"}
    for name in {*inspect.signature(compat.reconstruction_pipeline).parameters, "global_neighborhood_list"} | missing:
        assert f"`{name}`" in section, name


@pytest.mark.parametrize("name", ["reconstruct_surface", "reconstruction_pipeline", "check_mesh_consistency"])
def test_signatures(name):
    theirs = inspect.signature(getattr(pytest.importorskip("pysplashsurf"), name)).parameters
    mine = dict(inspect.signature(getattr(compat, name)).parameters)
    mine.pop("enable_multi_threading", None)
    assert [*mine] == [*theirs]
    for argument, parameter in theirs.items():
        assert mine[argument].kind == parameter.kind, argument
        # `grid` has no effect here, and may be left out.
        if argument != "grid":
            assert mine[argument].default == parameter.default, argument


@pytest.mark.parametrize("name", [name for name in compat.__all__ if name[0].isupper()])
def test_classes_have_the_members_that_callers_use(name):
    theirs = getattr(pytest.importorskip("pysplashsurf"), name)
    value = getattr(compat, name)
    fields = getattr(value, "__dataclass_fields__", {})
    mine = {member for member in [*dir(value), *fields] if not member.startswith("_")}
    missing = {member for member in dir(theirs) if not member.startswith("_")} - mine
    if name == "MeshType":
        assert missing <= {"name", "value"}
    else:
        # What the removed functions take.
        assert missing <= {"vertex_vertex_connectivity"}


@pytest.mark.parametrize("threshold", [0.4, 0.6, 0.8])
@pytest.mark.parametrize("shape", ["block", "ball", "irregular ball"])
def test_surfaces_are_close_to_those_of_pysplashsurf(shape, threshold):
    theirs = pytest.importorskip("pysplashsurf")
    particles = lattice(16, dtype=np.float64) if shape == "block" else ball()
    if shape == "irregular ball":
        particles = particles + np.random.default_rng(0).normal(0, 0.01, particles.shape)
    one, other = (
        module.reconstruct_surface(particles, **USUAL, iso_surface_threshold=threshold).mesh for module in (compat, theirs)
    )
    ratio = volume(one.vertices, one.triangles) / volume(other.vertices, other.triangles)
    assert ratio == pytest.approx(1.03, abs=0.03)
    for corner in (np.min, np.max):
        assert corner(one.vertices, axis=0) == pytest.approx(corner(other.vertices, axis=0), abs=0.015)
