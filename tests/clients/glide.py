"""A block of particles that glides along x, for checks of motion blur.

Each frame is the same block, moved by a whole number of voxels, so that all surfaces have the same number of
vertices: programs would interpolate between the frames. The block passes 16,384 voxels, where the origin to which
positions refer changes.
"""

VOXEL_SIZE = 0.05
SPACING = 2 * VOXEL_SIZE
FPS = 24
FRAMES = (1, 2, 3)
# The distance between two frames, in units and in voxels, and the speed in units per second.
STEP = 1.2
SPEED = STEP * FPS
START = 16384 * VOXEL_SIZE - 2 * STEP
# The size of the block, in particles.
SIZE = (16, 10, 6)


def positions(frame):
    x, y, z = SIZE
    shift = START + frame * STEP
    return [(shift + SPACING * i, SPACING * j, SPACING * k) for i in range(x) for j in range(y) for k in range(z)]
