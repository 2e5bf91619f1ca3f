"""Fig. 18 to 20: the speedup of threads, and a projection of it from the serial share of the work.

The paper's figures are plots without numbers; its speedups follow from its Table 2. The serial share s makes
Amdahl's law, T(n) = T(1)·(s + (1 − s)/n), fit the times with one thread and with the most threads, round by round.
The projection to more cores is that law; it ignores shared memory and caches, and loops with too few pieces for
that many cores, which reduce the real speedup.
"""

import os
import statistics
import sys

import plot
import processes
from paper import figures
from paper.measuring import COMPUTING, OTHER_LOAD_MAX, SMALL, UPPER_RIGHT, OtherLoad, in_seconds, measure_frame
from processes import Table, spread

PICTURE = "tables_speedup.svg"  # beside the tables

def tables(args):
    cores = os.cpu_count()
    counts = [threads for threads in (1, 2, 3, 4, 6, 8, 12) if threads <= cores]
    if len(counts) < 2:
        sys.exit("tables: measuring threads requires more than one core")
    other_load = OtherLoad()
    taken = {particles: on_threads(particles, counts, args.rounds) for particles in (SMALL, UPPER_RIGHT)}
    is_shared = other_load.share() > OTHER_LOAD_MAX
    recorded = recorded_threads()
    measured = [
        stages_on_threads(
            "Measured now, h = spacing: seconds, medians (least–greatest).",
            {f"{count / 1e6:g} M": rounds for count, rounds in taken.items()},
            is_shared,
        ),
        stages_on_threads(
            "The same from the output of `cargo bench --bench stages` in stages.txt: another solid with h = half the"
            " spacing, which has many more free voxels.",
            recorded,
        ),
    ]
    # The largest solid of each measurement. If the machine is shared, two threads get hardly more of the cores
    # than one, and the times are too noisy for a projection.
    sources = {} if is_shared else {"now": taken[UPPER_RIGHT]}
    sources["stages"] = list(recorded.values())[-1]
    args.folder.mkdir(parents=True, exist_ok=True)
    picture = plot.svg("threads", "speedup over one thread", figures.CORES, figures.CORES, 2, speedup_lines(sources))
    (args.folder / PICTURE).write_text(picture, encoding="utf-8")
    return [*measured, projected(sources)]


def on_threads(particles, counts, rounds):
    """Reconstructs a solid alternately on each number of threads. Returns, for each number, the seconds of
    the stages in each round."""
    path, spacing = processes.solid(particles)
    path.read_bytes()  # into the system's cache
    taken = {threads: [] for threads in counts}
    for _ in range(rounds):
        for threads in counts:
            one = measure_frame(path, spacing, threads=threads)
            taken[threads].append(with_sum([one.stage(stage) for stage in COMPUTING]))
            print(".", end="", flush=True)
    print()
    return taken


def recorded_threads():
    """Reads the stages on one and on two threads from docs/results/stages.txt: particles, and the format of `on_threads`."""
    rows = {}
    path = processes.ROOT / "docs" / "results" / "stages.txt"
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if len(words) == 9 and words[0].isdigit():
            threads, particles, _, *seconds = words
            taken = rows.setdefault(f"{float(particles) / 1e6:.2f} M", {})
            taken[int(threads)] = [with_sum(map(float, seconds[: len(COMPUTING)]))]
    return rows


def with_sum(seconds):
    """Adds the total to the seconds of each stage."""
    stages = dict(zip(COMPUTING, seconds))
    return stages | {"all three": sum(stages.values())}


def serial_shares(rounds, many, stage):
    """The serial share by Amdahl's law T(n) = T(1)·(s + (1 − s)/n), round by round."""
    ratios = [one[stage] / alone[stage] for one, alone in zip(rounds[many], rounds[1])]
    return [max(0, (ratio - 1 / many) / (1 - 1 / many)) for ratio in ratios]


def speedups(rounds, threads, stage="all three"):
    """The speedup of this number of threads over one thread, for each round."""
    return [alone[stage] / one[stage] for one, alone in zip(rounds[threads], rounds[1])]


def amdahl(share, threads):
    """The speedup of this number of threads over one thread by Amdahl's law, for this serial share."""
    return 1 / (share + (1 - share) / threads)


def stages_on_threads(title, taken, is_shared=False):
    """Fig. 18 and 19: seconds on each number of threads; also a projection to twelve threads, unless the
    machine was shared."""
    counts = list(next(iter(taken.values())))
    table = Table(
        title,
        *("particles", "stage", *(f"{count} thread{'s' * (count > 1)}" for count in counts)),
        *(f"speedup with {counts[-1]} threads", "serial share, %", f"projected speedup on {figures.CORES} cores"),
    )
    for particles, rounds in taken.items():
        for stage in next(iter(rounds.values()))[0]:
            shares = serial_shares(rounds, counts[-1], stage)
            table.row(
                *(particles, stage),
                *(in_seconds([one[stage] for one in rounds[threads]]) for threads in counts),
                spread(speedups(rounds, counts[-1], stage), ".2f"),
                "–" if is_shared else spread([100 * share for share in shares], ".1f"),
                "–" if is_shared else spread([amdahl(share, figures.CORES) for share in shares], ".1f"),
            )
    return table


def projected(sources):
    """Fig. 18 and 20: the paper's speedups, and ours at the same numbers of threads."""
    names = [name for source in sources for name in (f"measured, {source}", f"projected, {source}")]
    table = Table(
        "Speedup over one thread, all three stages. The paper's are derived from its Table 2; ours are those of the largest"
        " solids above.",
        *("threads", "the paper's", *names),
    )
    for threads, theirs in sorted(figures.speedups()):
        cells = []
        for ours in sources.values():
            is_measured = threads in ours
            cells.append(spread(speedups(ours, threads), ".2f") if is_measured else "–")
            cells.append("–" if is_measured else f"{amdahl(share_of(ours), threads):.1f}")
        table.row(threads, f"{theirs:.2f}", *cells)
    return table


def share_of(rounds):
    """The serial share of all stages."""
    return statistics.median(serial_shares(rounds, max(rounds), "all three"))


def speedup_lines(sources):
    """Fig. 20, and the projection."""
    counts = range(1, figures.CORES + 1)
    lines = [
        plot.Line("ideal", "#bbb", [(count, count) for count in counts], is_dashed=True),
        plot.Line("the paper, from Table 2", "#c60", figures.speedups(), is_marked=True),
    ]
    for (name, ours), colour in zip(sources.items(), ("#06c", "#393")):
        projection = [(count, amdahl(share_of(ours), count)) for count in counts]
        measured = [(threads, statistics.median(speedups(ours, threads))) for threads in ours]
        lines.append(plot.Line(f"projected, {name}", colour, projection, is_dashed=True))
        lines.append(plot.Line(f"measured, {name}", colour, measured, is_marked=True))
    return lines
