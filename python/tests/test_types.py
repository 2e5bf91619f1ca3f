"""Tests of the types and docstrings of the public names."""

from __future__ import annotations

import ast
import doctest
import functools
import inspect
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

import pymeniscus as pm
from pymeniscus import _native

PACKAGE = Path(pm.__file__).parent


#: A program that uses the package as its types allow.
CORRECT = """
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pymeniscus as pm

points = np.zeros((4, 3), np.float32)
options = pm.Options(preset="splash", voxel_size="0.3d")
values: pm.OptionValues = {"preset": "noisy", "clip": (0, 0, 0, 1, 1, 1), "quads": True, "steps": None}
surface = pm.reconstruct(points, radii=[0.1] * 4, velocity=points, spacing=0.1, steps=3, threads=2, memory="1GiB")
again: pm.Surface = pm.reconstruct(points, obstacles=[pm.Obstacle(points, [[0, 1, 2]]), "ship.obj"], **values)
vertices: NDArray[np.float32] = surface.vertices
triangles: NDArray[np.uint32] = surface.triangles
velocities: NDArray[np.float32] | None = surface.velocities
again = pm.reconstruct(points, **surface.settings)
distances, (x, y, z) = surface.level_set.dense(([0, 0, 0], [1, 1, 1]))
holds: bool = surface.certificate.holds
surface.write(Path("a.glb"), up="z", size=(64, 36))
with pm.watch("cache", "out", once=True) as frames:
    for frame in frames:
        outputs: tuple[Path, ...] = frame.outputs
particles = pm.read("a.ply")
pm.Sequence(particles.positions, preset="fluid").reconstruct(particles, attributes=["velocity"])
report = pm.convert(["a.ply"], "out", format=["glb"])["frames"]
"""

#: Lines that a type checker refuses, and its code for the error.
WRONG = {
    'pm.reconstruct(points, preset="foam")': "typeddict-item|arg-type",
    "pm.reconstruct(points, voxelsize=1)": "call-arg",
    'pm.reconstruct(points, steps="many")': "arg-type",
    "pm.reconstruct(points, threads=2.5)": "arg-type",
    "pm.reconstruct(points).vertices = points": "misc",
    'text: str = pm.reconstruct(points).certificate.holds': "assignment",
    "pm.reconstruct()": "call-arg",
    "pm.Options(voxelsize=1)": "call-arg",
    'pm.Options(steps=1).replace(steps="many")': "arg-type",
    "pm.read(3)": "arg-type",
    "pm.watch('a', 'b').status.imag": "union-attr",
    "pm.Surface().nothing": "attr-defined|call-arg",
}


def mypy(*arguments: str) -> subprocess.CompletedProcess[str]:
    pytest.importorskip("mypy")
    # Check the sources, because mypy reports nothing about installed packages.
    folder = Path(__file__).parents[1]
    command = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--cache-dir", os.devnull, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder)


def test_package_is_typed():
    assert (PACKAGE / "py.typed").exists()
    done = mypy("-p", "pymeniscus")
    assert done.returncode == 0, done.stdout + done.stderr


def test_programs_are_checked(tmp_path):
    (tmp_path / "correct.py").write_text(CORRECT)
    lines = ["import numpy as np", "import pymeniscus as pm", "points = np.zeros((4, 3))", *WRONG]
    (tmp_path / "wrong.py").write_text("\n".join(lines))
    done = mypy(str(tmp_path / "correct.py"), str(tmp_path / "wrong.py"))
    assert done.returncode == 1, done.stdout + done.stderr
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    for number, (line, codes) in enumerate(WRONG.items(), 4):
        of_line = [error for error in errors if f"wrong.py:{number}:" in error]
        assert any(error.endswith(tuple(f"[{code}]" for code in codes.split("|"))) for error in of_line), (line, of_line)
        errors = [error for error in errors if error not in of_line]
    assert not errors, "\n".join(errors)


def test_stub_has_what_the_native_module_has():
    tree = ast.parse((PACKAGE / "_native.pyi").read_text(encoding="utf-8"))
    stubs = {node.name: node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    public = {name for name in dir(_native) if not name.startswith("_")}
    assert public == {name for name in stubs if not name.startswith("_")}
    for name in public:
        node, found = stubs[name], getattr(_native, name)
        if isinstance(node, ast.FunctionDef):
            assert list(inspect.signature(found).parameters) == [argument.arg for argument in node.args.args], name
        else:
            methods = {method.name for method in node.body if isinstance(method, ast.FunctionDef)}
            members = {member for member in vars(found) if not member.startswith("_")}
            assert members == {method for method in methods if not method.startswith("_")}, name


def test_every_public_name_has_a_docstring():
    for name in pm.__all__:
        value = getattr(pm, name)
        if name == "__version__":
            continue
        assert inspect.getdoc(value) and len(inspect.getdoc(value)) > 20, name
        for member in public_members(value):
            # As the class defines it: a property or a class method is not called.
            found = inspect.getattr_static(value, member)
            found = getattr(found, "__func__", found)
            assert inspect.getdoc(found) and inspect.getdoc(found) != inspect.getdoc(type(found)), f"{name}.{member}"


def public_members(value: object) -> list[str]:
    """The public methods and properties that a class of the package defines itself."""
    if not inspect.isclass(value) or issubclass(value, dict):
        return []
    kinds = (types.FunctionType, classmethod, staticmethod, property, functools.cached_property)
    return [name for name, found in vars(value).items() if not name.startswith("_") and isinstance(found, kinds)]


def test_all_kinds_of_members_are_public():
    assert {"attributes", "report", "settings", "warnings", "vertices", "write"} <= set(public_members(pm.Surface))
    assert public_members(pm.Obstacle) == ["from_file"] and public_members(pm.Certificate) == ["holds"]


def test_functions_document_every_parameter():
    for function in (pm.reconstruct, pm.read, pm.convert, pm.render, pm.watch, pm.Surface.write, pm.Surface.render,
                     pm.LevelSet.dense, pm.LevelSet.sample):  # fmt: skip
        text = inspect.getdoc(function) or ""
        for name in inspect.signature(function).parameters:
            assert name == "self" or name in text, f"{function.__name__}: {name}"


def test_examples_in_docstrings():
    for module in (pm, sys.modules["pymeniscus._options"]):
        assert doctest.testmod(module, extraglobs={"Options": pm.Options}).failed == 0
