"""Tests that `Surface.write` writes the same bytes as the command."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import lattice

import pymeniscus as pm
from pymeniscus._native import format_names


def spacing_of(report: dict) -> float:
    return report["settings"][0]["spacing"]


@pytest.mark.parametrize(
    "options", [{}, {"preset": "auto"}, {"preset": "splash", "quads": True}, {"preset": "paper", "decimate": 0.05}]
)
def test_a_file_and_its_arrays(frame, tmp_path, options):
    formats = [name for name in format_names() if name not in ("stl", "png", "exr")]
    report = pm.convert(frame, tmp_path / "command", format=formats, **options)
    surface = pm.reconstruct(pm.read(frame), **{"spacing": spacing_of(report), **options}, formats=formats)
    for path in sorted((tmp_path / "command").iterdir()):
        if path.is_file():
            mine = tmp_path / path.name
            surface.write(mine)
            assert mine.read_bytes() == path.read_bytes(), path.name


def test_format_that_rounds_positions(frame, tmp_path):
    report = pm.convert(frame, tmp_path / "command", format=["stl"])
    surface = pm.reconstruct(pm.read(frame), spacing=spacing_of(report), formats=["stl"])
    (path,) = [path for path in (tmp_path / "command").iterdir() if path.is_file()]
    surface.write(tmp_path / path.name)
    assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_exported_arrays_with_attributes_and_radii(block, tmp_path):
    generator = np.random.default_rng(1)
    velocity = generator.normal(size=(1000, 3)).astype(np.float32)
    radii = generator.uniform(0.04, 0.08, 1000).astype(np.float32)
    exported = tmp_path / "frame.npz"
    np.savez(exported, position=block, velocity=velocity, radius=radii)
    options = {"spacing": 0.1, "anisotropy": "velocity"}
    pm.convert(
        exported, tmp_path / "command", format=["glb", "vdb"], attributes="velocity", radius_attribute="radius", **options
    )
    surface = pm.reconstruct(block, velocity=velocity, radii=radii, formats=["glb", "vdb"], **options)
    for name in ("frame.glb", "frame.vdb"):
        surface.write(tmp_path / name, source=exported)
        assert (tmp_path / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    again = pm.reconstruct(pm.read(exported), attributes="velocity", radius_attribute="radius", formats=["vdb"], **options)
    again.write(tmp_path / "again.vdb")
    assert (tmp_path / "again.vdb").read_bytes() == (tmp_path / "command" / "frame.vdb").read_bytes()


def test_computed_attributes(block, tmp_path):
    velocity = np.random.default_rng(2).normal(size=(1000, 3)).astype(np.float32)
    exported, names = tmp_path / "frame.npz", "velocity,speed,vorticity,normal_curvature"
    np.savez(exported, position=block, velocity=velocity)
    pm.convert(exported, tmp_path / "command", format=["ply", "vdb"], attributes=names, spacing=0.1)
    surface = pm.reconstruct(block, velocity=velocity, attributes=names, formats=["ply", "vdb"], spacing=0.1)
    assert list(surface.attributes) == names.split(",")
    surface.write(tmp_path / "frame.ply", source=exported)
    with pytest.warns(UserWarning, match="normal_curvature is not in the .vdb"):
        surface.write(tmp_path / "frame.vdb", source=exported)
    for name in ("frame.ply", "frame.vdb"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name


def test_condition_on_attributes(block, tmp_path):
    exported = tmp_path / "frame.npz"
    np.savez(exported, position=block, phase=(block[:, 0] < 0.5).astype(np.int32), height=block[:, 1].copy())
    options = {"where": "phase == 1 and height < 0.61", "attributes": "height"}
    report = pm.convert(exported, tmp_path / "command", format=["glb", "vdb"], **options)
    surface = pm.reconstruct(pm.read(exported), spacing=spacing_of(report), formats=["glb", "vdb"], **options)
    for name in ("frame.glb", "frame.vdb"):
        surface.write(tmp_path / name)
        assert (tmp_path / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name


@pytest.mark.parametrize(
    ("extension", "options"),
    [("glb", {"up": "z"}), ("usda", {"up": "z", "meters_per_unit": 0.01}), ("vdb", {"vdb": "half"})],
)
def test_options_of_files(frame, tmp_path, extension, options):
    report = pm.convert(frame, tmp_path / "command", format=extension, **options)
    surface = pm.reconstruct(pm.read(frame), spacing=spacing_of(report), formats=[extension])
    (path,) = [path for path in (tmp_path / "command").iterdir() if path.is_file()]
    surface.write(tmp_path / path.name, **options)
    assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_averages_over_time(tmp_path):
    """The meshes of `convert`, from files and from arrays. Comments differ: only `convert` names the frames around."""
    generator = np.random.default_rng(3)
    frames: list[tuple] = []
    (tmp_path / "in").mkdir()
    ids = np.arange(1000)
    for number in range(1, 6):
        points = lattice(10) + np.float32(0.02 * number) + generator.normal(scale=0.01, size=(1000, 3)).astype(np.float32)
        order = generator.permutation(1000)
        np.savez(tmp_path / "in" / f"dam.{number}.npz", position=points[order], id=ids[order])
        frames.append((points[order], ids[order]))
    paths = [tmp_path / "in" / f"dam.{number}.npz" for number in range(1, 6)]

    def meshes(surfaces, out):
        (tmp_path / out).mkdir()
        for number, surface in enumerate(surfaces, 1):
            surface.write(tmp_path / out / f"dam.{number}.obj")
        return texts(out)

    def texts(out):
        files = sorted((tmp_path / out).glob("*.obj"))
        return [[line for line in file.read_text().splitlines() if not line.startswith("#")] for file in files]

    for reach in (1, 3):
        options = {"spacing": 0.1, "temporal": reach}
        out = f"command{reach}"
        pm.convert(tmp_path / "in", tmp_path / out, format="obj", **options)
        assert len(texts(out)) == 5
        sequence = pm.Sequence(**options)
        assert meshes(sequence.averaged(map(pm.read, paths)), f"read{reach}") == texts(out)
        given = ({"points": points, "ids": ids} for points, ids in frames)
        assert meshes(sequence.averaged(given, threads=1), f"given{reach}") == texts(out)
    # Averages change something, unless there is only one frame, or none is to be averaged with.
    plain = [pm.Sequence(spacing=0.1).reconstruct(points) for points, _ in frames]
    assert all(one != other for one, other in zip(meshes(plain, "plain"), texts("command1")))
    assert meshes(pm.Sequence(spacing=0.1).averaged({"points": points} for points, _ in frames), "zero") == texts("plain")
    assert meshes(pm.Sequence(spacing=0.1, temporal=1).averaged([pm.read(paths[0])]), "one") == texts("plain")[:1]


def test_averages_need_particles_that_can_be_followed(block):
    sequence = pm.Sequence(spacing=0.1, temporal=1)
    with pytest.raises(pm.OptionError, match="`temporal` averages the frames of a sequence"):
        sequence.reconstruct(block)
    with pytest.warns(UserWarning, match="not averaged with the frames around it"):
        assert len(list(sequence.averaged([{"points": block}] * 3))) == 3
    velocity = np.ones_like(block)
    moving = [{"points": block + step * velocity * np.float32(0.05), "velocity": velocity} for step in range(3)]
    with pytest.warns(UserWarning, match="not averaged with the frames around it"):
        list(sequence.averaged(moving))
    followed = pm.Sequence(spacing=0.1, temporal=1, time_step=0.05)
    assert [surface.report["temporal"]["frames"] for surface in followed.averaged(moving)] == [1, 2, 1]
    for wrong in ({}, {"velocity": velocity}, {"points": block, "progress": print}):
        with pytest.raises(TypeError, match="a frame must be Particles"):
            next(sequence.averaged([wrong]))
    with pytest.raises(ValueError, match="attribute `id`"):
        next(sequence.averaged([{"points": block, "ids": [1, 2]}]))


def test_averages_survive_frames_that_fail(block):
    """The surfaces before a frame that fails come first, and warnings point to the caller."""
    frames = [{"points": block + np.float32(0.01 * number), "ids": np.arange(1000)} for number in range(5)]
    frames[3] = {"points": np.full((5, 3), np.nan), "ids": np.arange(5)}
    found = []
    with pytest.raises(pm.ParticleError, match="none of the 5 positions is finite"):
        found.extend(surface.report["temporal"]["frames"] for surface in _averaged(frames, temporal=2))
    # `extend` keeps what came before the error.
    assert found == [2, 2, 2]
    found.clear()
    with pytest.raises(OSError, match="gone"):
        found.extend(surface.report["temporal"]["frames"] for surface in _averaged(_broken(frames[:2]), temporal=2))
    assert found == [1, 1]
    with pytest.warns(UserWarning, match="not averaged with the frames around it") as warned:
        list(_averaged([{"points": block}] * 2, temporal=1))
    assert {warning.filename for warning in warned} == {__file__}
    with pytest.warns(UserWarning, match="time_step"):
        list(_averaged([{"points": block}], time_step=0.1))


def _broken(frames):
    yield from frames
    raise OSError("gone")


def _averaged(frames, **options):
    yield from pm.Sequence(spacing=0.1, **options).averaged(frames)


def test_ids_that_are_passed_win_over_those_of_a_file(block, tmp_path):
    ids = np.arange(1000)
    for number in range(2):
        moved = block + np.float32(0.02 * number)
        np.savez(tmp_path / f"dam.{number}.npz", position=moved, particle_id=np.roll(ids, 500 * number))
    read = [pm.read(tmp_path / f"dam.{number}.npz") for number in range(2)]
    own = list(_averaged([{"points": particles, "ids": ids} for particles in read], temporal=1))
    assert all(surface.report["temporal"]["confidence"] > 0.9 for surface in own)


def test_averages_share_the_memory_limit(block):
    frames = [{"points": block, "ids": np.arange(1000)}] * 2
    needed = {}
    for reach in (1, 3):
        with pytest.raises(pm.MemoryLimitError) as error:
            list(pm.Sequence(spacing=0.1, temporal=reach, memory="1MiB").averaged(frames))
        needed[reach] = float(re.search(r"needs at least (\d+) MiB", str(error.value))[1])
    # Four and eight frames are in memory at once.
    assert needed[3] / needed[1] == pytest.approx(2, rel=0.1)
    assert len(list(pm.Sequence(spacing=0.1, temporal=1, memory=f"{needed[1]:.0f}MiB").averaged(frames))) == 2


def test_two_attributes_and_two_obstacles(block, tmp_path):
    exported, walls = tmp_path / "frame.npz", []
    np.savez(exported, position=block, velocity=block, age=block[:, 0].copy())
    for number in (1, 2):
        walls.append(tmp_path / f"wall{number}.obj")
        walls[-1].write_text(f"v {number} -1 -1\nv {number} 2 -1\nv {number} 2 2\nv {number + 1} 0 0\n"
                             "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")  # fmt: skip
    formats = ["glb", "vdb", "ply"]
    pm.convert(exported, tmp_path / "command", format=formats, attributes="velocity,age", obstacle=walls, spacing=0.1)
    surface = pm.reconstruct(
        block, velocity=block, attributes={"age": block[:, 0]}, obstacles=walls, formats=formats, spacing=0.1
    )
    for extension in formats:
        mine = tmp_path / f"frame.{extension}"
        surface.write(mine, source=exported)
        assert mine.read_bytes() == (tmp_path / "command" / mine.name).read_bytes(), extension


def test_obstacle_files(block, tmp_path):
    path = tmp_path / "wall.obj"
    path.write_text("v 0.5 -1 -1\nv 0.5 2 -1\nv 0.5 2 2\nv 0.5 -1 2\nv 3 0.5 0.5\n"
                    "f 1 3 2\nf 1 4 3\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n")  # fmt: skip
    exported = tmp_path / "frame.npy"
    np.save(exported, block)
    pm.convert(exported, tmp_path / "command", format="glb", obstacle=path, spacing=0.1)
    surface = pm.reconstruct(pm.read(exported), obstacles=path, spacing=0.1)
    surface.write(tmp_path / "frame.glb")
    assert (tmp_path / "frame.glb").read_bytes() == (tmp_path / "command" / "frame.glb").read_bytes()


def test_without_a_source_a_file_does_not_name_one(surface, tmp_path):
    surface.write(tmp_path / "surface.glb")
    content = (tmp_path / "surface.glb").read_bytes()
    assert b"generator" in content and b"input_hash" not in content
    with pytest.raises(ValueError, match="not read from a file"):
        surface.write(tmp_path / "surface.glb", source=pm.Particles(np.zeros((1, 3))))


def test_spacing_of_one_frame_is_that_of_the_command(frame, tmp_path):
    report = pm.convert(frame, tmp_path, format="glb")
    assert pm.reconstruct(pm.read(frame)).settings["spacing"] == spacing_of(report)
