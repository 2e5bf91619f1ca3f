"""What all tables of the paper need: one frame skinned, by stages, and what other work took meanwhile."""

import json
import os
import resource
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import processes
from processes import ROOT, THREADS, Run, spread

# Without reading and writing, as the paper counts.
COMPUTING = ("rasterize", "smooth", "contour")

# The solids that take the dragon's place: particles asked for.
SMALL, UPPER_RIGHT, LARGE, LARGEST = 0.6e6, 4.8e6, 38.6e6, 309e6

# Of the machine's time, what other work may take before it counts as shared.
NEIGHBOURS_MAX = 0.05


@dataclass
class Skinned:
    """What one process took for a frame, and what its report says of it."""

    run: Run
    report: dict

    def stage(self, name):
        return self.report["seconds"][name]

    def computed(self):
        """Seconds without reading and writing, as the paper counts them."""
        return sum(map(self.stage, COMPUTING))


def skinned(path, voxel_size, *options, threads=THREADS):
    with tempfile.TemporaryDirectory() as out:
        report = Path(out) / "report.json"
        command = processes.meniscus(path, voxel_size, out, "--report", report, *options, threads=threads)
        run = processes.measured(command)
        return Skinned(run, json.loads(report.read_text())["frames"][0])


def in_seconds(values):
    """With as many digits as they deserve."""
    middle = statistics.median(values)
    return spread(values, ".1f" if middle >= 10 else ".2f" if middle >= 1 else ".3f")


class Neighbours:
    """How much of the machine other work takes, as Linux counts it."""

    def __init__(self):
        self.start = self.counted()

    def counted(self):
        """Seconds: of the clock, of all processors at work, and of those for us and our processes."""
        path = Path("/proc/stat")
        # user, nice, system, idle, waiting, interrupts, soft interrupts, stolen
        ticks = [int(word) for word in path.read_text().split("\n")[0].split()[1:9]] if path.exists() else [0] * 8
        busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")
        usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return time.perf_counter(), busy, sum(usage.ru_utime + usage.ru_stime for usage in usages)

    def share(self):
        """Of all processors' time since it was made; 0 where the system does not tell."""
        clock, busy, ours = (now - before for now, before in zip(self.counted(), self.start))
        return max(0, busy - ours) / (clock * os.cpu_count())

    def told(self):
        share = self.share()
        shared = ": they were shared" if share > NEIGHBOURS_MAX else ""
        return f"other work took {100 * share:.0f} % of the cores meanwhile{shared}"


def section_of_performance(heading):
    text = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    return text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
