"""Checks that every frame in convert.txt is converted to .glb, .obj, .ply and .vdb, with a closed mesh and a
certificate that holds, and that the error for an unreadable file names its format or fault. With
MENISCUS_BRIEF, only the project's own frames and two short shots are converted.

The check also makes a few difficult frames: without particles, with one particle, far from the origin, and
with z up. All outputs stay in target/clients/out for the other checks.
"""

import json
import shutil
import sys
from pathlib import Path

import flow
import glide
from project import BRIEF, DATA, OUT, OWN, WORK, Check, convert, data_is_there

FORMATS = ["glb", "obj", "ply", "vdb"]
CASES = Path(__file__).with_name("convert.txt")


def main():
    check = Check("convert: frames become .glb, .obj, .ply and .vdb")
    shutil.rmtree(OUT, ignore_errors=True)
    if BRIEF:
        reads(check, "own", OWN, [])
        moving(check)
        described(check)
        return check.end()
    there = data_is_there()
    for line in CASES.read_text().splitlines():
        verb, *rest = line.split("#")[0].split() or ["nothing"]
        if verb == "nothing":
            continue
        if verb == "reads" and there:
            reads(check, rest[0], DATA / rest[0], rest[1:])
        elif verb == "refuses" and there:
            refuses(check, rest[0], " ".join(rest[1:]))
        elif verb not in ("reads", "refuses"):
            sys.exit(f"{CASES}: unknown line “{line}”")
    reads(check, "own", OWN, [])
    awkward(check)
    flowing(check)
    moving(check)
    gliding(check)
    described(check)
    check.end()


def reads(check, label, inputs, options, formats=FORMATS):
    """Converts all frames of a file or folder, and checks the report of each frame."""
    out = OUT / label.replace("*", "all")
    paths = sorted(inputs.parent.glob(inputs.name))
    if not paths:
        check.line(label, "no such file", [f"{inputs}: no file"])
        return
    wanted = set()
    for path in paths:
        wanted |= {entry.name for entry in path.iterdir() if entry.suffix in FRAMES} if path.is_dir() else {path.name}
    status, said, frames = convert(paths, out, "--format", ",".join(formats), *options)
    if status:
        check.line(label, f"exit status {status}", [said.strip()])
    for name in sorted(wanted - frames.keys()):
        check.line(f"{label} {name}", "not in the report", [said.strip() if not status else "see above"])
    for name, frame in sorted(frames.items()):
        check.line(f"{label} {name}" if len(frames) > 1 else label, *outcome(frame, out, formats))


FRAMES = {".ply", ".bgeo", ".csv"}


def outcome(frame, out, formats):
    """The figures of a frame, and its faults."""
    if frame["status"] != "converted":
        return frame["status"], [frame.get("error") or "no error reported"]
    certificate = frame["certificate"]
    figures = (
        f"{frame['particles']} particles, h = {frame['settings']['voxel_size']:.6g}, "
        f"{frame['triangles']} triangles in {frame['components']} pieces, {sum(frame['seconds'].values()):.2f} s"
    )
    stem = Path(frame["input"]).name.removesuffix(".sc").rpartition(".")[0]
    missing = [f for f in formats if not (out / f"{stem}.{f}").is_file() or not (out / f"{stem}.{f}").stat().st_size]
    faults = [f"no {stem}.{f}" for f in missing]
    if not certificate["holds"]:
        faults.append(f"not certified: {certificate}")
    for count in ("boundary_edges", "non_manifold_edges", "degenerate_triangles"):
        if frame[count]:
            faults.append(f"{frame[count]} {count.replace('_', ' ')}")
    if frame["triangles"] and not frame["volume"] > 0:
        faults.append(f"its volume is {frame['volume']}")
    return figures, faults


def refuses(check, label, words):
    """Checks files that cannot be read: the error names the file and its kind, and no output is written."""
    paths = sorted(DATA.glob(label))
    if not paths:
        check.line(label, "no such file", [f"{DATA / label}: no file"])
    for path in paths:
        out = WORK / "refused"
        shutil.rmtree(out, ignore_errors=True)
        status, said, _ = convert([path], out, "--voxel-size", "0.1")
        error = next((line for line in said.splitlines() if line.startswith("error: ")), said.strip())
        faults = []
        if status == 0:
            faults.append("exit status 0")
        if words.lower() not in error.lower() or path.name not in error:
            faults.append(f"the error does not name {path.name} as “{words}”: {error}")
        if "panicked" in said:
            faults.append(said)
        if any(entry.suffix[1:] in FORMATS for entry in out.iterdir()):
            faults.append("something was written")
        check.line(path.relative_to(DATA), error.replace(f"{path}: ", ""), faults)


def awkward(check):
    """Checks frames that simulators rarely write."""
    folder = WORK / "awkward"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    block = [(0.1 * x, 0.1 * y, 0.1 * z) for x in range(6) for y in range(5) for z in range(4)]
    far = [(x + 4.0e6, y - 3.0e6, z + 1.0e6) for x, y, z in block]
    for name, points in {"empty": [], "single": [(1.0, 2.0, 3.0)], "block": block, "far": far}.items():
        rows = [f"{x!r},{y!r},{z!r}" for x, y, z in points]
        (folder / f"{name}.csv").write_text("\n".join(["x,y,z", *rows]) + "\n")
        for up in ("y", "z"):
            options = ["--voxel-size", "0.05", "--up", up]
            reads(check, f"awkward/{name}-up-{up}", folder / f"{name}.csv", options, [*FORMATS, "gltf"])
    options = ["--voxel-size", "0.05", "--contour", "tetrahedra", "--vdb", "half"]
    reads(check, "awkward/block-tetrahedra-half", folder / "block.csv", options)


def flowing(check):
    """Converts a frame whose particles have attributes; see flow.py."""
    flow.write_particles(WORK / "awkward" / "flowing.ply")
    for label, attributes, options in (
        ("flowing", "all", []),
        ("flowing-half", "all", ["--vdb", "half"]),
        # Only vectors: Blender 4.5 sometimes fails on a .glb that also has single numbers.
        ("flowing-vectors", "velocity,Cd", []),
    ):
        options = ["--voxel-size", str(flow.VOXEL_SIZE), "--attributes", attributes, *options]
        reads(check, label, WORK / "awkward" / "flowing.ply", options, [*FORMATS, "gltf"])
        written = json.loads((OUT / label / "report.json").read_text())
        report = written["frames"][0].get("attributes") or {}
        names = flow.NAMES if attributes == "all" else flow.NAMES[:2]
        faults = [] if report.get("names") == names else [f"the report lists {report.get('names')}"]
        if report and (report["vertices"]["empty"] or report["band"]["empty"]):
            faults.append(f"points without particles: {report}")
        check.line(f"{label} attributes", f"{', '.join(report.get('names', []))}: {report.get('seconds', 0):.3f} s", faults)


def moving(check):
    """Converts a sequence of a growing block to all mesh formats, to files that contain the whole sequence, and to a
    stage of level sets."""
    folder = WORK / "awkward" / "moving"
    folder.mkdir(parents=True, exist_ok=True)
    for frame in MOVING:
        points = [(0.1 * x, 0.1 * y, 0.1 * z) for x in range(4 + 2 * frame) for y in range(5) for z in range(4)]
        rows = ["x,y,z,vx,vy,vz", *(f"{x!r},{y!r},{z!r},{x!r},2,0" for x, y, z in points)]
        (folder / f"moving.{frame:03}.csv").write_text("\n".join(rows) + "\n")
    for label, more in (("moving", []), ("moving-quads", ["--quads"])):
        out = OUT / label
        names = ("shot.glb", "shot.abc")
        shots = [word for name in names for word in ("--sequence", out / name)]
        options = ["--voxel-size", "0.05", "--attributes", "velocity", "--up", "z", *shots, *more]
        out.mkdir(parents=True, exist_ok=True)
        reads(check, label, folder, options, ["glb", "obj", "ply", "vtp", "stl", "usda", "usdc", "abc"])
        faults = [f"no {name}" for name in names if not (out / name).is_file()]
        check.line(f"{label} shots", f"{len(MOVING)} frames", faults)
    out = OUT / "moving-volumes"
    out.mkdir(parents=True, exist_ok=True)
    options = ["--voxel-size", "0.05", "--attributes", "velocity", "--up", "z", "--stage", out / "stage.usda"]
    reads(check, "moving-volumes", folder, options, ["vdb"])


def gliding(check):
    """Converts a block that glides far from the world's origin; see glide.py."""
    folder = WORK / "awkward" / "gliding"
    folder.mkdir(parents=True, exist_ok=True)
    for frame in glide.FRAMES:
        rows = ["x,y,z,vx,vy,vz", *(f"{x!r},{y!r},{z!r},{glide.SPEED!r},0,0" for x, y, z in glide.positions(frame))]
        (folder / f"gliding.{frame:03}.csv").write_text("\n".join(rows) + "\n")
    out = OUT / "gliding"
    out.mkdir(parents=True, exist_ok=True)
    shots = ["--sequence", out / "shot.abc", "--stage", out / "stage.usda"]
    options = ["--voxel-size", str(glide.VOXEL_SIZE), "--attributes", "velocity", "--up", "z", "--fps", str(glide.FPS)]
    reads(check, "gliding", folder, [*options, *shots], ["glb", "ply", "usdc"])


def described(check):
    """Converts sequences whose particles have attributes of all types, with and without velocities. Frame 2 has no
    particles."""
    for label, fps, velocity in (("described", 30, "vx,vy,vz,"), ("described-still", 12.5, "")):
        folder = WORK / "awkward" / label
        folder.mkdir(parents=True, exist_ok=True)
        for frame in (1, 2, 3):
            rows = [f"x,y,z,{velocity}r,g,b,density,id,big,kind,uvw_x,uvw_y"]
            indices = [(x, y, z) for x in range(4 + frame) for y in range(5) for z in range(4)] if frame != 2 else []
            for number, (x, y, z) in enumerate(indices):
                speed = f"{0.1 * x!r},2,0," if velocity else ""
                kind = ("water", "oil", "")[x % 3]
                attributes = f"0.25,{0.2 * y!r},0.75,{1000.5 + x!r},{number},{(number << 32) + y},{kind},{x},{z}"
                rows.append(f"{0.1 * x!r},{0.1 * y!r},{0.1 * z!r},{speed}{attributes}")
            (folder / f"{label}.{frame:03}.csv").write_text("\n".join(rows) + "\n")
        out = OUT / label
        out.mkdir(parents=True, exist_ok=True)
        options = ["--voxel-size", "0.05", "--attributes", "all", "--up", "z", "--fps", str(fps)]
        reads(check, label, folder, [*options, "--sequence", out / "shot.abc"], ["glb", "ply", "abc"])


# Numbers of the frames; frame 3 is missing.
MOVING = (1, 2, 4)


if __name__ == "__main__":
    main()
