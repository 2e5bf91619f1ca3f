"""Simulates with the material point method in Taichi, and makes a surface of each frame without particle
files.

The simulation is Taichi's example mpm88 in three dimensions: a block of weakly compressible fluid falls into
a box.
"""

import sys
from pathlib import Path

import numpy as np
import taichi as ti

import pymeniscus

GRID, COUNT, STEP = 32, 8192, 2e-4


@ti.data_oriented
class Fluid:
    """The particles and the grid of the simulation."""

    def __init__(self) -> None:
        self.x = ti.Vector.field(3, ti.f32, COUNT)
        self.v = ti.Vector.field(3, ti.f32, COUNT)
        self.affine = ti.Matrix.field(3, 3, ti.f32, COUNT)
        self.volume_ratio = ti.field(ti.f32, COUNT)
        self.grid_v = ti.Vector.field(3, ti.f32, (GRID, GRID, GRID))
        self.grid_m = ti.field(ti.f32, (GRID, GRID, GRID))
        edge = round(COUNT ** (1 / 3)) + 1
        lattice = np.stack(np.meshgrid(*[np.arange(edge)] * 3), -1).reshape(-1, 3)[:COUNT]
        self.x.from_numpy((0.15 + 0.4 * lattice / edge).astype(np.float32))
        self.volume_ratio.fill(1)

    @ti.kernel
    def substep(self):
        for node in ti.grouped(self.grid_m):
            self.grid_v[node] = ti.Vector.zero(ti.f32, 3)
            self.grid_m[node] = 0.0
        dx = 1.0 / GRID
        volume = (0.5 * dx) ** 3
        for p in self.x:
            base = (self.x[p] / dx - 0.5).cast(int)
            fx = self.x[p] / dx - base.cast(float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            stress = -STEP * 4 * 400.0 * volume * (self.volume_ratio[p] - 1) / dx**2
            affine = ti.Matrix.identity(ti.f32, 3) * stress + volume * self.affine[p]
            for offset in ti.static(ti.grouped(ti.ndrange(3, 3, 3))):
                weight = w[offset[0]][0] * w[offset[1]][1] * w[offset[2]][2]
                distance = (offset.cast(float) - fx) * dx
                self.grid_v[base + offset] += weight * (volume * self.v[p] + affine @ distance)
                self.grid_m[base + offset] += weight * volume
        for node in ti.grouped(self.grid_m):
            if self.grid_m[node] > 0:
                self.grid_v[node] /= self.grid_m[node]
            self.grid_v[node][1] -= STEP * 9.8
            for axis in ti.static(range(3)):
                if node[axis] < 3 and self.grid_v[node][axis] < 0:
                    self.grid_v[node][axis] = 0
                if node[axis] > GRID - 3 and self.grid_v[node][axis] > 0:
                    self.grid_v[node][axis] = 0
        for p in self.x:
            base = (self.x[p] / dx - 0.5).cast(int)
            fx = self.x[p] / dx - base.cast(float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            v, affine = ti.Vector.zero(ti.f32, 3), ti.Matrix.zero(ti.f32, 3, 3)
            for offset in ti.static(ti.grouped(ti.ndrange(3, 3, 3))):
                weight = w[offset[0]][0] * w[offset[1]][1] * w[offset[2]][2]
                distance = (offset.cast(float) - fx) * dx
                v += weight * self.grid_v[base + offset]
                affine += 4 * weight * self.grid_v[base + offset].outer_product(distance) / dx**2
            self.v[p], self.affine[p] = v, affine
            self.x[p] += STEP * v
            self.volume_ratio[p] *= 1 + STEP * affine.trace()


def main(out: Path, frames: int = 24, save=None) -> None:
    """Simulate, and write a .glb of each frame; `save` gets the particles and the surface of each frame."""
    ti.init(arch=ti.cpu, random_seed=0)
    fluid = Fluid()
    sequence = pymeniscus.Sequence(preset="noisy", spacing=0.02)
    out.mkdir(parents=True, exist_ok=True)
    for frame in range(frames):
        for _ in range(40):
            fluid.substep()
        points, velocity = fluid.x.to_numpy(), fluid.v.to_numpy()
        surface = sequence.reconstruct(points, velocity=velocity)
        if save is not None:
            save(frame, points, velocity, surface)
        surface.write(out / f"fluid.{frame:04}.glb")
        print(frame, surface)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/taichi"))
