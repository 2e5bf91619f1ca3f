"""Tests that everything about options agrees with their definition in the core."""

from __future__ import annotations

import copy
import pickle
import warnings

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
    assert pm.reconstruct(block, **options).settings["steps"] == "3"
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


def test_generated_files_are_those_of_the_core():
    generate = load("generate_options", ROOT / "python")
    assert generate.OPTION_VALUES.read_text(encoding="utf-8") == generate.option_values()
    page = generate.PAGE.read_text(encoding="utf-8")
    assert generate.with_options(page) == page


def test_numbers_keep_all_digits(block):
    spacing = 0.1 + 2**-50
    assert float(pm.reconstruct(block, spacing=spacing).settings["spacing"]) == spacing


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"lone_radius": "0.5d", "anisotropy": "none"}, "`lone_radius` is ignored: it is for `anisotropy` neighbors only"),
        ({"void_threshold": 2.0}, "`void_threshold` is ignored: it is for `obstacle` only"),
        ({"preset": "water"}, "the preset `water` is deprecated"),
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
