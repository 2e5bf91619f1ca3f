"""Checks the files that .ci/release makes, as people without Rust use them. The argument is their folder.

    files        SHA256SUMS has all of them; their sizes are within the limits
    glibc        the programs for Linux need no glibc that is newer than 2.17
    same bytes   examples/frames and difficult frames become the same .glb, .vdb, .ply and .obj as with the program that
                 was built here: with the programs for Linux, with every instruction set; for aarch64, run by QEMU;
                 for Windows, run by Wine
    watch        the program for Windows follows a slow writer, ends on Ctrl-C, and continues; long paths, names in
                 Unicode, and names that differ in case only
    Debian 11    the program for Linux, in an empty system
    wheel        in an empty virtual environment: the example of README.md, within 30 s
    extension    Blender 4.5 validates, installs and enables it

Needs Wine, QEMU and debootstrap, which tests/clients/install installs, and root for Debian 11.
"""

import contextlib
import gzip
import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import zipfile
from pathlib import Path

from project import OWN, PROGRAM, ROOT, WORK, Check

FOLDER = WORK / "release"
MB = 1_000_000
PROGRAM_MAX, WHEEL_MAX, EXTENSION_MAX = 20 * MB, 8 * MB, 40 * MB
GLIBC_MAX = (2, 17)
EXAMPLE_SECONDS_MAX = 30
FORMATS = "glb,vdb,ply,obj"
# The processor of this machine may lack some; then the program says so, and uses the next.
LEVELS = ["baseline", "avx2", "avx512"]
WINE = ROOT / "tests" / "clients" / "wine"
QEMU = ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"]
DEBIAN_11 = "bullseye"


def main():
    files = Path(sys.argv[1]).resolve()
    check = Check("release: the files that people get")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    check.line("files", *complete(files))
    systems = unpacked(check, files)
    cases = difficult()
    expected = results([PROGRAM], cases, FOLDER / "expected")
    for name, command in systems.items():
        for level in LEVELS if name == "linux-x86_64" else [None]:
            label = f"{name}, {level}" if level else name
            environment = {"MENISCUS_SIMD": level} if level else {}
            check.line(f"same bytes, {label}", *differences(expected, results(command, cases, FOLDER / "made", environment)))
    if "windows-x86_64" in systems:
        watched(check, systems["windows-x86_64"])
    check.line("Debian 11", *in_debian_11(systems["linux-x86_64"][0]))
    check.line("wheel", *in_virtual_environment(files))
    check.line("extension", *in_blender(files))
    check.end()


# Files


def only(files, pattern):
    (found,) = files.glob(pattern)
    return found


def complete(files):
    faults = []
    sums = dict(reversed(line.split()) for line in (files / "SHA256SUMS").read_text().splitlines())
    there = {path.name for path in files.iterdir()} - {"SHA256SUMS"}
    faults += [f"{name}: not in SHA256SUMS, or missing" for name in there ^ sums.keys()]
    for name in there & sums.keys():
        if hashlib.sha256((files / name).read_bytes()).hexdigest() != sums[name]:
            faults.append(f"{name}: another checksum")
    limits = [("pymeniscus-*.whl", WHEEL_MAX), ("meniscus-[0-9.]*[0-9].zip", EXTENSION_MAX)]
    for pattern, most in limits:
        found = [path for path in files.glob(pattern) if "windows" not in path.name]
        faults += [f"{path.name}: {path.stat().st_size:,} bytes" for path in found if path.stat().st_size > most]
        faults += [] if found else [f"no {pattern}"]
    wheels = sorted(path.name for path in files.glob("*.whl"))
    faults += [] if len(wheels) == 3 else [f"the wheels are {wheels}"]
    return f"{len(there)} files, {sum(path.stat().st_size for path in files.iterdir()) / MB:.0f} MB", faults


def unpacked(check, files):
    """Unpacks the archives. Returns the command of each program by system."""
    commands = {}
    for system, prefix in (("linux-x86_64", []), ("linux-aarch64", QEMU), ("windows-x86_64", [WINE])):
        archive = only(files, f"meniscus-*-{system}.*")
        if archive.suffix == ".zip":
            with zipfile.ZipFile(archive) as opened:
                opened.extractall(FOLDER)
        else:
            with tarfile.open(archive) as opened:
                opened.extractall(FOLDER, filter="data")
        folder = only(FOLDER, f"meniscus-*-{system}")
        program = folder / ("meniscus.exe" if system.startswith("windows") else "meniscus")
        size = program.stat().st_size
        faults = [f"{size:,} bytes are over {PROGRAM_MAX:,}"] if size > PROGRAM_MAX else []
        faults += [f"no {name}" for name in ("README.md", "LICENSE-MIT", "licences.txt", "examples/frames/dam.0001.bgeo") if not (folder / name).exists()]
        figures = f"{archive.name}, the program has {size / MB:.1f} MB"
        if not system.startswith("windows"):
            newest = newest_glibc(program)
            figures += f", glibc {'.'.join(map(str, newest))}"
            faults += [f"it needs glibc {newest}"] if newest > GLIBC_MAX else []
        check.line(system, figures, faults)
        commands[system] = [*prefix, program]
    return commands


def newest_glibc(program):
    said = subprocess.run(["readelf", "--version-info", program], capture_output=True, text=True, check=True).stdout
    return max(tuple(map(int, number.split("."))) for number in re.findall(r"GLIBC_(2[0-9.]+)", said))


# The same bytes


def difficult():
    """Frames and options that once went wrong, or come close to a limit. The inputs are made in FOLDER/in."""
    made = FOLDER / "in"
    made.mkdir()
    frame = OWN / "dam.0005.bgeo"

    def table(name, rows, header="x,y,z"):
        text = "\n".join([header, *(",".join(f"{value:.9g}" for value in row) for row in rows), ""])
        path = made / name
        if name.endswith(".gz"):
            path.write_bytes(gzip.compress(text.encode(), mtime=0))
        else:
            path.write_text(text)
        return path

    numbers = random.Random(7)
    block = [(0.1 * x, 0.1 * y, 0.1 * z) for x in range(9) for y in range(8) for z in range(7)]
    shaken = [tuple(value + numbers.uniform(-0.03, 0.03) for value in row) for row in block]
    moving = [(*row, *(numbers.uniform(-3, 3) for _ in range(3))) for row in shaken]
    sheet = [(0.1 * x, 0.1 * y, 0.0) for x in range(20) for y in range(20)]
    thread = [(0.1 * x, 0.0, 0.0) for x in range(40)]
    far = [(x + 1e5, y - 2e5, z) for x, y, z in block]
    box = made / "box.obj"
    corners = [(x, y, z) for x in (-1, 0.31) for y in (-1, 2) for z in (-1, 2)]
    quads = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {quad}" for quad in quads]
    box.write_text("\n".join([*lines, ""]))
    sized = ["--spacing", "0.1"]
    return {
        "frames": [OWN],
        **{preset: [frame, "--preset", preset] for preset in ("noisy", "splash", "granular", "preview", "paper")},
        "implicit": [frame, "--integrator", "implicit"],
        "temporal": [OWN, "--frames", "3-5", "--temporal", "1"],
        "quads": [frame, "--quads"],
        "decimated": [frame, "--decimate", "0.2"],
        "attributes": [frame, "--attributes", "all"],
        "smooth normals": [frame, "--smooth-normals", "3"],
        "offset": [frame, "--offset", "-0.3h"],
        "tiles": [frame, "--voxel-size", "0.02", "--memory", "24MiB"],
        "shaken": [table("shaken.csv", shaken), *sized],
        "compressed": [table("shaken.csv.gz", shaken), *sized],
        "velocity": [table("moving.csv", moving, "x,y,z,vx,vy,vz"), *sized, "--anisotropy", "velocity"],
        "sheet": [table("sheet.csv", sheet), *sized],
        "thread": [table("thread.csv", thread), *sized, "--preset", "splash"],
        "far": [table("far.csv", far), *sized],
        "one": [table("one.csv", [(0.3, 0.2, 0.1)]), *sized],
        "none": [table("none.csv", []), *sized],
        "obstacle": [table("wet.csv", block), *sized, "--obstacle", box],
    }


def results(command, cases, folder, environment=None):
    """The exit status and the files of each case, by their names."""
    shutil.rmtree(folder, ignore_errors=True)
    found = {}
    for name, words in cases.items():
        out = folder / name
        ran = run(command, ["convert", *words, "--format", FORMATS, "--out", out], environment)
        outputs = [path for path in out.rglob("*.*") if path.suffix[1:] in FORMATS.split(",")]
        found[name] = (ran.returncode, {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in outputs})
        if ran.returncode and not outputs:
            found[name] += (ran.stdout + ran.stderr,)
    return found


def run(command, words, environment=None, **options):
    words = [str(word) for word in [*command, *words]]
    options = {"timeout": 1800, "capture_output": True, "text": True, "errors": "replace"} | options
    return subprocess.run(words, env={**os.environ, **(environment or {})}, **options)


def differences(expected, found):
    faults = []
    for name, (status, files, *_) in expected.items():
        other, others, *said = found[name]
        if status != other:
            faults.append(f"{name}: exit status {other}, not {status}: {''.join(said)[-300:]}")
        changed = [file for file in files.keys() | others.keys() if files.get(file) != others.get(file)]
        faults += [f"{name}: {', '.join(sorted(changed)[:4])}"] if changed else []
    count = sum(len(files) for _, files, *_ in found.values())
    return f"{len(found)} cases, {count} files", faults


# Windows


def watched(check, command):
    """The daemon for Windows, run by Wine."""
    inputs, out = FOLDER / "Wässer ∞", FOLDER / "surfaces"
    inputs.mkdir()
    frames = sorted(OWN.glob("dam.*"))
    with daemon(command, inputs, out) as process:
        slowly(frames[0], inputs)
        check.line("watch, a slow writer", *waits_for(out / "dam.0001.glb"))
        process.send_signal(signal.SIGINT)
        status = process.wait(timeout=60)
        left = [path.name for path in out.rglob("*.tmp-*")]
        check.line("watch, Ctrl-C", f"exit status {status}", ([] if status == 0 else ["it is not 0"]) + left)
    deep = inputs / ("d" * 120) / ("e" * 120)
    deep.mkdir(parents=True)
    with daemon(command, inputs, out) as process:
        slowly(frames[1], inputs)
        shutil.copy(frames[2], deep / "långt.0003.bgeo")
        check.line("watch, continued", *waits_for(out / "dam.0002.glb"))
        check.line("watch, a long path", *waits_for(out / deep.relative_to(inputs) / "långt.0003.glb"))
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)
    clash = FOLDER / "clash"
    clash.mkdir()
    shutil.copy(frames[0], clash / "dam.0001.bgeo")
    (clash / "DAM.0001.csv").write_text("x,y,z\n" + "".join(f"{0.1 * x},{0.1 * y},0\n" for x in range(9) for y in range(9)))
    ran = run(command, ["convert", clash, "--out", FOLDER / "one"])
    made = sorted(path.name for path in (FOLDER / "one").glob("*.glb"))
    faults = [] if len(made) == 1 and ran.returncode == 1 else [f"exit status {ran.returncode}, {made}: {ran.stderr[-300:]}"]
    check.line("names that differ in case", f"{made} and a message", faults)


@contextlib.contextmanager
def daemon(command, inputs, out):
    words = [*map(str, command), "watch", str(inputs), "--out", str(out), "--format", "glb", "--pattern", "**"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def slowly(source, folder):
    """Writes a file in pieces, in place."""
    data = source.read_bytes()
    with (folder / source.name).open("wb", buffering=0) as file:
        for start in range(0, len(data), len(data) // 8 + 1):
            file.write(data[start : start + len(data) // 8 + 1])
            time.sleep(0.3)


def waits_for(path, seconds=120):
    start = time.monotonic()
    while not path.exists() and time.monotonic() < start + seconds:
        time.sleep(0.1)
    return f"after {time.monotonic() - start:.1f} s", [] if path.exists() else [f"{path.name} did not appear"]


# Without Rust


def in_debian_11(program):
    """Runs the program in an empty Debian 11."""
    root = WORK / "debian-11"
    if not (root / "complete").exists():
        shutil.rmtree(root, ignore_errors=True)
        made = run(["debootstrap", "--variant=minbase"], [DEBIAN_11, root, "http://deb.debian.org/debian"])
        if made.returncode:
            return "no system", [(made.stdout + made.stderr)[-400:]]
        (root / "complete").touch()
    shutil.copy(program, root / "opt" / "meniscus")
    shutil.copytree(OWN, root / "opt" / "frames", dirs_exist_ok=True)
    shutil.rmtree(root / "opt" / "out", ignore_errors=True)
    ran = run(["chroot", root], ["/opt/meniscus", "convert", "/opt/frames", "--out", "/opt/out"])
    count = len(list((root / "opt" / "out").glob("*.glb")))
    return f"{count} frames", [] if ran.returncode == 0 and count else [(ran.stdout + ran.stderr)[-400:]]


def in_virtual_environment(files):
    example = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    folder = FOLDER / "python"
    run([sys.executable], ["-m", "venv", folder], check=True)
    start = time.monotonic()
    installed = run([folder / "bin" / "pip"], ["install", "--quiet", only(files, "pymeniscus-*manylinux*x86_64.whl")])
    ran = run([folder / "bin" / "python"], ["-c", example], cwd=folder)
    seconds = time.monotonic() - start
    faults = [] if (folder / "surface.glb").exists() else [(installed.stderr + ran.stderr)[-400:]]
    faults += [f"over {EXAMPLE_SECONDS_MAX} s"] if seconds > EXAMPLE_SECONDS_MAX else []
    return f"installed, and the example of README.md run, in {seconds:.0f} s", faults


IN_BLENDER = """
import subprocess, sys
from pathlib import Path
import bpy
archive = sys.argv[1]
tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
subprocess.run([sys.executable, tool, "validate", archive], check=True, stdout=subprocess.DEVNULL)
bpy.ops.preferences.addon_enable(module="bl_pkg")
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
assert "bl_ext.user_default.meniscus" in bpy.context.preferences.addons
import numpy, pymeniscus
points = numpy.stack(numpy.meshgrid(*[numpy.arange(8) * 0.1] * 3), -1).reshape(-1, 3)
assert pymeniscus.reconstruct(points).certificate.holds
print(bpy.app.version_string, pymeniscus.__version__, flush=True)
"""


def in_blender(files):
    archive = next(path for path in files.glob("meniscus-*.zip") if "windows" not in path.name)
    home = FOLDER / "blender"
    home.mkdir()
    ran = run([WORK / "venv" / "bin" / "python"], ["-c", IN_BLENDER, archive], {"BLENDER_USER_RESOURCES": str(home)})
    said = ran.stdout.strip().splitlines()
    # Blender may end with an error after the last line.
    is_done = bool(said) and re.fullmatch(r"4\.5\.\S+( LTS)? \S+", said[-1])
    return f"Blender {said[-1] if said else '?'}", [] if is_done else [(ran.stdout + ran.stderr)[-600:]]


if __name__ == "__main__":
    main()
