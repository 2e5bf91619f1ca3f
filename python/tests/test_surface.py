"""Tests of surfaces: views, lifetimes, level sets, files and conversions."""

from __future__ import annotations

import base64
import gc
import io

import numpy as np
import pytest
from conftest import lattice

import pymeniscus as pm
from pymeniscus._native import format_names


def test_arrays_are_views_of_one_memory(surface):
    for name in ("vertices", "normals", "triangles"):
        one, other = getattr(surface, name), getattr(surface, name)
        assert one.ctypes.data == other.ctypes.data and one is not other
        assert not one.flags.owndata and not one.flags.writeable
        with pytest.raises(ValueError):
            one[0] = 0
        with pytest.raises(ValueError):
            one.flags.writeable = True
    assert surface.level_set.values.ctypes.data == surface.level_set.values.ctypes.data
    assert surface.level_set.origins.ctypes.data == surface.level_set.origins.ctypes.data


def test_attribute_arrays_are_views(block):
    made = pm.reconstruct(block, velocity=block, attributes={"id": np.arange(1000)}, spacing=0.1)
    assert made.velocities.ctypes.data == made.attributes["velocity"].ctypes.data
    assert not made.attributes["id"].flags.owndata and not made.attributes["id"].flags.writeable


def test_arrays_outlive_their_surface(block):
    made = pm.reconstruct(block, velocity=block, spacing=0.1)
    arrays = [made.vertices, made.triangles, made.normals, made.level_set.values, made.level_set.origins, made.velocities]
    copies = [array.copy() for array in arrays]
    del made
    gc.collect()
    for _ in range(3):
        pm.reconstruct(block * 1.1, spacing=0.1)
    assert all(np.array_equal(array, copy) for array, copy in zip(arrays, copies))


def test_dlpack_of_outputs(surface):
    try:
        taken = np.from_dlpack(surface.vertices)
    except BufferError:
        pytest.skip("this NumPy cannot export read-only arrays")
    assert taken.ctypes.data == surface.vertices.ctypes.data


def test_quads_and_loose_triangles_are_the_whole_mesh(surface):
    quads, loose = surface.quads, surface.loose_triangles
    assert quads.dtype == np.uint32 and quads.shape[1] == 4 and len(quads) > 100
    assert 2 * len(quads) + len(loose) == len(surface.triangles)

    def edges(faces):
        return {(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1))}

    directed = edges(surface.triangles)
    of_faces = edges(quads) | edges(loose)
    assert of_faces <= directed
    # The mesh is closed: each edge occurs in both directions.
    assert all((b, a) in of_faces for a, b in of_faces)


def test_level_set_agrees_with_the_mesh(surface):
    level_set = surface.level_set
    assert level_set.origins.shape == (len(level_set), 3) and (level_set.origins % 8 == 0).all()
    assert level_set.values.shape == (len(level_set), 8, 8, 8) and level_set.values.dtype == np.float32
    assert np.abs(level_set.values).max() <= level_set.half_width
    assert np.abs(level_set.sample(surface.vertices)).max() < 0.5
    outward = surface.vertices + surface.normals * level_set.voxel_size
    assert (level_set.sample(outward) > 0).mean() > 0.99


def test_dense_box_has_the_stored_values_and_signs_beyond(surface):
    level_set = surface.level_set
    values, least = level_set.dense()
    for origin, leaf in zip(level_set.origins, level_set.values):
        x, y, z = origin - least
        assert np.array_equal(values[x : x + 8, y : y + 8, z : z + 8], leaf)
    # The middle of the block is inside, and a corner of the box is outside.
    h = level_set.voxel_size
    inside, first = level_set.dense(([0.45] * 3, [0.5] * 3))
    assert inside.size and (inside < 0).all()
    assert np.allclose(np.array(first) * h, 0.45, atol=h)
    outside, _ = level_set.dense(([5.0] * 3, [5.2] * 3))
    assert (outside == level_set.half_width).all()
    empty, _ = level_set.dense(([1, 1, 1], [0, 0, 0]))
    assert empty.size == 0


def test_deep_inside_is_negative_where_no_leaf_is_stored():
    points = lattice(40, 0.1)
    level_set = pm.reconstruct(points, spacing=0.1).level_set
    assert level_set.sample([[2.0, 2.0, 2.0]])[0] == -level_set.half_width
    values, least = level_set.dense()
    middle = tuple((np.array([2.0] * 3) / level_set.voxel_size).round().astype(int) - least)
    assert values[middle] == -level_set.half_width
    assert values.size > level_set.values.size


def test_samples_at_voxels_are_their_values(surface):
    level_set = surface.level_set
    leaf = len(level_set) // 2
    voxels = level_set.origins[leaf] + np.array([[1, 2, 3], [7, 0, 5]])
    samples = level_set.sample(voxels * level_set.voxel_size)
    assert np.allclose(samples, [level_set.values[leaf, 1, 2, 3], level_set.values[leaf, 7, 0, 5]], atol=1e-4)
    assert np.isnan(level_set.sample([[np.nan, 0, 0], [np.inf, 0, 0]])).all()
    with pytest.raises(ValueError):
        level_set.dense(([0, 0, 0], [np.inf, 1, 1]))


def test_an_empty_surface_has_empty_arrays():
    with pytest.warns(UserWarning):
        made = pm.reconstruct(lattice(4), spacing=0.1, drop_islands=1000)
    assert made.vertices.shape == (0, 3) and made.triangles.shape == (0, 3) and made.quads.shape == (0, 4)
    assert made._repr_png_() is None and "0" in made._repr_html_()


@pytest.mark.parametrize("extension", format_names())
def test_every_format_is_written(block, tmp_path, extension):
    surface = pm.reconstruct(block, spacing=0.1, formats=[extension])
    path = tmp_path / f"surface.{extension}"
    surface.write(path, size=(64, 36))
    assert path.stat().st_size > 500
    before = path.read_bytes()
    surface.write(path, size=(64, 36))
    assert path.read_bytes() == before
    assert [found.name for found in tmp_path.iterdir()] == [path.name]


def test_formats_of_the_core_are_all_known(block, tmp_path):
    surface = pm.reconstruct(block, spacing=0.1, formats=format_names())
    for extension in format_names():
        surface.write(tmp_path / "surface", format=extension, size=(16, 16))


def test_write_options_have_an_effect(block, surface, tmp_path):
    def bytes_of(extension, **options):
        path = tmp_path / f"surface.{extension}"
        surface.write(path, **options)
        return path.read_bytes()

    assert bytes_of("glb") != bytes_of("glb", up="z")
    assert bytes_of("usda") != bytes_of("usda", meters_per_unit=0.01)
    assert len(bytes_of("vdb", vdb="half")) < len(bytes_of("vdb"))
    assert len(bytes_of("vdb", vdb="none")) > len(bytes_of("vdb"))
    assert bytes_of("png", size=(64, 36)) != bytes_of("png", size=(64, 36), camera="azimuth=90")


@pytest.mark.parametrize(
    ("name", "options", "error", "text"),
    [
        ("surface", {}, ValueError, "no extension"),
        ("surface.docx", {}, ValueError, "unknown format `docx`"),
        ("surface.glb", {"up": "x"}, ValueError, "up is `x`"),
        ("surface.usda", {"meters_per_unit": 0}, ValueError, "meters_per_unit is 0"),
        ("surface.vdb", {"vdb": "lzma"}, ValueError, "vdb: `lzma` is unknown"),
        ("surface.png", {"size": (1, 1)}, ValueError, "size is 1 × 1; both must be from 16 to 8192"),
        ("surface.png", {"size": (-1, 64)}, ValueError, "from 16 to 8192"),
        ("surface.png", {"size": "64x64"}, TypeError, "size must be two integers"),
        ("surface.png", {"size": (64,)}, TypeError, "size must be two integers"),
        ("surface.png", {"size": (64.5, 64)}, TypeError, "size must be two integers"),
        ("surface.png", {"camera": None}, TypeError, "camera must be text, not NoneType"),
        ("surface.glb", {"up": None}, TypeError, "up must be text"),
        ("surface.glb", {"format": 3}, TypeError, "format must be text, not int"),
        ("surface.png", {"camera": "azimut=3"}, ValueError, "camera"),
        ("none/surface.glb", {}, FileNotFoundError, "none"),
    ],
)
def test_write_errors(surface, tmp_path, name, options, error, text):
    with pytest.raises(error, match=text):
        surface.write(tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("box", [5, (1, 2), ((0, 0, 0), (1, 1)), [[0] * 3, [1] * 3, [2] * 3], ((0, 0, 0),), "ab", {}])
def test_invalid_boxes_are_refused(surface, box):
    with pytest.raises(ValueError, match="two corners of three finite numbers"):
        surface.level_set.dense(box)


@pytest.mark.parametrize("extension", ["glb", "jpg"])
def test_pictures_have_picture_formats(surface, extension):
    with pytest.raises(ValueError, match=f"format is `{extension}`; it must be png or exr"):
        surface.render(format=extension)


def test_attributes_that_a_file_lacks_are_warned_about(block, tmp_path):
    made = pm.reconstruct(block, velocity=block, spacing=0.1)
    with pytest.warns(UserWarning, match="formats="):
        made.write(tmp_path / "surface.vdb")
    prepared = pm.reconstruct(block, velocity=block, spacing=0.1, formats="vdb")
    prepared.write(tmp_path / "with.vdb")
    assert (tmp_path / "with.vdb").stat().st_size > (tmp_path / "surface.vdb").stat().st_size


def test_notebooks_get_a_picture(surface):
    assert surface._repr_png_().startswith(b"\x89PNG")
    html = surface._repr_html_()
    assert "data:image/png;base64," in html and "holds" in html
    assert surface.render(format="exr", size=(32, 32))[:4] == b"\x76\x2f\x31\x01"


def test_notebooks_render_the_picture_once(block, monkeypatch):
    made, calls = pm.reconstruct(block, spacing=0.1), []
    render = pm.Surface.render
    monkeypatch.setattr(pm.Surface, "render", lambda self, **options: calls.append(1) or render(self, **options))
    assert base64.b64encode(made._repr_png_()).decode() in made._repr_html_()
    assert calls == [1]


def test_trimesh(surface):
    pytest.importorskip("trimesh")
    mesh = surface.to_trimesh()
    assert mesh.is_watertight and mesh.volume > 0
    assert abs(mesh.volume - surface.report["volume"]) < 1e-3 * mesh.volume


def test_pyvista(surface):
    pytest.importorskip("pyvista")
    mesh = surface.to_pyvista()
    assert mesh.n_points == len(surface.vertices) and mesh.is_manifold


def test_open3d(surface):
    # Its import fails without some libraries of the system.
    pytest.importorskip("open3d", exc_type=ImportError)
    assert surface.to_open3d().is_watertight()


def test_blender(block):
    bpy = pytest.importorskip("bpy")
    number = np.arange(1000)
    attributes = {"id": number, "huge": number * 0 + np.iinfo(np.int64).min, "word": np.full(1000, "water"),
                  "pair": block[:, :2], "color4": np.ones((1000, 4)), "five": np.ones((1000, 5)),
                  "position": block, "sharp_face": block[:, 0]}  # fmt: skip
    surface = pm.reconstruct(block, velocity=block, attributes=attributes, spacing=0.1)
    with pytest.warns(UserWarning, match="left out") as caught:
        mesh = surface.to_blender("fluid")
    assert [str(warning.message).split("`")[1] for warning in caught] == ["huge", "word", "five"]
    assert {warning.filename for warning in caught} == {__file__}
    assert len(mesh.vertices) == len(surface.vertices) and len(mesh.polygons) == len(surface.triangles)
    assert not mesh.validate()

    for name, stored, member, dtype in (
        ("velocity", "velocity", "vector", np.float32),
        ("pair", "pair", "vector", np.float32),
        ("color4", "color4", "color", np.float32),
        ("position", "_position", "vector", np.float32),
        ("sharp_face", "_sharp_face", "value", np.float32),
        ("id", "id", "value", np.int32),
    ):
        expected = surface.attributes[name].reshape(-1)
        found = np.empty(len(expected), dtype)
        mesh.attributes[stored].data.foreach_get(member, found)
        assert np.array_equal(found, expected), name
    assert np.array_equal([vertex.co[:] for vertex in mesh.vertices], surface.vertices)
    again = pm.reconstruct(block[:500], spacing=0.1).to_blender("fluid")
    assert again == mesh and "velocity" not in mesh.attributes and bpy.data.meshes["fluid"] == mesh


def test_repr(surface):
    assert "vertices" in repr(surface) and "holds" in repr(surface.certificate) and "leaves" in repr(surface.level_set)


def test_numpy_can_save_views(surface):
    buffer = io.BytesIO()
    np.save(buffer, surface.vertices)
    assert np.array_equal(np.load(io.BytesIO(buffer.getvalue())), surface.vertices)


def test_small_pieces_are_spray():
    drops = np.array([[0, 0, 3], [1, 0, 3], [1.1, 0, 3]], np.float32)
    points = np.concatenate([drops, lattice(6)])
    heat = np.arange(len(points), dtype=np.float32)
    made = pm.reconstruct(points, attributes={"heat": heat}, spacing=0.1, spray=20)
    assert made.certificate.holds and made.report["particles"] == 216 and made.vertices[:, 2].max() < 1
    assert made.report["spray"] == {"particles": 3, "drops": 1, "clusters": 1, "filaments": 0}
    assert np.array_equal(made.spray.positions, drops) and made.spray["heat"].tolist() == [0, 1, 2]
    assert list(made.spray["spray_class"]) == [0, 1, 1]
    assert np.allclose(4 / 3 * np.pi * made.spray["radius"] ** 3, 0.1**3, rtol=1e-5)
    without = pm.reconstruct(points[3:], spacing=0.1)
    assert np.array_equal(made.vertices, without.vertices) and without.spray is None
    with pytest.raises(pm.OptionError, match="each frame alone decides"):
        pm.reconstruct(points, spacing=0.1, spray=20, spray_keep=3)
