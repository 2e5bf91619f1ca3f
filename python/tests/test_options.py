"""Tests that everything about options agrees with their definition in the core."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pytest
from conftest import ROOT
from simulate import load

import pymeniscus as pm
from pymeniscus._native import option_table as native_table


@pytest.mark.parametrize("copied", [lambda options: pickle.loads(pickle.dumps(options)), copy.copy, copy.deepcopy])
def test_options_are_pickled_and_copied(copied):
    options = pm.Options(preset="splash", voxel_size="0.3d", steps=4, clip=(0, 0, 0, 1, 1, 1), quads=True)
    assert copied(options) == options and hash(copied(options)) == hash(options)
    assert dict(copied(options)) == dict(options)


def test_options_are_a_mapping(block):
    options = pm.Options(spacing=0.1, steps=3, decimate=None)
    assert dict(options) == {"spacing": 0.1, "steps": 3} and len(options) == 2
    assert options.replace(steps=None, quads=True) == pm.Options(spacing=0.1, quads=True)
    assert pm.reconstruct(block, **options).settings["steps"] == 3
    assert pm.Options(voxel_size=0.1) == pm.Options(voxel_size="0.1") != pm.Options(voxel_size="0.1d")
    assert eval(repr(options), {"Options": pm.Options}) == options


def test_wrong_options():
    with pytest.raises(TypeError, match="did you mean `decimate`"):
        pm.Options(decimat=1)
    with pytest.raises(pm.OptionError):
        pm.Options(preset="foam")
    with pytest.raises(TypeError, match="cannot be object"):
        pm.Options(steps=object())


def test_every_option_of_the_core_is_a_keyword():
    names = [row["name"] for row in native_table()]
    assert len(names) > 25 and set(names) - {info.name for info in pm.option_table()} == {"attributes"}
    for info in pm.option_table():
        assert len(info.help) > 10 and info.kind in ("number", "count", "switch", "length", "text")
    preset = pm.option_table()[0]
    assert "noisy" in preset.choices and "flip" in preset.other_names
    assert pm.Options(preset="flip") == pm.Options(preset="noisy")


def test_generated_file_is_that_of_the_core():
    generate = load("generate_options", ROOT / "python")
    assert generate.OPTION_VALUES.read_text(encoding="utf-8") == generate.option_values()


def test_numbers_keep_all_digits(block):
    spacing = 0.1 + 2**-50
    assert pm.reconstruct(block, spacing=spacing).settings["spacing"] == spacing


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"preset": "splash", "voxel_size": "0.3d", "quads": True, "clip": (0, 0, 0, 0.5, 1, 1)},
        {"preset": "paper", "voxel_size": 0.05, "integrator": "implicit"},
        {"anisotropy": "velocity", "velocity_scale": 24.0, "offset": "-0.1d"},
    ],
)
def test_settings_give_the_same_surface_without_warnings(block, options):
    particles = {"velocity": block, "radii": np.full(1000, 0.1), "attributes": {"height": block[:, 2]}}
    made = pm.reconstruct(block, spacing=0.1, **particles, **options)
    values = {name: type(made.settings[name]) for name in ("voxel_size", "steps", "quads", "anisotropy")}
    assert values == {"voxel_size": float, "steps": int, "quads": bool, "anisotropy": str}
    assert "attributes" not in made.settings and ("clip" in made.settings) == ("clip" in options)
    sequence = pm.Sequence(block, radii=particles["radii"], velocity=block, spacing=0.1, **options)
    assert sequence.settings == made.settings
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = pm.reconstruct(block, **particles, **made.settings)
    assert again.settings == made.settings and again.vertices.tobytes() == made.vertices.tobytes()
    with pytest.raises(pm.ParticleError, match="`radius`, which `radius_attribute` needs"):
        pm.reconstruct(block, **made.settings)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"max_stretch": 3.0, "anisotropy": "none"}, "`max_stretch` is ignored: it is for `anisotropy=\"neighbors\"`"),
        ({"radius_min": "1d"}, "`radius_min` is ignored: it is for `preset=\"paper\"` only"),
        ({"void_threshold": 2.0}, "`void_threshold` is ignored: it is for `obstacles` only"),
        (
            {"neighbor_radius": "3d", "preset": "paper"},
            "it is for `anisotropy=\"neighbors\"` and `position_smoothing` only",
        ),
    ],
)
def test_options_without_effect_are_warned_about(block, options, text):
    with pytest.warns(UserWarning, match=text) as caught:
        pm.reconstruct(block, spacing=0.1, **options)
    assert [warning.filename for warning in caught] == [__file__]
    sequence = pm.Sequence(spacing=0.1, **options)
    with pytest.warns(UserWarning, match=text):
        sequence.reconstruct(block)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sequence.reconstruct(block)


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"quads": True, "contour": "tetrahedra"}, pm.OptionError, '`quads` requires dual contouring: remove `contour="tetrahedra"`'),
        ({"quads": True, "decimate": 0.5}, pm.OptionError, "`quads` cannot be combined with `decimate`"),
        ({"radius_attribute": "size"}, pm.ParticleError, "no attribute `size`, which `radius_attribute` needs"),
        ({"radii": [0] * 1000}, pm.ParticleError, "no positive value, but `radius_attribute` needs radii"),
        ({"anisotropy": "velocity"}, pm.ParticleError, 'no attribute `velocity`, which `anisotropy="velocity"` needs'),
        ({"voxel_size": 1e-9}, pm.OptionError, "64 voxels: choose another voxel size"),
        ({"memory": "1KiB"}, pm.MemoryLimitError, "the limit is 0 MiB: raise it or choose larger voxels"),
    ],
)
def test_errors_name_options_as_keywords(block, arguments, error, text):
    with pytest.raises(error) as caught:
        pm.reconstruct(block, spacing=0.1, **arguments)
    assert text in str(caught.value) and "--" not in str(caught.value)


def test_level_set_over_the_memory_limit_names_the_keyword(surface, tmp_path):
    path = tmp_path / "block.vdb"
    surface.write(path)
    with pytest.raises(pm.MemoryLimitError, match=r"block\.vdb: the level set.* needs \d+ MiB .*: raise `memory`$"):
        pm.Obstacle.from_file(path, memory="1KiB")
