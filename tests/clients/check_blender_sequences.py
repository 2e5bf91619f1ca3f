"""Checks the extension of Blender: imports of sequences, finished and growing, and conversions in the background.

    imported      a stage, a shot in .abc, .vdb: each frame has the vertices or bounds of its .ply; a missing
                  frame holds the previous one, and the panel says so
    times         offsets, and rates of scenes that differ from the rate of the sequence
    refused       a single frame, a stage of volumes: the message says what to do
    opened        a saved .blend shows the same frames in a Blender without the extension
    growing       SPlisHSPlasH writes frames, a daemon of the panel converts them, and the scene follows; a truncated
                  file is shown with its reason; the main thread is not blocked
    stopped       a second daemon and a wrong setting are refused with the reason; the daemon ends with the panel, and with a Blender that
                  is killed
    spray         the points beside the surface of a stage, also of a single frame, keep their material at each frame, also
                  in sequences_spray.png
    removed       nothing of the modules stays
    rendered      sequences_still.png, sequences_blurred.png: the last frame, sharp and with motion blur

Runs in separate Pythons, with Blender 4.5 and 5.0 as a module. The argument is the wheel of pymeniscus.
"""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import zipfile
from math import floor
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
from mathutils import Matrix

from check_blender import new_material, positions_of, render, stage, to_log, transformed
from mesh_files import read_ply
from project import OWN, ROOT, STRICT_TIMES, WORK, Check

HERE = Path(__file__).resolve().parent
FOLDER = WORK / "sequences"
SITE = FOLDER / "site"
SIMULATOR = WORK / "simulators" / "bin" / "python"
TURN = Matrix.Rotation(np.pi / 2, 4, "X")
FPS = 24
NUMBERS = (1, 2, 3, 5, 6, 7, 8)
# The main thread may be busy for this time.
TICK_MAX_SECONDS = 0.05
PATIENCE_SECONDS = 240


def main():
    check = Check(f"blender_sequences: Blender {bpy.app.version_string} imports, follows and converts")
    to_log(WORK / "blender_sequences.log")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    prepare()
    for label, examine in (
        ("stage.usda", lambda: imported("stage.usda")),
        ("shot.abc", lambda: imported("shot.abc")),
        ("dam.0001.vdb", lambda: imported("out/dam.0001.vdb")),
        ("presets", presets),
        ("refused", refused),
        ("opened without the extension", opened),
        ("stages and .vdb that grow", grown),
        ("SPlisHSPlasH", growing),
        ("a second daemon", locked),
        ("a wrong setting", wrong),
        ("a Blender that is killed", killed),
        ("pictures", pictures),
        ("spray", spray),
        ("removed", removed),
    ):
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                figures, faults = examine()
            check.line(label, figures, faults)
        except Exception as error:
            check.line(label, "did not come to its end", [f"{type(error).__name__}: {error}"])
    check.end()


def prepare():
    """Unpacks the wheel, registers the modules, and converts the frames, of which number 4 is missing."""
    with zipfile.ZipFile(sys.argv[1]) as wheel:
        wheel.extractall(SITE)
    sys.path[:0] = [str(SITE), str(ROOT / "blender")]
    global conversion, sequence, pymeniscus
    import pymeniscus
    from meniscus import conversion, sequence

    bpy.ops.wm.read_factory_settings(use_empty=True)
    sequence.register()
    conversion.register()
    frames = FOLDER / "in"
    frames.mkdir()
    for number in NUMBERS:
        shutil.copy(OWN / f"dam.{number:04}.bgeo", frames)
    pymeniscus.convert(
        frames, FOLDER / "out", format="usdc,vdb,ply,glb", attributes="v", fps=FPS, stage=FOLDER / "stage.usda",
        sequence=[FOLDER / "shot.abc"],
    )
    pymeniscus.convert(frames, FOLDER / "volumes", format="vdb", stage=FOLDER / "volumes.usda")


def new_scene(fps=FPS):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = fps
    return bpy.context.scene


def import_by_operator(name, **settings):
    """Runs the operator, and returns the object."""
    scene = bpy.context.scene
    scene.meniscus_sequence.path = str(FOLDER / name)
    for key, value in settings.items():
        setattr(scene.meniscus_sequence, key, value)
    bpy.ops.meniscus.sequence_import()
    return next(obj for obj in scene.objects if obj.meniscus_sequence.path)


def shown(obj):
    """The vertices that an object shows now, in the axes of the world. Of a volume, those of its mesh."""
    if obj.type == "VOLUME":
        obj = obj.parent
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = transformed(positions_of(evaluated.to_mesh()), evaluated.matrix_world)
    evaluated.to_mesh_clear()
    return points


def faults_of(obj, number):
    """Whether an object shows one of our frames."""
    points = shown(obj)
    expected = transformed(read_ply(FOLDER / "out" / f"dam.{number:04}.ply")[0], TURN)
    voxel = 0.0204
    if obj.type != "VOLUME" and len(points) != len(expected):
        return [f"{len(points)} vertices instead of the {len(expected)} of frame {number}"]
    if not len(points):
        return ["nothing"]
    # Blender's mesher puts the vertices of a level set at other places in their cells.
    allowed = (0.3 if obj.type == "VOLUME" else 1e-3) * voxel
    off = max(abs(getattr(points, end)(axis=0) - getattr(expected, end)(axis=0)).max() for end in ("min", "max"))
    if obj.type != "VOLUME":
        off = max(off, abs(points - expected).max())
    return [f"its vertices are {off / voxel:.2g} voxels from those of frame {number}"] if off > allowed else []


def held(number):
    """The frame that is shown for a number."""
    return max([other for other in NUMBERS if other <= number], default=NUMBERS[0])


def imported(name):
    """The frames at the rate of the sequence, with an offset, and at other rates of the scene."""
    faults = []
    kind = Path(name).suffix
    rate = {"fps": FPS} if kind == ".vdb" else {}

    def compare(label, obj, number_at, frames):
        for frame in frames:
            bpy.context.scene.frame_set(frame)
            number = held(min(max(number_at(frame), NUMBERS[0]), NUMBERS[-1]))
            faults.extend(f"{label}, frame {frame}: {fault}" for fault in faults_of(obj, number))

    scene = new_scene(30)
    obj = import_by_operator(name, **rate)
    if scene.render.fps / scene.render.fps_base != FPS:
        faults.append(f"the scene has {scene.render.fps} frames per second")
    if (scene.frame_start, scene.frame_end) != (1, 8):
        faults.append(f"the scene is {scene.frame_start} to {scene.frame_end}")
    compare("as it is", obj, lambda frame: frame, range(10))
    if kind in (".usda", ".vdb"):
        scene.frame_set(4)
        if "Frame 4 is missing: shows 3" not in labels(sequence.MENISCUS_PT_sequence):
            faults.append(f"the panel says {labels(sequence.MENISCUS_PT_sequence)}")
    obj.meniscus_sequence.offset = 10
    if (scene.frame_start, scene.frame_end) != (11, 18):
        faults.append(f"with an offset, the scene is {scene.frame_start} to {scene.frame_end}")
    compare("offset", obj, lambda frame: frame - 10, range(10, 20))
    for fps in (30, 12, 25):
        new_scene(fps)
        obj = import_by_operator(name, keeps_rate=True, offset=2, **rate)
        if bpy.context.scene.render.fps != fps:
            faults.append(f"the scene has {bpy.context.scene.render.fps} frames per second instead of {fps}")
        compare(f"{fps} per second", obj, lambda frame: 1 + floor((frame - 3) * FPS / fps + 1e-6), range(2, 15))
        obj.meniscus_sequence.keeps_rate = False
        compare(f"{fps} no more", obj, lambda frame: frame - 2, range(2, 12))
    return "frames 1 2 3 (4) 5 6 7 8; offset 10; scenes with 30, 12 and 25 frames per second", faults


def labels(panel):
    """The labels of a panel. Without a window, it draws on a mock layout."""
    layout = MagicMock()
    panel.draw(SimpleNamespace(layout=layout), bpy.context)
    return [call.kwargs["text"] for call in layout.box().label.call_args_list]


def presets():
    """Those that the panel offers are those of the method."""
    words = next(info.choices for info in pymeniscus.option_table() if info.name == "preset")
    offered = conversion.PRESETS
    faults = [f"{name} is missing" for name in words if name not in offered]
    return " ".join(offered), faults + [f"{name} is none" for name in offered if name not in words]


def refused():
    faults = []
    (FOLDER / "other.usda").write_text("#usda 1.0\n")
    (FOLDER / "truncated.usdc").write_bytes((FOLDER / "out/dam.0001.usdc").read_bytes()[:5000])
    for name, words in (
        ("out/dam.0001.usdc", "--stage"), ("volumes.usda", ".vdb files"), ("out/dam.0001.glb", "is not a stage"),
        ("missing.usda", "missing.usda: No such file"), ("other.usda", "other.usda"), ("truncated.usdc", "not complete"),
    ):
        scene = new_scene()
        try:
            import_by_operator(name)
            faults.append(f"{name} was imported")
        except RuntimeError as error:
            if words not in str(error) or "Errno" in str(error):
                faults.append(f"{name}: {error}")
        if len(scene.objects):
            faults.append(f"{name}: there are {len(scene.objects)} objects")
    return "6 files, and a Blender without USD", faults + refused_without_usd()


def refused_without_usd():
    """A Blender that was built without USD, as some distributions do, says so, also when a conversion is linked."""
    before, sequence.BUILD = sequence.BUILD, SimpleNamespace(usd=False, alembic=False)
    try:
        scene = new_scene()
        texts = [conversion.link(scene, FOLDER / "stage.usda")]
        try:
            import_by_operator("stage.usda")
        except RuntimeError as error:
            texts.append(str(error))
    finally:
        sequence.BUILD = before
    return [f"without USD: {text}" for text in texts if "this Blender was built without USD" not in text]


def opened():
    """Saves each kind with another rate, and looks at the frames in a Blender without the extension."""
    faults = []
    for name in ("stage.usda", "shot.abc", "out/dam.0001.vdb"):
        new_scene(30)
        obj = import_by_operator(name, keeps_rate=True)
        visible = obj.parent if obj.type == "VOLUME" else obj
        here = []
        for frame in range(1, 12):
            bpy.context.scene.frame_set(frame)
            here.append([len(shown(obj)), float(shown(obj).sum())])
        blend = FOLDER / f"{Path(name).stem}.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(blend))
        there = json.loads(in_blender(PLAYS, str(blend), visible.name).splitlines()[-1])
        # Sums of 32-bit numbers depend on how the numbers were computed.
        if not np.allclose(there, here, rtol=1e-5):
            faults.append(f"{name}: {there} instead of {here}")
    return "stage.usda, shot.abc, dam.0001.vdb at 30 frames per second", faults


PLAYS = """
    import json, sys
    import bpy
    import numpy as np

    assert "meniscus" not in sys.modules and not hasattr(bpy.types.Scene, "meniscus_sequence")
    bpy.ops.wm.open_mainfile(filepath=sys.argv[1], use_scripts=False)
    seen = []
    for frame in range(1, 12):
        bpy.context.scene.frame_set(frame)
        evaluated = bpy.data.objects[sys.argv[2]].evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = evaluated.to_mesh()
        points = np.array([evaluated.matrix_world @ vertex.co for vertex in mesh.vertices])
        seen.append([len(points), float(points.sum())])
    print(json.dumps(seen))
"""


def in_blender(script, *words):
    """Runs a script in another Blender, and returns what it printed."""
    command = [sys.executable, "-c", textwrap.dedent(script), *words]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if ran.returncode:
        raise RuntimeError(ran.stderr[-2000:])
    return ran.stdout.strip()


def follow():
    """Lets the timers act until the files have been read once more."""
    for _ in range(2):
        sequence.tick()
        if sequence._reading:
            sequence._reading.join()
    sequence.tick()


def grown():
    """Grows a stage and a .vdb sequence by a frame, fills the gap, and undoes."""
    faults = []
    for formats, name in (("usdc", "growing-usdc/shot.usda"), ("vdb", "growing-vdb/out/dam.0001.vdb")):
        folder = FOLDER / f"growing-{formats}"
        (folder / "in").mkdir(parents=True)
        scene = new_scene()

        def write(numbers):
            for number in numbers:
                shutil.copy(OWN / f"dam.{number:04}.bgeo", folder / "in")
            pymeniscus.convert(
                folder / "in", folder / "out", format=formats, attributes="v", fps=FPS, spacing=0.051, skip_done=True,
                stage=folder / "shot.usda",
            )

        write([1])
        obj = import_by_operator(name, offset=4)
        for numbers, end in (([2, 3], 7), ([5], 9), ([8], 12), ([6, 7], 12)):
            write(numbers)
            follow()
            if scene.frame_end != end:
                faults.append(f"{formats}: the scene ends at {scene.frame_end}, not at {end}")
            scene.frame_set(numbers[0] + 4)
            faults += [f"{formats}, frame {numbers[0]}: {fault}" for fault in faults_of(obj, numbers[0])]
        scene.frame_set(8)
        faults += [f"{formats}, frame 4: {fault}" for fault in faults_of(obj, 3)]
        scene.frame_end = 7
        write([4])
        follow()
        if scene.frame_end != 7:
            faults.append(f"{formats}: the scene did not end with the sequence, but was extended to {scene.frame_end}")
        # The visible frame is another one now, without a change of the frame.
        if len(shown(obj)) == len(read_ply(FOLDER / "out" / "dam.0003.ply")[0]):
            faults.append(f"{formats}: frame 4 was filled, but is not shown")
        obj.meniscus_sequence.follows = False
        follow()
    return "frame 1, then 2 3, 5, 8, 6 7 and 4; frame 5, then 3", faults + begun_later()


def begun_later():
    """Frames before the first one that was there: several threads do not finish them in order."""
    folder, faults = FOLDER / "begun-later", []
    (folder / "in").mkdir(parents=True)
    scene = new_scene()

    def write(number):
        shutil.copy(OWN / f"dam.{number:04}.bgeo", folder / "in")
        pymeniscus.convert(
            folder / "in", folder / "out", format="usdc", attributes="v", fps=FPS, spacing=0.051, skip_done=True,
            stage=folder / "shot.usda",
        )

    write(5)
    obj = import_by_operator("begun-later/shot.usda")
    if obj.name != "dam":
        faults.append(f"the sequence dam has the name {obj.name}")
    write(3)
    follow()
    if (scene.frame_start, scene.frame_end) != (3, 5):
        faults.append(f"begun later: the scene has the frames {scene.frame_start} to {scene.frame_end}")
    for number in (3, 5):
        scene.frame_set(number)
        faults += [f"begun later, frame {number}: {fault}" for fault in faults_of(obj, number)]
    return faults


def growing():
    """The panel converts what SPlisHSPlasH writes, and one file that is truncated."""
    folder = FOLDER / "live"
    cache = folder / "partio"
    cache.mkdir(parents=True)
    whole = (OWN / "dam.0001.bgeo").read_bytes()
    scene = new_scene(25)
    settings = scene.meniscus_conversion
    settings.folder, settings.out, settings.fps, settings.preset = str(cache), str(folder / "surfaces"), 8, "preview"
    with (folder / "simulator.log").open("w") as said:
        simulator = subprocess.Popen([SIMULATOR, HERE / "simulate_splishsplash.py", folder], stdout=said, stderr=said)
    bpy.ops.meniscus.conversion_start()
    faults, slowest, seen = [], {}, {}
    start = time.monotonic()
    try:
        while time.monotonic() < start + PATIENCE_SECONDS:
            was_linked = len(scene.objects) > 0
            for name, tick in (("conversion", conversion.tick), ("sequence", sequence.tick)):
                began = time.perf_counter()
                tick()
                spent = time.perf_counter() - began
                # The link is Blender's own import of one frame.
                name = name if was_linked or name == "sequence" or not len(scene.objects) else "link"
                slowest[name] = max(spent, slowest.get(name, 0))
            obj = next((obj for obj in scene.objects if obj.meniscus_sequence.path), None)
            if obj and not was_linked:
                (folder / ".coming").write_bytes(whole[: len(whole) // 2])
                (folder / ".coming").rename(cache / "broken_1.bgeo")
            if obj and simulator.poll() is None and scene.frame_end not in seen:
                # It plays while it is written.
                scene.frame_set(scene.frame_end)
                seen[scene.frame_end] = len(shown(obj))
            frames = sorted(cache.glob("ParticleData_Fluid_*.bgeo"))
            has_failed = bool(conversion._conversion.progress.failures)
            if simulator.poll() is not None and frames and obj and scene.frame_end >= len(frames) and has_failed:
                break
            time.sleep(0.2)
        said = labels(conversion.MENISCUS_PT_conversion)
        counts = conversion._conversion.progress.counts
    finally:
        simulator.kill()
        conversion._conversion.stop_now()
    if simulator.wait() or len(frames) < 25:
        faults.append(f"the simulator ended with {simulator.returncode} and {len(frames)} frames: see simulator.log")
    if len(seen) < 3 or len(set(seen.values())) < 3:
        faults.append(f"it did not play while it was written: {seen}")
    text = " ".join(said)
    if "broken_1.bgeo: " not in text or "remain" not in text:
        faults.append(f"the truncated file is not shown: {said}")
    if not any("frames done" in line for line in said) or not any("frames per minute" in line for line in said):
        faults.append(f"the panel says {said}")
    if scene.render.fps / scene.render.fps_base != 8:
        faults.append("the scene has not the rate of the simulation")
    for frame in (1, len(frames) // 2, len(frames)):
        scene.frame_set(frame)
        attributes = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.attributes
        if not len(shown(obj)) or "velocity" not in attributes:
            faults.append(f"frame {frame} is empty, or has no velocities")
    faults += [f"{name} took {took:.3f} s" for name, took in slowest.items() if STRICT_TIMES and took > TICK_MAX_SECONDS]
    times = ", ".join(f"{name} {1000 * took:.0f} ms" for name, took in slowest.items())
    figures = f"{len(frames)} frames, {len(seen)} states seen meanwhile, {counts}; {said[-3:]}; at most {times}"
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "live.blend"))
    return figures, faults


def locked():
    """Two daemons for the same results."""
    first = conversion.Conversion(FOLDER / "in", FOLDER / "locked", ["--format=usdc"])
    wait_for(lambda: first.progress.state == "running")
    scene = new_scene()
    settings = scene.meniscus_conversion
    settings.folder, settings.out = str(FOLDER / "in"), str(FOLDER / "locked")
    bpy.ops.meniscus.conversion_start()
    wait_for(lambda: not conversion._conversion.is_running)
    said = labels(conversion.MENISCUS_PT_conversion)
    faults = [] if "another daemon writes into" in " ".join(said) else [f"the panel says {said}"]
    start = time.monotonic()
    first.stop_now()
    took = time.monotonic() - start
    if first._process.returncode != 0 or first.is_running:
        faults.append(f"the first one ended with {first._process.returncode}")
    return f"refused; the first one stopped in {took:.2f} s", faults


def wrong():
    """A setting that the command refuses: the panel shows the reason, and no advice about the command line."""
    settings = new_scene().meniscus_conversion
    settings.folder, settings.out, settings.voxel_size = str(FOLDER / "in"), str(FOLDER / "wrong"), "abc"
    settings.temporal, settings.fps = 2, 25
    is_averaged = {"--temporal=2", "--time-step=0.04"}.issubset(conversion.options_of(settings))
    faults = [] if is_averaged else ["the panel does not average over time"]
    bpy.ops.meniscus.conversion_start()
    wait_for(lambda: not conversion._conversion.is_running)
    text = conversion._conversion.progress.error
    is_plain = text.startswith("invalid value 'abc'") and "is not a voxel size" in text and "--help" not in text
    return "refused", faults if is_plain else [*faults, f"the panel says {text!r}"]


def wait_for(is_so):
    start = time.monotonic()
    while not is_so():
        if time.monotonic() > start + 60:
            raise TimeoutError("waited for a minute")
        time.sleep(0.05)


def killed():
    """The daemon of a Blender that is killed ends, and so does that of one that exits."""
    faults, took = [], []
    for how in ("kill", "exit"):
        out = FOLDER / f"killed-{how}"
        words = map(str, [ROOT / "blender", SITE, FOLDER / "in", out, how])
        command = [sys.executable, "-c", textwrap.dedent(STARTS), *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        pid = int(next(line for line in process.stdout if line.startswith("pid ")).split()[1])
        start = time.monotonic()
        if how == "kill":
            process.send_signal(signal.SIGKILL)
        process.wait(60)
        while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]:
            if time.monotonic() > start + 20:
                os.kill(pid, signal.SIGKILL)
                faults.append(f"{how}: the daemon goes on")
                break
            time.sleep(0.02)
        took.append(time.monotonic() - start)
    return f"its daemon ended after {took[0]:.2f} s; with a Blender that exits, after {took[1]:.2f} s", faults


STARTS = """
    import sys, time
    from pathlib import Path
    sys.path[:0] = sys.argv[1:3]
    import bpy
    from meniscus import conversion, sequence

    sequence.register()
    conversion.register()
    daemon = conversion.Conversion(Path(sys.argv[3]), Path(sys.argv[4]), ["--format=usdc"])
    conversion._conversion = daemon
    while daemon.progress.state != "running":
        time.sleep(0.05)
    print("pid", daemon._process.pid, flush=True)
    if sys.argv[5] == "kill":
        time.sleep(600)
    conversion.unregister()
    sequence.unregister()
"""


def pictures():
    """Renders a frame of the stage, sharp and blurred."""
    points, _ = read_ply(FOLDER / "out" / "dam.0005.ply")
    images = {}
    for name in ("still", "blurred"):
        scene = new_scene()
        obj = import_by_operator("stage.usda")
        material, shader = new_material("water")
        shader.inputs["Base Color"].default_value = (0.02, 0.15, 0.3, 1)
        shader.inputs["Roughness"].default_value = 0.08
        obj.data.materials.append(material)
        scene.frame_set(5)
        stage(TURN, points.min(axis=0), points.max(axis=0))
        scene.render.use_motion_blur, scene.render.motion_blur_shutter = name == "blurred", 1.0
        images[name] = render(WORK / f"sequences_{name}.png")
    # Only the wave at the wall moves by more than a few pixels in a frame.
    blurred = (abs(images["still"] - images["blurred"]).max(axis=-1) > 0.1).mean()
    faults = [f"sequences_{name}.png shows nothing" for name, image in images.items() if image.std() < 0.05]
    if blurred < 0.003:
        faults.append("the motion is not blurred")
    return f"{blurred:.2%} of the pixels are blurred: {WORK.name}/sequences_{{still,blurred}}.png", faults


def spray():
    """Steps through stages with points, and renders one. Blender takes the data of points from the file, without
    materials, in each frame that has points."""
    faults, folder = [], FOLDER / "spray"
    report = pymeniscus.convert(
        FOLDER / "in", folder / "out", format="usdc,ply", attributes="v", fps=FPS, spacing=0.051, spray=20,
        stage=folder / "shot.usda",
    )
    counts = {int(Path(frame["input"]).stem[4:]): frame["spray"]["particles"] for frame in report["frames"]}
    pymeniscus.convert(
        FOLDER / "in/dam.0008.bgeo", folder / "out", format="usdc", spacing=0.051, spray=20, skip_done=True,
        attributes="v", fps=FPS, stage=folder / "single.usda",
    )
    for name, numbers in (("single.usda", (8,)), ("shot.usda", NUMBERS)):
        scene = new_scene()
        import_by_operator(f"spray/{name}")
        objects = {obj.type: obj for obj in scene.objects if obj.meniscus_sequence.path}
        if sorted(objects) != ["MESH", "POINTCLOUD"]:
            return "", [f"{name}: imported {sorted(objects)}"]
        points = objects["POINTCLOUD"]
        for obj in objects.values():
            modifier = sequence.modifier_of(obj)
            prim = f"/{sequence.ROOT}/" + {"MESH": "dam/surface", "POINTCLOUD": "dam_spray/spray"}[obj.type]
            if not modifier or modifier.object_path != prim:
                faults.append(f"{name}: {obj.name} does not read {prim}")
        for obj in objects.values():
            material, shader = new_material(obj.type)
            shader.inputs["Base Color"].default_value = (0.02, 0.15, 0.3, 1) if obj.type == "MESH" else (1, 0, 0, 1)
            if obj.type == "MESH":
                obj.data.materials.append(material)
            elif [slot.link for slot in obj.material_slots] == ["OBJECT"] and obj.material_slots[0].material:
                obj.material_slots[0].material = material
            else:
                faults.append(f"{name}: the points have the slots {[slot.link for slot in obj.material_slots]}")
        for number in numbers:
            scene.frame_set(number)
            graph = bpy.context.evaluated_depsgraph_get()
            for obj in objects.values():
                slots = [slot.material and slot.material.name for slot in obj.evaluated_get(graph).material_slots]
                if len(slots) != 1 or slots[0] is None:
                    faults.append(f"{name}, frame {number}: {obj.name} has the materials {slots}")
            if (found := len(points.evaluated_get(graph).data.points)) != counts[number]:
                faults.append(f"{name}, frame {number}: {found} points instead of {counts[number]}")
    # The last frame of the last stage, with the points in red.
    vertices, _ = read_ply(folder / "out" / "dam.0008.ply")
    stage(TURN, vertices.min(axis=0), vertices.max(axis=0))
    image = render(WORK / "sequences_spray.png")
    red = (image[..., 0] > 2 * image[..., 1:].max(axis=-1) + 0.1).sum()
    if red < 20:
        faults.append(f"sequences_spray.png has {red} red pixels")
    figures = " ".join(map(str, counts.values()))
    return f"{figures} points; {red} red pixels: {WORK.name}/sequences_spray.png", faults


def removed():
    """What unregistering leaves."""
    new_scene()
    conversion.unregister()
    sequence.unregister()
    names = [name for kind in (bpy.types.Scene, bpy.types.Object) for name in dir(kind) if name.startswith("meniscus_")]
    classes = [name for name in dir(bpy.types) if name.startswith("MENISCUS_")]
    timers = [tick.__module__ for tick in (sequence.tick, conversion.tick) if bpy.app.timers.is_registered(tick)]
    operators = [name for name in dir(bpy.ops.meniscus) if name.startswith(("sequence", "conversion"))]
    handlers = [each.__name__ for each in bpy.app.handlers.frame_change_pre if each.__module__ == sequence.__name__]
    faults = [f"still there: {name}" for name in names + classes + timers + handlers + operators]
    return "properties, classes, timers, handlers, operators", faults


if __name__ == "__main__":
    main()
