"""The exceptions of the package."""


class MeniscusError(Exception):
    """The base class of the package's own exceptions.

    Failures of the system are `OSError` as usual, and arguments of the wrong type are `TypeError`.
    """


class OptionError(MeniscusError, ValueError):
    """An option is unknown or out of its range, two contradict each other, or the particle spacing cannot be
    measured."""


class ParticleError(MeniscusError, ValueError):
    """The particles have no surface: there are none, a needed attribute is missing, or the voxels are too
    small for the frame."""


class MemoryLimitError(MeniscusError, MemoryError):
    """The frame needs more memory than the limit. The message has both."""


class FormatError(MeniscusError, ValueError):
    """A file cannot be read, or a format cannot hold the data. The message has the position in the file."""


class CancelledError(MeniscusError):
    """The reconstruction was cancelled."""
