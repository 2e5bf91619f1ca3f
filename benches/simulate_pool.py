"""Simulates water with SPlisHSPlasH: a pool that sloshes slowly, or a dam break.

    simulate_pool.py pool|dam FOLDER

Writes FOLDER/partio/ParticleData_Fluid_1.bgeo and so on: 10 frames per second of the pool, 30 of the dam
break. y is up. Both scenes are modifications of the scene in `tests/clients/simulate_splishsplash.py`.
`benches/quality` runs this script in a virtual environment for simulators.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "clients"))
import simulate_splishsplash as simulation

DAM_BREAK = simulation.dam_break()
# The pool is deeper on one side, so that it sloshes. The solver is position-based fluids without viscosity:
# the particles of DFSPH come to rest in layers, which leave no bumps to smooth.
POOL = DAM_BREAK | {
    "Configuration": DAM_BREAK["Configuration"] | {"simulationMethod": 2, "stopAt": 3.4, "dataExportFPS": 10},
    "Materials": [{"id": "Fluid", "density0": 1000, "viscosityMethod": 0}],
    "FluidBlocks": [
        {"denseMode": 0, "start": [-0.95, 0.05, -0.45], "end": [0.0, 0.6, 0.45]},
        {"denseMode": 0, "start": [0.0, 0.05, -0.45], "end": [0.95, 0.4, 0.45]},
    ],
}
DAM = DAM_BREAK | {"Configuration": DAM_BREAK["Configuration"] | {"stopAt": 1.2, "dataExportFPS": 30}}


def main():
    scene = {"pool": POOL, "dam": DAM}[sys.argv.pop(1)]
    simulation.dam_break = lambda: scene
    simulation.main()


if __name__ == "__main__":
    main()
