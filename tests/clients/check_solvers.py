"""Checks that the files that solvers write have closed surfaces.

    newton    a block of particles falls; USD by Newton's own viewer, as points and as instances of a sphere
    pysph     a block of water falls; HDF5 by PySPH

Every particle of the fluid is read, and no other; every surface is closed and has the volume of the block.
"""

import shutil
import subprocess

from project import ROOT, WORK, Check, convert

PARTICLE_COUNT = 1000
VOLUME = 1.0
# For each solver: its Python, the pattern of its files, their number, and the number of frames of each.
SOLVERS = {"newton": (WORK / "newton/bin/python", "*.usd?", 2, 4), "pysph": ("/usr/bin/python3", "*.hdf5", 4, 1)}
# Both compile their equations first.
GIVE_UP_SECONDS = 1800


def main():
    check = Check("solvers: surfaces of the files that they write")
    for name, (python, pattern, file_count, frame_count) in SOLVERS.items():
        folder = WORK / "solvers" / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        command = [python, ROOT / "tests/clients" / f"simulate_{name}.py", folder]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=GIVE_UP_SECONDS)
        paths = sorted(folder.glob(pattern))
        is_wrong = ran.returncode or len(paths) != file_count
        faults = [(ran.stdout + ran.stderr)[-2000:]] if is_wrong else []
        check.line(name, f"{len(paths)} files, exit status {ran.returncode}", faults)
        for path in paths:
            check.line(path.name, *surfaced(path, folder / "surfaces" / path.stem, frame_count))
    check.end()


def surfaced(path, out, count):
    """Converts a file, and checks the report of each frame."""
    status, said, frames = convert([path], out, "--format", "ply")
    faults = [] if status == 0 else [said.strip()]
    if len(frames) != count or len(list(out.glob("*.ply"))) != count:
        faults.append(f"{len(frames)} frames of {count}")
    for name, frame in frames.items():
        if frame["particles"] != PARTICLE_COUNT:
            faults.append(f"{name}: {frame['particles']} particles")
        if frame["boundary_edges"] or not frame["certificate"]["holds"]:
            faults.append(f"{name}: not closed, or not around its particles")
        if not 0.8 * VOLUME < frame["volume"] < 1.2 * VOLUME:
            faults.append(f"{name}: its volume is {frame['volume']}")
    return f"{len(frames)} frames", faults


if __name__ == "__main__":
    main()
