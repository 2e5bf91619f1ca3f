"""Bodies that the surface does not enter."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, TypeAlias, Union

import numpy as np

from . import _native
from ._arrays import as_array, as_points
from ._options import bytes_of

#: A file, a mesh as a pair of vertices and triangles, an object with ``vertices`` and ``faces`` such as
#: ``trimesh.Trimesh``, or an `Obstacle`.
ObstacleLike: TypeAlias = Union["Obstacle", "str", "os.PathLike[str]", tuple[Any, Any], Any]


class Obstacle:
    """A body that the surface does not enter, such as a ship or a vessel.

    Use the same object for all frames of a sequence if the body is static: it caches the distances from the
    body.

    Parameters
    ----------
    vertices : array_like, shape (V, 3)
        Vertex positions in world units.
    triangles : array_like, shape (T, 3)
        Vertex indices, integers. The mesh may have holes, repeated vertices, and triangles with the wrong
        orientation.

    Raises
    ------
    TypeError, ValueError
        If the arrays have other shapes or types, or a triangle has the index of a vertex that does not exist.
    """

    __slots__ = ("_native",)

    def __init__(self, vertices: Any, triangles: Any) -> None:
        positions = as_points(vertices, "vertices").astype(np.float64, copy=False)
        indices = as_array(triangles, "triangles")
        if indices.ndim != 2 or indices.shape[1] != 3:
            raise ValueError(f"triangles must have the shape (T, 3), not {indices.shape}")
        if indices.dtype.kind not in "iu":
            raise TypeError(f"triangles must be integers, not {indices.dtype}")
        # An index of 2**63 or more becomes negative, which the native module refuses too.
        self._native = _native.Obstacle.from_mesh(
            np.ascontiguousarray(positions), np.ascontiguousarray(indices, np.int64)
        )

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], *, memory: int | str | None = None) -> Obstacle:
        """The obstacle in a file: a mesh of any format that meniscus reads, or a level set in .vdb.

        Parameters
        ----------
        path : path-like
            The file.
        memory : int or str, optional
            Limit of the memory for reading a level set, in bytes or as text such as ``"8GiB"``; by default, half of
            the machine's memory.

        Raises
        ------
        OSError
            If the file cannot be opened.
        ValueError
            If the memory limit is not a positive number of bytes.
        FormatError
            If the file contains neither a mesh nor a level set.
        MemoryLimitError
            If a level set needs more memory than the limit.
        """
        obstacle = cls.__new__(cls)
        obstacle._native = _native.Obstacle.from_file(path, bytes_of(memory))
        return obstacle


class Bodies:
    """The obstacles of a call or a sequence. A file is read once, and again after a change.

    Parameters
    ----------
    memory : int
        Limit of the memory for reading a level set, in bytes.
    """

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._files: dict[str, Obstacle] = {}

    def natives(self, obstacles: ObstacleLike | Iterable[ObstacleLike] | None) -> list[_native.Obstacle]:
        """The obstacles that a caller passed: none, one or several."""
        if obstacles is None:
            return []
        several: Any = [obstacles] if _is_one(obstacles) else obstacles
        if not isinstance(several, Iterable):
            raise _not_one(several)
        return [self._obstacle(obstacle)._native for obstacle in several]

    def _obstacle(self, value: Any) -> Obstacle:
        if isinstance(value, Obstacle):
            return value
        if isinstance(value, (str, os.PathLike)):
            path = os.path.abspath(value)
            known = self._files.get(path)
            if known is None or not known._native.is_current():
                known = self._files[path] = Obstacle.from_file(value, memory=self._memory)
            return known
        if isinstance(value, (tuple, list)) and len(value) == 2:
            return Obstacle(value[0], value[1])
        if _is_mesh(value):
            return Obstacle(value.vertices, value.faces)
        raise _not_one(value)


def _is_one(value: Any) -> bool:
    """Whether this is one obstacle instead of several. A pair is a mesh unless it is a pair of obstacles."""
    if isinstance(value, tuple) and len(value) == 2:
        return not any(isinstance(part, tuple) or _is_one(part) for part in value)
    return isinstance(value, (Obstacle, str, os.PathLike)) or _is_mesh(value)


def _is_mesh(value: Any) -> bool:
    return hasattr(value, "vertices") and hasattr(value, "faces")


def _not_one(value: Any) -> TypeError:
    return TypeError(
        "an obstacle is a file, a pair (vertices, triangles), an object with vertices and faces, or an Obstacle; "
        f"not {type(value).__name__}"
    )
