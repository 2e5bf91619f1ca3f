"""Runs the examples and the code in the documentation. Examples for a simulator run only if it is
installed."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys

import pytest
from conftest import ROOT
from simulate import load

import pymeniscus

EXAMPLES = ROOT / "python" / "examples"


def test_quickstart(tmp_path):
    load("quickstart").main(tmp_path)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".glb", ".png", ".vdb"]


def test_genesis_style(tmp_path):
    load("genesis_style").main(tmp_path, frames=3)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(("name", "package"), [("taichi", "taichi"), ("splishsplash", "pysplishsplash")])
def test_simulator_in_process_has_the_bytes_of_the_command(tmp_path, name, package):
    if importlib.util.find_spec(package) is None:
        is_required = os.environ.get("PYMENISCUS_REQUIRE_SIMULATORS")
        (pytest.fail if is_required else pytest.skip)(f"{package} is not installed")
    command = [sys.executable, ROOT / "python" / "tests" / "simulate.py", name, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "the bytes of the command" in done.stdout, done.stdout + done.stderr


def test_warp(tmp_path):
    pytest.importorskip("warp")
    load("warp_particles").main(tmp_path, frames=2)
    assert len(list(tmp_path.iterdir())) == 2


def test_notebook(tmp_path):
    cells = json.loads((EXAMPLES / "tutorial.ipynb").read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["surface"].certificate.holds


def test_example_with_a_file(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    (block,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "pymeniscus.read(" in block]
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"pymeniscus": pymeniscus}
    exec(block, names)
    assert names["particles"].roles == {"v": "velocity"} and names["surface"].velocities is not None
    assert os.path.getsize("dam.0001.glb") > 1000


@pytest.mark.parametrize("page", [ROOT / "python" / "README.md", ROOT / "docs" / "python.md"])
def test_first_example_of_a_page(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    block = re.search(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)[1]
    exec(block, {})
    assert os.path.getsize("surface.glb") > 1000
