"""Tests of the commands, as functions and as a program."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import pymeniscus as pm
from pymeniscus._commands import _flags


def test_convert_returns_the_report(frame, tmp_path):
    report = pm.convert(frame, tmp_path, format=["glb", "vdb"])
    (entry,) = report["frames"]
    assert entry["status"] == "converted" and len(entry["outputs"]) == 2
    assert all(Path(path).exists() for path in entry["outputs"])
    again = pm.convert([frame], tmp_path, format="glb,vdb", skip_done=True)
    assert again["frames"][0]["status"] == "already_done"


def test_convert_errors(tmp_path):
    with pytest.raises(pm.CommandError) as caught:
        pm.convert(tmp_path / "none.ply", tmp_path / "out")
    assert caught.value.status == 2 and "none.ply" in str(caught.value)
    with pytest.raises(pm.CommandError, match="voxelsize"):
        pm.convert(tmp_path / "none.ply", tmp_path / "out", voxelsize=3)
    with pytest.raises(ValueError, match="no inputs"):
        pm.convert([], tmp_path)


def test_failed_frames(frame, tmp_path):
    bad = tmp_path / "bad.ply"
    bad.write_text("ply\nnothing")
    with pytest.raises(pm.CommandError) as caught:
        pm.convert([frame, bad], tmp_path / "out", format="glb")
    assert caught.value.status == 1 and caught.value.report is not None
    report = pm.convert([frame, bad], tmp_path / "out", format="glb", allow_failures=True)
    assert {entry["status"] for entry in report["frames"]} == {"converted", "failed"}


def test_render(frame, tmp_path):
    path = pm.render(frame, tmp_path / "frame.png", size="64x36", camera="azimuth=60")
    assert path.read_bytes().startswith(b"\x89PNG")
    folder = pm.render(frame, tmp_path / "pictures", size="64x36")
    assert [found.suffix for found in folder.iterdir() if found.is_file()] == [".png"]


def test_watch_once(frame, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    for number in (1, 2):
        shutil.copy(frame, cache / f"dam.{number:04}{frame.suffix}")
    with pm.watch(cache, tmp_path / "out", once=True, format="glb") as frames:
        found = sorted(frames, key=lambda finished: finished.path)
    assert [finished.state for finished in found] == ["converted", "converted"] and frames.status == 0
    assert all(finished.outputs and finished.outputs[0].suffix == ".glb" and finished.particles for finished in found)
    with pytest.raises(RuntimeError, match="started before"):
        frames.__enter__()
    # Without the journal, frames are recognized by their outputs.
    shutil.rmtree(tmp_path / "out" / ".meniscus")
    with pm.watch(cache, tmp_path / "out", once=True, format="glb") as frames:
        assert [finished.state for finished in frames] == ["already_done", "already_done"]


def test_watch_sees_new_frames_and_stops(frame, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    with pm.watch(cache, tmp_path / "out", format="glb", settle="50ms", settle_unverifiable="100ms") as frames:
        shutil.copy(frame, cache / f"dam.0001{frame.suffix}")
        first = next(iter(frames))
        assert first.state == "converted" and first.path.name.startswith("dam.0001")
    assert frames.status == 0


def test_watch_errors(tmp_path):
    with pytest.raises(RuntimeError, match="use `with"):
        next(iter(pm.watch(tmp_path, tmp_path / "out")))
    with pytest.raises(pm.CommandError):
        with pm.watch(tmp_path, tmp_path / "out", nonsense=1) as frames:
            list(frames)


@pytest.mark.parametrize("arguments", [["--version"], ["convert", "--help"]])
def test_module_is_the_program(arguments):
    done = subprocess.run([sys.executable, "-m", "pymeniscus", *arguments], capture_output=True, text=True)
    assert done.returncode == 0 and "meniscus" in done.stdout.lower()
    if arguments == ["--version"]:
        assert pm.__version__ in done.stdout


def test_module_has_the_exit_status_of_the_program(tmp_path):
    done = subprocess.run([sys.executable, "-m", "pymeniscus", "convert", "none", "--out", str(tmp_path)], capture_output=True)
    assert done.returncode == 2


def test_console_script_is_installed():
    script = Path(sys.executable).with_name("pymeniscus")
    if not script.exists():
        pytest.skip("the package is not installed")
    assert subprocess.run([script, "--version"], capture_output=True).returncode == 0


def test_flags():
    options = {"skip_done": True, "allow_violations": False, "quads": False, "format": ["glb", "vdb"], "steps": 3,
               "obstacle": ["a.obj", Path("b.obj")], "preset": None}  # fmt: skip
    assert _flags(options) == ["--skip-done", "--quads=false", "--format=glb,vdb", "--steps=3",
                               "--obstacle=a.obj", "--obstacle=b.obj"]  # fmt: skip
