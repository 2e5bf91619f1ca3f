"""Particles from files."""

from __future__ import annotations

import os
from collections.abc import ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._arrays import words_of


class Particles:
    """A frame of particles: positions, and other attributes by name.

    ``particles["velocity"]`` is the attribute with this name, or else the one with the role that the name
    stands for: an array of shape (N,) or (N, K). As in a data frame, ``len(particles)`` is the number of
    particles; iteration, `keys`, `values` and `items` give the attributes, as in a mapping. The arrays
    belong to the caller, who may change them.

    Attributes
    ----------
    positions : ndarray, shape (N, 3), float32 or float64
        Positions in the unit of the file, in its precision.
    roles : dict of str to str
        The recognised roles of attributes: ``"velocity"``, ``"acceleration"``, ``"radius"``, ``"color"``,
        ``"id"``, ``"normal"``, ``"density"``, ``"mass"`` or ``"kind"``.
    notes : tuple of str
        Remarks about the file, such as skipped rows.
    path : str or None
        The file that the particles were read from.

    Parameters
    ----------
    positions : ndarray, shape (N, 3), float32 or float64
        Positions. The array is not copied.
    attributes : mapping of str to ndarray, optional
        Attributes by name, shape (N,) or (N, K). `reconstruct` checks their shapes and types.
    roles : mapping of str to str, optional
        The roles of attributes by name.
    notes : tuple of str, optional
        Remarks.
    path : str, optional
        The file that the particles came from.
    file_hash : str, optional
        The hash of this file, which outputs record. Without it, `Surface.write` does not take the particles as
        its `source`.
    """

    def __init__(
        self,
        positions: NDArray[Any],
        attributes: Mapping[str, NDArray[Any]] | None = None,
        *,
        roles: Mapping[str, str] | None = None,
        notes: tuple[str, ...] = (),
        path: str | None = None,
        file_hash: str | None = None,
    ) -> None:
        self.positions = positions
        self._attributes = dict(attributes or {})
        self.roles: dict[str, str] = dict(roles or {})
        self.notes = notes
        self.path = path
        self._hash = file_hash
        #: Text in the form of the file: indices and distinct words.
        self._texts: dict[str, tuple[NDArray[np.int32], list[str]]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        found = self._found(name)
        if found is None:
            known = ", ".join(f"`{other}`" for other in self._attributes) or "none"
            raise KeyError(f"no attribute `{name}`; the attributes are: {known}")
        return self._attributes[found]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self._found(name) is not None

    def get(self, name: str, default: Any = None) -> Any:
        """The attribute, or `default` if there is none."""
        return self[name] if name in self else default

    def _found(self, name: str) -> str | None:
        """The name of the attribute with this name, or else with the role that it stands for."""
        if name in self._attributes:
            return name
        role = _native.role_of(name) or name
        return next((other for other in self._attributes if self.roles.get(other) == role), None)

    def __iter__(self) -> Iterator[str]:
        return iter(self._attributes)

    def __len__(self) -> int:
        """The number of particles."""
        return len(self.positions)

    def keys(self) -> KeysView[str]:
        """The names of the attributes."""
        return self._attributes.keys()

    def values(self) -> ValuesView[NDArray[Any]]:
        """The arrays of the attributes."""
        return self._attributes.values()

    def items(self) -> ItemsView[str, NDArray[Any]]:
        """The names and the arrays of the attributes."""
        return self._attributes.items()

    def __repr__(self) -> str:
        names = ", ".join(self._attributes) or "none"
        return f"<Particles: {len(self.positions)}, attributes: {names}>"


def read(
    path: str | os.PathLike[str], *, columns: str | Mapping[str, str | int] | None = None
) -> Particles:
    """Read particles from a file of any format that meniscus reads: PLY, BGEO, VTK and lists of its files, HDF5,
    USD, Alembic, OpenVDB, PRT, JSON, NumPy, LAMMPS, XYZ, delimited text and more.

    The content determines the format, and the file may be compressed with gzip or zstd.

    Parameters
    ----------
    path : path-like
        The file. A step of a file with several steps has a path such as ``"dump.lammpstrj/step=1000"``.
    columns : str or mapping, optional
        New names for columns of a table, each with a column by its name or its number from 1 on, such as
        ``"x=centroid_x,y=centroid_y,z=3"`` or ``{"x": "centroid_x", "y": "centroid_y", "z": 3}``.

    Returns
    -------
    Particles
        Positions in the precision of the file, and all attributes with their types in the file.

    Raises
    ------
    OSError
        If the file cannot be opened.
    FormatError
        If the file contains no readable particles. The message has the position in the file.
    ValueError
        If ``columns`` does not name columns.
    """
    if isinstance(columns, Mapping):
        columns = ",".join(f"{name}={column}" for name, column in columns.items())
    positions, attributes, notes, file_hash = _native.read(path, columns)
    return particles_of(positions, attributes, notes=tuple(notes), path=os.fspath(path), file_hash=file_hash)


def particles_of(
    positions: NDArray[Any],
    attributes: list[tuple[str, str | None, int, NDArray[Any], list[str] | None]],
    *,
    notes: tuple[str, ...] = (),
    path: str | None = None,
    file_hash: str | None = None,
) -> Particles:
    """Particles from the arrays of the native module."""
    arrays: dict[str, NDArray[Any]] = {}
    roles, texts = {}, {}
    for name, role, arity, values, table in attributes:
        if table is not None:
            texts[name] = values, table
            values = words_of(values, table)
        arrays[name] = values if arity == 1 else values.reshape(-1, arity)
        if role is not None:
            roles[name] = role
    particles = Particles(positions, arrays, roles=roles, notes=notes, path=path, file_hash=file_hash)
    particles._texts = texts
    return particles
