"""Tests of the commands, as functions and as a program."""

from __future__ import annotations

import copy
import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pymeniscus as pm
from pymeniscus._commands import _flags
from pymeniscus._options import as_pairs


def test_convert_returns_the_report(frame, tmp_path):
    report = pm.convert(frame, tmp_path, format=["glb", "vdb"])
    (entry,) = report["frames"]
    assert entry["status"] == "converted" and len(entry["outputs"]) == 2
    assert all(Path(path).exists() for path in entry["outputs"])
    again = pm.convert([frame], tmp_path, format="glb,vdb", skip_done=True)
    assert again["frames"][0]["status"] == "already_done"


def test_report_of_an_earlier_call_is_not_returned(frame, tmp_path):
    path = tmp_path / "report.json"
    report = pm.convert(frame, tmp_path / "out", format="glb", report=path)
    assert json.loads(path.read_text()) == report and len(report["frames"]) == 1
    with pytest.raises(pm.CommandError) as caught:
        pm.convert(frame, tmp_path / "out", format="glb", report=path, nonsense=1, allow_failures=True)
    assert caught.value.status == 2 and caught.value.report is None
    assert json.loads(path.read_text()) == report


@pytest.mark.parametrize("copied", [lambda error: pickle.loads(pickle.dumps(error)), copy.copy])
def test_errors_are_pickled_and_copied(copied):
    error = pm.CommandError(1, "warning: a\nerror: b\n", {"frames": []})
    again = copied(error)
    assert (again.status, again.messages, again.report) == (1, "warning: a\nerror: b\n", {"frames": []})
    assert str(again) == str(error) == "error: b"
    assert str(pm.CommandError(-9, "")) == "exit status -9"


def test_command_does_not_import_modules_of_the_working_folder(frame, tmp_path, monkeypatch):
    for name in ("pymeniscus", "json", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('imported from the working folder')\n")
    monkeypatch.chdir(tmp_path)
    assert pm.convert(frame, "out", format="glb")["frames"][0]["status"] == "converted"


def test_convert_repeats_options_that_name_files(frame, tmp_path):
    inputs = tmp_path / "in"
    inputs.mkdir()
    for number in (1, 2):
        shutil.copy(frame, inputs / f"frame.{number}{frame.suffix}")
    files = [tmp_path / "shot.glb", tmp_path / "shot.abc"]
    pm.convert(inputs, tmp_path / "out", format="glb", sequence=files, fps=24)
    assert all(file.stat().st_size > 1000 for file in files)


def test_convert_errors(tmp_path):
    with pytest.raises(pm.CommandError) as caught:
        pm.convert(tmp_path / "none.ply", tmp_path / "out")
    assert caught.value.status == 2 and "none.ply" in str(caught.value)
    with pytest.raises(pm.CommandError, match="voxelsize"):
        pm.convert(tmp_path / "none.ply", tmp_path / "out", voxelsize=3)
    with pytest.raises(pm.CommandError, match="--out"):
        pm.convert(tmp_path / "none.ply", None)
    with pytest.raises(pm.CommandError, match="--formats(.|\n)*'--format'"):
        pm.convert(tmp_path / "none.ply", tmp_path / "out", formats="glb")
    with pytest.raises(ValueError, match="no inputs"):
        pm.convert([], tmp_path)


def test_text_is_printed_if_the_options_ask_for_it(capsys):
    assert pm.convert(help=True) == {} and "--skip-done" in capsys.readouterr().out
    assert pm.convert(print_settings=True, spacing=0.1) == {} and "voxel_size = " in capsys.readouterr().out


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
    surfaces = [(tmp_path / "out" / finished.path.with_suffix(".glb").name,) for finished in found]
    assert [finished.outputs for finished in found] == surfaces and all(finished.particles for finished in found)
    with pytest.raises(RuntimeError, match="started before"):
        frames.__enter__()
    # Frames that were touched are recognized by their content.
    for path in cache.iterdir():
        path.touch()
    with pm.watch(cache, tmp_path / "out", once=True, format="glb") as frames:
        again = sorted(frames, key=lambda finished: finished.path)
    assert [(finished.state, finished.outputs) for finished in again] == [("already_done", made) for made in surfaces]


def test_watch_reports_failed_frames(frame, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    (cache / "dam.1.ply").write_text("ply\nformat nonsense 1.0\n")
    shutil.copy(frame, cache / f"other{frame.suffix}")
    with pm.watch(cache, tmp_path / "out", once=True, format="glb") as frames:
        (failed,) = [finished for finished in frames if finished.state != "converted"]
    assert (failed.path, failed.state, failed.outputs) == (cache / "dam.1.ply", "failed", ()) and frames.status == 1
    assert "nonsense" in failed.message


def test_watch_sees_new_frames_and_stops(frame, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    with pm.watch(cache, tmp_path / "out", format="glb", settle="50ms") as frames:
        shutil.copy(frame, cache / f"dam.0001{frame.suffix}")
        first = next(iter(frames))
        assert first.state == "converted" and first.path.name.startswith("dam.0001")
    assert frames.status == 0


def test_slow_callers_do_not_block_the_command(frame, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    # The log of these frames is longer than a pipe can hold, and every frame is done before the first is asked
    # for.
    for number in range(400):
        (cache / f"{number:04}-{'x' * 180}.csv").write_text("x,y,z\n0,0,0\n")
    with pm.watch(cache, tmp_path / "out", once=True, format="obj", voxel_size=0.5, spacing=1) as frames:
        frames._process.wait(timeout=120)
        states = [finished.state for finished in frames]
    assert states == ["converted"] * 400 and list(frames) == []


def test_level_of_the_log_does_not_hide_frames(frame, tmp_path, monkeypatch):
    monkeypatch.setenv("MENISCUS_LOG", "error")
    with pm.watch(frame.parent, tmp_path / "out", once=True, format="glb", preset="preview") as frames:
        assert {finished.state for finished in frames} == {"converted"}


def test_command_that_did_nothing_is_reported_at_the_end_of_the_context(tmp_path):
    with pytest.raises(pm.CommandError, match="nonsense") as caught:
        with pm.watch(tmp_path, tmp_path / "out", nonsense=1) as frames:
            frames._process.wait(timeout=60)
    assert caught.value.status == 2
    # An exception of the caller is not replaced, and a command that is stopped at once is no error.
    with pytest.raises(ZeroDivisionError):
        with pm.watch(tmp_path, tmp_path / "out", nonsense=1) as frames:
            frames._process.wait(timeout=60)
            raise ZeroDivisionError
    with pm.watch(tmp_path, tmp_path / "out", format="glb") as frames:
        frames.stop()
        frames.stop()


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


def test_numbers_have_the_text_that_reconstruct_passes():
    third = np.float32(1 / 3)
    options = {"spacing": third, "clip": np.array([0.1, 2, 3, 4, 5, 6], np.float32), "steps": np.int16(3),
               "quads": np.bool_(False), "skip_done": np.bool_(True), "offset": np.array(0.5)}  # fmt: skip
    text = dict(as_pairs({name: value for name, value in options.items() if name in ("spacing", "clip", "steps")}))
    assert _flags(options) == [f"--spacing={text['spacing']}", f"--clip={text['clip']}", f"--steps={text['steps']}",
                               "--quads=false", "--skip-done", "--offset=0.5"]  # fmt: skip
    assert text["spacing"] == repr(float(third)) != str(third)
    with pytest.raises(TypeError, match="cannot be object"):
        _flags({"steps": object()})
