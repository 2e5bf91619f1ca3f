"""Tests of reconstruction: all kinds of inputs, options, errors, threads and progress."""

from __future__ import annotations

import ctypes
import os
import platform
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import lattice

import pymeniscus as pm


def same(one: pm.Surface, other: pm.Surface) -> bool:
    return (
        one.vertices.tobytes() == other.vertices.tobytes()
        and one.triangles.tobytes() == other.triangles.tobytes()
        and one.level_set.values.tobytes() == other.level_set.values.tobytes()
    )


def test_block_has_a_valid_surface(surface):
    assert surface.certificate.holds and surface.certificate.violations == ""
    assert surface.vertices.dtype == np.float32 and surface.vertices.shape[1] == 3
    assert surface.triangles.dtype == np.uint32 and surface.triangles.max() == len(surface.vertices) - 1
    assert surface.normals.shape == surface.vertices.shape
    assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-4)
    assert surface.report["particles"] == 1000 and surface.report["triangles"] == len(surface.triangles)
    assert 0.9 < surface.vertices.max() < 1.15
    assert surface.origin == (0, 0, 0)


@pytest.mark.parametrize("layout", ["fortran", "every second", "reversed", "columns of a wider array", "read-only"])
def test_strides_do_not_matter(block, surface, layout):
    if layout == "fortran":
        points = np.asfortranarray(block)
    elif layout == "every second":
        points = np.repeat(block, 2, axis=0)[::2]
    elif layout == "reversed":
        points = block[::-1].copy()[::-1]
    elif layout == "columns of a wider array":
        points = np.concatenate([block, block], axis=1)[:, :3]
    else:
        points = block.copy()
        points.flags.writeable = False
    assert same(pm.reconstruct(points, spacing=0.1), surface)


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8", np.float16, np.int32, np.uint8])
def test_number_types(dtype):
    points = lattice(5, 1.0).astype(dtype)
    native = np.float32 if np.dtype(dtype).kind == "f" and np.dtype(dtype).itemsize <= 4 else np.float64
    assert same(pm.reconstruct(points, spacing=1.0), pm.reconstruct(lattice(5, 1.0, native), spacing=1.0))


def test_float64_keeps_its_precision():
    points = lattice(5, 0.1, np.float64)
    assert not np.array_equal(points, points.astype(np.float32))
    far = points + 1e6
    made = pm.reconstruct(far, spacing=0.1)
    assert made.certificate.holds
    assert np.allclose(np.asarray(made.origin) + made.vertices.astype(float).mean(axis=0), far.mean(axis=0), atol=0.05)


def test_lists_and_buffers(block, surface):
    assert same(pm.reconstruct(block.tolist(), spacing=0.1), pm.reconstruct(block.astype(float), spacing=0.1))
    assert same(pm.reconstruct(memoryview(block), spacing=0.1), surface)


class OnlyDlpack:
    def __init__(self, array, device=None):
        self.array, self.device = array, device

    def __dlpack__(self, **keywords):
        return self.array.__dlpack__(**keywords)

    def __dlpack_device__(self):
        return self.device or self.array.__dlpack_device__()


class OnlyInterface:
    def __init__(self, array):
        self.array = array
        self.__array_interface__ = array.__array_interface__


class OnlyArray:
    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return self.array


@pytest.mark.parametrize("wrap", [OnlyDlpack, OnlyInterface, OnlyArray])
def test_protocols_share_memory(block, surface, wrap):
    from pymeniscus._arrays import as_points

    wrapped = wrap(block)
    assert np.shares_memory(as_points(wrapped), block)
    assert same(pm.reconstruct(wrapped, spacing=0.1), surface)


def test_torch_tensor_is_not_copied(block, surface):
    torch = pytest.importorskip("torch")
    from pymeniscus._arrays import as_points

    tensor = torch.from_numpy(block)
    assert as_points(tensor).ctypes.data == tensor.data_ptr()
    assert same(pm.reconstruct(tensor, spacing=0.1), surface)


def test_warp_array_is_not_copied(block, surface):
    warp = pytest.importorskip("warp")
    from pymeniscus._arrays import as_points

    array = warp.array(block, dtype=warp.vec3, device="cpu")
    assert as_points(array).ctypes.data == array.ptr
    assert same(pm.reconstruct(array, spacing=0.1), surface)


@pytest.mark.parametrize("device_type", [2, 4, 7, 8, 10, 14])
def test_device_arrays_are_refused(block, device_type):
    with pytest.raises(TypeError, match="memory of a device"):
        pm.reconstruct(OnlyDlpack(block, (device_type, 0)))


@pytest.mark.parametrize("device_type", [1, 3, 11, 13])
def test_memory_that_the_processor_reads_is_not_copied(block, device_type):
    from pymeniscus._arrays import as_points

    assert as_points(OnlyDlpack(block, (device_type, 0))).ctypes.data == block.ctypes.data


class RecordsGradients:
    """A tensor of PyTorch with ``requires_grad``."""

    def __dlpack__(self, **keywords):
        raise BufferError("Can't export tensors that require gradient, use tensor.detach()")

    def __dlpack_device__(self):
        return (1, 0)

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead.")


def test_tensors_that_record_gradients_are_refused(block):
    with pytest.raises(TypeError, match=r"points cannot be read as an array.*detach\(\)"):
        pm.reconstruct(RecordsGradients())
    torch = pytest.importorskip("torch")
    with pytest.raises(TypeError, match="detach"):
        pm.reconstruct(torch.from_numpy(block).requires_grad_())


def test_masked_values_are_refused(block, surface):
    masked = np.ma.masked_array(block, mask=False)
    assert same(pm.reconstruct(masked, spacing=0.1), surface)
    with pytest.raises(TypeError, match="velocity has masked values"):
        pm.reconstruct(block, velocity=np.ma.masked_less(block, 0.1), spacing=0.1)
    masked[0, 0] = np.ma.masked
    with pytest.raises(TypeError, match="points has masked values"):
        pm.reconstruct(masked, spacing=0.1)
    with pytest.raises(TypeError, match="`a` has masked values"):
        pm.reconstruct(block, attributes={"a": masked[:, 0]}, spacing=0.1)


@pytest.mark.parametrize(
    ("points", "error", "text"),
    [
        (np.zeros((4, 2)), ValueError, r"shape \(N, 3\), not \(4, 2\)"),
        (np.zeros(6), ValueError, r"shape \(N, 3\)"),
        (np.zeros((2, 3), complex), TypeError, "real numbers, not complex128"),
        (np.array([["a", "b", "c"]]), TypeError, "real numbers"),
        ("particles.ply", TypeError, "points"),
        (Path("particles.ply"), TypeError, r"pymeniscus.read\('particles.ply'\)"),
        (np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4")]), TypeError, "real numbers"),
        (np.zeros((0, 2)), ValueError, r"shape \(N, 3\), not \(0, 2\)"),
        ([pm.Particles(np.zeros((4, 3)))], ValueError, r"shape \(N, 3\)"),
        (np.zeros((2, 3), "M8[s]"), TypeError, "real numbers"),
        (None, TypeError, "points"),
        (np.zeros((0, 3)), pm.ParticleError, "no particles"),
        ([], pm.ParticleError, "no particles"),
        (np.zeros((3, 5)), ValueError, r"shape \(N, 3\), not \(3, 5\): pass the transpose, `points.T`"),
        (np.zeros((3, 4)), ValueError, r"not \(3, 4\)$"),
        (np.zeros((4, 3), bool), TypeError, "points must be real numbers, not bool"),
        (np.full((4, 3), np.nan), pm.ParticleError, "none of the 4 positions is finite"),
    ],
)
def test_invalid_points_are_refused(points, error, text):
    with pytest.raises(error, match=text):
        pm.reconstruct(points)


def test_positions_that_are_not_finite_are_left_out(block):
    points = np.concatenate([block, [[np.nan, 0, 0], [np.inf, 0, 0]]]).astype(np.float32)
    with pytest.warns(UserWarning):
        made = pm.reconstruct(points, spacing=0.1)
    assert made.report["dropped"] == 2 and made.warnings
    for call in (pm.reconstruct, pm.Sequence(spacing=0.1).reconstruct, pm.Sequence):
        with pytest.raises(pm.ParticleError, match="none of the 2 positions is finite"):
            call(points[-2:], **({"spacing": 0.1} if call == pm.reconstruct else {}))


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"voxelsize": 1}, TypeError, "did you mean `voxel_size`"),
        ({"voxel_size": "wide"}, pm.OptionError, "voxel_size.*not a voxel size.*such as 0.4d$"),
        ({"voxel_size": "5h"}, pm.OptionError, "voxel_size.*not a voxel size.*such as 0.4d$"),
        ({"blend": "wide"}, pm.OptionError, "blend.*not a length.*such as 5h$"),
        ({"decimate": 3}, pm.OptionError, "decimate is 3; it must be from 0 to 1"),
        ({"preset": "foam"}, pm.OptionError, "expected one of fluid"),
        ({"steps": -1}, pm.OptionError, "steps.*whole number"),
        ({"quads": "maybe"}, pm.OptionError, "`quads`: must be True or False, not 'maybe'"),
        ({"quads": 1}, pm.OptionError, "`quads`: must be True or False, not 1"),
        ({"clip": [1, 2, 3]}, pm.OptionError, "clip"),
        ({"preset": "paper", "radius_ratio": float("nan")}, pm.OptionError, "."),
        ({"threads": 0}, ValueError, "1 to 1024"),
        ({"threads": -1}, ValueError, "1 to 1024, not -1"),
        ({"threads": 10**30}, ValueError, "1 to 1024"),
        ({"threads": 2.5}, TypeError, "threads must be an integer, not float"),
        ({"memory": "lots"}, ValueError, "8GiB"),
        ({"memory": 0}, ValueError, "positive"),
        ({"memory": float("nan")}, ValueError, "memory must be a positive number of bytes"),
        ({"memory": 2**70}, ValueError, "memory must be a positive number of bytes"),
        ({"memory": []}, TypeError, "memory must be a number of bytes or text, not list"),
        ({"formats": None}, TypeError, "formats must be extensions"),
        ({"formats": [3]}, TypeError, "formats must be extensions"),
        ({"progress": 5}, TypeError, "progress must be a function, not int"),
        ({"obstacle": "ship.obj"}, TypeError, "did you mean `obstacles`"),
        ({"velocities": [[0, 0, 0]]}, TypeError, "did you mean `velocity`"),
        ({"memory": "1KiB"}, pm.MemoryLimitError, "limit"),
        ({"formats": ["docx"]}, ValueError, "unknown format `docx`"),
        ({"radius_attribute": "pscale"}, pm.ParticleError, "pscale"),
        ({"anisotropy": "velocity"}, pm.ParticleError, "velocity"),
    ],
)
def test_errors(block, options, error, text):
    with pytest.raises(error, match=text):
        pm.reconstruct(block, **{"spacing": 0.1, **options})


def test_errors_have_the_usual_classes():
    assert issubclass(pm.OptionError, ValueError) and issubclass(pm.MemoryLimitError, MemoryError)
    for error in (pm.OptionError, pm.ParticleError, pm.MemoryLimitError, pm.FormatError, pm.CommandError):
        assert issubclass(error, pm.MeniscusError)


def test_every_option_changes_something_or_is_refused(block):
    """No option is ignored: each is in the settings of the surface, and a preset changes them."""
    values = {"number": 0.5, "count": 3, "switch": True, "length": "2h"}
    special = {"preset": "splash", "radius_min": "1.2d", "radius_ratio": 2.5, "blend": "2.5d", "spacing": 0.1,
               "voxel_size": "0.5d", "clip": (0, 0, 0, 0.5, 0.5, 0.5), "radius_attribute": "r", "max_stretch": 3.0,
               "neighbor_radius": "3d", "offset": "0.1h",
               "step_size": 1.0, "fill_cavities": 4.0, "columns": "x=a", "where": "r > 0", "rest_period": 4}  # fmt: skip
    needs = {"radius_min": {"preset": "paper"}, "radius_ratio": {"preset": "paper"}, "radius_scale": {"radius_attribute": "r"},
             "velocity_gain": {"anisotropy": "velocity"}}  # fmt: skip
    attributes = {"r": np.full(1000, 0.07, np.float32)}
    velocity = np.ones((1000, 3), np.float32)
    far = pm.Obstacle([[9, 9, 9], [9, 10, 9], [10, 9, 9], [9, 9, 10]], [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    for info in pm.option_table():
        value = special.get(info.name, info.choices[-1] if info.choices else values.get(info.kind))
        assert value is not None, info.name
        options = {"spacing": 0.1, **needs.get(info.name, {}), info.name: value}
        if info.name == "void_threshold":
            options["obstacles"] = far
        if info.name == "columns":
            with pytest.raises(pm.OptionError, match="columns are of tables in files"):
                pm.reconstruct(block, **options)
            continue
        if info.name == "spray_keep":
            with pytest.raises(pm.OptionError, match="each frame alone decides"):
                pm.reconstruct(block, **{**options, "spray": 20})
            continue
        if info.name in ("rest", "rest_period"):
            with pytest.raises(pm.OptionError, match="`rest` needs the frames before a frame"):
                pm.reconstruct(block, **{**options, "rest": 4})
            continue
        if info.name in ("temporal", "time_step"):
            with pytest.raises(pm.OptionError, match="`temporal` averages the frames of a sequence"):
                pm.reconstruct(block, velocity=velocity, **{**options, "temporal": 1})
            continue
        made = pm.reconstruct(block, attributes=attributes, velocity=velocity, **options)
        if info.name == "preset":
            assert made.settings != pm.reconstruct(block, spacing=0.1).settings
        else:
            assert info.name in made.settings, info.name


def test_auto_becomes_the_preset_that_suits_the_particles(block):
    wild = np.random.default_rng(7).random((1000, 3))
    for points, preset in ((block, "fluid"), (wild, "noisy")):
        made = pm.reconstruct(points, preset="auto", spacing=0.1)
        assert made.settings["preset"] == preset
        assert made.settings == pm.reconstruct(points, preset=preset, spacing=0.1).settings
    # All frames of a sequence have the preset of its first.
    sequence = pm.Sequence(preset="auto", spacing=0.1)
    assert [sequence.reconstruct(points).settings["preset"] for points in (wild, block)] == ["noisy", "noisy"]
    assert pm.reconstruct(wild, preset="mpm", spacing=0.1).settings["preset"] == "noisy"


def test_presets_that_do_not_suit_the_particles_are_warned_about(block):
    wild = np.random.default_rng(7).random((1000, 3))
    sheet = {"is_flat": (np.arange(1000) < 100).astype(np.int32)}
    unsuitable = r'irregularity \d+ %.*; use `preset="noisy"`, or give `preset="fluid"` if splashes matter more$'
    for points, options, text in (
        (wild, {}, unsuitable),
        (block, {"preset": "auto", "where": "is_flat == 1"}, "too few particles are surrounded.*: the preset is fluid$"),
        (block[:100], {"preset": "auto", "spacing": 0.1}, "too few particles"),
    ):
        with pytest.warns(UserWarning, match=text) as caught:
            made = pm.reconstruct(points, attributes=sheet if "where" in options else None, **options)
        assert {warning.filename for warning in caught} == {__file__}
        assert [str(warning.message) for warning in caught] == list(made.warnings)
    sequence = pm.Sequence()
    with pytest.warns(UserWarning, match=unsuitable) as caught:
        sequence.reconstruct(wild)
    assert {warning.filename for warning in caught} == {__file__}
    with pytest.warns(UserWarning, match=unsuitable):
        pm.Sequence(wild)
    # A preset or a spacing was chosen, or the default suits.
    for options in ({"preset": "fluid"}, {"preset": "auto"}, {"spacing": 0.1}):
        assert not any("irregular" in warning for warning in pm.reconstruct(wild, **options).warnings)
    assert pm.reconstruct(block).warnings == ()


def test_radii_make_drops_of_different_sizes():
    points = np.array([[0, 0, 0], [10, 0, 0]], np.float32)
    made = pm.reconstruct(points, radii=[0.5, 1.0], spacing=1.0, voxel_size=0.2, anisotropy="none", position_smoothing=0)
    right = made.vertices[:, 0] > 5
    small, large = (np.ptp(made.vertices[side], axis=0) for side in (~right, right))
    assert (large > 1.5 * small).all()
    assert made.settings["radius_attribute"] == "radius"
    with pytest.raises(ValueError, match="radii must have the shape"):
        pm.reconstruct(points, radii=[1.0])


def test_only_chosen_particles_form_the_surface(block):
    phase = np.where(block[:, 0] < 0.5, "fluid", "wall")
    is_fluid = phase == "fluid"
    alone = pm.reconstruct(block[is_fluid], radii=np.full(is_fluid.sum(), 0.05), attributes={"phase": phase[is_fluid]})
    every = {"radii": np.full(1000, 0.05), "attributes": {"phase": phase}}
    by_mask = pm.reconstruct(block, where=is_fluid, **every)
    by_condition = pm.reconstruct(block, where="phase == fluid", **every)
    in_sequence = pm.Sequence(where="phase == fluid").reconstruct(block, **every)
    of_sequence = pm.Sequence().reconstruct(block, where=list(is_fluid), **every)
    for made in (by_mask, by_condition, in_sequence, of_sequence):
        assert np.array_equal(made.vertices, alone.vertices) and np.array_equal(made.triangles, alone.triangles)
        assert np.array_equal(made.attributes["phase"], alone.attributes["phase"])
    assert by_condition.settings["where"] == "phase == fluid" and "where" not in by_mask.settings
    particles = pm.Particles(block, {"phase": phase}, path="a.ply", file_hash="0" * 32)
    assert pm.reconstruct(particles, where=is_fluid)._source is None
    assert pm.reconstruct(particles, where="phase != wall")._source is not None
    for where, error, text in [
        ("mk == 1", pm.ParticleError, r'`where` "mk == 1": the particles have no attribute `mk`; available: phase'),
        ("phase = 1", pm.OptionError, "expected .* at character 7, found `=`"),
        ("phase == oil", pm.ParticleError, "none of the 1000 particles meets `phase == oil`"),
        (is_fluid[1:], ValueError, r"where must have the shape \(1000,\), not \(999,\)"),
        (np.arange(1000), TypeError, "where must be a condition as text, or an array of truth values"),
    ]:
        with pytest.raises(error, match=text):
            pm.reconstruct(block, attributes={"phase": phase}, where=where)
    with pytest.raises(TypeError, match="only `reconstruct` takes a mask"):
        pm.Sequence(where=is_fluid)


def test_attributes_reach_the_vertices(block):
    velocity = np.tile([1.0, 2.0, 3.0], (1000, 1))
    ids = np.arange(1000, dtype=np.int64)
    words = np.where(block[:, 0] < 0.5, "water", "oil")
    made = pm.reconstruct(
        block, velocity=velocity, attributes={"height": block[:, 2], "id": ids, "phase": words}, spacing=0.1
    )
    assert set(made.attributes) == {"velocity", "height", "id", "phase"}
    assert np.allclose(made.velocities, [1, 2, 3], atol=1e-5)
    assert made.attributes["height"].dtype == np.float32 and made.attributes["height"].shape == (len(made.vertices),)
    assert np.abs(made.attributes["height"] - made.vertices[:, 2]).max() < 0.3
    assert made.attributes["id"].dtype == np.int64 and set(made.attributes["id"]) <= set(ids.tolist())
    assert set(made.attributes["phase"]) <= {"water", "oil"} and len(set(made.attributes["phase"])) == 2
    left = made.vertices[:, 0] < 0.3
    assert set(made.attributes["phase"][left]) == {"water"}
    particles = pm.Particles(block, {"height": block[:, 2]})
    assert list(pm.reconstruct(block, attributes=particles, spacing=0.1).attributes) == ["height"]


def ball(radius: float, spacing: float) -> np.ndarray:
    """Particles on a lattice in a ball around the origin."""
    points = lattice(2 * int(radius / spacing) + 1, spacing, np.float64)
    points -= points.mean(axis=0)
    return points[np.linalg.norm(points, axis=1) <= radius]


def test_speed_and_vorticity_are_computed(block):
    # A constant velocity has its length everywhere, and does not turn.
    made = pm.reconstruct(block, velocity=np.tile([2.0, -3.0, 6.0], (1000, 1)), attributes="speed,vorticity", spacing=0.1)
    assert set(made.attributes) == {"velocity", "speed", "vorticity"}
    assert np.allclose(made.attributes["speed"], 7, rtol=1e-5) and np.abs(made.attributes["vorticity"]).max() < 1e-4
    # A rotation of 3 radians per second turns with twice that. The option scales both.
    points, axis = block + 0.02 * np.sin(np.arange(3000)).reshape(-1, 3), np.array([1.0, -2.0, 2.0])
    velocity = np.cross(axis, points)
    for scale, source in (
        (1.0, {"points": points, "velocity": velocity, "attributes": ["Speed", "vorticity"]}),
        (2.0, {"points": points, "attributes": {"v": velocity, "vorticity": None, "speed": None}}),
        (0.5, {"points": pm.Particles(points, {"v": velocity}), "attributes": "speed,vorticity"}),
    ):
        made = pm.reconstruct(**source, velocity_scale=scale, spacing=0.1)
        assert np.allclose(made.attributes["vorticity"], 6 * scale, rtol=2e-3)
        # Means over the particles around a vertex, half a spacing deeper.
        expected = scale * np.linalg.norm(np.cross(axis, made.vertices), axis=1)
        assert np.abs(made.attributes["speed"] - expected).max() < 3 * scale * 0.1
    # Each frame of a sequence, and particles that a mask chooses.
    sequence, still = pm.Sequence(spacing=0.1), np.zeros(1000, bool)
    still[:500] = True
    velocity = np.where(still[:, None], 0.0, [[0.0, 3.0, 4.0]])
    made = sequence.reconstruct(block, velocity=velocity, attributes="speed", where=~still)
    assert np.allclose(made.attributes["speed"], 5, rtol=1e-5)
    averaged = pm.Sequence(spacing=0.1, temporal=1, time_step=0.01).averaged(
        {"points": block, "velocity": np.full((1000, 3), float(frame)), "attributes": "speed"} for frame in range(3)
    )
    for frame, made in enumerate(averaged):
        assert np.allclose(made.attributes["speed"], frame * 3**0.5, rtol=1e-5)


@pytest.mark.parametrize("radius", [0.5, 1.0])
def test_curvature_is_that_of_the_mesh(radius):
    """Of a ball, 1/r; of a cavity, -1/r. The preset is so smooth that the particles' lattice has no effect."""
    solid = ball(radius, 0.05)
    made = pm.reconstruct(solid, attributes="normal_curvature", spacing=0.05, preset="noisy")
    assert list(made.attributes) == ["normal_curvature"] and made.attributes["normal_curvature"].dtype == np.float32
    found = np.median(made.attributes["normal_curvature"])
    mean_radius = np.linalg.norm(made.vertices, axis=1).mean()
    assert abs(found * mean_radius - 1) < 0.1, found
    outside = lattice(int(2.4 * radius / 0.05), 0.05, np.float64)
    outside -= outside.mean(axis=0)
    outside = outside[np.linalg.norm(outside, axis=1) > radius]
    made = pm.reconstruct(outside, attributes={"normal_curvature": None}, spacing=0.05, preset="noisy")
    distances = np.linalg.norm(made.vertices, axis=1)
    is_cavity = distances < 1.05 * radius
    found = np.median(made.attributes["normal_curvature"][is_cavity])
    assert abs(found * distances[is_cavity].mean() + 1) < 0.1, found


def test_attributes_that_cannot_be_computed(block):
    for source in ({"points": block}, {"points": pm.Particles(block)}, {"points": block, "velocity": None}):
        with pytest.warns(UserWarning, match="^`vorticity` is not computed: the particles have no velocities$") as caught:
            made = pm.reconstruct(**source, attributes="vorticity", spacing=0.1)
        assert len(caught) == 1 and caught[0].filename == __file__ and not made.attributes
    given = np.arange(1000, dtype=np.float32)
    # Attributes of the particles take precedence.
    for name in ("Speed", "vorticity", "normal_curvature"):
        for source in (
            {"points": block, "velocity": np.ones((1000, 3)), "attributes": {name: given}},
            {"points": pm.Particles(block, {name: given, "v": np.ones((1000, 3))}), "attributes": name},
        ):
            made = pm.reconstruct(**source, spacing=0.1)
            assert made.attributes[name].max() > 900 and not made.warnings
    with pytest.raises(TypeError, match="`heat` is not an array of numbers but NoneType"):
        pm.reconstruct(block, attributes={"mass": given, "heat": None}, spacing=0.1)
    # "all" includes none of them, as in the command.
    assert list(pm.reconstruct(block, velocity=np.ones((1000, 3)), attributes="all", spacing=0.1).attributes) == ["velocity"]


@pytest.mark.parametrize(
    ("keywords", "error"),
    [
        ({"velocity": np.zeros((3, 3))}, ValueError),
        ({"attributes": {"a": np.zeros(3)}}, ValueError),
        ({"attributes": {"a": np.zeros((1000, 0))}}, ValueError),
        ({"attributes": {"a": np.zeros(1000, complex)}}, TypeError),
        ({"attributes": {"a": np.full(1000, 2**64 - 1, np.uint64)}}, ValueError),
        ({"attributes": ["a"]}, TypeError),
        ({"attributes": "a,normal_curvature"}, TypeError),
        ({"attributes": {"a": None}}, TypeError),
        ({"attributes": {3: np.zeros(1000)}}, TypeError),
        ({"attributes": 3}, TypeError),
        ({"attributes": [3]}, TypeError),
        ({"velocity": np.full((1000, 3), "fast")}, TypeError),
        ({"radii": np.full(1000, "wide")}, TypeError),
        ({"radii": np.full(1000, 1j)}, TypeError),
        ({"radii": np.full(1000, True)}, TypeError),
    ],
)
def test_attributes_that_do_not_fit(block, keywords, error):
    with pytest.raises(error):
        pm.reconstruct(block, spacing=0.1, **keywords)


def test_threads_do_not_change_bytes(block, surface):
    assert same(pm.reconstruct(block, spacing=0.1, threads=1), surface)
    assert same(pm.reconstruct(block, spacing=0.1, threads=3), surface)


@pytest.mark.skipif(platform.machine() != "x86_64" or platform.libc_ver()[0] != "glibc", reason="knows one fenv_t")
def test_floating_point_mode_of_the_caller_does_not_change_bytes(block, surface):
    # Denormal numbers of float64: 1e-310 has no float32, and 1e-40 is a denormal number there as well.
    points = np.where(block == 0, 1e-310, block.astype(np.float64))
    tiny = {"tiny": np.full(len(block), 1e-40)}
    denormal = pm.reconstruct(points, spacing=0.1, attributes=tiny)
    assert np.allclose(denormal.attributes["tiny"], np.float32(1e-40), rtol=1e-3, atol=0)
    assert same(denormal, pm.reconstruct(block.astype(np.float64), spacing=0.1))
    # Taichi and programs linked with -ffast-math flush denormals to zero, and new threads inherit the mode.
    libm, saved = ctypes.CDLL("libm.so.6"), (ctypes.c_uint32 * 8)()
    libm.fegetenv(saved)
    flushing = type(saved)(*saved)
    flushing[7] |= 0x8040
    try:
        libm.fesetenv(flushing)
        assert np.float32(1e-40) * np.float32(0.5) == 0
        made = [pm.reconstruct(block, spacing=0.1, threads=threads) for threads in (5, None)]
        flushed = pm.reconstruct(points, spacing=0.1, attributes=tiny)
    finally:
        libm.fesetenv(saved)
    assert all(same(one, surface) for one in made) and same(flushed, denormal)
    assert flushed.attributes["tiny"].tobytes() == denormal.attributes["tiny"].tobytes()


def test_several_threads_at_once(block, surface):
    made = [None] * 4

    def work(index):
        made[index] = pm.reconstruct(block, spacing=0.1)

    workers = [threading.Thread(target=work, args=(index,)) for index in range(4)]
    [worker.start() for worker in workers]
    [worker.join() for worker in workers]
    assert all(same(one, surface) for one in made)


def test_other_threads_run_during_a_call():
    points = np.random.default_rng(0).random((200_000, 3), dtype=np.float32)
    seconds = []

    def work():
        start = time.perf_counter()
        pm.reconstruct(points, preset="noisy", velocity=points, steps=8)
        seconds.append(time.perf_counter() - start)

    worker = threading.Thread(target=work)
    worker.start()
    gaps, last = [], time.perf_counter()
    while worker.is_alive():
        time.sleep(0.001)
        now = time.perf_counter()
        gaps.append(now - last)
        last = now
    # If the call held the interpreter's lock, one gap would be nearly as long as the call.
    assert max(gaps) < 0.3 * seconds[0], (max(gaps), seconds[0])


def test_one_sequence_from_several_threads(block, surface):
    sequence = pm.Sequence(spacing=0.1)
    made = []
    workers = [threading.Thread(target=lambda: made.append(sequence.reconstruct(block))) for _ in range(4)]
    [worker.start() for worker in workers]
    [worker.join() for worker in workers]
    assert len(made) == 4 and all(same(one, surface) for one in made)


def test_progress_is_reported_in_order_on_the_thread_of_the_caller(block):
    calls = []
    pm.reconstruct(block, spacing=0.1, progress=lambda phase, part: calls.append((phase, part, threading.get_ident())))
    phases = [phase for phase, _, _ in calls]
    assert list(dict.fromkeys(phases)) == ["prepare", "rasterize", "smooth", "contour"]
    assert all(0 <= part <= 1 for _, part, _ in calls)
    assert {ident for _, _, ident in calls} == {threading.get_ident()}


def test_an_exception_of_progress_is_raised(block):
    class Stop(Exception):
        pass

    def stop(phase, part):
        raise Stop(phase)

    with pytest.raises(Stop):
        pm.reconstruct(block, spacing=0.1, progress=stop)
    assert pm.reconstruct(block, spacing=0.1).certificate.holds


def test_obstacles_are_not_entered(block, tmp_path):
    box = np.array([[x, y, z] for x in (0.3, 0.6) for y in (0.3, 0.6) for z in (0.3, 2.0)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
                      [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    keep = ~((block > 0.25) & (block < [0.65, 0.65, 2.0])).all(axis=1)
    obstacle = pm.Obstacle(box, faces)
    made = pm.reconstruct(block[keep], obstacles=obstacle, spacing=0.1)
    inside = ((made.vertices > 0.32) & (made.vertices < [0.58, 0.58, 1.9])).all(axis=1)
    assert not inside.any() and made.report["obstacles"] is not None
    assert same(pm.reconstruct(block[keep], obstacles=[(box, faces)], spacing=0.1), made)
    path = tmp_path / "box.obj"
    path.write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in box) + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)
    )
    of_file = pm.reconstruct(block[keep], obstacles=path, spacing=0.1)
    assert np.allclose(of_file.vertices, made.vertices) and "box.obj" in of_file.report["obstacles"]["files"]
    with pytest.raises(FileNotFoundError, match="none.obj"):
        pm.Obstacle.from_file(tmp_path / "none.obj")
    with pytest.raises(ValueError, match="does not exist"):
        pm.Obstacle(box, faces + 5)
    with pytest.raises(TypeError, match="obstacle"):
        pm.reconstruct(block, obstacles=[3])


def test_obstacle_out_of_reach_is_warned_about(block):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    near, far = pm.Obstacle(corners + [1, 0, 0], faces), pm.Obstacle(corners + [100, 0, 0], faces)
    with pytest.warns(UserWarning, match="too far from the particles to have an effect: it spans \\(100, 0, 0\\)") as caught:
        made = pm.reconstruct(block, spacing=0.1, obstacles=[near, far])
    assert len([text for text in made.warnings if "too far" in text]) == 1
    assert [warning.filename for warning in caught if "too far" in str(warning.message)] == [__file__]
    assert not any("too far" in text for text in pm.reconstruct(block, spacing=0.1, obstacles=near).warnings)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read every file")
def test_file_without_permission_raises_permission_error(surface, frame, tmp_path):
    secret = tmp_path / frame.name
    secret.write_bytes(frame.read_bytes())
    secret.chmod(0)
    with pytest.raises(PermissionError) as caught:
        pm.read(secret)
    assert caught.value.filename == str(secret)
    with pytest.raises(PermissionError):
        pm.Obstacle.from_file(secret)
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o500)
    with pytest.raises(PermissionError):
        surface.write(folder / "surface.glb")


def test_scratch_files_make_the_same_surface(tmp_path):
    points = lattice(40, 0.1)
    whole = pm.reconstruct(points, spacing=0.1)
    small = next(
        megabytes for megabytes in (8, 16, 24, 32, 48, 64, 96, 128)
        if not _fails(lambda: pm.reconstruct(points, spacing=0.1, memory=megabytes << 20, scratch=tmp_path))
    )  # fmt: skip
    assert same(pm.reconstruct(points, spacing=0.1, memory=small << 20, scratch=tmp_path), whole)
    assert not list(tmp_path.iterdir())
    with pytest.raises(NotADirectoryError):
        pm.reconstruct(points, scratch=tmp_path / "none")


def _fails(call):
    try:
        call()
    except pm.MemoryLimitError:
        return True
    return False


def test_sequences_keep_their_settings(block):
    coarse = block * 2
    sequence = pm.Sequence(block)
    voxel_size = sequence.settings["voxel_size"]
    made = sequence.reconstruct(coarse[:200])
    assert made.level_set.voxel_size == voxel_size
    assert pm.reconstruct(coarse[:200]).level_set.voxel_size != voxel_size
    later = pm.Sequence()
    assert later.settings is None
    first = later.reconstruct(block)
    assert later.reconstruct(coarse[:200], velocity=coarse[:200]).level_set.voxel_size == first.level_set.voxel_size
    assert same(first, pm.reconstruct(block))
    with pytest.raises(TypeError, match="unknown option"):
        pm.Sequence(foo=1)


def test_a_sequence_that_needs_velocities_measures_a_first_frame(block):
    sequence = pm.Sequence(block, velocity=block, anisotropy="velocity")
    made = sequence.reconstruct(block, velocity=block)
    assert same(made, pm.reconstruct(block, velocity=block, anisotropy="velocity"))


def test_a_sequence_scales_the_velocities_of_later_frames(block):
    velocity = np.ones_like(block)
    options = {"spacing": 0.1, "velocity_scale": 24.0}
    expected = pm.reconstruct(block, velocity=velocity, **options).velocities
    found = pm.Sequence(**options).reconstruct(block, velocity=velocity).velocities
    assert np.allclose(found, 24) and np.array_equal(found, expected)


def test_wrong_arguments_of_a_sequence(block):
    with pytest.raises(TypeError, match="`threads` is an argument of Sequence.reconstruct"):
        pm.Sequence(block, threads=2)
    with pytest.raises(TypeError, match="first_frame"):
        pm.Sequence(radii=np.ones(1000))
    with pytest.raises(pm.OptionError, match="steps"):
        pm.Sequence(steps=-1)
