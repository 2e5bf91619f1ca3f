"""Makes a surface from arrays, checks its certificate, and writes it to files."""

import sys
from pathlib import Path

import numpy as np

import pymeniscus


def ball(count: int) -> np.ndarray:
    """Random particles in a ball."""
    points = np.random.default_rng(0).uniform(-1, 1, (2 * count, 3))
    return points[np.linalg.norm(points, axis=1) < 1][:count].astype(np.float32)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    points = ball(20_000)
    surface = pymeniscus.reconstruct(
        points, preset="noisy", attributes={"height": points[:, 2]}, formats=["glb", "vdb"]
    )
    assert surface.certificate.holds, surface.certificate.violations
    print(surface)
    print("volume", surface.report["volume"], "of", 4 / 3 * np.pi)
    for name in ("ball.glb", "ball.vdb", "ball.png"):
        surface.write(out / name)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/python"))
