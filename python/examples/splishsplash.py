"""Reconstructs surfaces during a simulation by pySPlisHSPlasH: in its process, from a callback, without
particle files.

usage: python splishsplash.py SCENE.json [OUT]
"""

import sys
from pathlib import Path

import numpy as np
import pysplishsplash as sph

import pymeniscus


class Surfaces:
    """Makes surfaces at regular intervals while the simulation runs."""

    def __init__(self, out: Path, every: float, stop_at: float, save=None) -> None:
        self.out, self.every, self.stop_at, self.save = out, every, stop_at, save
        self.count, self.sequence = 0, None
        out.mkdir(parents=True, exist_ok=True)

    def __call__(self) -> None:
        if sph.TimeManager.getCurrent().getTime() < self.count * self.every:
            return
        simulation = sph.Simulation.getCurrent()
        model = simulation.getFluidModel(0)
        count = model.numActiveParticles()
        # A view of the simulation's buffer, not a copy: valid only until this callback returns.
        points = np.asarray(model.getFieldBuffer("position"))[:count]
        velocity = np.asarray(model.getFieldBuffer("velocity"))[:count]
        if self.sequence is None:
            # The radius is a 32-bit float: round it, to remove the digits beyond its precision.
            self.sequence = pymeniscus.Sequence(spacing=round(2 * simulation.getParticleRadius(), 6))
        surface = self.sequence.reconstruct(points, velocity=velocity)
        if self.save is not None:
            self.save(self.count, points.copy(), velocity.copy(), surface)
        surface.write(self.out / f"fluid.{self.count:04}.glb")
        print(self.count, surface)
        self.count += 1


def main(scene: Path, out: Path, every: float = 1 / 24, stop_at: float = 1.0, save=None) -> None:
    """Run a scene, and write a .glb every `every` seconds of simulated time."""
    base = sph.Exec.SimulatorBase()
    base.init(sceneFile=str(scene.resolve()), useGui=False, stopAt=stop_at, outputDir=str(out.resolve() / "simulation"))
    base.initSimulation()
    base.setTimeStepCB(Surfaces(out, every, stop_at, save))
    base.runSimulation()
    base.cleanup()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "out/splishsplash"))
