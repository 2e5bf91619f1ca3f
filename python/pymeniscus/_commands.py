"""The commands of meniscus for files and folders.

Each command runs in a separate process, because it handles signals and uses the standard streams. So a
command has exactly the options and the output bytes of the command line, and neither a crash nor its use of
memory affects the caller's process.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

from ._errors import MeniscusError
from ._options import _text, option_table

Paths: TypeAlias = "str | os.PathLike[str] | Iterable[str | os.PathLike[str]]"

#: Options that the command line repeats for each value of a list. Values of other lists are separated by
#: commas.
_REPEATED = frozenset({"obstacle", "sequence"})

#: Runs the package in the folder of the first argument. ``python -m pymeniscus`` would search the working
#: folder first, which may have another module of this name, or one of the name of a standard module.
_PROGRAM = """
import sys
sys.path[:] = [sys.argv.pop(1), *filter(None, sys.path)]
from pymeniscus.__main__ import main
main()
"""


class CommandError(MeniscusError):
    """A command failed.

    Attributes
    ----------
    status : int
        The exit status: 1 if some frames failed, 2 if the command did nothing, for example because an option
        is unknown, and the negative number of the signal if one ended the command.
    messages : str
        What the command wrote to the standard error.
    report : dict or None
        The report, if the command wrote one.
    """

    def __init__(self, status: int, messages: str, report: dict[str, Any] | None = None) -> None:
        # Pickling calls the constructor with the arguments of the base class.
        super().__init__(status, messages, report)
        self.status = status
        self.messages = messages
        self.report = report

    def __str__(self) -> str:
        """The errors in `messages` with their indented details, or all messages if none is marked as an error: at
        most 20 lines."""
        lines = [line for line in self.messages.splitlines() if line.strip()]
        errors, is_error = [], False
        for line in lines:
            is_error = line.startswith("error") or (is_error and line.startswith("  "))
            errors += [line] if is_error else []
        return "\n".join((errors or lines)[-20:]) or f"exit status {self.status}"


def convert(
    inputs: Paths | None = None,
    out: str | os.PathLike[str] | None = None,
    *,
    allow_failures: bool = False,
    **options: Any,
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
        left out. ``report="report.json"`` also writes the report to a file, which is left as it is if no
        frame could be converted. ``help=True`` prints all options.

    Returns
    -------
    dict
        The report; see docs/report.md for its entries. Empty if the options ask for text instead, which is
        printed: ``help=True`` and ``print_settings=True``.

    Raises
    ------
    CommandError
        If some frames failed (the others are converted), or no frame could be converted.
    KeyboardInterrupt
        On Ctrl-C. Files that exist then are complete; a call with ``skip_done=True`` continues the
        conversion.
    """
    with tempfile.TemporaryDirectory(prefix="pymeniscus-") as folder:
        # Not at the path that the caller chose: a file there may be the report of an earlier call.
        written = Path(folder, "report.json")
        chosen = options.pop("report", None)
        arguments = ["convert", *_flags({**options, "out": out, "report": written}), "--", *_paths(inputs)]
        status, printed, messages = _run(arguments)
        report: dict[str, Any] | None = None
        if written.exists():
            report = json.loads(written.read_text(encoding="utf-8"))
            if chosen is not None:
                shutil.copyfile(written, chosen)
    if status == 0 and report is None:
        print(printed, end="")
        return {}
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
        A .png or .exr file for one frame, or the folder for the pictures of any number of frames. A folder
        whose name ends like that of a file, such as ``shots.final``, must exist, or be a string that
        ends with ``/``.
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
    status, printed, messages = _run(["render", *_flags({**options, "out": output}), "--", *_paths(inputs)])
    if status != 0:
        raise CommandError(status, messages)
    if not os.path.exists(output):
        print(printed, end="")
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
        The absolute paths of the files with the results.
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

    If the command did nothing, for example because an option is unknown, or if it crashed, the end of the
    iteration and the end of the context raise `CommandError`.

    Attributes
    ----------
    status : int or None
        The exit status of the command; None while it runs. It is 1 if some frames failed.
    """

    def __init__(self, folders: Paths, out: str | os.PathLike[str], options: dict[str, Any]) -> None:
        self._arguments = [
            "watch",
            *_flags({**options, "out": out, "log": "json"}),
            "--",
            *_paths(folders),
        ]
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self._frames: queue.SimpleQueue[FinishedFrame | None] = queue.SimpleQueue()
        self._last_lines: deque[str] = deque(maxlen=20)
        self._is_stopping = False
        self._has_raised = False
        self.status: int | None = None

    def __enter__(self) -> Watch:
        if self._process is not None:
            raise RuntimeError("this watch was started before: call watch() again")
        # The command is in a process group of its own, so that Ctrl-C reaches only the caller, who then
        # leaves the context. The level `info` of the log includes the lines about finished frames.
        self._process = subprocess.Popen(
            _command(self._arguments),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
            env={**os.environ, "MENISCUS_LOG": "info"},
        )
        # A thread reads the log, because a full pipe would block the command while the caller handles a frame.
        self._reader = threading.Thread(target=self._read_log, args=(self._process,), daemon=True)
        self._reader.start()
        return self

    def _read_log(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        try:
            with process.stderr:
                for line in process.stderr:
                    self._note(line)
            self.status = process.wait()
        finally:
            self._frames.put(None)

    def _note(self, line: str) -> None:
        """Handle a line of the log."""
        try:
            event = json.loads(line)
        except ValueError:
            event = None
        if not isinstance(event, dict):
            self._last_lines.append(line.rstrip())
            return
        if event.get("level") in ("ERROR", "WARN"):
            self._last_lines.append(str(event.get("message", "")))
        frame = self._finished(event)
        if frame is not None:
            self._frames.put(frame)

    def __iter__(self) -> Iterator[FinishedFrame]:
        """The frames that the command has finished, each once, in the order in which it finishes them. Waits
        for the next frame while the command runs.

        Raises
        ------
        CommandError
            If the command did nothing, for example because an option is unknown, or if it crashed.
        RuntimeError
            Outside the context.
        """
        self._started()
        while (frame := self._frames.get()) is not None:
            yield frame
        # Later iterations, and those of other threads, end as well.
        self._frames.put(None)
        self._check_status()

    def stop(self) -> None:
        """Ask the command to finish the frames in progress and to end, without waiting for it. You may call
        it repeatedly, and from any thread. The iteration still yields the frames that the command finishes.

        Raises
        ------
        RuntimeError
            Before the context is entered.
        """
        process = self._started()
        if process.poll() is None and not self._is_stopping:
            self._is_stopping = True
            process.send_signal(signal.SIGTERM)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        process = self._started()
        assert self._reader is not None
        self.stop()
        try:
            self._reader.join()
        except KeyboardInterrupt:
            process.kill()
            self._reader.join()
            raise
        if kind is None and not self._has_raised:
            self._check_status()

    def _check_status(self) -> None:
        """Raise an exception if the command did nothing, or crashed. Frames that failed are not an error here:
        the iteration has yielded them."""
        # A command that is stopped before it handles signals is ended by the signal.
        is_stopped = self._is_stopping and self.status == -signal.SIGTERM
        if self.status not in (0, 1) and not is_stopped:
            self._has_raised = True
            raise CommandError(2 if self.status is None else self.status, "\n".join(self._last_lines))

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            raise RuntimeError("use `with watch(...) as frames:`")
        return self._process

    @staticmethod
    def _finished(event: dict[str, Any]) -> FinishedFrame | None:
        """The frame that a line of the log reports as finished; see docs/operations.md for its fields."""
        if "frame" not in event or "state" not in event:
            return None
        outputs = tuple(Path(output) for output in json.loads(event.get("outputs", "[]")))
        return FinishedFrame(Path(event["frame"]), event["state"], outputs, event.get("particles"), event["message"])


def _command(arguments: list[str]) -> list[str]:
    if not sys.executable:
        raise RuntimeError("the path of the Python interpreter is unknown, so the command cannot be started")
    return [sys.executable, "-c", _PROGRAM, str(Path(__file__).resolve().parents[1]), *arguments]


def _run(arguments: list[str]) -> tuple[int, str, str]:
    """Run a command until it ends. Returns its exit status, its standard output and its standard error."""
    process = subprocess.Popen(
        _command(arguments),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
    )
    try:
        printed, messages = process.communicate()
    except BaseException:
        process.terminate()
        process.communicate()
        raise
    return process.returncode, printed, messages


def _paths(paths: Paths | None) -> list[str]:
    if paths is None:
        return []
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
        if getattr(value, "ndim", None) == 0:
            value = value.item()  # a number of NumPy or PyTorch
        if value is None or (value is False and name not in valued):
            continue
        if value is True and name not in valued:
            flags.append(flag)
        elif isinstance(value, (str, os.PathLike)) or not isinstance(value, Iterable):
            flags.append(f"{flag}={_word(name, value)}")
        else:
            words = [_word(name, item) for item in value]
            flags += [f"{flag}={word}" for word in words] if name in _REPEATED else [f"{flag}={','.join(words)}"]
    return flags


def _word(name: str, value: Any) -> str:
    """A value as text. Numbers have the text that `reconstruct` passes to the method."""
    return os.fspath(value) if isinstance(value, os.PathLike) else _text(name, value)
