"""The exceptions of the package."""


class MeniscusError(Exception):
    """The base class of the package's own exceptions.

    As usual, failures of the system raise `OSError`, and arguments of the wrong type raise `TypeError`.
    """


class OptionError(MeniscusError, ValueError):
    """An option is unknown or out of its range, two options contradict each other, or the particle spacing
    cannot be measured."""


class ParticleError(MeniscusError, ValueError):
    """The particles cannot have a surface: there are none, no position is finite, a required attribute is
    missing, or the voxels are too small for the extent of the frame."""


class MemoryLimitError(MeniscusError, MemoryError):
    """The frame, or the level set of an obstacle, needs more memory than the limit. The message has both
    numbers."""


class FormatError(MeniscusError, ValueError):
    """A file cannot be read, or a format cannot store the data. For a file, the message has the position of
    the fault."""
