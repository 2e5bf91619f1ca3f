"""Runs whole processes: their costs, their inputs, and the tables of results.

A process is measured from its start to its end: wall-clock seconds, the CPU seconds of all its threads, and
its peak memory, all as counted by the system. Runs that are compared alternate, so that all of them see the
same state of the machine.
"""

import argparse
import csv
import datetime
import importlib.machinery
import importlib.util
import io
import json
import os
import re
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")).resolve()
# The program to measure. It is built, unless MENISCUS names an existing program.
PROGRAM = Path(os.environ.get("MENISCUS") or TARGET / "release" / "meniscus").resolve()
# The folder of the solids of generated particles, which are kept between runs.
SOLIDS = TARGET / "solids"
# Frames of other programs, which are not part of the project.
DATA = Path(os.environ.get("MENISCUS_SHARED", ROOT.parent / "shared")) / "data"

THREADS = 2


@dataclass
class Run:
    """The costs of one process."""

    seconds: float
    cpu_seconds: float
    memory_bytes: int


def build():
    """Builds the program, unless MENISCUS names one."""
    if not os.environ.get("MENISCUS"):
        subprocess.run(["cargo", "build", "--release", "--quiet", "--bin", "meniscus"], cwd=ROOT, check=True)


def script(name):
    """Imports another benchmark as a module."""
    loader = importlib.machinery.SourceFileLoader(name, str(ROOT / "benches" / name))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(name, loader))
    sys.modules[name] = module  # The data classes of the module look it up there.
    loader.exec_module(module)
    return module


def measured(command):
    """Runs a command and returns its costs; exits if it fails."""
    command = [str(word) for word in command]
    launcher = [sys.executable, "-I", "-S", ROOT / "benches" / "one_process.py"]
    ran = subprocess.run([*launcher, *command], capture_output=True, text=True)
    *figures, status = json.loads(ran.stdout or "[1]")
    if status:
        sys.exit(f"{' '.join(command)}\nended with {status}: {ran.stderr.strip()}")
    return Run(*figures)


def meniscus(frames, voxel_size, out, *options, threads=THREADS, preset="paper"):
    """Returns the command that converts the file `frames`, or all files if it is a pattern."""
    ours = [PROGRAM, "convert", frames, "--out", out, "--format", "glb", "--voxel-size", repr(voxel_size)]
    return [*ours, "--preset", preset, "--threads", threads, *options]


def solid(count):
    """Returns a solid of about this many particles, and their spacing. Creates it if it is missing."""
    SOLIDS.mkdir(parents=True, exist_ok=True)
    path = SOLIDS / f"solid_{count:.0f}.ply"
    if not path.exists():
        print(f"writing {path}", flush=True)
        generator = ["cargo", "run", "--release", "--quiet", "-p", "solid", "--", str(count), path]
        subprocess.run(generator, cwd=ROOT, check=True)
    with path.open("rb") as file:
        header = file.read(300).decode("ascii", errors="replace")
    return path, float(re.search(r"^comment spacing (\S+)$", header, re.MULTILINE)[1])


def particle_count(solid_path):
    """Returns the number of particles in the header of a solid's file."""
    with solid_path.open("rb") as file:
        return int(re.search(rb"element vertex (\d+)", file.read(300))[1])


def spread(values, form):
    """Formats the median, with the minimum and maximum if there are several values."""
    middle = format(statistics.median(values), form)
    return middle if len(values) == 1 else f"{middle} ({min(values):{form}}–{max(values):{form}})"


def conditions():
    """The machine, the date and the program, in one line."""
    model = "processor of unknown name"
    if Path("/proc/cpuinfo").exists():
        names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores; {datetime.date.today()}; {program()}"


def program():
    """The measured program: the commit that it is built from, and its path."""
    if os.environ.get("MENISCUS"):
        version = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True).stdout.strip()
        return f"{version}, built before"
    git = ["git", "-C", ROOT]
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain", "src", "formats"], capture_output=True).stdout
    return f"commit {commit or 'unknown'}{' and changes' if changed else ''}"


class Table:
    """Rows of text under a heading, printed when complete."""

    def __init__(self, title, *columns):
        self.title = title
        self.rows = [columns]

    def row(self, *cells):
        self.rows.append([str(cell) for cell in cells])

    def plain(self):
        widths = [max(map(len, column)) for column in zip(*self.rows)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in self.rows]
        return "\n".join([self.title, *lines])

    def csv(self):
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(self.rows)
        return f"# {self.title}\n{text.getvalue()}"


def arguments(doc):
    """Returns a parser whose help is the module's docstring."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the tables there, too")
    return parser


def publish(tables, path, about=None):
    """Prints the tables, and writes them to a file, if given, below a comment: `about`, or the machine and the
    program. Each table follows its title, which is a comment, too."""
    for table in tables:
        print(f"\n{table.plain()}")
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = "\n".join(table.csv() for table in tables)
        path.write_text(f"# {about or conditions()}\n{text}", encoding="utf-8")


def recorded(path):
    """Returns the rows, by column, of a file with one table that `publish` wrote."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))
