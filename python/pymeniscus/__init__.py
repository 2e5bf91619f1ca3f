"""Reconstructs smooth surfaces from the particles of a simulation.

>>> import numpy as np, pymeniscus
>>> points = np.stack(np.meshgrid(*[np.arange(8) * 0.1] * 3), -1).reshape(-1, 3)
>>> surface = pymeniscus.reconstruct(points)
>>> surface.certificate.holds
True

`reconstruct` makes the surface of one frame. A `Sequence` makes the surfaces of many frames with the same
settings. `read` reads particles from files. `convert`, `render` and `watch` run the command line, which you
can also run as ``python -m pymeniscus``.

Lengths are in the unit of the particles. An option that is a length also takes text: ``"0.4d"`` is 0.4
particle spacings and ``"5h"`` is 5 voxels. The voxel size itself cannot be in voxels.
"""

from ._commands import CommandError, FinishedFrame, Watch, convert, render, watch
from ._errors import (
    FormatError,
    MemoryLimitError,
    MeniscusError,
    OptionError,
    ParticleError,
)
from ._native import version as _version
from ._obstacles import Obstacle
from ._options import OptionInfo, Options, OptionValues, option_table
from ._particles import Particles, read
from ._reconstruct import Sequence, reconstruct
from ._surface import Certificate, LevelSet, Surface

__version__ = _version()

__all__ = [
    "Certificate",
    "CommandError",
    "FinishedFrame",
    "FormatError",
    "LevelSet",
    "MemoryLimitError",
    "MeniscusError",
    "Obstacle",
    "OptionError",
    "OptionInfo",
    "OptionValues",
    "Options",
    "ParticleError",
    "Particles",
    "Sequence",
    "Surface",
    "Watch",
    "__version__",
    "convert",
    "option_table",
    "read",
    "reconstruct",
    "render",
    "watch",
]
