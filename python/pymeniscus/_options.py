"""The options of the method.

The core defines the options, and this module gets them from the core: a new option needs no code here.
`OptionValues`, which type checkers read, is in `_option_values.py`. ``python/generate_options.py`` of a clone
writes that file, and a test compares it with the core.
"""

from __future__ import annotations

import difflib
import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native
from ._errors import OptionError
from ._option_values import OptionValues

if TYPE_CHECKING:
    # Type checkers know this module without its package.
    from typing_extensions import Unpack

__all__ = ["OptionInfo", "OptionValues", "Options", "as_pairs", "as_values", "option_table"]

#: Options for which the functions have separate keywords.
RESERVED = frozenset({"attributes"})


@dataclass(frozen=True)
class OptionInfo:
    """An option of the method.

    Attributes
    ----------
    name : str
        The keyword of the option.
    group : str
        The heading above the option in the help of the command line.
    kind : str
        The kind of value: ``"number"``, ``"count"``, ``"switch"``, ``"length"`` or ``"text"``.
    range : str or None
        The allowed values, such as ``"0 to 4"``; None if they depend on other options.
    choices : tuple of str
        The allowed words; empty for other values.
    other_names : tuple of str
        Other names of some of these words, which are allowed too: ``"flip"`` is the preset ``"noisy"``.
    help : str
        The effect of the option, with its unit and its default.
    """

    name: str
    group: str
    kind: str
    range: str | None
    choices: tuple[str, ...]
    other_names: tuple[str, ...]
    help: str


@lru_cache(maxsize=None)
def option_table() -> tuple[OptionInfo, ...]:
    """Every option of the method, in the order of the command line's help.

    Returns
    -------
    tuple of OptionInfo
    """
    return tuple(
        OptionInfo(
            name=row["name"],
            group=row["group"],
            kind=row["kind"],
            range=row["range"],
            choices=tuple(row["choices"]),
            other_names=tuple(row["other_names"]),
            help=row["help"],
        )
        for row in _native.option_table()
        if row["name"] not in RESERVED
    )


def as_pairs(options: Mapping[str, Any], others: Iterable[str] = ()) -> list[tuple[str, str]]:
    """Options as pairs of name and text, for the core. Options that are None are left out.

    Parameters
    ----------
    options : mapping of str to Any
        Options by name.
    others : iterable of str
        Other keywords of the function, which may be what the caller meant by an unknown name.

    Raises
    ------
    TypeError
        If no option has the name, or the value has the wrong type.
    OptionError
        If the value of a switch is neither True nor False.
    """
    known = {info.name: info for info in option_table()}
    pairs = []
    for name, value in options.items():
        if name not in known:
            near = difflib.get_close_matches(name, [*known, *others], n=1)
            hint = f"; did you mean `{near[0]}`?" if near else ""
            raise TypeError(f"unknown option `{name}`{hint}")
        if value is None:
            continue
        if known[name].kind == "switch" and not isinstance(value, (bool, np.bool_)):
            raise OptionError(f"option `{name}`: must be True or False, not {value!r}")
        pairs.append((name, _text(name, value)))
    return pairs


def as_values(pairs: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """Options that the core resolved, by name: numbers, True or False, or words. A box is six numbers. These
    values give the same pairs again."""
    kinds = {info.name: info.kind for info in option_table()}
    convert: dict[str, Callable[[str], Any]] = {
        "number": float, "length": float, "count": int, "switch": "true".__eq__, "text": str,
    }  # fmt: skip
    values = {name: convert[kinds[name]](text) for name, text in pairs if name in kinds}
    if "clip" in values:
        values["clip"] = tuple(float(number) for number in values["clip"].split(","))
    return values


def _text(name: str, value: Any) -> str:
    """The text of a value on the command line. A number gets as few digits as suffice to read the same number
    back."""
    if isinstance(value, str):
        return value
    if name == "where":
        raise TypeError("`where` must be a condition as text here: only `reconstruct` takes a mask of the particles")
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    try:
        numbers = np.asarray(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise TypeError(f"option `{name}` cannot be {type(value).__name__}") from None
    return ",".join(repr(float(number)) for number in numbers)


def bytes_of(memory: int | str | None) -> int:
    """The number of bytes in a memory limit; None means half of the machine's memory.

    Raises
    ------
    ValueError
        If it is not a positive number, or has an unknown unit.
    TypeError
        If it is neither a number nor text.
    """
    if memory is None:
        return _native.default_memory()
    if isinstance(memory, str):
        memory = _native.memory_bytes(memory)
    elif not isinstance(memory, numbers.Real):
        raise TypeError(f"memory must be a number of bytes or text, not {type(memory).__name__}")
    if not 1 <= memory < 2**64:
        raise ValueError(f"memory must be a positive number of bytes, not {memory}")
    return int(memory)


def thread_count(threads: int | None) -> int | None:
    """A checked number of threads; None means one for each core.

    Raises
    ------
    TypeError
        If it is not an integer.
    ValueError
        If it is not from 1 to 1024.
    """
    if threads is None:
        return None
    if not isinstance(threads, numbers.Integral):
        raise TypeError(f"threads must be an integer, not {type(threads).__name__}")
    if not 1 <= threads <= 1024:
        raise ValueError(f"threads must be from 1 to 1024, not {threads}")
    return int(threads)


def extensions_of(formats: Iterable[str]) -> list[str]:
    """Extensions of files as the core names them: in lower case, without a dot.

    Raises
    ------
    TypeError
        If the formats are not text.
    """
    given: Any = formats.split(",") if isinstance(formats, str) else formats
    names: list[Any] = list(given) if isinstance(given, Iterable) else [given]
    if not all(isinstance(name, str) for name in names):
        raise TypeError('formats must be extensions such as ["glb", "vdb"]')
    return [name.strip().lstrip(".").lower() for name in names]


class Options(Mapping[str, Any]):
    """Checked options of the method, which you can pass to several calls, compare, or pickle.

    Parameters
    ----------
    **options
        See `OptionValues`. None means the default of the preset.

    Raises
    ------
    TypeError
        If no option has the name.
    OptionError
        If a text is not a value of its option. The call that uses the options checks the ranges.

    Examples
    --------
    >>> fine = Options(preset="splash", voxel_size="0.3d")
    >>> fine["preset"]
    'splash'
    >>> surface = reconstruct(points, **fine)                  # doctest: +SKIP
    """

    __slots__ = ("_values",)

    def __init__(self, **options: Unpack[OptionValues]) -> None:
        _native.check_options(as_pairs(options))
        self._values: dict[str, Any] = {name: value for name, value in options.items() if value is not None}

    def replace(self, **options: Unpack[OptionValues]) -> Options:
        """A copy with other options.

        Parameters
        ----------
        **options
            Options to add or to replace. None removes an option.

        Returns
        -------
        Options

        Raises
        ------
        TypeError
            If no option has the name.
        OptionError
            If a text is not a value of its option.
        """
        return Options(**{**self._values, **options})

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def _canonical(self) -> tuple[tuple[str, str], ...]:
        return tuple(_native.check_options(as_pairs(self._values)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Options) and self._canonical() == other._canonical()

    def __hash__(self) -> int:
        return hash(self._canonical())

    def __repr__(self) -> str:
        return f"Options({', '.join(f'{name}={value!r}' for name, value in self._values.items())})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (self._values,)


def _unpickled(values: dict[str, Any]) -> Options:
    return Options(**values)


