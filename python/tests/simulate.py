"""Runs an example with a simulator, and compares each surface with the command on the exported frame.

usage: python simulate.py EXAMPLE FOLDER

It runs in a separate process, because simulators change their process: Taichi the floating-point mode,
SPlisHSPlasH the libraries of OpenGL.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import pymeniscus as pm

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"

SCENE = {
    "Configuration": {
        "timeStepSize": 0.001,
        "particleRadius": 0.025,
        "pause": False,
        "enablePartioExport": False,
        "simulationMethod": 4,
        "gravitation": [0, -9.81, 0],
    },
    "FluidBlocks": [
        {"denseMode": 0, "start": [-0.3, 0.0, -0.3], "end": [0.3, 0.6, 0.3], "translation": [0, 0, 0], "scale": [1, 1, 1]}
    ],
}


def load(name: str, folder: Path = EXAMPLES) -> ModuleType:
    """The module of an example, or of another script."""
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


class Comparison:
    """Exports each frame, and writes its surface. Then compares the surface files with those that the command
    writes."""

    def __init__(self, folder: Path, spacing: float, **options: Any) -> None:
        self.folder, self.options = folder, {"spacing": spacing, **options}
        for name in ("exported", "in_process"):
            (folder / name).mkdir(parents=True)

    def save(self, number: int, points: Any, velocity: Any, surface: pm.Surface) -> None:
        """The callback for the example, which calls it for each frame."""
        path = self.folder / "exported" / f"fluid.{number:04}.npz"
        np.savez(path, position=points, velocity=velocity)
        surface.write(self.folder / "in_process" / f"fluid.{number:04}.glb", source=path)

    def check(self, frames_min: int) -> None:
        """Convert the exported frames with the command, and compare the files."""
        options = {"format": "glb", "attributes": "velocity", **self.options}
        pm.convert(self.folder / "exported", self.folder / "command", **options)
        names = sorted(path.name for path in (self.folder / "in_process").iterdir())
        assert len(names) >= frames_min, names
        for name in names:
            ours, expected = ((self.folder / of / name).read_bytes() for of in ("in_process", "command"))
            assert ours == expected, f"{name} differs from the command"
        print(f"{len(names)} frames have the bytes of the command")


def taichi(folder: Path) -> None:
    """A material point simulation."""
    comparison = Comparison(folder, 0.02, preset="noisy")
    load("taichi_mpm").main(folder / "out", frames=3, save=comparison.save)
    comparison.check(3)


def splishsplash(folder: Path) -> None:
    """A falling block in SPlisHSPlasH, with surfaces from its callback."""
    # The wheel contains a libGLdispatch, and crashes on import unless the system's libGLdispatch is loaded
    # first.
    try:
        ctypes.CDLL("libGL.so.1", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        pass
    comparison = Comparison(folder, 0.05)
    scene = folder / "scene.json"
    scene.write_text(json.dumps(SCENE))
    load("splishsplash").main(scene, folder / "out", every=0.02, stop_at=0.05, save=comparison.save)
    comparison.check(2)


def main() -> None:
    """Run the example that the command line names."""
    examples: dict[str, Callable[[Path], None]] = {"taichi": taichi, "splishsplash": splishsplash}
    examples[sys.argv[1]](Path(sys.argv[2]).resolve())


if __name__ == "__main__":
    main()
