"""Simulates a block of water that falls in a box without a lid with PySPH, which writes its own HDF5.

usage: simulate_pysph.py FOLDER

The particles of the box are an array of their own in each file. PySPH compiles its equations before it starts.
"""

import sys

import numpy as np
from pysph.base.utils import get_particle_array
from pysph.solver.application import Application
from pysph.sph.scheme import WCSPHScheme

SPACING = 0.1
DENSITY = 1000.0
SPEED_OF_SOUND = 30.0


class FallingBlock(Application):
    def create_particles(self):
        x, y, z = (axis.ravel() for axis in np.mgrid[-4:15, -4:15, -4:15] * SPACING)
        is_fluid = (0 <= np.minimum(x, y)) & (np.maximum(x, y) < 10 * SPACING) & (0 <= z) & (z < 10 * SPACING)
        is_wall = (z < -2.5 * SPACING) | (np.minimum(x, y) < -2.5 * SPACING) | (np.maximum(x, y) > 12.5 * SPACING)
        parts = []
        for name, chosen in (("boundary", is_wall), ("fluid", is_fluid)):
            mass = DENSITY * SPACING**3
            parts.append(
                get_particle_array(
                    name=name, x=x[chosen], y=y[chosen], z=z[chosen], m=mass, rho=DENSITY, h=1.3 * SPACING
                )
            )
        self.scheme.setup_properties(parts)
        return parts

    def create_scheme(self):
        scheme = WCSPHScheme(
            ["fluid"], ["boundary"], dim=3, rho0=DENSITY, c0=SPEED_OF_SOUND, h0=1.3 * SPACING, hdx=1.3, gz=-9.81
        )
        scheme.configure_solver(dt=5e-4, tf=0.03, pfreq=20)
        return scheme


FallingBlock(fname="pysph").run(["--directory", sys.argv[1], "--compress-output", "--quiet"])
