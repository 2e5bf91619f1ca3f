"""Checks that meniscus reads the grids of points that OpenVDB writes; `write_points.cpp` has the list of files.

Each value is compared with what OpenVDB reads: positions in world space, numbers, vectors, and groups. PLY has no
64-bit integers and no text, so these columns are compared as numbers, or left out.
"""

import shutil
import subprocess
from pathlib import Path

import numpy as np

from mesh_files import read_vertices
from project import WORK, Check, convert

FOLDER = WORK / "openvdb-points"
LIBRARIES = ["-lopenvdb", "-ltbb", "-lImath-3_1", "-lboost_iostreams"]
# The columns of vectors in a PLY.
VECTORS = {name: [f"{name}_{axis}" for axis in "xyz"] for name in ("v", "N")}


def main():
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    source, program = Path(__file__).with_name("write_points.cpp"), FOLDER / "write_points"
    subprocess.run(["g++", "-std=c++17", "-w", source, "-o", program, *LIBRARIES], check=True)
    subprocess.run([program, FOLDER], check=True)
    check = Check("OpenVDB: meniscus reads its grids of points")
    for path in sorted(FOLDER.glob("*.vdb")):
        check.line(path.name, *compared(path))
    check.end()


def compared(path):
    out = FOLDER / path.stem
    status, said, _ = convert([path], out, "--particles-only", "--format", "ply")
    if status:
        return "could not be converted", [said.strip()]
    found, expected, faults, worst = read_vertices(next(out.glob("*.ply"))), columns(path.with_suffix(".txt")), [], 0.0
    for name, values in expected.items():
        if name not in found.dtype.names:
            faults.append(f"there is no {name}")
        elif len(found) != len(values):
            faults.append(f"there are {len(found)} particles and not {len(values)}")
        else:
            worst = max(worst, (abs(found[name] - values) / (1 + abs(values))).max())
    if worst > 1e-6:
        faults.append(f"values differ by {worst:.1e}")
    return f"{len(found)} particles, {len(expected)} columns, values differ by {worst:.1e}", faults


def columns(path):
    """The columns of a text of `write_points.cpp`, by their names in a PLY."""
    found = {}
    for line in path.read_text().splitlines():
        for cell in line.split("|"):
            name, _, values = cell.partition(" ")
            if name == "name":
                continue
            values = [float(value) for value in values.split()]
            for column, value in zip(VECTORS.get(name, [name]), values):
                found.setdefault(column, []).append(value)
    return {name: np.array(values) for name, values in found.items()}


if __name__ == "__main__":
    main()
