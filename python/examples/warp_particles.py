"""Reconstructs particles of Warp or Newton: arrays on the CPU are used without a copy, those on a GPU are
copied once.

A Warp kernel moves the particles in a vortex; each frame gets a surface.
"""

import sys
from pathlib import Path

import numpy as np
import warp as wp

import pymeniscus


@wp.kernel
def move(x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), step: float):
    index = wp.tid()
    p = x[index]
    v[index] = wp.vec3(-p[1], p[0], 0.2 * wp.sin(3.0 * p[0]))
    x[index] = p + step * v[index]


def main(out: Path, frames: int = 12, device: str = "cpu") -> None:
    """Simulate, and write a .glb of each frame."""
    wp.init()
    axis = np.linspace(-0.5, 0.5, 20)
    points = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3).astype(np.float32)
    x = wp.array(points, dtype=wp.vec3, device=device)
    v = wp.zeros_like(x)
    sequence = pymeniscus.Sequence(spacing=1 / 19)
    out.mkdir(parents=True, exist_ok=True)
    for frame in range(frames):
        wp.launch(move, dim=len(x), inputs=[x, v, 1 / 24], device=device)
        on_host = (x, v) if device == "cpu" else (x.numpy(), v.numpy())
        surface = sequence.reconstruct(on_host[0], velocity=on_host[1])
        surface.write(out / f"vortex.{frame:04}.glb")
        print(frame, surface)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/warp"))
