"""Tests of Ctrl-C, of threads at import, and of memory over many calls, each in a separate process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest
from conftest import heed_interrupts

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")


def start(script: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-u", "-c", textwrap.dedent(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_interrupts,
    )


#: Limit of the time until Ctrl-C takes effect: 0.2 s on an idle machine, and more on a busy machine, such as
#: one that runs many tests.
DELAY_MAX = 0.2 if os.environ.get("PYMENISCUS_STRICT_TIMES") else 2.0


@pytest.mark.parametrize("phase", ["prepare", "rasterize", "smooth", "contour", "interpolate"])
def test_ctrl_c_ends_a_reconstruction(phase):
    process = start(
        f"""
        import time, numpy as np, pymeniscus
        points = np.random.default_rng(0).random((200_000, 3), dtype=np.float32)
        def progress(phase, part):
            if phase == "{phase}" and part == 0:
                print(phase, flush=True)
        try:
            while True:
                pymeniscus.reconstruct(points, velocity=points, steps=8, formats=["vdb"], progress=progress)
        except KeyboardInterrupt:
            print("interrupted", time.time())
        # The package works afterwards.
        print(len(pymeniscus.reconstruct(points[:1000]).vertices) > 0)
        """
    )
    assert process.stdout is not None
    assert process.stdout.readline() == f"{phase}\n"
    time.sleep(0.05)
    sent = time.time()
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    lines = [line for line in output.splitlines() if line != phase]
    assert process.returncode == 0 and lines[-1] == "True", errors
    delay = float(lines[0].removeprefix("interrupted ")) - sent
    assert delay < DELAY_MAX, delay


def test_importing_starts_no_thread():
    process = start(
        """
        import os
        import numpy
        before = len(os.listdir("/proc/self/task"))
        import pymeniscus
        pymeniscus.Options(preset="fluid")
        print(len(os.listdir("/proc/self/task")) - before)
        """
    )
    if not os.path.isdir("/proc/self/task"):
        pytest.skip("needs /proc")
    output, errors = process.communicate(timeout=60)
    assert output == "0\n", errors


def test_memory_is_flat():
    calls = int(os.environ.get("PYMENISCUS_LEAK_CALLS", "990"))
    process = start(
        f"""
        import gc, os, tempfile, numpy as np, pymeniscus
        points = np.random.default_rng(0).random((1000, 3), dtype=np.float32)
        velocity = points.copy()
        corners = np.array([[2, 0, 0], [3, 0, 0], [2, 1, 0], [2, 0, 1]])
        faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
        folder = tempfile.TemporaryDirectory()
        def resident():
            gc.collect()
            return int(open("/proc/self/statm").read().split()[1]) * 4096
        def call():
            body = pymeniscus.Obstacle(corners, faces)
            made = pymeniscus.reconstruct(points, velocity=velocity, formats=["vdb"], obstacles=body)
            made.write(os.path.join(folder.name, "surface.glb"))
            for wrong in (dict(blend="65h"), dict(memory="1KiB")):
                try:
                    pymeniscus.reconstruct(points, spacing=0.1, **wrong)
                except pymeniscus.MeniscusError:
                    pass
                else:
                    raise SystemExit("not refused")
            return made.vertices.sum() + made.attributes["velocity"].sum() + made.level_set.sample(points).sum()
        # Each thread takes memory when it first works, and on a busy machine some work late.
        for _ in range({calls // 3}):
            call()
        early = resident()
        for _ in range({calls - calls // 3}):
            call()
        print(resident() / early)
        """
    )
    if not os.path.isfile("/proc/self/statm"):
        pytest.skip("needs /proc")
    output, errors = process.communicate(timeout=600)
    assert float(output) < 1.05, (output, errors)


def test_fork_after_use_works():
    """A child has none of the threads of its parent, so nothing may wait for a thread of the global pool."""
    process = start(
        """
        import os, numpy as np, pymeniscus
        points = np.random.default_rng(0).random((500, 3), dtype=np.float32)
        def results():
            surface = pymeniscus.reconstruct(points, quads=True)
            values = [getattr(surface, name) for name in dir(surface) if not name.startswith("_")]
            surface._repr_png_()
            return len(values), surface.vertices.sum()
        here = results()
        child = os.fork()
        if child == 0:
            os._exit(0 if results() == here else 3)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        """
    )
    output, errors = process.communicate(timeout=60)
    assert output == "0\n", errors
