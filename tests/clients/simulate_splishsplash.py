"""Simulates a dam break with SPlisHSPlasH, without a window.

    simulate_splishsplash.py FOLDER

The exporter of SPlisHSPlasH writes FOLDER/partio/ParticleData_Fluid_1.bgeo and so on, gzipped, each directly
under its final name.
"""

import ctypes
import json
import os
import sys
from pathlib import Path

SECONDS = 3.0
FRAMES_PER_SECOND = 8
# Distances are in metres. The floor of the tank is at y = 0, and its middle is at the origin.
PARTICLE_RADIUS = 0.025
TANK = [2.0, 2.0, 1.0]
BLOCK = {"denseMode": 0, "start": [-0.95, 0.05, -0.45], "end": [-0.35, 0.95, 0.45]}


def main():
    folder = Path(sys.argv[1]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    scene = folder / "scene.json"
    scene.write_text(json.dumps(dam_break(), indent=2))
    # Threads that wait for each other sleep instead of spinning, because other programs use the machine, too.
    os.environ["OMP_WAIT_POLICY"] = "passive"
    simulator = splishsplash().Exec.SimulatorBase()
    simulator.init(
        sceneFile=str(scene), outputDir=str(folder), useGui=False, initialPause=False, useCache=False
    )
    simulator.run()


def splishsplash():
    """Imports SPlisHSPlasH. Its wheel contains a libGLdispatch, and crashes on import unless that of the
    system is loaded first."""
    ctypes.CDLL("libGL.so.1", mode=ctypes.RTLD_GLOBAL)
    import pysplishsplash

    return pysplishsplash


def dam_break():
    """A block of water in a corner of a tank, in the format of SPlisHSPlasH's scene files."""
    return {
        "Configuration": {
            "particleRadius": PARTICLE_RADIUS,
            "simulationMethod": 4,  # DFSPH
            "gravitation": [0, -9.81, 0],
            "timeStepSize": 0.005,
            "cflMaxTimeStepSize": 0.005,
            "boundaryHandlingMethod": 0,  # particles
            "stopAt": SECONDS,
            "enablePartioExport": True,
            "particleAttributes": "velocity;density",
            "dataExportFPS": FRAMES_PER_SECOND,
        },
        "Materials": [{"id": "Fluid", "density0": 1000, "viscosityMethod": 1, "viscosity": 0.01}],
        "RigidBodies": [
            {
                "geometryFile": str(Path(sys.prefix) / "bin" / "data" / "models" / "UnitBox.obj"),
                "translation": [0, TANK[1] / 2, 0],
                "scale": TANK,
                "isDynamic": False,
                "isWall": True,
                "mapInvert": True,
            }
        ],
        "FluidBlocks": [BLOCK],
    }


if __name__ == "__main__":
    main()
