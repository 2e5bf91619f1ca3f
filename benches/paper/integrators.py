"""Table 1: the stages of a frame for each integrator.

The paper's frames are not published, so we use others: small simulations with h = half the spacing, and a solid
of 600 000 particles with h = spacing. Both explicit runs work on the same sparse leaves as the other integrators:
meniscus has no dense grid. `smooth` is what the paper lists as operator, slope, vectors of CG, voxels on and off,
constraints, and sweeping between steps; `rasterize` includes the sweeping of the bounds; `contour`, for which the
paper lists no time, includes the measurements and the certificate.
"""

import statistics
import sys
from dataclasses import dataclass

import processes
from paper import figures
from paper.measuring import COMPUTING, SMALL, MeasuredFrame, in_seconds, measure_frame
from processes import ROOT, THREADS, Table

# Names as in the tables, with the options of the program. 10 000 steps of 0.01 h⁴ have the same total
# pseudo-time as 5 steps of 20 h⁴.
INTEGRATORS = {
    "explicit, 10 000 steps": ["--integrator", "explicit", "--steps", 10_000],
    "explicit, 500 steps": ["--integrator", "explicit"],
    "implicit": ["--integrator", "implicit"],
    "fast": ["--integrator", "fast"],
}
LONGEST = "explicit, 10 000 steps"  # Runs once instead of once per round.

# Half the particle spacing of the dam break in examples/frames.
DAM_VOXEL_SIZE = 0.0264

@dataclass
class Example:
    """One frame, or several whose mean is used, and the seconds that the authors' program took."""

    name: str
    paths: list
    voxel_size: float
    program_implicit: float | None = None
    program_explicit: float | None = None


def tables(args):
    parts = [part for part in args.frames.split(",") if part]
    chosen = [frame for frame in examples() if not parts or any(part in frame.name.lower() for part in parts)]
    if not chosen:
        sys.exit("tables: no frame name matches")
    taken = {frame.name: by_integrator(frame, args.rounds) for frame in chosen}
    return [papers(), *ours(chosen, taken)]


def examples():
    """Returns the available frames."""
    frames = sorted((ROOT / "examples" / "frames").glob("dam.*.bgeo"))
    yield Example(f"dam of `examples/frames`, mean of {len(frames)}", frames, DAM_VOXEL_SIZE)
    for frame in processes.script("peers").frames_named(""):
        if frame.name in figures.PROGRAM_EXPLICIT:
            explicit = figures.PROGRAM_EXPLICIT[frame.name]
            yield Example(frame.name, [frame.ours], frame.voxel_size, frame.author_seconds, explicit)
    path, spacing = processes.solid(SMALL)
    implicit = min(figures.PROGRAM_DRAGONS.items())[1][0]
    yield Example("solid 0.6 M", [path], spacing, implicit, figures.PROGRAM_DRAGON_EXPLICIT)


def by_integrator(frame, rounds):
    """Returns the rounds of each integrator. A round runs one process for each file of the example."""
    print(f"{frame.name} ", end="", flush=True)
    taken = {name: [] for name in INTEGRATORS}
    for index in range(rounds):
        for name, options in INTEGRATORS.items():
            if name != LONGEST or index == 0:
                taken[name].append([measure_frame(path, frame.voxel_size, *options) for path in frame.paths])
                print(".", end="", flush=True)
    print()
    return taken


def means(rounds, figure):
    """Returns the mean of a figure over the files of an example, for each round."""
    return [statistics.fmean(map(figure, files)) for files in rounds]


def papers():
    table = Table(
        f"The paper's, in seconds, on {figures.MACHINE}.",
        *("integrator", "part", *figures.EXAMPLES),
    )
    for name, parts in (("explicit, dense, 10 000 steps", figures.EXPLICIT), ("implicit, sparse", figures.IMPLICIT)):
        for part, values in parts.items():
            table.row(name, part, *(f"{value:g}" for value in values))
    return table


def ours(frames, taken):
    """The times of the stages, and ratios of integrators."""
    stages = Table(
        f"Ours, in seconds, on {THREADS} threads: medians (least–greatest).",
        *("frame", "particles", "free voxels", "integrator", *COMPUTING, "write", "whole process", "CPU, %", "memory, MB"),
        "CG iterations",
    )
    for frame in frames:
        for name, rounds in taken[frame.name].items():
            stages.row(*stage_row(frame, name, rounds))
    ratios = Table(
        "Speedup of one integrator over another, without reading and writing; and seconds of the authors' program,"
        f" whole processes, on another machine ({figures.PROGRAM_MACHINE}).",
        *("frame", "implicit over explicit, 10 000 steps", "fast over explicit, 10 000 steps", "fast over implicit"),
        *("the authors', implicit", "the authors', explicit, 500 steps"),
    )
    for name, dense, sparse in zip(figures.EXAMPLES, figures.EXPLICIT["total"], figures.IMPLICIT["total"]):
        ratios.row(f"the paper's {name}", f"{dense / sparse:.0f}, dense to sparse", "–", "–", "–", "–")
    for frame in frames:
        seconds = {name: means(rounds, MeasuredFrame.computed) for name, rounds in taken[frame.name].items()}
        explicit, implicit, fast = (statistics.median(seconds[name]) for name in (LONGEST, "implicit", "fast"))
        ours = f"{explicit / implicit:.1f}", f"{explicit / fast:.0f}", f"{implicit / fast:.1f}"
        theirs = (f"{value:.1f}" if value else "–" for value in (frame.program_implicit, frame.program_explicit))
        ratios.row(frame.name, *ours, *theirs)
    return stages, ratios


def stage_row(frame, integrator, rounds):
    particles, free = (means(rounds[:1], lambda one, key=key: one.report[key])[0] for key in ("particles", "free_voxels"))
    seconds = [in_seconds(means(rounds, lambda one, stage=stage: one.stage(stage))) for stage in (*COMPUTING, "write")]
    cpu = statistics.median(means(rounds, lambda one: 100 * one.run.cpu_seconds / one.run.seconds))
    memory_bytes = max(one.run.memory_bytes for files in rounds for one in files)
    whole = in_seconds(means(rounds, lambda one: one.run.seconds))
    counts = f"{particles:,.0f}", f"{free:,.0f}"
    iterations = "–"
    if rounds[0][0].report["convergence"]:
        iterations = f"{means(rounds[:1], lambda one: one.report['convergence']['iterations'])[0]:.0f}"
    return frame.name, *counts, integrator, *seconds, whole, f"{cpu:.0f}", f"{memory_bytes / 1e6:.0f}", iterations
