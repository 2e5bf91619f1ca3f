"""Tests of the types and docstrings of the public names."""

from __future__ import annotations

import ast
import doctest
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

import pymeniscus as pm
from pymeniscus import _native

PACKAGE = Path(pm.__file__).parent


def test_package_is_typed():
    assert (PACKAGE / "py.typed").exists()
    pytest.importorskip("mypy")
    # Check the sources, because mypy reports nothing about installed packages.
    folder = Path(__file__).parents[1]
    command = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--cache-dir", os.devnull, "-p", "pymeniscus"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr


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
        if inspect.isclass(value):
            for member, found in vars(value).items():
                is_public = not member.startswith("_")
                if is_public and (callable(found) or isinstance(found, property)) and member != "holds":
                    assert inspect.getdoc(found), f"{name}.{member}"


def test_functions_document_every_parameter():
    for function in (pm.reconstruct, pm.read, pm.convert, pm.render, pm.watch, pm.Surface.write, pm.Surface.render,
                     pm.LevelSet.dense, pm.LevelSet.sample):  # fmt: skip
        text = inspect.getdoc(function) or ""
        for name in inspect.signature(function).parameters:
            assert name == "self" or name in text, f"{function.__name__}: {name}"


def test_examples_in_docstrings():
    for module in (pm, sys.modules["pymeniscus._options"]):
        assert doctest.testmod(module, extraglobs={"Options": pm.Options}).failed == 0
