"""Checks that surfaces appear while simulators run.

SPlisHSPlasH and Taichi write frames with their own writers, under the final names and without pauses, into a
folder that `meniscus watch` watches. Every frame becomes a .glb and a .vdb, each complete from the moment its
name appears. After the end of the simulator, the last output appears within the conversion time of its frame
plus one second. On SIGTERM, the daemon exits with status 0, and leaves only the surfaces and its records.
`meniscus convert` writes the same bytes for the same frames, with the spacing that the daemon measured on the
first frame.

Once more with averages over time, and a daemon that is killed again and again while SPlisHSPlasH runs: in the end
the surfaces have the bytes of `meniscus convert`, too.
"""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

from project import PROGRAM, WORK, Check, convert

HERE = Path(__file__).resolve().parent
PYTHON = WORK / "simulators" / "bin" / "python"
LIVE = WORK / "live"
# For each simulator: the subfolder and the pattern of its frames, and the minimum number of frames.
SIMULATORS = {"splishsplash": ("partio", "*.bgeo", 25), "taichi": ("", "*.ply", 30)}
FORMATS = ["glb", "vdb"]
# Largest delay of the last surface after the end of the simulator, without the time to convert the last
# frame. It includes the wait until the file of the frame is stable.
LATE_MAX_SECONDS = 1.0
LOOK_EVERY_SECONDS = 0.005
# Far longer than a simulation and its conversions take.
GIVE_UP_SECONDS = 300
WAIT_SECONDS = 30
# With averages over time: fewer kills than this would not test much.
KILLS_MIN = 5
AVERAGED = ["--temporal", "1", "--time-step", "0.125", "--spacing", "0.05"]
# The daemon's folder for its own files, in the folder of the surfaces.
STATE_FOLDER = ".meniscus"
# Without this, Taichi looks for a newer version on the network.
QUIET = {"TI_SKIP_VERSION_CHECK": "ON"}


def main():
    check = Check("simulators: surfaces appear while they run")
    for name, (frames, pattern, count) in SIMULATORS.items():
        folder = LIVE / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        cache, surfaces = folder / "cache" / frames, folder / "surfaces"
        observer = Observer(surfaces)
        with Daemon(cache, surfaces, folder / "daemon.log") as daemon:
            seconds, status = simulate(name, folder, observer)
            end = time.monotonic()
            paths = sorted(cache.glob(pattern))
            check.line(f"{name}: simulator", *simulated(paths, count, seconds, status))
            observer.wait_for(outputs(paths))
            check.line(f"{name}: daemon", *ended_well(daemon, surfaces, outputs(paths)))
            check.line(f"{name}: surfaces", *in_time(paths, end, observer, daemon))
        check.line(f"{name}: bytes", *same_as_converted(paths, folder, observer, daemon))
    check.line("splishsplash: averaged over time", *averaged())
    check.end()


def averaged():
    """Kills daemons that average surfaces over time while a simulator runs. Checks that the surfaces end with the
    bytes that `convert` writes."""
    folder = LIVE / "averaged"
    shutil.rmtree(folder, ignore_errors=True)
    cache, surfaces = folder / "cache" / "partio", folder / "surfaces"
    cache.mkdir(parents=True)
    chance, kill_count = random.Random(48), 0
    options = [*AVERAGED, "--temporal-wait", "100ms", "--settle", "50ms"]
    with (folder / "simulator.log").open("w") as said:
        command = [str(PYTHON), str(HERE / "simulate_splishsplash.py"), str(folder / "cache")]
        simulator = subprocess.Popen(command, stdout=said, stderr=said, env={**os.environ, **QUIET})
    until = time.monotonic() + GIVE_UP_SECONDS
    while simulator.poll() is None and time.monotonic() < until:
        with Daemon(cache, surfaces, folder / "daemon.log", *options):
            time.sleep(chance.uniform(0.1, 1.5))
        kill_count += 1
    simulator.kill()
    paths = sorted(cache.glob("*.bgeo"))
    faults = [] if simulator.wait() == 0 else ["the simulator failed; see simulator.log"]
    if kill_count < KILLS_MIN or len(paths) < SIMULATORS["splishsplash"][2]:
        faults.append(f"{kill_count} kills and {len(paths)} frames are too few")
    with Daemon(cache, surfaces, folder / "daemon.log", *options, "--once") as daemon:
        status = daemon.process.wait(timeout=GIVE_UP_SECONDS)
    status_of_convert, said, _ = convert(paths, folder / "converted", "--format", ",".join(FORMATS), *AVERAGED)
    if status or status_of_convert:
        return f"exit status {status} and {status_of_convert}", [*faults, said.strip()]
    wrong = [
        name
        for name in sorted(outputs(paths))
        if not (surfaces / name).is_file() or digest(surfaces / name) != digest(folder / "converted" / name)
    ]
    faults += [f"{name} is something else" for name in wrong[:5]]
    return f"{len(paths)} frames, {kill_count} kills", faults


def simulate(name, folder, observer):
    """Runs a simulator, and meanwhile polls for surfaces. Returns the duration and the exit status of the
    simulator."""
    start = time.monotonic()
    command = [str(PYTHON), str(HERE / f"simulate_{name}.py"), str(folder / "cache")]
    with (folder / "simulator.log").open("w") as said:
        process = subprocess.Popen(command, stdout=said, stderr=said, env={**os.environ, **QUIET})
    while process.poll() is None and time.monotonic() < start + GIVE_UP_SECONDS:
        observer.look()
        time.sleep(LOOK_EVERY_SECONDS)
    process.kill()
    return time.monotonic() - start, process.wait()


def simulated(paths, count, seconds, status):
    """Checks the simulator itself: without its frames the other checks have no input."""
    faults = []
    if status:
        faults.append(f"its exit status is {status}; see simulator.log")
    if len(paths) < count:
        faults.append(f"of its {count} frames there are {len(paths)}")
    return f"{len(paths)} frames in {seconds:.1f} s", faults


def ended_well(daemon, surfaces, wanted):
    """Checks that the daemon ends on SIGTERM, and leaves only surfaces and its records."""
    status, seconds = daemon.end()
    left = {path.name for path in surfaces.glob("*")} - wanted - {STATE_FOLDER}
    faults = [f"left behind: {name}" for name in sorted(left)]
    if status:
        faults.append(f"its exit status is {status}; see daemon.log")
    return f"in {seconds:.2f} s", faults


def in_time(paths, end, observer, daemon):
    """Checks that every frame has its surfaces, and that the last appeared soon after the simulator's end."""
    wanted = outputs(paths)
    missing = sorted(wanted - observer.appeared.keys())
    if missing or not wanted:
        return f"{len(wanted) - len(missing)} of {len(wanted)}", [f"no {', '.join(missing[:5])} and so on"]
    last = max(wanted, key=observer.appeared.get)
    late = observer.appeared[last] - end
    meanwhile = sum(observer.appeared[name] < end for name in wanted)
    seconds = daemon.skinning_seconds()
    faults = [f"the log says nothing of {path.name}" for path in paths if path.stem not in seconds][:5]
    skinning = seconds.get(Path(last).stem, 0.0)
    if late >= skinning + LATE_MAX_SECONDS:
        faults.append(f"{last} came {late - skinning - LATE_MAX_SECONDS:.2f} s too late")
    return (
        f"{meanwhile} of {len(wanted)} there when the simulator ended; "
        f"the last {late:.2f} s later, of which {skinning:.2f} s skinning"
    ), faults


def same_as_converted(paths, folder, observer, daemon):
    """Checks that every output has the bytes that `convert` writes for the frame, when it first appears and
    at the end."""
    again = folder / "converted"
    options = ["--format", ",".join(FORMATS), "--spacing", daemon.spacing()]
    status, said, _ = convert(paths, again, *options)
    if status:
        return f"convert: exit status {status}", [said.strip()]
    faults = []
    for name in sorted(outputs(paths)):
        surface, right = folder / "surfaces" / name, digest(again / name)
        if observer.digests.get(name) != right:
            faults.append(f"{name} was something else, or not whole, when it appeared")
        elif not surface.is_file() or digest(surface) != right:
            faults.append(f"{name} is something else")
    return f"{len(outputs(paths))} files as convert makes them", faults[:5]


class Daemon:
    """A running `meniscus watch`."""

    def __init__(self, cache, surfaces, log, *options):
        self.log = log
        words = ["watch", cache, "--out", surfaces, "--format", ",".join(FORMATS), "--log", "json", *options]
        with log.open("w") as stderr:
            self.process = subprocess.Popen([str(word) for word in [PROGRAM, *words]], stderr=stderr)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def end(self):
        """Sends SIGTERM. Returns the exit status or a fault, and the time until the daemon ended."""
        start = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        try:
            status = self.process.wait(timeout=WAIT_SECONDS)
        except subprocess.TimeoutExpired:
            status = "not there: it goes on"
        return status, time.monotonic() - start

    def skinning_seconds(self):
        """The total time of each frame in all stages, by stem."""
        seconds = {}
        for fields in self.entries():
            stages = [value for name, value in fields.items() if name.endswith("_s")]
            if "frame" in fields and stages:
                seconds[Path(fields["frame"]).stem] = sum(stages)
        return seconds

    def spacing(self):
        """The particle spacing that the daemon measured."""
        return next(fields["spacing"] for fields in self.entries() if "spacing" in fields)

    def entries(self):
        """The daemon's log, a dictionary for each line."""
        for line in self.log.read_text().splitlines():
            entry = json.loads(line)
            yield {**entry, **entry.get("fields", {})}


class Observer:
    """Opens every output as soon as its name appears."""

    def __init__(self, folder):
        self.folder = folder
        self.appeared = {}
        self.digests = {}

    def look(self):
        if not self.folder.is_dir():
            return
        for path in self.folder.iterdir():
            if path.name not in self.appeared and path.suffix[1:] in FORMATS:
                self.appeared[path.name] = time.monotonic()
                self.digests[path.name] = digest(path)

    def wait_for(self, names):
        """Polls until files with all these names exist, or the time limit has passed."""
        until = time.monotonic() + WAIT_SECONDS
        while not names <= self.appeared.keys() and time.monotonic() < until:
            self.look()
            time.sleep(LOOK_EVERY_SECONDS)


def outputs(paths):
    """The names of the expected outputs of these frames."""
    return {f"{path.stem}.{suffix}" for path in paths for suffix in FORMATS}


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
