"""Tests of concurrent use, limits, warnings, and the bytes of unusual particles."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings

import numpy as np
import pytest
from conftest import heed_interrupts, lattice

import pymeniscus as pm


def test_vertices_can_be_read_while_they_are_reconstructed(surface):
    points = surface.vertices
    read = []
    made = pm.reconstruct(points, spacing=0.05, progress=lambda phase, part: read.append(surface.vertices.sum()))
    assert made.certificate.holds and read
    assert not surface.vertices.flags.writeable


def test_all_arrays_of_a_surface_are_read_only(block):
    made = pm.reconstruct(block, spacing=0.1, quads=True)
    for array in (made.vertices, made.triangles, made.normals, made.quads, made.loose_triangles):
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True


def test_huge_box_raises_memory_error(surface):
    edge = surface.level_set.voxel_size * 1e5
    with pytest.raises(MemoryError, match=r"[0-9]{15} bytes"):
        surface.level_set.dense(((0, 0, 0), (edge, edge, edge)))


def test_concurrent_first_frames_use_the_same_settings(block):
    for _ in range(5):
        sequence, made, barrier = pm.Sequence(), [], threading.Barrier(2)

        def work(points, sequence=sequence, made=made, barrier=barrier):
            barrier.wait()
            made.append(sequence.reconstruct(points))

        workers = [threading.Thread(target=work, args=(block * scale,)) for scale in (1, 3)]
        [worker.start() for worker in workers]
        [worker.join() for worker in workers]
        assert len(made) == 2 and made[0].settings == made[1].settings


def test_empty_frame_has_an_empty_surface(block, tmp_path):
    with pytest.warns(UserWarning, match="no particles are left"):
        made = pm.reconstruct(np.zeros((0, 3)), spacing=0.1)
    assert len(made.vertices) == 0 and len(made.triangles) == 0
    path = tmp_path / "frame.npy"
    np.save(path, np.zeros((0, 3)))
    pm.convert(path, tmp_path / "command", format="glb", spacing=0.1)
    made.write(tmp_path / "frame.glb", source=path)
    assert (tmp_path / "frame.glb").read_bytes() == (tmp_path / "command" / "frame.glb").read_bytes()
    sequence = pm.Sequence(block)
    with pytest.warns(UserWarning, match="no particles are left"):
        assert len(sequence.reconstruct(np.zeros((0, 3))).vertices) == 0
    with pytest.raises(pm.ParticleError, match="no particles"):
        pm.Sequence().reconstruct(np.zeros((0, 3)))


def test_radii_and_another_attribute_for_radii_are_refused(block):
    with pytest.raises(TypeError, match="radius_attribute='size'"):
        pm.reconstruct(block, radii=np.ones(1000), radius_attribute="size", spacing=0.1)


@pytest.mark.parametrize("name", ["diameter", "width", "radius"])
def test_named_radii_have_the_bytes_of_the_command(block, tmp_path, name):
    values = np.random.default_rng(0).uniform(0.04, 0.09, 1000).astype(np.float32)
    path = tmp_path / "frame.npz"
    np.savez(path, position=block, **{name: values})
    options = {"spacing": 0.1, "radius_attribute": name}
    pm.convert(path, tmp_path / "command", format="glb", **options)
    pm.reconstruct(block, attributes={name: values}, **options).write(tmp_path / "mine.glb", source=path)
    pm.convert(path, tmp_path / "all", format="glb", attributes=name, **options)
    assert (tmp_path / "mine.glb").read_bytes() == (tmp_path / "all" / "frame.glb").read_bytes()


def test_text_has_the_bytes_of_the_command(block, tmp_path):
    words = np.where(block[:, 0] < 0.25, "water", np.where(block[:, 0] < 0.6, "", "air"))
    path = tmp_path / "frame.csv"
    rows = (f"{x!r},{y!r},{z!r},{word}" for (x, y, z), word in zip(block.astype(float).tolist(), words, strict=True))
    path.write_text("x,y,z,phase\n" + "\n".join(rows) + "\n")
    formats = ["ply", "vtp", "usda"]
    pm.convert(path, tmp_path / "command", format=formats, attributes="phase", spacing=0.1)
    for made in (
        pm.reconstruct(block.astype(float), attributes={"phase": words}, spacing=0.1),
        pm.reconstruct(pm.read(path), attributes=["phase"], spacing=0.1),
    ):
        for extension in formats:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made.write(tmp_path / f"frame.{extension}", source=path)
            written = (tmp_path / f"frame.{extension}").read_bytes()
            assert written == (tmp_path / "command" / f"frame.{extension}").read_bytes(), extension


def test_files_with_other_positions_than_those_that_were_checked_are_refused(block, tmp_path):
    far = block + np.float32(1000)
    with pytest.raises(ValueError, match=r'pass formats=\["stl"\] to'):
        pm.reconstruct(far, spacing=0.1).write(tmp_path / "surface.stl")
    assert not list(tmp_path.iterdir())
    prepared = pm.reconstruct(far, spacing=0.1, formats=["stl"])
    for extension in ("stl", "ply"):
        prepared.write(tmp_path / f"surface.{extension}")


def test_stl_needs_no_preparation_where_it_rounds_nothing(surface, block, tmp_path):
    surface.write(tmp_path / "surface.stl")
    pm.reconstruct(block, spacing=0.1, formats=["stl"]).write(tmp_path / "prepared.stl")
    assert (tmp_path / "surface.stl").read_bytes() == (tmp_path / "prepared.stl").read_bytes()


def test_writing_warns_about_what_a_format_cannot_store(block, tmp_path):
    made = pm.reconstruct(block, attributes={"id": np.arange(1000) + 2**40}, spacing=0.1)
    with pytest.warns(UserWarning, match="id"):
        made.write(tmp_path / "surface.glb")
    with pytest.warns(UserWarning, match="no attributes"):
        made.write(tmp_path / "surface.vdb")


def test_a_step_of_a_file_is_read(tmp_path):
    path = tmp_path / "dump.lammpstrj"
    step = "ITEM: TIMESTEP\n{0}\nITEM: NUMBER OF ATOMS\n2\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\n" \
           "ITEM: ATOMS id type x y z\n1 1 0 0 {0}\n2 1 1 0 {0}\n"  # fmt: skip
    path.write_text(step.format(0) + step.format(1000))
    particles = pm.read(f"{path}/step=1000")
    assert particles.positions[:, 2].tolist() == [1000, 1000]


def tetrahedron(path, count=4):
    corners = [(0, 0, 5), (1, 0, 5), (0, 1, 5), (0, 0, 6)]
    faces = [(1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4)][:count]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    path.write_text(text + "".join(f"f {a} {b} {c}\n" for a, b, c in faces))
    return path


def test_open_obstacles_are_warned_about(block, tmp_path):
    with pytest.warns(UserWarning, match="open.obj"):
        pm.reconstruct(block, obstacles=tetrahedron(tmp_path / "open.obj", 3), spacing=0.1)


def test_a_sequence_reads_an_obstacle_again_after_a_change(block, tmp_path):
    path = tetrahedron(tmp_path / "body.obj")
    sequence = pm.Sequence(spacing=0.1)
    first, second = (sequence._bodies.natives(path)[0] for _ in range(2))
    assert first is second
    os.utime(path, ns=(1, 1))
    assert sequence._bodies.natives(path)[0] is not first


def test_memory_is_text_as_in_the_command(block, tmp_path):
    path = tetrahedron(tmp_path / "body.obj")
    assert pm.Obstacle.from_file(path, memory="1GiB")
    with pytest.raises(ValueError, match="8GiB"):
        pm.Obstacle.from_file(path, memory="lots")
    from pymeniscus._options import bytes_of

    assert bytes_of("8G") == 8 * 10**9 and bytes_of("8GiB") == 8 << 30 and bytes_of(5) == 5


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize(
    "work",
    [
        "made.level_set.dense(((-3, -3, -3), (3, 3, 3)))",
        "made.level_set.sample(points)",
        "made.render(size=(4096, 4096))",
        "made.write('surface.obj')",
        "pymeniscus.read('frame.csv')",
    ],
)
def test_ctrl_c_ends_other_calls(work, tmp_path):
    script = f"""
    import time, numpy as np, pymeniscus
    made = pymeniscus.reconstruct(np.random.default_rng(0).random((20_000, 3)))
    points = np.random.default_rng(0).random((10_000_000, 3))
    with open("frame.csv", "w") as file:
        file.write("x,y,z\\n" + "0.25,0.5,0.75\\n" * (4_000_000 if "read" in {work!r} else 1))
    print("ready", flush=True)
    try:
        while True:
            {work}
    except KeyboardInterrupt:
        print(time.time())
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        preexec_fn=heed_interrupts,
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    sent = time.time()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    delay = float(output) - sent
    assert delay < (0.2 if os.environ.get("PYMENISCUS_STRICT_TIMES") else 2.0), delay
    assert not [path for path in tmp_path.iterdir() if "tmp" in path.name]


def test_two_frames_of_a_sequence_are_computed_at_once():
    sequence, running = pm.Sequence(spacing=0.1), threading.Barrier(2, timeout=30)
    waited = threading.local()

    def progress(phase, part):
        if not hasattr(waited, "done"):
            waited.done = True
            running.wait()

    made = []
    frame = lattice(8)
    work = lambda: made.append(sequence.reconstruct(frame, progress=progress))  # noqa: E731
    workers = [threading.Thread(target=work) for _ in range(2)]
    [worker.start() for worker in workers]
    [worker.join() for worker in workers]
    assert len(made) == 2
