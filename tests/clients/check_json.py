"""Checks that meniscus reads particles in JSON as Python's json module and splashsurf write them.

    rows          [[x, y, z], ..], of floats and of integers, compact and indented; as splashsurf writes it
    records       an object for each particle, with a velocity, an id and text
    lists         an object with a list for each attribute
    flat          lists without inner lists, as WebGL has them

Every file is written as PLY by `meniscus convert --particles-only`. Its positions must be equal to the last bit,
and so must velocities and ids. Splashsurf reads the file of rows and writes it again, with the same number of
particles.
"""

import json
import shutil
import subprocess

import numpy as np

from mesh_files import read_vertices
from project import WORK, Check, convert

FOLDER = WORK / "json"
SPLASHSURF = WORK / "splashsurf" / "bin" / "pysplashsurf"
COUNT = 1000


def main():
    check = Check("json: frames of Python's json and of splashsurf")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    random = np.random.default_rng(50)
    particles = {
        "position": random.normal(size=(COUNT, 3)) * 10.0 ** random.integers(-9, 9, (COUNT, 1)),
        "velocity": random.normal(size=(COUNT, 3)),
        "id": random.permutation(COUNT) * 2_000_000,
    }
    whole = {**particles, "position": random.integers(-9, 9, (COUNT, 3)).astype(float)}
    for label, text, expected in texts(particles, whole):
        path = FOLDER / f"{label}.json"
        path.write_text(text, encoding="utf-8")
        check.line(label, *compared(path, expected))
    rows = FOLDER / "rows.json"
    check.line("splashsurf", *rewritten(rows))
    (FOLDER / "settings.json").write_text(json.dumps({"position": [0, 0, 5], "gravity": [0, -9.81, 0]}))
    check.line("a folder with settings.json", *in_folder(FOLDER / "settings.json", rows))
    check.end()


def texts(particles, whole):
    """Labels, texts and the particles in them."""
    positions, velocities, ids = (particles[name].tolist() for name in ("position", "velocity", "id"))
    only = {"position": particles["position"]}
    yield "rows", json.dumps(positions), only
    yield "indented", json.dumps(positions, indent=2), only
    yield "integers", json.dumps(whole["position"].astype(int).tolist()), {"position": whole["position"]}
    records = [dict(zip("xyz", p), v=v, id=n, phase="water") for p, v, n in zip(positions, velocities, ids)]
    yield "records", json.dumps(records), particles
    lists = {"time": 0.5, "velocities": velocities, "positions": positions, "id": ids, "box": {"min": [0, 0, 0]}}
    yield "lists", json.dumps(lists), particles
    columns = dict(zip("xyz", particles["position"].T.tolist()), id=ids)
    columns |= dict(zip(("vx", "vy", "vz"), particles["velocity"].T.tolist()))
    yield "columns", json.dumps(columns, indent=1), particles
    flat = {"positions": sum(positions, []), "velocities": sum(velocities, []), "id": ids}
    yield "flat", json.dumps(flat, separators=(",", ":")), particles


def compared(path, expected):
    """The figures of a file, and what differs from the expected particles."""
    out = FOLDER / "out" / path.stem
    status, said, _ = convert([path], out, "--particles-only", "--format", "ply")
    if status:
        return f"exit status {status}", [said.strip()]
    return faults_of(read_vertices(out / f"{path.stem}.ply"), expected)


def faults_of(found, expected):
    faults = []
    for name, values in expected.items():
        columns = {"position": "x y z", "velocity": "v_x v_y v_z", "id": "id"}[name].split()
        if name == "velocity" and columns[0] not in found.dtype.names:
            columns = [f"velocities_{axis}" for axis in "xyz"]
        if missing := [column for column in columns if column not in found.dtype.names]:
            faults.append(f"no property {', '.join(missing)} among {', '.join(found.dtype.names)}")
            continue
        read = np.stack([found[column] for column in columns], axis=1)
        if not np.array_equal(read, values.reshape(len(values), -1)):
            faults.append(f"{name} differs")
    return f"{len(found)} particles, {', '.join(found.dtype.names)}", faults


def rewritten(path):
    """Compares the particles of a file that splashsurf has written with those that it was written from."""
    written = path.with_name("rewritten.json")
    command = [SPLASHSURF, "convert", "--particles", path, "-o", written]
    ran = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=600)
    if ran.returncode:
        return f"exit status {ran.returncode}", [(ran.stdout + ran.stderr).strip()]
    positions = np.array(json.loads(written.read_text()))
    figures, faults = compared(written, {"position": positions})
    return figures, faults if len(positions) == COUNT else [*faults, f"splashsurf wrote {len(positions)} particles"]


def in_folder(settings, frame):
    """Checks that settings beside a frame are not converted, and are no failure."""
    folder, out = FOLDER / "folder", FOLDER / "out" / "folder"
    folder.mkdir()
    for path in (settings, frame):
        shutil.copy(path, folder)
    status, said, _ = convert([folder], out, "--particles-only", "--format", "ply")
    faults = [f"exit status {status}: {said.strip()}"] if status else []
    frames = sorted(path.stem for path in out.glob("*.ply"))
    if frames != [frame.stem]:
        faults.append(f"converted {frames}")
    return f"{len(frames)} frame", faults


if __name__ == "__main__":
    main()
