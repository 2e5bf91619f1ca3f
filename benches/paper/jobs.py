"""Table 2: converts many frames, with many single-threaded processes or with fewer processes of more
threads.

The same surface of 4.8 million particles at h = spacing is made repeatedly. The last row of ours is a single
process that gets all frames in one command: there each thread processes a different frame as long as there are
enough.
"""

import os
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import processes
from paper import figures
from paper.measuring import UPPER_RIGHT, in_seconds
from processes import Table, spread

def tables(args):
    path, spacing = processes.solid(UPPER_RIGHT)
    cores = os.cpu_count()
    ways = [(count, cores // count) for count in range(cores, 0, -1) if cores % count == 0]
    taken = {way: [] for way in ways}
    together = []
    with tempfile.TemporaryDirectory(dir=processes.SOLIDS) as folder:
        frames = [Path(folder) / f"job.{number:04}.ply" for number in range(1, args.jobs + 1)]
        for frame in frames:
            frame.symlink_to(path)
        path.read_bytes()  # Loads the file into the system's cache.
        for _ in range(args.rounds):
            for way in ways:
                taken[way].append(at_once(frames, spacing, *way))
                print(".", end="", flush=True)
            together.append(in_one(Path(folder) / "job.####.ply", spacing, cores))
            print(".", end="", flush=True)
    print()
    return [papers(), ours(args.jobs, taken, together, cores)]


def at_once(frames, voxel_size, count, threads):
    """Runs this many processes at a time, each with this many threads, until all frames are done. Returns the elapsed
    seconds, and the sum of their peak memory in bytes."""

    def job(frame):
        with tempfile.TemporaryDirectory() as out:
            return processes.measured(processes.meniscus(frame, voxel_size, out, threads=threads))

    start = time.perf_counter()
    with ThreadPoolExecutor(count) as pool:
        runs = list(pool.map(job, frames))
    seconds = time.perf_counter() - start
    return seconds, count * max(run.memory_bytes for run in runs)


def in_one(pattern, voxel_size, threads):
    """Converts all frames with one command. Returns seconds and bytes."""
    with tempfile.TemporaryDirectory() as out:
        run = processes.measured(processes.meniscus(pattern, voxel_size, out, threads=threads))
    return run.seconds, run.memory_bytes


def papers():
    table = Table(
        f"The paper's, {figures.JOBS} jobs, on {figures.MACHINE}. The last two columns are derived from the times: the time of"
        " a job while that many ran, and its speedup over one thread.",
        *("concurrent processes", "threads per process", "time, h:min", "relative to the first", "seconds per job", "speedup"),
    )
    least = figures.PROCESSES[0][2]
    for (processes_at_once, threads, minutes), (_, speedup) in zip(figures.PROCESSES, figures.speedups()):
        job = figures.job_seconds(processes_at_once, minutes)
        duration = f"{minutes // 60}:{minutes % 60:02}"
        table.row(processes_at_once, threads, duration, f"{minutes / least:.2f}", f"{job:.0f}", f"{speedup:.2f}")
    return table


def ours(jobs, taken, together, cores):
    table = Table(
        f"Ours, {jobs} jobs, whole processes from a .ply to a .glb: medians (least–greatest).",
        *("concurrent processes", "threads per process", "seconds", "relative to the first", "total memory, GB"),
    )
    first = [seconds for seconds, _ in next(iter(taken.values()))]
    rows = [*((count, threads, rounds) for (count, threads), rounds in taken.items())]
    rows.append(("1, all jobs in one command", cores, together))
    for count, threads, rounds in rows:
        # Runs of the same round are compared, because the machine is in the same state within a round.
        beside = [seconds / other for (seconds, _), other in zip(rounds, first)]
        memory = max(size for _, size in rounds) / 1e9
        seconds = in_seconds([seconds for seconds, _ in rounds])
        table.row(count, threads, seconds, spread(beside, ".2f"), f"{memory:.2f}")
    return table
