"""OpenUSD plays a stage while the daemon still writes it.

    at each frame     the points, faces, normals, velocities and extent of its .ply, or of the last one before it
    at each time      samples of points and velocities at the same time codes; nothing is blended where frames are missing
    volumes           the .vdb of the frame, its level set and its velocities
    usdchecker        reports nothing

Frames arrive one by one, the first one without particles, and one without velocities, which then has none in the stage;
at the end the daemon starts again, without the stage.
"""

import shutil
import subprocess
import time

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdValidation, UsdVol

from mesh_files import read_ply, read_vertices
from project import PROGRAM, WORK, Check

FOLDER = WORK / "stage"
# In the order of their arrival. Frames 3 and 6 are missing.
NUMBERS = (0, 2, 1, 7, 4, 5)
WITHOUT_VELOCITY = 4
FPS = 25
PATIENCE_SECONDS = 120


def main():
    check = Check(f"stage: OpenUSD {'.'.join(map(str, Usd.GetVersion()))} plays it while it grows")
    for formats in ("usdc,ply,vdb", "usda,ply", "vdb"):
        grows(check, formats)
    check.end()


def grows(check, formats):
    folder = FOLDER / formats.replace(",", "-")
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "in").mkdir(parents=True)
    numbers = []
    with Watching(folder, formats):
        for number in NUMBERS:
            put(folder, number)
            numbers = sorted([*numbers, number])
            check.line(f"{formats}, {number} has arrived", *played(folder, formats, numbers))
    (folder / "shot.usda").unlink()
    with Watching(folder, formats):
        check.line(f"{formats}, after a restart", *played(folder, formats, numbers))


class Watching:
    """A daemon until the end of the block."""

    def __init__(self, folder, formats):
        options = ["--format", formats, "--stage", "shot.usda", "--fps", FPS, "--attributes", "velocity", "--up", "z"]
        words = [PROGRAM, "watch", "in", "--out", "out", "--spacing", 0.1, "--settle", "10ms"]
        self.words, self.folder = [str(word) for word in [*words, *options]], folder

    def __enter__(self):
        self.log = open(self.folder / "log", "a")
        self.process = subprocess.Popen(self.words, cwd=self.folder, stderr=self.log)

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(60)
        self.log.close()


def put(folder, number):
    """A block that grows; frame 0 has no particles. Far from the origin from frame 5 on."""
    shift = 1000.0 if number >= 5 else 0.0
    points = [(0.1 * x + shift, 0.1 * y, 0.1 * z) for x in range(4 + number) for y in range(5) for z in range(4)]
    rows = ["x,y,z,vx,vy,vz", *(f"{x!r},{y!r},{z!r},{x!r},2,{number}" for x, y, z in points if number)]
    if number == WITHOUT_VELOCITY:
        rows = [",".join(row.split(",")[:3]) for row in rows]
    (folder / "new.csv").write_text("\n".join(rows) + "\n")
    (folder / "new.csv").rename(folder / "in" / f"dam.{number:03}.csv")


def played(folder, formats, numbers):
    """The figures of the stage once it has these frames, and its faults."""
    path = folder / "shot.usda"
    extension = formats.split(",")[0]
    wanted = [f"./out/dam.{number:03}.{extension}@" for number in numbers]
    start = time.monotonic()
    while not path.exists() or not all(name in path.read_text() for name in wanted):
        if time.monotonic() - start > PATIENCE_SECONDS:
            return "it did not grow", [(folder / "log").read_text()[-2000:]]
        time.sleep(0.01)
    try:
        stage = opened(path)
        faults = of_layer(stage, numbers)
        if extension != "vdb":
            faults += of_mesh(stage, folder, numbers)
        if "vdb" in formats:
            faults += of_volume(stage, folder, numbers, is_alone=extension == "vdb")
        return f"frames {' '.join(map(str, numbers))}, {path.stat().st_size} bytes", faults
    except Exception as error:
        return "could not be read", [f"{type(error).__name__}: {error}"]


def opened(path):
    """The stage as it is now: OpenUSD would reuse a layer that is still open."""
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.Reload(True)
    return Usd.Stage.Open(layer)


def of_layer(stage, numbers):
    faults = []
    if [stage.GetStartTimeCode(), stage.GetEndTimeCode()] != [numbers[0], numbers[-1]]:
        faults.append(f"it plays from {stage.GetStartTimeCode()} to {stage.GetEndTimeCode()}")
    if (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) != (FPS, FPS):
        faults.append("it has another speed")
    if (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) != ("Z", 1):
        faults.append("its axis or its unit is another")
    # What the command usdchecker does, which the package does not have.
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return faults + [error.GetErrorAsString() for error in errors]


def held(numbers):
    """The frame at each time code of a sample: each frame is repeated just before the next."""
    codes = {}
    for number, following in zip(numbers, [*numbers[1:], None]):
        codes[number] = number
        if following is not None:
            codes[following - 1 / 64] = number
    return codes


def of_mesh(stage, folder, numbers):
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("dam/surface"))
    faults = []
    codes = held(numbers)
    samples = mesh.GetPointsAttr().GetTimeSamples()
    if samples != sorted(codes) or mesh.GetVelocitiesAttr().GetTimeSamples() != samples:
        faults.append(f"its samples are at {samples}; expected {sorted(codes)}")
    for time_code in range(numbers[0], numbers[-1] + 1):
        number = max(number for number in numbers if number <= time_code)
        ply = folder / "out" / f"dam.{number:03}.ply"
        faults += [f"at {time_code}: {fault}" for fault in of_frame(mesh, time_code, ply)]
    # Nothing may be blended from a frame to the next.
    for number, following in zip(numbers, numbers[1:]):
        ply = folder / "out" / f"dam.{number:03}.ply"
        faults += [f"before {following}: {fault}" for fault in of_frame(mesh, following - 0.5, ply)]
    return faults


def of_frame(mesh, time_code, ply):
    points, triangles = read_ply(ply)
    vertices = read_vertices(ply)
    found = np.array(mesh.GetPointsAttr().Get(time_code)).reshape(-1, 3)
    moved = np.array(UsdGeom.Xformable(mesh).GetLocalTransformation(Usd.TimeCode(time_code)))[3, :3]
    faults = []
    if found.shape != points.shape or (len(points) and abs(found + moved - points).max() > 1e-4):
        return [f"its {len(found)} points are not those of {ply.name}, moved by {moved}"]
    corners, counts = mesh.GetFaceVertexIndicesAttr().Get(time_code), mesh.GetFaceVertexCountsAttr().Get(time_code)
    if not np.array_equal(np.array(corners).reshape(-1, 3), triangles) or set(counts) - {3}:
        faults.append("its faces are others")
    normals = mesh.GetNormalsAttr().Get(time_code)
    if len(normals) != len(points) or mesh.GetNormalsInterpolation() != "vertex":
        faults.append("its normals are of other points")
    if mesh.GetSubdivisionSchemeAttr().Get() != "none":
        faults.append("it would be subdivided")
    faults += of_varying(mesh, time_code, found, vertices)
    if not len(points):
        return faults
    # Motion blur: USD moves the points by the velocities of the sample at or before the time.
    blurred = UsdGeom.PointBased(mesh).ComputePointsAtTime(Usd.TimeCode(time_code), Usd.TimeCode(time_code))
    if len(blurred) != len(points):
        faults.append("USD does not move its points")
    return faults


def of_varying(mesh, time_code, points, vertices):
    """Attributes that a frame may lack: it has none of them then, and not those of another frame."""
    faults = []
    velocities, extent = mesh.GetVelocitiesAttr().Get(time_code), mesh.GetExtentAttr().Get(time_code)
    if not len(points):
        if velocities or extent is not None:
            faults.append("it has no points, but velocities or an extent of another frame")
        return faults
    if "vx" not in vertices.dtype.names:
        if velocities is not None:
            faults.append(f"it has {len(velocities)} velocities of another frame")
    else:
        expected = np.stack([vertices[name] for name in ("vx", "vy", "vz")], axis=1)
        # Between two samples, USD interpolates equal values, which rounds them.
        if np.shape(velocities) != expected.shape or not np.allclose(velocities, expected, rtol=1e-6, atol=0):
            faults.append("its velocities are others")
    if extent is None or abs(np.array(extent) - [points.min(axis=0), points.max(axis=0)]).max() > 0:
        faults.append(f"its extent is {extent}")
    return faults


def of_volume(stage, folder, numbers, is_alone):
    volume = UsdVol.Volume(stage.GetDefaultPrim().GetPrimAtPath("dam/volume"))
    faults = []
    if (volume.GetVisibilityAttr().Get() == "invisible") == is_alone:
        faults.append("the volume is visible together with the mesh, or never")
    fields = {name: UsdVol.OpenVDBAsset(stage.GetPrimAtPath(path)) for name, path in volume.GetFieldPaths().items()}
    if set(fields) != {"surface", "velocity"}:
        return [*faults, f"its fields are {sorted(fields)}"]
    for name, field in fields.items():
        kind = ("levelSet", "float") if name == "surface" else (None, "float3")
        found = (field.GetFieldClassAttr().Get(), field.GetFieldDataTypeAttr().Get())
        if found != kind or field.GetFieldNameAttr().Get() != name:
            faults.append(f"the field {name} is {found}")
        for time_code in range(numbers[0], numbers[-1] + 1):
            number = max(number for number in numbers if number <= time_code)
            resolved = field.GetFilePathAttr().Get(time_code).resolvedPath
            if resolved != str((folder / "out" / f"dam.{number:03}.vdb").resolve()):
                faults.append(f"{name} at {time_code} is in {resolved}")
    return faults


if __name__ == "__main__":
    main()
