"""Shared by all tables of the paper: measures the stages of a frame, and the load of other processes
meanwhile."""

import json
import os
import resource
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import processes
from processes import THREADS, Run, spread

# Excluding reading and writing, as in the paper.
COMPUTING = ("rasterize", "smooth", "contour")

# The solids that replace the dragon: requested numbers of particles.
SMALL, UPPER_RIGHT, LARGE, LARGEST = 0.6e6, 4.8e6, 38.6e6, 309e6

# The machine counts as shared if other processes take more than this fraction of its CPU time.
OTHER_LOAD_MAX = 0.05


@dataclass
class MeasuredFrame:
    """The costs of one process for a frame, and its report."""

    run: Run
    report: dict

    def stage(self, name):
        return self.report["seconds"][name]

    def computed(self):
        """Seconds excluding reading and writing, as in the paper."""
        return sum(map(self.stage, COMPUTING))


def measure_frame(path, voxel_size, *options, threads=THREADS):
    with tempfile.TemporaryDirectory() as out:
        report = Path(out) / "report.json"
        command = processes.meniscus(path, voxel_size, out, "--report", report, *options, threads=threads)
        run = processes.measured(command)
        return MeasuredFrame(run, json.loads(report.read_text())["frames"][0])


def in_seconds(values):
    """Formats seconds with a sensible number of digits."""
    middle = statistics.median(values)
    return spread(values, ".1f" if middle >= 10 else ".2f" if middle >= 1 else ".3f")


class OtherLoad:
    """Measures the load of other processes, as reported by Linux."""

    def __init__(self):
        self.start = self.counted()

    def counted(self):
        """Returns seconds: elapsed, of CPU time on the whole machine, and of CPU time of this process and its children."""
        path = Path("/proc/stat")
        # user, nice, system, idle, waiting, interrupts, soft interrupts, stolen
        ticks = [int(word) for word in path.read_text().split("\n")[0].split()[1:9]] if path.exists() else [0] * 8
        busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")
        usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return time.perf_counter(), busy, sum(usage.ru_utime + usage.ru_stime for usage in usages)

    def share(self):
        """The fraction of CPU time that other processes took since this object was created; 0 if the system
        does not report it."""
        clock, busy, ours = (now - before for now, before in zip(self.counted(), self.start))
        return max(0, busy - ours) / (clock * os.cpu_count())

    def text(self):
        share = self.share()
        shared = ": the machine was shared" if share > OTHER_LOAD_MAX else ""
        return f"other processes used {100 * share:.0f} % of the CPU time{shared}"
