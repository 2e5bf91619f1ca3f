"""Simulates water in a tank with SPlisHSPlasH.

    simulate_scenes.py pool|rest|dam|crown|jet SEED FOLDER

    pool    sloshes slowly, with position-based fluids: 10 frames per second
    rest    a pool that calms down
    dam     a dam breaks and hits a column
    crown   a cube falls into a pool
    jet     an emitter shoots water at the floor for 0.7 seconds

Writes FOLDER/partio/ParticleData_Fluid_1.bgeo and so on; 30 frames per second, except of the pool. y is up, and
particles are 0.05 apart. Other seeds than 0 change the start a little. All scenes are modifications of the
scene in `tests/clients/simulate_splishsplash.py`. `benches/quality` runs this script in a virtual environment
for simulators.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "clients"))
import simulate_splishsplash as simulation

DAM_BREAK = simulation.dam_break()
TANK = DAM_BREAK["RigidBodies"][0]


def main():
    made = scene(sys.argv.pop(1), int(sys.argv.pop(1)))
    simulation.dam_break = lambda: made
    simulation.main()


def scene(name, seed):
    shift = 0.02 * seed
    match name:
        case "pool":
            # The pool is deeper on one side, so that it sloshes. Position-based fluids have no viscosity here:
            # the particles of DFSPH come to rest in layers, which leave no bumps to smooth.
            return DAM_BREAK | {
                "Configuration": configuration(simulationMethod=2, stopAt=3.4, dataExportFPS=10),
                "Materials": [{"id": "Fluid", "density0": 1000, "viscosityMethod": 0}],
                "FluidBlocks": [
                    block([-0.95, 0.05, -0.45], [shift, 0.6, 0.45]),
                    block([shift, 0.05, -0.45], [0.95, 0.4, 0.45]),
                ],
            }
        case "rest":
            pool = block([-0.95, 0.05, -0.45], [0.95, 0.4 + 0.05 * seed, 0.45])
            return DAM_BREAK | {"Configuration": configuration(stopAt=4.03), "FluidBlocks": [pool]}
        case "dam":
            inside_out = {"isWall": False, "mapInvert": False}
            column = TANK | inside_out | {"translation": [0.4, 0.5, 0.01 + shift], "scale": [0.2, 1.0, 0.2]}
            return DAM_BREAK | {
                "Configuration": configuration(),
                "RigidBodies": [TANK, column],
                "FluidBlocks": [block([-0.95, 0.05, -0.45], [-0.1, 0.95, 0.45], [shift, 0, 0])],
            }
        case "crown":
            pool = block([-0.95, 0.05, -0.45], [0.95, 0.4, 0.45])
            cube = block([-0.15 + shift, 0.8, -0.15], [0.15 + shift, 1.1, 0.15], [0, -3, 0])
            return DAM_BREAK | {"Configuration": configuration(), "FluidBlocks": [pool, cube]}
        case "jet":
            emitter = {
                "type": 1,
                "width": 8,
                "height": 8,
                "translation": [-0.55, 0.8 + shift, 0.0],
                "rotationAxis": [0, 0, 1],
                "rotationAngle": -0.2,
                "velocity": 2.0,
                "emitStartTime": 0.0,
                "emitEndTime": 0.7,
            }
            return DAM_BREAK | {
                "Configuration": configuration(),
                "Materials": [DAM_BREAK["Materials"][0] | {"maxEmitterParticles": 12000}],
                "FluidBlocks": [],
                "Emitters": [emitter],
                "RigidBodies": [TANK | {"translation": [0, 1, 0], "scale": [1.4, 2, 0.7]}],
            }
    sys.exit(f"{name}: no such scene")


def configuration(**changes):
    return DAM_BREAK["Configuration"] | {"dataExportFPS": 30, "stopAt": 2.03} | changes


def block(start, end, velocity=(0, 0, 0)):
    return {"denseMode": 0, "start": start, "end": end, "initialVelocity": list(velocity)}


if __name__ == "__main__":
    main()
