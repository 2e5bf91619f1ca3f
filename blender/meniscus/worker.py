"""Computes surfaces on a thread. Nothing here touches Blender's data."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymeniscus

from .meshes import MeshArrays, arrays_of
from .options import coarse, text_of
from .points import Points

# Full quality begins when nothing has changed for this long, in seconds.
REST = 0.3


class _Newer(Exception):
    """A newer request replaces the running one."""


@dataclass
class Request:
    """What to make a surface of. `key` identifies the surface; a new request replaces an older one of the
    same key. `known` is the signature of the mesh that exists."""

    key: int
    points: Points
    options: dict[str, Any]
    known: str = ""
    has_preview: bool = True
    time: float = field(default_factory=time.monotonic)


@dataclass
class Result:
    """A finished request: arrays, or an error. `arrays` is None if the existing mesh is right."""

    request: Request
    signature: str = ""
    arrays: MeshArrays | None = None
    spacing: float | None = None
    error: str = ""
    warnings: tuple[str, ...] = ()
    is_coarse: bool = False
    seconds: float = 0.0


Progress = Callable[[str, float], object]


def measured(points: Points, options: dict[str, Any]) -> float:
    """The particle spacing, rounded to the 32 bits of a property, so that the first surface is made with the
    value that is stored."""
    # A condition needs the attributes.
    first = pymeniscus.Particles(points.positions, points.attributes if "where" in options else None)
    settings = pymeniscus.Sequence(first, radii=points.radii, velocity=points.velocity, **options).settings
    assert settings is not None
    return float(np.float32(settings["spacing"]))


def signature_of(points_hash: str, options: dict[str, Any]) -> str:
    described = sorted((name, str(value)) for name, value in options.items())
    return f"{pymeniscus.__version__} {points_hash} {described}"


def compute(request: Request, is_coarse: bool = False, progress: Progress | None = None) -> Result:
    """Makes the surface of a request. The same points and options give the same surface on any machine, in the
    viewport and in a render."""
    start = time.monotonic()
    result = Result(request, is_coarse=is_coarse)
    points, options = request.points, dict(request.options)
    try:
        if not options.get("spacing"):
            options.pop("spacing", None)
            result.spacing = measured(points, options)
            options["spacing"] = text_of(result.spacing)
        points_hash = points.hash()
        result.signature = signature_of(points_hash, options)
        # A mesh in full quality needs no preview.
        if is_coarse and result.signature != request.known:
            options = coarse(options)
            result.signature = signature_of(points_hash, options)
        if result.signature != request.known:
            surface = pymeniscus.reconstruct(
                points.positions,
                radii=points.radii,
                velocity=points.velocity,
                attributes=points.attributes or None,
                progress=progress,
                **options,
            )
            result.arrays, result.warnings = arrays_of(surface), surface.warnings
    except _Newer:
        raise
    except Exception as error:
        # Whatever it is, the panel shows it. The thread must go on with the other surfaces.
        result.error = str(error) or type(error).__name__
    result.seconds = time.monotonic() - start
    return result


class Worker:
    """One thread for all surfaces; each computation uses all cores.

    For each surface the newest request wins. A preview is never interrupted, so that a long drag shows one
    after the other. Full quality starts after a rest, and a newer request ends it. The thread ends when
    nothing is left to do.
    """

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._pending: dict[int, tuple[Request, bool]] = {}
        self._results: list[Result] = []
        self._thread: threading.Thread | None = None
        self._running: tuple[int, bool] | None = None
        self.progress: dict[int, tuple[str, float]] = {}

    def submit(self, request: Request) -> None:
        with self._change:
            # The mesh will be that of the last result, which may not be written yet.
            for result in self._results:
                self._foresee(request, result)
            self._pending[request.key] = (request, request.has_preview)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="meniscus", daemon=True)
                self._thread.start()
            self._change.notify()

    @staticmethod
    def _foresee(request: Request, result: Result) -> None:
        """Sets the signature of the mesh that a request will find."""
        if result.request.key == request.key and result.arrays is not None:
            request.known = result.signature

    def results(self) -> list[Result]:
        """The results since the last call."""
        with self._change:
            results, self._results = self._results, []
        return results

    @property
    def is_busy(self) -> bool:
        with self._change:
            return bool(self._pending or self._running or self._results)

    def forget(self, key: int) -> None:
        """Forgets the requests and results of a surface."""
        with self._change:
            self._pending.pop(key, None)
            self._results = [each for each in self._results if each.request.key != key]
            if self._running is not None and self._running[0] == key:
                self._running = None

    def clear(self, wait: float = 0.0) -> None:
        """Forgets all requests and results, and ends the thread; waits for its end up to some seconds."""
        with self._change:
            self._pending.clear()
            self._results.clear()
            thread, self._running = self._thread, None
            self._change.notify()
        if thread is not None and wait:
            thread.join(wait)

    def _next(self) -> tuple[Request, bool] | None:
        """The next request, and whether to make its preview; None if nothing is left. Called with the lock."""
        while self._pending:
            previews = [entry for entry in self._pending.values() if entry[1]]
            if previews:
                request = min(previews, key=lambda entry: entry[0].time)[0]
                self._pending[request.key] = (request, False)
                return request, True
            request = min((entry[0] for entry in self._pending.values()), key=lambda each: each.time)
            rest = request.time + REST - time.monotonic()
            if rest <= 0 or not request.has_preview:
                del self._pending[request.key]
                return request, False
            self._change.wait(rest)
        return None

    def _work(self) -> None:
        while True:
            with self._change:
                taken = self._next()
                if taken is None:
                    self._thread = None
                    return
                request, is_coarse = taken
                self._running = (request.key, is_coarse)
            try:
                result = compute(request, is_coarse, lambda phase, part: self._on_progress(request, phase, part))
            except _Newer:
                result = None
            with self._change:
                is_wanted = self._running is not None
                self._running = None
                self.progress.pop(request.key, None)
                # An error of a preview is not reported: full quality follows, and its options are those of
                # the user.
                if result is not None and is_wanted and not (is_coarse and result.error):
                    self._results.append(result)
                    if request.key in self._pending:
                        self._foresee(self._pending[request.key][0], result)

    def _on_progress(self, request: Request, phase: str, part: float) -> None:
        running = self._running
        if running is None or (not running[1] and request.key in self._pending):
            raise _Newer
        self.progress[request.key] = (phase, part)
