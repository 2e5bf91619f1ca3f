"""Checks that shards run as an Open Job Description. The command `openjd` of that project validates the
template and runs it on this machine.

Five shards in chunks of two are three tasks. The next step verifies all outputs. In a second run, every frame
is done already.
"""

import filecmp
import shutil
import subprocess
import sys

from project import OWN, PROGRAM, ROOT, WORK, Check, convert

OPENJD = WORK / "openjd" / "bin" / "openjd"
TEMPLATE = ROOT / "examples" / "farm" / "openjd.yaml"
FRAME_COUNT = 6
SHARD_COUNT = 5


def main():
    check = Check("shards by an Open Job Description")
    work = WORK / "openjd_job"
    shutil.rmtree(work, ignore_errors=True)
    frames = work / "in"
    frames.mkdir(parents=True)
    for path in sorted(OWN.glob("*.bgeo"))[:FRAME_COUNT]:
        shutil.copy(path, frames)
    status, said, _ = convert([frames], work / "one")
    check.line("one process", f"{FRAME_COUNT} frames", [said] if status else [])
    status, said = run([OPENJD, "check", TEMPLATE])
    check.line("openjd check", said.strip().splitlines()[-1], [said] if status else [])

    out = work / "out"
    out.mkdir()
    given = {"Input": frames, "Out": out, "Options": "--format glb,vdb", "Shards": SHARD_COUNT, "ShardsPerTask": 2, "Meniscus": PROGRAM}
    command = [OPENJD, "run", TEMPLATE, *(word for name, value in given.items() for word in ("-p", f"{name}={value}"))]
    for label, already in (("openjd run", 0), ("openjd run again", FRAME_COUNT)):
        status, said = run(command)
        # Three tasks of the first step, and the task that verifies all outputs.
        task_count = said.count("Running Task")
        found = [task_count == 4, f"{FRAME_COUNT} frames: {FRAME_COUNT} done" in said, said.count(": done already") == already]
        for shard in range(1, SHARD_COUNT + 1):
            found.append(f"shard {shard}/{SHARD_COUNT}: " in said)
        faults = [said] if status or not all(found) else []
        check.line(label, f"{task_count} tasks, {already} frames done already", faults)

    one = sorted(path for path in (work / "one").iterdir() if path.suffix in (".glb", ".vdb"))
    is_same = [(out / path.name).exists() and filecmp.cmp(path, out / path.name, shallow=False) for path in one]
    check.line("bytes", f"{len(one)} files as one process writes them", [] if one and all(is_same) else [str(is_same)])
    return check.end()


def run(command):
    """Runs a command, and returns its exit status and its output."""
    words = [str(word) for word in command]
    ran = subprocess.run(words, capture_output=True, text=True, timeout=300)
    return ran.returncode, ran.stdout + ran.stderr


sys.exit(main())
