"""Runs the command line of the bundled pymeniscus in a process of its own.

Blender puts the wheels of an extension on its own `sys.path` only, so the process gets their folder in
PYTHONPATH.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

#: A file may be on a disk that does not respond.
INFO_SECONDS = 30
#: The command ends when its standard input does: so also when Blender crashes or is killed.
ENDS_WITH_INPUT = """
import os, signal, sys, threading

def wait():
    sys.stdin.buffer.read()
    os.kill(os.getpid(), signal.SIGTERM)

threading.Thread(target=wait, daemon=True).start()
from pymeniscus.__main__ import main
main()
"""


def start(arguments: list[str]) -> subprocess.Popen[str]:
    """Start a command that runs until its standard input is closed, and logs to the standard error."""
    return subprocess.Popen(
        [sys.executable, "-c", ENDS_WITH_INPUT, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
        **_surroundings(),
    )


def run(arguments: list[str], timeout: float | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command to its end.

    Raises
    ------
    OSError
        If it does not start.
    subprocess.TimeoutExpired
        If it takes longer than `timeout`, in seconds.
    """
    return subprocess.run(
        [sys.executable, "-m", "pymeniscus", *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        timeout=timeout,
        **_surroundings(),
    )


def info(path: Path) -> dict[str, Any]:
    """What the command `info` says about a file.

    Raises
    ------
    ValueError
        If the file cannot be read; with the command's reason.
    """
    try:
        done = run(["info", "--json", str(path)], INFO_SECONDS)
    except subprocess.TimeoutExpired:
        raise ValueError(f"{path} did not respond for {INFO_SECONDS} s") from None
    try:
        about = json.loads(done.stdout)[0]
    except (ValueError, LookupError):
        raise ValueError(done.stderr.strip() or f"cannot read {path}") from None
    if "error" in about:
        raise ValueError(f"{path.name}: {about['error']}")
    return about


def _surroundings() -> dict[str, Any]:
    """Keywords of `subprocess` with which Python finds the package, and shows no window."""
    import pymeniscus

    site = str(Path(pymeniscus.__file__).resolve().parent.parent)
    return {
        "env": {**os.environ, "PYTHONPATH": site, "PYTHONDONTWRITEBYTECODE": "1"},
        # In a session of its own, it does not get the Ctrl-C of a terminal in which Blender runs.
        "start_new_session": True,
        "creationflags": getattr(subprocess, "CREATE_NO_WINDOW", 0),
    }
