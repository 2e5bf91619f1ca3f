"""The commands of meniscus for files and folders.

Each command runs in a separate process, because it handles signals and uses the standard streams. So a
command has exactly the options and the output bytes of the command line, and neither a crash nor its use of
memory affects the caller's process.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

from ._errors import MeniscusError
from ._options import option_table

Paths: TypeAlias = "str | os.PathLike[str] | Iterable[str | os.PathLike[str]]"

#: Options that the command line repeats for each value of a list. Values of other lists are separated by
#: commas.
_REPEATED = frozenset({"obstacle"})


class CommandError(MeniscusError):
    """A command failed.

    Attributes
    ----------
    status : int
        The exit status: 1 if some frames failed, 2 if the command did nothing.
    messages : str
        What the command wrote to the standard error.
    report : dict or None
        The report, if the command wrote one.
    """

    def __init__(self, status: int, messages: str, report: dict[str, Any] | None = None) -> None:
        lines = [line for line in messages.splitlines() if line.startswith("error")] or messages.splitlines()
        super().__init__("\n".join(lines[-20:]) or f"exit status {status}")
        self.status = status
        self.messages = messages
        self.report = report


def convert(
    inputs: Paths, out: str | os.PathLike[str], *, allow_failures: bool = False, **options: Any
) -> dict[str, Any]:
    """Convert files, folders or sequences of particles into meshes and level sets: ``meniscus convert``.

    Parameters
    ----------
    inputs : path-like or iterable of path-like
        Files, folders, globs, or numbered patterns such as ``dam.####.bgeo``.
    out : path-like
        The folder for the results; for a single frame, it may be a file.
    allow_failures : bool
        Whether to return the report instead of raising an exception if some frames failed, or failed
        validation.
    **options
        The options of the command with ``_`` for ``-``: ``format=["glb", "vdb"]``, ``preset="splash"``,
        ``skip_done=True``, ``obstacle="ship.obj"``, ``frames="1-240x2"`` and so on. An option that is None is
        left out.

    Returns
    -------
    dict
        The report; see docs/report.md for its entries.

    Raises
    ------
    CommandError
        If some frames failed (the others are converted), or no frame could be converted.
    KeyboardInterrupt
        On Ctrl-C. Files that exist then are complete; a call with ``skip_done=True`` continues the
        conversion.
    """
    with tempfile.TemporaryDirectory(prefix="pymeniscus-") as folder:
        report_path = options.pop("report", None) or os.path.join(folder, "report.json")
        arguments = ["convert", *_flags({**options, "out": out, "report": report_path}), "--", *_paths(inputs)]
        status, messages = _run(arguments)
        report: dict[str, Any] | None = None
        if os.path.exists(report_path):
            report = json.loads(Path(report_path).read_text(encoding="utf-8"))
    if report is None or (status != 0 and not allow_failures):
        raise CommandError(status, messages, report)
    return report


def render(inputs: Paths, output: str | os.PathLike[str], **options: Any) -> Path:
    """Render pictures of level sets, or of the surfaces of particles, in files: ``meniscus render``.

    Parameters
    ----------
    inputs : path-like or iterable of path-like
        Level sets in .vdb, or anything that `convert` takes.
    output : path-like
        A .png or .exr file for one frame, or the folder for the pictures of any number of frames.
    **options
        The options of the command with ``_`` for ``-``: ``size="1920x1080"``, ``camera="azimuth=60"``,
        ``particles=True`` and so on.

    Returns
    -------
    pathlib.Path
        `output`.

    Raises
    ------
    CommandError
        If a picture could not be made.
    """
    is_file = os.path.splitext(os.fspath(output))[1].lower() in (".png", ".exr")
    target = {"output": output} if is_file else {"out": output}
    status, messages = _run(["render", *_flags({**options, **target}), "--", *_paths(inputs)])
    if status != 0:
        raise CommandError(status, messages)
    return Path(output)


@dataclass(frozen=True)
class FinishedFrame:
    """A frame that `watch` has finished.

    Attributes
    ----------
    path : pathlib.Path
        The particle file, or the level set.
    state : str
        ``"converted"``, ``"already_done"`` (by an earlier run), or ``"failed"``.
    outputs : tuple of pathlib.Path
        The files with the results.
    particles : int or None
        The number of particles; None for a level set, and unless the frame was converted now.
    message : str
        The message in the log; for a failed frame, the reason.
    """

    path: Path
    state: str
    outputs: tuple[Path, ...] = ()
    particles: int | None = None
    message: str = field(default="", repr=False)


def watch(folders: Paths, out: str | os.PathLike[str], **options: Any) -> Watch:
    """Convert every frame in folders as a simulation writes it: ``meniscus watch``.

    Parameters
    ----------
    folders : path-like or iterable of path-like
        The folders to watch.
    out : path-like
        The folder for the results.
    **options
        The options of the command with ``_`` for ``-``. With ``once=True``, the command ends when everything
        is converted.

    Returns
    -------
    Watch
        A context manager that iterates over the finished frames.

    Examples
    --------
    >>> with watch("cache", "surfaces", format="glb") as frames:           # doctest: +SKIP
    ...     for frame in frames:
    ...         print(frame.path, frame.state, frame.outputs)
    """
    return Watch(folders, out, options)


class Watch:
    """A running ``meniscus watch``: a context manager, and an iterator of `FinishedFrame`.

    The iteration ends when the command ends: after `stop`, or with ``once=True`` when everything is
    converted. Leaving the context stops the command, which first finishes the frames in progress.

    Attributes
    ----------
    status : int or None
        The exit status of the command; None while it runs.
    """

    def __init__(self, folders: Paths, out: str | os.PathLike[str], options: dict[str, Any]) -> None:
        self._out = Path(out)
        self._folders = [Path(folder) for folder in _paths(folders)]
        self._arguments = [
            "watch",
            *_flags({**options, "out": out, "log": "json"}),
            "--",
            *[os.fspath(folder) for folder in self._folders],
        ]
        self._process: subprocess.Popen[str] | None = None
        self._last_lines: deque[str] = deque(maxlen=20)
        self.status: int | None = None

    def __enter__(self) -> Watch:
        if self._process is not None:
            raise RuntimeError("this watch was started before: call watch() again")
        # The command is in a process group of its own, so that Ctrl-C reaches only the caller, who then
        # leaves the context.
        self._process = subprocess.Popen(
            _command(self._arguments),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
        )
        return self

    def __iter__(self) -> Iterator[FinishedFrame]:
        process = self._started()
        assert process.stderr is not None
        for line in process.stderr:
            try:
                event = json.loads(line)
            except ValueError:
                self._last_lines.append(line.rstrip())
                continue
            if event.get("level") in ("ERROR", "WARN"):
                self._last_lines.append(str(event.get("message", "")))
            frame = self._finished(event)
            if frame is not None:
                yield frame
        self.status = process.wait()
        if self.status == 2:
            raise CommandError(self.status, "\n".join(self._last_lines))

    def stop(self) -> None:
        """Ask the command to finish the frames in progress and to end. You may call it repeatedly, and from
        any thread."""
        process = self._started()
        if process.poll() is None and not getattr(process, "_is_stopping", False):
            process._is_stopping = True  # type: ignore[attr-defined]
            process.send_signal(signal.SIGTERM)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        process = self._started()
        self.stop()
        try:
            # Read the rest of the log: a full pipe would block the command.
            if process.stderr is not None:
                for _ in process.stderr:
                    pass
                process.stderr.close()
            self.status = process.wait()
        except KeyboardInterrupt:
            process.kill()
            self.status = process.wait()
            raise

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            raise RuntimeError("use `with watch(...) as frames:`")
        return self._process

    def _finished(self, event: dict[str, Any]) -> FinishedFrame | None:
        if "frame" not in event:
            return None
        path, message = Path(event["frame"]), str(event.get("message", ""))
        if "read_s" in event:
            particles = event.get("particles")
            return FinishedFrame(path, "converted", self._outputs(path), particles, message)
        if message == "frame was done already":
            return FinishedFrame(path, "already_done", self._outputs(path), None, message)
        if event.get("level") == "ERROR":
            return FinishedFrame(path, "failed", (), None, message)
        return None

    def _outputs(self, path: Path) -> tuple[Path, ...]:
        """The results of a frame: files with the extension of an output format, whose stem is the frame's
        name up to the end or to one of its dots."""
        from . import _native

        folder = self._out
        for watched in self._folders:
            try:
                folder = self._out / path.parent.resolve().relative_to(watched.resolve())
                break
            except ValueError:
                continue
        stems = [path.name[:end] for end in range(len(path.name), 0, -1) if path.name[end : end + 1] in (".", "")]
        for stem in stems:
            candidates = [folder / f"{stem}.{extension}" for extension in _native.format_names()]
            found = tuple(candidate for candidate in candidates if candidate.exists() and candidate != path)
            if found:
                return found
        return ()


def _command(arguments: list[str]) -> list[str]:
    if not sys.executable:
        raise RuntimeError("the path of the Python interpreter is unknown, so the command cannot be started")
    return [sys.executable, "-m", "pymeniscus", *arguments]


def _run(arguments: list[str]) -> tuple[int, str]:
    """Run a command until it ends. Returns its exit status and its standard error."""
    process = subprocess.Popen(
        _command(arguments),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
    )
    try:
        _, messages = process.communicate()
    except BaseException:
        process.terminate()
        process.wait()
        raise
    return process.returncode, messages


def _paths(paths: Paths) -> list[str]:
    if isinstance(paths, (str, os.PathLike)):
        return [os.fspath(paths)]
    found = [os.fspath(path) for path in paths]
    if not found:
        raise ValueError("there are no inputs")
    return found


def _flags(options: dict[str, Any]) -> list[str]:
    """Options as flags of the command line."""
    valued = {info.name for info in option_table() if info.kind == "switch"}
    flags: list[str] = []
    for name, value in options.items():
        flag = f"--{name.rstrip('_').replace('_', '-')}"
        if value is None or (value is False and name not in valued):
            continue
        if value is True and name not in valued:
            flags.append(flag)
        elif isinstance(value, bool):
            flags.append(f"{flag}={str(value).lower()}")
        elif isinstance(value, (str, os.PathLike)):
            flags.append(f"{flag}={os.fspath(value)}")
        elif isinstance(value, Iterable):
            values = [os.fspath(item) if isinstance(item, os.PathLike) else str(item) for item in value]
            flags += [f"{flag}={item}" for item in values] if name in _REPEATED else [f"{flag}={','.join(values)}"]
        else:
            flags.append(f"{flag}={value}")
    return flags
