"""Table 3: from 0.6 to 309 million particles.

The dragon of the paper's Fig. 17 on finer and finer lattices, and a solid with about its area and volume
(`examples/solid`), both with h = spacing. A row with ¹ is from docs/results/scale.csv.
"""

import statistics
import sys
from dataclasses import dataclass

import processes
from paper import figures
from paper.measuring import (
    COMPUTING,
    LARGE,
    LARGEST,
    SMALL,
    UPPER_RIGHT,
    in_seconds,
    measure_frame,
)
from processes import THREADS, Table, spread

def tables(args):
    rows = [measured_solid(count, args.rounds) for count in (SMALL, UPPER_RIGHT)]
    rows.append(measured_solid(LARGE, 1))
    rows.append(measured_solid(LARGEST, 1) if args.long else recorded_large_solid(LARGEST))
    return [papers(), ours(rows)]


@dataclass
class Large:
    """The row of a large solid, as text."""

    particles: str
    free_voxels: str
    stages: list
    seconds: float | None  # None if read from docs/results/scale.csv.
    whole: str
    cpu: str
    memory: str


def recorded_large_solid(count):
    """Reads the row of this solid from the output of `benches/scale`."""
    for row in processes.recorded(processes.ROOT / "docs" / "results" / "scale.csv"):
        digits = row["particles"].replace(",", "")
        if row["preset"] == "paper" and digits.isdigit() and f"{float(digits):.3g}" == f"{count:.3g}":
            stages = [row[stage] for stage in COMPUTING]
            costs = row["total seconds"], row["CPU seconds"], row["peak memory, GB"]
            return Large(f"{row['particles']} ¹", row["free voxels"], stages, None, *costs)
    sys.exit(f"tables: docs/results/scale.csv has no row of {count:.3g} particles; --long measures it")


def measured_solid(count, rounds):
    path, spacing = processes.solid(count)
    processes.script("scale").read_once(path)
    taken = []
    for _ in range(rounds):
        taken.append(measure_frame(path, spacing))
        print(".", end="", flush=True)
    print()
    stages = [in_seconds([one.stage(stage) for one in taken]) for stage in COMPUTING]
    seconds = [one.run.seconds for one in taken]
    cpu = spread([one.run.cpu_seconds for one in taken], ".1f")
    memory = f"{max(one.run.memory_bytes for one in taken) / 1e9:.2f}"
    report = taken[0].report
    counts = f"{report['particles']:,}", f"{report['free_voxels']:,}"
    return Large(*counts, stages, statistics.median(seconds), in_seconds(seconds), cpu, memory)


def papers():
    table = Table(
        f"The paper's dragon at h = spacing, implicit, without reading and writing, on {figures.MACHINE}; and the authors'"
        f" published program, whole processes, on two threads ({figures.PROGRAM_MACHINE}).",
        *("particles", "seconds", "relative to the row above", "of which rasterization", "CPU seconds", "memory, GB"),
        *("CG iterations", "published program: seconds", "memory, GB"),
    )
    above = None
    for particles, seconds, rasterization, cpu_percent, memory, iterations in figures.DRAGONS:
        growth = f"{seconds / above:.1f}" if above else "–"
        cpu = f"{seconds * cpu_percent / 100:,.0f}"
        program = (f"{figure:g}" for figure in figures.PROGRAM_DRAGONS.get(particles, ()))
        program = list(program) or ["–", "–"]
        millions = f"{particles / 1e6:g} M"
        table.row(millions, f"{seconds:g}", growth, f"{rasterization:g}", cpu, f"{memory:g}", iterations, *program)
        above = seconds
    return table


def ours(rows):
    table = Table(
        f"Our solid at h = spacing, fast, whole processes from a .ply to a .glb on {THREADS} threads.",
        *("particles", "free voxels", "rasterize", "smooth", "contour", "whole process", "relative to the row above"),
        *("CPU seconds", "memory, GB"),
    )
    above = None
    for row in rows:
        growth = f"{row.seconds / above:.1f}" if above and row.seconds else "–"
        table.row(row.particles, row.free_voxels, *row.stages, row.whole, growth, row.cpu, row.memory)
        above = row.seconds
    return table
