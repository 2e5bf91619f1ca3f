"""Checks that Prometheus' promtool finds no fault in /metrics before, during and after the conversion of
frames.

    before      no frame is converted yet
    working     at least one frame is in its stages, and at least one is done
    after       one frame failed, the others are done: counters and histograms agree

No counter decreases from one sample to the next.
"""

import re
import shutil
import subprocess
import time
import urllib.request

from project import OWN, PROGRAM, WORK, Check

STAGES = ("read", "rasterize", "smooth", "contour", "write")
ROUNDS = 4
# The program from Debian's package, which `install` unpacks.
PROMTOOL = WORK / "prometheus" / "usr" / "bin" / "promtool"


def main():
    check = Check("metrics: promtool checks /metrics")
    folder = WORK / "metrics"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "in").mkdir(parents=True)
    count = put_frames(folder)
    with Watching(folder) as watching:
        texts = {"before": watching.metrics()}
        hand_over(folder)
        texts["working"] = watching.metrics_when(lambda values: values[state("working")] and values[state("done")])
        texts["after"] = watching.metrics_when(
            lambda values: values[state("done")] == count and values[state("failed")] == 1
        )
    before = {}
    for when, text in texts.items():
        values = values_of(text)
        faults = promtool(text) + backwards(before, values)
        if when == "after":
            faults += disagreements(values, count)
        check.line(when, f"{len(values)} values, {values[state('done')]:.0f} frames done", faults)
        before = values
    check.end()


def put_frames(folder):
    """Writes frames and one invalid file next to the watched folder. Returns the number of valid frames."""
    (folder / "beside").mkdir()
    frames = sorted(OWN.glob("*.bgeo"))
    for turn in range(ROUNDS):
        for frame in frames:
            shutil.copyfile(frame, folder / "beside" / f"dam{turn}.{frame.name.split('.')[1]}.bgeo")
    (folder / "beside" / "bad.0001.bgeo").write_bytes(b"XXXX" + frames[0].read_bytes()[4:])
    return ROUNDS * len(frames)


def hand_over(folder):
    for frame in sorted((folder / "beside").iterdir()):
        frame.rename(folder / "in" / frame.name)


class Watching:
    """A daemon with an HTTP server, which runs until the end of the `with` block."""

    def __init__(self, folder):
        self.folder = folder

    def __enter__(self):
        words = [PROGRAM, "watch", "in", "--out", "out", "--listen", "127.0.0.1:0", "--preview", "png"]
        self.log = open(self.folder / "log", "w+")
        self.process = subprocess.Popen([str(word) for word in words], cwd=self.folder, stderr=self.log)
        self.address = until("the server starts", lambda: re.search(r"http://[\d.:]+", (self.folder / "log").read_text()))[0]
        until("it is ready", lambda: self.ask("/readyz"))
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(60)
        self.log.close()

    def ask(self, path):
        try:
            with urllib.request.urlopen(self.address + path, timeout=30) as answer:
                return answer.read().decode()
        except OSError:
            return None

    def metrics(self):
        return self.ask("/metrics")

    def metrics_when(self, is_so):
        def look():
            text = self.metrics()
            return text if text and is_so(values_of(text)) else None

        return until("the metrics say so", look)


def until(what, look, patience_s=300):
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        found = look()
        if found:
            return found
        time.sleep(0.01)
    raise TimeoutError(f"waited in vain: {what}")


def state(name):
    return f'meniscus_frames{{state="{name}"}}'


def values_of(text):
    lines = (line.rsplit(" ", 1) for line in text.splitlines() if line and not line.startswith("#"))
    return {name: float(value) for name, value in lines}


def promtool(text):
    """The lines that promtool prints. Each counts as a fault, even if promtool only recommends a change."""
    ran = subprocess.run([PROMTOOL, "check", "metrics"], input=text, capture_output=True, text=True, timeout=60)
    said = (ran.stdout + ran.stderr).splitlines()
    return said or ([f"promtool ends with {ran.returncode}"] if ran.returncode else [])


def backwards(before, values):
    counted = [name for name in before if re.search(r"_(total|count|sum|bucket)\b", name)]
    return [f"{name} went from {before[name]} to {values.get(name)}" for name in counted if not before[name] <= values.get(name, -1)]


def disagreements(values, count):
    faults = []
    if values["meniscus_frames_converted_total"] != count or values["meniscus_failures_total"] != 1:
        faults.append("other frames were converted, or failed")
    for stage in STAGES:
        name = "meniscus_stage_duration_seconds"
        all_of_them = values[f'{name}_bucket{{stage="{stage}",le="+Inf"}}']
        if not values[f'{name}_count{{stage="{stage}"}}'] == all_of_them == count:
            faults.append(f"{stage}: the histogram is not of {count} frames")
        if not values[f'{name}_sum{{stage="{stage}"}}'] > 0:
            faults.append(f"{stage} took no time")
    for name in ("meniscus_input_bytes_total", "meniscus_output_bytes_total", "meniscus_resident_memory_bytes"):
        if not values[name] > 0:
            faults.append(f"{name} is {values[name]}")
    return faults


main()
