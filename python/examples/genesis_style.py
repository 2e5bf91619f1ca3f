"""Reconstructs surfaces in a loop such as that of Genesis: each particle has its own radius, each frame needs
one call, and the memory does not grow.

It needs no simulator: particles of two sizes fall and bounce.
"""

import sys
from pathlib import Path

import numpy as np

import pymeniscus


def main(out: Path, frames: int = 24) -> None:
    """Simulate, and write a .ply of each frame."""
    generator = np.random.default_rng(0)
    x = generator.uniform([-0.5, 0.5, -0.5], [0.5, 1.5, 0.5], (4000, 3))
    v = np.zeros_like(x)
    radii = np.where(generator.random(len(x)) < 0.2, 0.06, 0.04)
    # One object for all frames: settings are resolved once.
    sequence = pymeniscus.Sequence(preset="noisy", spacing=0.08, voxel_size=0.03)
    out.mkdir(parents=True, exist_ok=True)
    for frame in range(frames):
        v[:, 1] -= 9.8 / 24
        x += v / 24
        below = x[:, 1] < 0
        x[below, 1], v[below, 1] = -x[below, 1], -0.3 * v[below, 1]
        surface = sequence.reconstruct(x, radii=radii, velocity=v)
        # For a renderer in this process: arrays without copies.
        vertices, triangles = surface.vertices, surface.triangles
        print(frame, vertices.shape, triangles.shape)
        surface.write(out / f"balls.{frame:04}.ply")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/genesis_style"))
