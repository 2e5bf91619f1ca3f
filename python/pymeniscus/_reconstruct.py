"""Reconstruction of surfaces from particles."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._arrays import as_array, as_attribute, as_mask, as_points, as_reals, words_of
from ._obstacles import Bodies, ObstacleLike
from ._options import OptionValues, as_pairs, as_values, bytes_of, extensions_of, thread_count
from ._particles import Particles
from ._surface import Surface

if TYPE_CHECKING:
    # Type checkers know this module without its package.
    from typing_extensions import Unpack

#: Attributes of the particles: arrays by name. Also names of computed attributes, and for `Particles` of theirs, or "all".
Attributes = Mapping[str, Any] | Iterable[str] | str | None

#: Keywords of `reconstruct` that are not options.
_KEYWORDS = ("radii", "velocity", "attributes", "obstacles", "formats", "threads", "memory", "scratch",
             "progress")  # fmt: skip

#: A function that is called with the name of the phase and the fraction of the phase that is done.
Progress = Callable[[str, float], object]


def reconstruct(
    points: Any,
    *,
    radii: Any = None,
    velocity: Any = None,
    attributes: Attributes = None,
    obstacles: ObstacleLike | Iterable[ObstacleLike] | None = None,
    formats: Iterable[str] = (),
    threads: int | None = None,
    memory: int | str | None = None,
    scratch: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
    **options: Unpack[OptionValues],
) -> Surface:
    """The surface of one frame of particles.

    The method starts from a smooth sum of kernels, and smooths the surface within bounds around that start.
    The same particles and options give the same bytes on any number of threads. The call
    releases the interpreter's lock while it computes, and Ctrl-C interrupts it. Do not change the arrays
    during the call.

    Parameters
    ----------
    points : array_like, shape (N, 3), or Particles
        Positions. float32 and float64 keep their precision. NumPy arrays and everything with ``__dlpack__``,
        ``__array_interface__``, ``__array__`` or the buffer protocol are used without a copy if they are
        C-contiguous. Positions that are not finite are left out and counted in the report, unless all are.
    radii : array_like, shape (N,), optional
        Each particle's own radius, in the unit of the positions. This argument sets the option
        `radius_attribute` to ``"radius"``.
    velocity : array_like, shape (N, 3), optional
        Velocities in units of length per second. The surface gets velocities, too. With
        ``anisotropy="velocity"``, they stretch the particles.
    attributes : mapping of str to array_like, iterable of str, or "all", optional
        Attributes that the surface gets: arrays of numbers or text by name, shape (N,) or (N, K). A vertex
        gets the mean of real numbers over the particles around it, and the integers and text of the nearest
        particle. If `points` are `Particles`, names of their attributes, or ``"all"``. These names are computed,
        unless the particles have an attribute of that name: ``"speed"`` and ``"vorticity"`` of velocities, and
        ``"normal_curvature"`` of the mesh. In a mapping, they have None in place of an array. Without velocities,
        a warning says that an attribute is not computed.
    obstacles : Obstacle, path-like, (vertices, triangles), or an iterable of these, optional
        Bodies that the surface does not enter.
    formats : iterable of str, optional
        Extensions of the files that you will write with `Surface.write`. They have two effects. For ``"vdb"``
        and ``"exr"``, attributes are also computed at voxels. For ``"stl"``, a mesh far from the origin gets
        positions that are rounded to 32 bits in world coordinates.
    threads : int, optional
        Number of threads, 1 to 1024; one for each core by default. Concurrent calls use separate threads.
        `Surface.write` and `LevelSet.sample` use all cores, whatever this number is.
    memory : int or str, optional
        Limit of the memory for the frame, in bytes or as text such as ``"8GiB"``; by default, half of the
        machine's memory.
    scratch : path-like, optional
        A folder for the temporary files of a frame that needs more memory than the limit. Without it, such a
        frame raises `MemoryLimitError`.
    progress : callable, optional
        Called as ``progress(phase, fraction)`` on the thread of the caller. Phases are ``"prepare"``,
        ``"rasterize"``, ``"smooth"``, ``"contour"`` and ``"interpolate"``. If it raises an exception, the
        computation ends, and the caller gets the exception.
    **options
        Every option of the method: see `OptionValues`, or `option_table` for their ranges and defaults. `where`
        chooses the particles that form the surface: a condition on their attributes, as on the command line, or
        a mask, array_like of bool, shape (N,).

    Returns
    -------
    Surface

    Raises
    ------
    TypeError
        For an unknown option, for `radii` with another `radius_attribute`, and for arrays of a wrong type or in
        the memory of a device.
    ValueError
        For arrays of a wrong shape, and obstacles that are too far from the origin.
    OptionError
        If an option is out of its range, or the particle spacing cannot be measured. A subclass of `ValueError`.
    ParticleError
        If the spacing or the preset must be measured and there are no particles, no position is finite, an
        attribute that an option needs is missing, or the voxels are too small for the extent of the frame. A
        subclass of `ValueError`.
    MemoryLimitError
        If the frame needs more memory than the limit. A subclass of `MemoryError`.
    OSError
        If scratch files cannot be written.
    KeyboardInterrupt
        On Ctrl-C, within 0.2 s unless the frame has millions of particles.

    Warns
    -----
    UserWarning
        About options without effect, a preset that does not suit the particles or that ``"auto"`` could not
        choose by them, a resolution that is probably wrong, and particles that were left out.

    Examples
    --------
    >>> surface = reconstruct(points, preset="splash", voxel_size="0.3d", velocity=v)      # doctest: +SKIP
    >>> surface.write("frame.glb")                                                         # doctest: +SKIP
    """
    mask = None if isinstance(options.get("where"), str) else options.pop("where", None)
    as_pairs(options, _KEYWORDS)
    given = _Given(points, radii, velocity, attributes, mask)
    limits = bytes_of(memory), _folder_of(scratch)
    bodies = Bodies(limits[0]).natives(obstacles)
    _warn_of_ignored(given, options, bodies)
    return _run(given, given.pairs(options), bodies, formats, limits, threads, progress)


class Sequence:
    """Reconstructs the frames of a sequence with the settings of the first one.

    If each frame had its own measured particle spacing, the surface would flicker. A sequence measures the
    spacing once, and uses the same voxel size and the same radii for all frames. It also chooses the preset
    once, with ``preset="auto"``.

    Parameters
    ----------
    first_frame : array_like, shape (N, 3), or Particles, optional
        The frame to measure; by default, the first frame that you reconstruct. For a condition in `where`, it
        must be `Particles` with the attributes. The constructor does not reconstruct its surface. It uses all
        cores.
    radii : array_like, shape (N,), optional
        The radii of the particles of `first_frame`.
    velocity : array_like, shape (N, 3), optional
        The velocities of the particles of `first_frame`, which ``anisotropy="velocity"`` needs.
    memory, scratch, **options
        As for `reconstruct`. With `spacing`, and a preset other than ``"auto"``, the settings do not depend on
        any frame.

    Notes
    -----
    Several threads may use one sequence: it computes their frames in parallel. Only the measurement on the
    first frame makes the others wait. ``meniscus convert`` measures on the first, middle and last frame: pass
    its results as `spacing` and `preset` to get the same bytes. Files of obstacles are read once, and again
    after a change.

    Examples
    --------
    >>> sequence = Sequence(preset="noisy", spacing=0.02)                   # doctest: +SKIP
    >>> for frame in simulation:                                            # doctest: +SKIP
    ...     sequence.reconstruct(frame.x, velocity=frame.v).write(f"{frame.number:04}.glb")
    """

    def __init__(
        self,
        first_frame: Any = None,
        *,
        radii: Any = None,
        velocity: Any = None,
        memory: int | str | None = None,
        scratch: str | os.PathLike[str] | None = None,
        **options: Unpack[OptionValues],
    ) -> None:
        self._options: dict[str, Any] = dict(options)
        for name in self._options:
            if name in _KEYWORDS:
                raise TypeError(f"`{name}` is an argument of Sequence.reconstruct, not of Sequence")
        _native.check_options(as_pairs(self._options))
        if first_frame is None and (radii is not None or velocity is not None):
            raise TypeError("radii and velocity are those of first_frame: pass it too")
        self._limits = bytes_of(memory), _folder_of(scratch)
        self._bodies = Bodies(self._limits[0])
        self._lock = threading.Lock()
        self._resolved: dict[str, Any] | None = None
        self._has_frame = False
        if first_frame is not None:
            self._settings_on(_Given(first_frame, radii, velocity, None, None))

    def _settings_on(self, given: _Given) -> dict[str, Any]:
        """The settings with all lengths in world units. The first call resolves them on its frame. A warning
        points to the caller of the public function."""
        warning = None
        with self._lock:
            if self._resolved is None:
                pairs, warning = _native.resolve(given.pairs(self._options), given.points, given.attributes)
                self._resolved = as_values(pairs)
            resolved = self._resolved
        if warning is not None:
            warnings.warn(warning, stacklevel=3)
        return resolved

    @property
    def settings(self) -> dict[str, Any] | None:
        """The settings of the sequence, as in `Surface.settings`; None before the first frame."""
        return None if self._resolved is None else dict(self._resolved)

    def reconstruct(
        self,
        points: Any,
        *,
        radii: Any = None,
        velocity: Any = None,
        attributes: Attributes = None,
        where: Any = None,
        obstacles: ObstacleLike | Iterable[ObstacleLike] | None = None,
        formats: Iterable[str] = (),
            threads: int | None = None,
        progress: Progress | None = None,
    ) -> Surface:
        """The surface of the next frame.

        Parameters
        ----------
        points, radii, velocity, attributes, obstacles, formats, threads, progress
            As for the function `reconstruct`. The options are those of the sequence.
        where : array_like of bool, shape (N,), optional
            The particles that form the surface. A condition on attributes is an option of the sequence.

        Returns
        -------
        Surface

        Raises
        ------
        TypeError, ValueError, OptionError, ParticleError, MemoryLimitError, OSError, KeyboardInterrupt
            As for the function `reconstruct`. A frame that fails does not change the sequence.
        """
        given, bodies = self._frame_of(points, radii, velocity, attributes, where, obstacles)
        if not self._has_frame:
            self._has_frame = True
            _warn_of_ignored(given, self._options, bodies)
        pairs = given.pairs(self._settings_on(given))
        return _run(given, pairs, bodies, formats, self._limits, threads, progress)

    def averaged(
        self,
        frames: Iterable[Particles | Mapping[str, Any]],
        *,
        formats: Iterable[str] = (),
        threads: int | None = None,
    ) -> Iterator[Surface]:
        """The surfaces of consecutive frames, each averaged with those around it as the option `temporal` says.

        Parameters
        ----------
        frames : iterable of Particles, or of mappings
            The frames in order, evenly spaced in time. A mapping has arguments of `reconstruct`: `points`, and
            where they apply `velocity`, `radii`, `attributes`, `where` and `obstacles`; and `ids`, the number
            of each particle, by which it is found in the frames around. Particles without ids are followed by
            their velocities, for the option `time_step`.
        formats, threads
            As for the function `reconstruct`.

        Yields
        ------
        Surface
            One for each frame, once the `temporal` frames after it have been read. A frame that fails ends the
            iteration, after the surfaces of those before it.

        Examples
        --------
        >>> sequence = Sequence(spacing=0.02, temporal=1)                       # doctest: +SKIP
        >>> frames = ({"points": frame.x, "ids": frame.id} for frame in simulation)    # doctest: +SKIP
        >>> for number, surface in enumerate(sequence.averaged(frames)):        # doctest: +SKIP
        ...     surface.write(f"{number:04}.glb")
        """
        reach = int(self._options.get("temporal") or 0)
        extensions, count = extensions_of(formats), thread_count(threads)
        # The frames that later ones are averaged with, or that wait; the next one to make is at `following`.
        window: list[tuple[tuple[str, str] | None, _native.Smoothed]] = []
        following, failure = 0, None

        def surface_of(index: int) -> Surface:
            source, smoothed = window[index]
            first = max(index - reach, 0)
            around = enumerate(window[first : index + reach + 1], first)
            others = [(at - index, other) for at, (_, other) in around if at != index]
            return _with_warnings(Surface(_native.average(smoothed, others, count), source))

        remaining = iter(frames)
        while True:
            try:
                frame = next(remaining)
                given, bodies = self._frame_of(**_arguments_of(frame))
                if not self._has_frame:
                    self._has_frame = True
                    _warn_of_ignored(given, self._options, bodies)
                pairs = given.pairs(self._settings_on(given))
                smoothed = _native.smooth(
                    pairs,
                    given.selects_all,
                    given.selected,
                    given.points,
                    given.attributes,
                    bodies,
                    extensions,
                    *self._limits,
                    count,
                )
            except StopIteration:
                break
            except Exception as error:
                failure = error
                break
            window.append((given.source, smoothed))
            if len(window) - following > reach:
                yield surface_of(following)
                following += 1
            while following > reach:
                window.pop(0)
                following -= 1
        for index in range(following, len(window)):
            yield surface_of(index)
        if failure is not None:
            raise failure

    def _frame_of(
        self,
        points: Any,
        radii: Any = None,
        velocity: Any = None,
        attributes: Attributes = None,
        where: Any = None,
        obstacles: ObstacleLike | Iterable[ObstacleLike] | None = None,
        ids: Any = None,
    ) -> tuple[_Given, list[_native.Obstacle]]:
        """The particles and the obstacles of a frame."""
        if isinstance(where, str):
            raise TypeError("a condition as text is an option of Sequence: pass a mask, or Sequence(where=...)")
        given = _Given(points, radii, velocity, attributes, where)
        if ids is not None:
            given._add("id", "id", ids, given.count)
        return given, self._bodies.natives(obstacles)


def _arguments_of(frame: Particles | Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `Sequence._frame_of` for a frame of `Sequence.averaged`."""
    if isinstance(frame, Particles):
        return {"points": frame}
    known = {"points", "radii", "velocity", "attributes", "where", "obstacles", "ids"}
    if not isinstance(frame, Mapping) or "points" not in frame or not known.issuperset(frame):
        raise TypeError(
            "a frame must be Particles, or a mapping with `points` and arguments of Sequence.reconstruct, or `ids`"
        )
    return dict(frame)


class _Given:
    """The particles of a frame, in the form that the native module takes."""

    def __init__(self, points: Any, radii: Any, velocity: Any, attributes: Attributes, mask: Any) -> None:
        self.source: tuple[str, str] | None = None
        self.attributes: list[tuple[str, str | None, int, Any, list[str] | None]] = []
        self.selected: list[str] = []
        self.selects_all = False
        self.has_radii = radii is not None
        particles = points if isinstance(points, Particles) else None
        self.points = as_points(points if particles is None else particles.positions)
        self.count = count = len(self.points)
        self._mask = None if mask is None else as_mask(mask, count, "where")
        if self._mask is not None:
            self.points = self.points[self._mask]
        if particles is not None:
            # Files cannot record a mask, so a surface of some of the particles has no source.
            if mask is None and particles.path is not None and particles._hash is not None:
                self.source = (particles.path, particles._hash)
            for name, values in particles.items():
                self._add(name, particles.roles.get(name), values, count, particles._texts.get(name))
        if radii is not None:
            radii = as_array(radii, "radii")
            if radii.ndim == 2 and radii.shape[1] == 1:
                radii = radii[:, 0]
            self._add("radius", "radius", as_reals(radii, (count,), "radii"), count)
        if velocity is not None:
            self._add("velocity", "velocity", as_reals(velocity, (count, 3), "velocity"), count)
            self.selected.append("velocity")
        if attributes is None:
            return
        if isinstance(attributes, Particles):
            attributes = dict(attributes.items())
        if not isinstance(attributes, Iterable):
            raise TypeError(f"attributes must be arrays by name, not {type(attributes).__name__}")
        if not isinstance(attributes, str):
            attributes = attributes if isinstance(attributes, Mapping) else list(attributes)
            for name in attributes:
                if not isinstance(name, str):
                    raise TypeError(f"the name of an attribute must be text, not {type(name).__name__}")
        if isinstance(attributes, Mapping):
            for name, values in attributes.items():
                if values is not None or not _is_computed(name):
                    self._add(name, None, values, count)
                self.selected.append(name)
        elif isinstance(attributes, str):
            self.selects_all = attributes == "all"
            self.selected += [] if self.selects_all else [name.strip() for name in attributes.split(",")]
        else:
            self.selected += list(attributes)
        # The velocities, which their argument selects, may be named as well: files record each name once.
        self.selected = list(dict.fromkeys(self.selected))
        if not self.attributes and not all(map(_is_computed, self.selected)):
            raise TypeError("attributes must be arrays by name: only Particles have attributes of their own")

    def _add(
        self,
        name: str,
        role: str | None,
        values: Any,
        count: int,
        text: tuple[NDArray[np.int32], list[str]] | None = None,
    ) -> None:
        # An attribute that the caller passes by keyword replaces that of the particles with the same name.
        self.attributes = [attribute for attribute in self.attributes if attribute[0] != name]
        arity, flat, table = as_attribute(values, count, name)
        if text is not None and table is not None and np.array_equal(words_of(*text), np.asarray(values).reshape(-1)):
            # The caller did not change the words, so they keep the indices that they have in the file.
            flat, table = text
        if self._mask is not None:
            flat = flat.reshape(-1, arity)[self._mask].reshape(-1)
        self.attributes.append((name, role, arity, flat, table))

    def pairs(self, options: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The options as text, with the option `radius_attribute` if the caller passed radii."""
        named = options.get("radius_attribute")
        if self.has_radii and named not in (None, "radius"):
            raise TypeError(f"radii= and radius_attribute={named!r} contradict each other: pass one of them")
        if self.has_radii:
            options = {**options, "radius_attribute": "radius"}
        return as_pairs(options)


def _is_computed(name: str) -> bool:
    """Whether an attribute of this name is computed if the particles have none."""
    return name.lower() in _native.computed_attributes()


def _warn_of_ignored(given: _Given, options: Mapping[str, Any], obstacles: list[_native.Obstacle]) -> None:
    """Warn about options that have no effect. The warning points to the caller of the public function."""
    pairs = given.pairs(options)
    if given.selects_all or given.selected:
        pairs.append(("attributes", "all"))
    for warning in _native.option_warnings(pairs, bool(obstacles)):
        warnings.warn(warning, stacklevel=3)


def _run(
    given: _Given,
    pairs: list[tuple[str, str]],
    obstacles: list[_native.Obstacle],
    formats: Iterable[str],
    limits: tuple[int, str | None],
    threads: int | None,
    progress: Progress | None,
) -> Surface:
    if progress is not None and not callable(progress):
        raise TypeError(f"progress must be a function, not {type(progress).__name__}")
    made = _native.reconstruct(
        pairs,
        given.selects_all,
        given.selected,
        given.points,
        given.attributes,
        obstacles,
        extensions_of(formats),
        *limits,
        thread_count(threads),
        progress,
    )
    return _with_warnings(Surface(made, given.source))


def _with_warnings(surface: Surface) -> Surface:
    """Warn of what the surface has warnings about. They point to the caller of the public function, which is three calls
    up."""
    for warning in surface.warnings:
        warnings.warn(warning, stacklevel=4)
    return surface


def _folder_of(scratch: str | os.PathLike[str] | None) -> str | None:
    if scratch is None:
        return None
    folder = os.fspath(scratch)
    if not os.path.isdir(folder):
        raise NotADirectoryError(f"scratch is not a folder: {folder}")
    return folder
