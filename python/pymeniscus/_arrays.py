"""Converts arrays of any library to NumPy arrays, without a copy if the layout allows it."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: DLPack's types of devices whose memory the processor reads: main memory, main memory that is pinned for CUDA or
#: ROCm, and managed memory of CUDA.
_READABLE = frozenset({1, 3, 11, 13})


def as_array(values: Any, name: str) -> NDArray[Any]:
    """The values as a NumPy array.

    Parameters
    ----------
    values : array_like
        A NumPy array, or anything with ``__dlpack__``, ``__array_interface__``, ``__array__`` or the buffer
        protocol, or a nested sequence of numbers.
    name : str
        A name for the values in error messages.

    Returns
    -------
    numpy.ndarray
        A view of the same memory, or a copy if the values are a sequence.

    Raises
    ------
    TypeError
        If the values are in the memory of a device, are not an array, or are a masked array with masked
        values.
    """
    if np.ma.is_masked(values):
        raise TypeError(f"{name} has masked values: remove them, or replace them with `filled()`")
    if isinstance(values, np.ndarray):
        return np.asarray(values)
    if hasattr(values, "__dlpack__") and hasattr(values, "__dlpack_device__"):
        device_type, device = values.__dlpack_device__()
        if int(device_type) not in _READABLE:
            raise TypeError(
                f"{name} is in the memory of a device (DLPack type {int(device_type)}, number {device}): "
                "copy it to the main memory first"
            )
        try:
            return np.from_dlpack(values)
        except (BufferError, RuntimeError, TypeError):
            # Older versions of DLPack cannot represent read-only memory, and some libraries refuse tensors
            # that record gradients. Try the other protocols.
            pass
    try:
        array = np.asarray(values)
    except (ValueError, RuntimeError) as error:
        # PyTorch raises a RuntimeError for a tensor that records gradients.
        raise TypeError(f"{name} cannot be read as an array: {error}") from error
    if array.dtype == object:
        raise TypeError(f"{name} is not an array of numbers but {type(values).__name__}")
    return array


def as_points(values: Any, name: str = "points") -> NDArray[Any]:
    """Points, shape (N, 3), as a C-contiguous array of float32 or float64 in the machine's byte order.

    float32 and float64 keep their precision, float16 becomes float32, and integers become float64.

    Raises
    ------
    TypeError
        If the values are not real numbers; Boolean values are not.
    ValueError
        If the shape is not (N, 3).
    """
    if isinstance(values, (str, os.PathLike)):
        raise TypeError(f"{name} must be an array; read a file by pymeniscus.read({os.fspath(values)!r})")
    array = as_array(values, name)
    kind, size = array.dtype.kind, array.dtype.itemsize
    if kind == "f":
        dtype = np.dtype(np.float32 if size <= 4 else np.float64)
    elif kind in "iu":
        dtype = np.dtype(np.float64)
    else:
        raise TypeError(f"{name} must be real numbers, not {array.dtype}")
    if array.shape == (0,):
        # An empty list has no second dimension.
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        is_transposed = array.ndim == 2 and array.shape[0] == 3 and array.shape[1] > 4
        advice = f": pass the transpose, `{name}.T`" if is_transposed else ""
        raise ValueError(f"{name} must have the shape (N, 3), not {array.shape}{advice}")
    return np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"])


def as_reals(values: Any, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Real numbers of this shape, in their type and layout.

    Raises
    ------
    TypeError
        If the values are not real numbers.
    ValueError
        If they have another shape.
    """
    array = as_array(values, name)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, not {array.dtype}")
    if array.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}, not {array.shape}")
    return array


def as_mask(values: Any, count: int, name: str) -> NDArray[np.bool_]:
    """A mask of `count` particles.

    Raises
    ------
    TypeError
        If the values are not truth values.
    ValueError
        If their number is not `count`.
    """
    array = as_array(values, name)
    if array.dtype != np.bool_:
        raise TypeError(f"{name} must be a condition as text, or an array of truth values, not of {array.dtype}")
    if array.shape != (count,):
        raise ValueError(f"{name} must have the shape ({count},), not {array.shape}")
    return array


def as_attribute(
    values: Any, count: int, name: str
) -> tuple[int, NDArray[Any], list[str] | None]:
    """An attribute of `count` particles: the number of values per particle, the values as a flat array, and
    for text the distinct words, which the values then index.

    Raises
    ------
    TypeError
        If the values are neither numbers nor text.
    ValueError
        If the number of particles is not `count`, or integers do not fit into signed 64 bits.
    """
    array = as_array(values, f"the attribute `{name}`") if not _is_text(values) else np.asarray(values)
    if array.ndim not in (1, 2) or array.shape[0] != count:
        raise ValueError(
            f"the attribute `{name}` must have the shape ({count},) or ({count}, K), not {array.shape}"
        )
    arity = 1 if array.ndim == 1 else int(array.shape[1])
    if arity == 0:
        raise ValueError(f"the attribute `{name}` has no values")
    kind, size = array.dtype.kind, array.dtype.itemsize
    if kind in "US":
        indices, table = _in_order(array.astype(str).reshape(-1))
        return arity, indices, table
    dtype: Any
    if kind == "f":
        dtype = np.float32 if size <= 4 else np.float64
    elif kind == "b" or (kind == "u" and size == 1):
        dtype = np.uint8
    elif (kind == "i" and size <= 4) or (kind == "u" and size == 2):
        dtype = np.int32
    elif kind in "iu":
        dtype = np.int64
        if kind == "u" and size == 8 and array.size and int(array.max()) > np.iinfo(np.int64).max:
            raise ValueError(f"the attribute `{name}` has integers above 2**63 - 1")
    else:
        raise TypeError(f"the attribute `{name}` must be numbers or text, not {array.dtype}")
    return arity, np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"]).reshape(-1), None


def words_of(indices: NDArray[np.int32], table: list[str]) -> NDArray[np.str_]:
    """The words with these indices. An index outside the table means that there is no word: it becomes ""."""
    is_word = (indices >= 0) & (indices < len(table))
    return np.asarray([*table, ""], np.str_)[np.where(is_word, indices, len(table))]


def _in_order(words: NDArray[np.str_]) -> tuple[NDArray[np.int32], list[str]]:
    """Indices into the distinct words in order of their first appearance, as readers of files return them.
    Empty words have the index -1."""
    distinct, first, inverse = np.unique(words, return_index=True, return_inverse=True)
    order = [index for index in np.argsort(first) if distinct[index] != ""]
    rank = np.full(len(distinct), -1, np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return rank[inverse.reshape(-1)], [str(distinct[index]) for index in order]


def _is_text(values: Any) -> bool:
    return isinstance(values, (list, tuple)) and bool(values) and isinstance(values[0], str)
