"""Simulates a block of particles that falls with Newton, which writes frames with its own viewer of USD.

usage: simulate_newton.py FOLDER

It writes the particles as points into points.usdc, and as instances of a sphere, the viewer's default, into
spheres.usda.
"""

import sys
from pathlib import Path

import newton
import warp
from newton.viewer import ViewerUSD

FRAME_COUNT = 4
RATE = 60
SPACING = 0.1
COUNT = 10

warp.set_device("cpu")
builder = newton.ModelBuilder()
builder.add_particle_grid(
    pos=warp.vec3(0.0, 0.0, 0.3),
    rot=warp.quat_identity(),
    vel=warp.vec3(0.5, 0.0, 0.0),
    dim_x=COUNT,
    dim_y=COUNT,
    dim_z=COUNT,
    cell_x=SPACING,
    cell_y=SPACING,
    cell_z=SPACING,
    mass=1.0,
    jitter=0.0,
    radius_mean=SPACING / 2,
)
builder.add_ground_plane()
model = builder.finalize()
solver = newton.solvers.SolverXPBD(model)
before, after = model.state(), model.state()
folder = Path(sys.argv[1])
viewers = [
    ViewerUSD(str(folder / name), fps=RATE, num_frames=FRAME_COUNT, points_as_spheres=as_spheres)
    for name, as_spheres in (("points.usdc", False), ("spheres.usda", True))
]
for viewer in viewers:
    viewer.set_model(model)
    viewer.show_particles = True
for frame in range(FRAME_COUNT):
    for viewer in viewers:
        viewer.begin_frame(frame / RATE)
        viewer.log_state(before)
        viewer.end_frame()
    before.clear_forces()
    solver.step(before, after, model.control(), None, 1 / RATE)
    before, after = after, before
for viewer in viewers:
    viewer.close()
