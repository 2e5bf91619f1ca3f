"""Checks shards on a real Slurm: a job array with a task for each shard. One shard has an invalid frame, and
another is killed.

    one process  ──────────────────────────────────────────────▶  one/   ┐
    1  2  3  4   tasks of an array, two at a time                         ├ the same bytes
       │  └─ SIGKILL during the task ──▶ requeued ──────────────▶  out/   ┘
       └─ an invalid frame ──▶ failed, repaired, and submitted again

The array's script, which is that of examples/farm, requeues a task that was killed, and not one whose input is
broken. Neither a requeued task nor one that is submitted again repeats finished frames.
"""

import filecmp
import os
import shutil
import signal
import subprocess
import sys
import time

from project import OWN, PROGRAM, ROOT, WORK, Check, convert
from slurm import ask, cluster, environment_of, pids

FRAME_COUNT = 8
SHARD_COUNT = 4
BROKEN_SHARD = 2
KILLED_SHARD = 3
# The voxels are so small that a frame takes long enough to kill a shard between two frames.
OPTIONS = ["--format", "glb,vdb", "--preset", "paper", "--voxel-size", "0.008", "--radius-min", "0.0277"]
DEADLINE_SECONDS = 200


def main():
    check = Check("shards on Slurm")
    work = WORK / "slurm"
    shutil.rmtree(work, ignore_errors=True)
    frames = work / "in"
    frames.mkdir(parents=True)
    for path in sorted(OWN.glob("*.bgeo"))[:FRAME_COUNT]:
        shutil.copy(path, frames)
    status, said, _ = convert([frames], work / "one", *OPTIONS, "--threads", "2")
    check.line("one process", f"{FRAME_COUNT} frames", [said] if status else [])
    with cluster(work / "cluster") as environment:
        environment["MENISCUS"] = str(PROGRAM)
        broken, sound = break_frame(work)
        run = Run(work, environment)
        run.to_the_end(KILLED_SHARD)
        check_tasks(check, run, {BROKEN_SHARD: "FAILED 1:0 0", KILLED_SHARD: "COMPLETED 0:0 1"}, "1:0")
        faults = [] if run.before_kill and run.identities() == run.before_kill else ["the frame was written again"]
        check.line("killed by SIGKILL", "finished frames stay as they were", faults)
        broken.write_bytes(sound)
        run = Run(work, environment)
        run.to_the_end()
        check_tasks(check, run, {}, "0:0")
    check_outputs(check, work)
    return check.end()


def first_of(work, shard):
    """The name of the first frame of a shard, without extension."""
    stems = sorted(path.stem for path in (work / "in").iterdir())
    return stems[(shard - 1) * FRAME_COUNT // SHARD_COUNT]


def break_frame(work):
    """Replaces a frame by an invalid one. Returns its path, and what it was."""
    path = work / "in" / f"{first_of(work, BROKEN_SHARD)}.bgeo"
    sound = path.read_bytes()
    path.write_bytes(b"no frame at all")
    return path, sound


class Run:
    """A run of the array."""

    def __init__(self, work, environment):
        self.work, self.environment = work, environment
        self.killed_first = first_of(work, KILLED_SHARD)
        # The identities of the shard's first outputs at the time when the shard was killed.
        self.before_kill = None
        submit = [ROOT / "examples" / "farm" / "submit.sh", str(SHARD_COUNT), "--cpus-per-task=1", "--", "in", "--out", "out", *OPTIONS]
        ran = subprocess.run(submit, env=environment, cwd=work, check=True, capture_output=True, text=True, timeout=60)
        self.array, self.verify = ran.stdout.split()
        self.seconds = time.monotonic()

    def to_the_end(self, killed_shard=None):
        """Waits until the last job has ended, and kills a shard before."""
        deadline = self.seconds + DEADLINE_SECONDS
        while not self.has_ended():
            if time.monotonic() > deadline:
                print(ask(self.environment, "squeue"), file=sys.stderr)
                raise TimeoutError(f"the jobs have not ended after {DEADLINE_SECONDS} s")
            is_to_be_killed = killed_shard is not None and self.before_kill is None
            if is_to_be_killed:
                self.kill()
            time.sleep(0.02 if is_to_be_killed else 0.2)
        self.seconds = time.monotonic() - self.seconds

    def kill(self):
        """Kills the shard as soon as its first frame is done."""
        records = (path.read_text(errors="replace") for path in (self.work / "out" / ".meniscus").glob("frames-*"))
        if not any(f'{{"done":{{"name":"{self.killed_first}"' in text for text in records):
            return
        task = f"SLURM_ARRAY_TASK_ID={KILLED_SHARD}".encode()
        job = f"SLURM_ARRAY_JOB_ID={self.array}".encode()
        for pid in pids():
            environment = environment_of(pid)
            if task in environment and job in environment and is_program(pid):
                self.before_kill = self.identities()
                os.kill(pid, signal.SIGKILL)

    def identities(self):
        """Identifiers that change when the first frame of the killed shard is written again."""
        stats = [path.stat() for path in sorted((self.work / "out").glob(f"{self.killed_first}.*"))]
        return [(stat.st_ino, stat.st_mtime_ns) for stat in stats]

    def task(self, shard):
        """The record of a task in Slurm."""
        return fields(ask(self.environment, "scontrol", "--oneliner", "show", "job", f"{self.array}_{shard}"))

    def verify_job(self):
        """The record of the job that verifies all outputs."""
        return fields(ask(self.environment, "scontrol", "--oneliner", "show", "job", self.verify))

    def has_ended(self):
        """Whether the last job has ended."""
        return self.verify_job().get("JobState") in ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT")


def is_program(pid):
    """Whether a process is meniscus instead of the script that runs it."""
    try:
        return os.readlink(f"/proc/{pid}/exe") == str(PROGRAM.resolve())
    except OSError:
        return False


def fields(text):
    """Names and values in a line of scontrol's output."""
    words = (word.partition("=") for word in text.split())
    return {name: value for name, _, value in words}


def check_tasks(check, run, others, verified):
    """Checks the final states of the tasks according to Slurm, and the exit code of the last job. `others` has the state
    of each shard that does not simply succeed."""
    for shard in range(1, SHARD_COUNT + 1):
        task = run.task(shard)
        found = " ".join(str(task.get(name)) for name in ("JobState", "ExitCode", "Restarts"))
        expected = others.get(shard, "COMPLETED 0:0 0")
        check.line(f"shard {shard}", f"state, exit code, restarts: {found}", [] if found == expected else [f"to be {expected}"])
    verify = run.verify_job()
    faults = [] if verify.get("ExitCode") == verified else [str(verify)]
    check.line("verify", f"{verify.get('JobState')}, {run.seconds:.0f} s for all jobs", faults)


def check_outputs(check, work):
    """Compares the files with those of a single process."""
    log = "".join(path.read_text() for path in work.glob("meniscus-*-verify.log"))
    faults = [] if f"{FRAME_COUNT} frames: {FRAME_COUNT} done" in log else [log]
    check.line("frames", log.strip(), faults)
    one = sorted(path for path in (work / "one").iterdir() if path.suffix in (".glb", ".vdb"))
    there = sorted(path.name for path in (work / "out").iterdir() if path.suffix in (".glb", ".vdb"))
    faults = [f"{path.name} differs" for path in one if not is_same(path, work / "out" / path.name)]
    if there != [path.name for path in one]:
        faults.append(f"there are {there}")
    check.line("bytes", f"{len(one)} files as one process writes them", faults)


def is_same(path, other):
    """Whether two files have the same bytes."""
    return other.exists() and filecmp.cmp(path, other, shallow=False)


sys.exit(main())
