"""Paths, the command that runs meniscus, and the output of checks.

A check prints one line for each file, with figures. It continues after a failure, repeats all
failures at its end, and then exits with status 1.
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Whether times are compared with their limits, which only an idle machine with two cores can keep.
STRICT_TIMES = bool(os.environ.get("MENISCUS_STRICT_TIMES"))
# Whether the checks are brief: of few files, with the program of the development profile.
BRIEF = bool(os.environ.get("MENISCUS_BRIEF"))
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")).resolve()
PROGRAM = TARGET / ("debug" if BRIEF else "release") / "meniscus"
WORK = TARGET / "clients"
# The outputs of check_convert.py and check_reference.py, which the other checks read.
OUT = WORK / "out"
# Frames of other programs. They are not part of the project; if they are missing, their checks are skipped.
DATA = Path(os.environ.get("MENISCUS_SHARED", ROOT.parent / "shared")) / "data"
# The project's own frames.
OWN = ROOT / "examples" / "frames"

DAM_BREAK = "dam_break_frame_23_24389_particles"


def data_is_there():
    """Whether frames of other programs exist; prints a message if not."""
    if DATA.is_dir():
        return True
    print(f"  skipped: no frames of other programs: the folder {DATA} is missing")
    return False


def convert(inputs, out, *options):
    """Runs `meniscus convert` and returns its exit status, its output, and its report by stem: empty for particles."""
    out.mkdir(parents=True, exist_ok=True)
    report = out / "report.json"
    report.unlink(missing_ok=True)
    command = [PROGRAM, "convert", *inputs, "--out", out, *options]
    if "--particles-only" not in options:
        command += ["--report", report]
    ran = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=1800)
    frames = {}
    if report.exists():
        written = json.loads(report.read_text())
        for frame in written["frames"]:
            frame["settings"] = written["settings"][frame["settings"]]
            frames[Path(frame["input"]).name] = frame
    return ran.returncode, ran.stdout + ran.stderr, frames


def times_of(path):
    """The times of the frames of a file, in seconds; None for a frame without a time."""
    ran = subprocess.run([str(PROGRAM), "info", "--json", str(path)], capture_output=True, text=True, timeout=600)
    return [frame.get("time") for frame in json.loads(ran.stdout)]


def same_times(path, expected):
    """What is wrong with the times of the frames of a file, as a list."""
    found = times_of(path)
    are_same = len(found) == len(expected) and all(
        one == other or None not in (one, other) and math.isclose(one, other) for one, other in zip(found, expected)
    )
    return [] if are_same else [f"the times are {found} and not {expected}"]


def frame_of(output):
    """The report of the frame that an output was made from."""
    written = json.loads((output.parent / "report.json").read_text())
    for frame in written["frames"]:
        if output.name in [Path(path).name for path in frame.get("outputs", [])]:
            frame["settings"] = written["settings"][frame["settings"]]
            return frame
    raise LookupError(f"{output.parent / 'report.json'} says nothing of {output.name}")


class Check:
    """The lines of one check."""

    def __init__(self, title):
        self.failed = []
        self.passed = 0
        print(title, flush=True)

    def line(self, label, figures, faults=()):
        """Prints the line of a file: its measurements and its faults."""
        faults = list(faults)
        print(f"  {'FAILED' if faults else 'ok    '} {label}: {figures}", flush=True)
        for fault in faults:
            print(f"         {fault}", flush=True)
        if faults:
            self.failed.append(f"{label}: {'; '.join(faults)}")
        else:
            self.passed += 1

    def end(self):
        """Prints the summary, and ends the process."""
        print(f"  {self.passed} passed, {len(self.failed)} failed", flush=True)
        for failed in self.failed:
            print(f"  failed: {failed}", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # Skip the cleanup of sys.exit: the modules of large programs sometimes crash in it.
        os._exit(1 if self.failed or not self.passed else 0)
