"""Checks that meniscus reads the particles of stages that OpenUSD writes, in all three forms.

    still      points, widths, velocities, ids and primvars of all types, below transforms
    moving     time samples: each is a frame
    composed   sublayers, references, payloads and variants; the same as a package
    houdini    a .usdc as Houdini exports points with attributes of 16 bits: compressed numbers and tables, vectors

Positions, velocities, ids and other attributes are those that OpenUSD computes, and so are the times. `info` shows
the text, which PLY has not. The frames of the last become surfaces.
"""

import shutil
import subprocess

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt

from mesh_files import read_vertices
from project import PROGRAM, WORK, Check, convert, same_times

FILES = WORK / "usd"
COUNT = 500
CODES = [1, 2, 5]
# The attributes that `info` shows.
SHOWN = "velocities", "widths", "ids", "half", "double", "few", "int", "word"
HOUDINI_SHOWN = "velocities", "widths", "ids", "Cd", "age"


def main():
    check = Check(f"usd: particles of OpenUSD {'.'.join(map(str, Usd.GetVersion()))}")
    shutil.rmtree(FILES, ignore_errors=True)
    FILES.mkdir(parents=True)
    for ending in ("usda", "usdc"):
        for name, write in (("still", still), ("moving", moving), ("composed", composed)):
            path = FILES / f"{name}.{ending}"
            write(path)
            check.line(path.name, *compared(path))
    for name, first in (("composed.usdz", "composed.usda"), ("moving.usdz", "moving.usdc")):
        UsdUtils.CreateNewUsdzPackage(str(FILES / first), str(FILES / name))
        check.line(name, *compared(FILES / name))
    path = FILES / "houdini.usdc"
    houdini(path)
    check.line(path.name, *compared(path))
    check.line("houdini: attributes", *same_attributes(path))
    status, text, frames = convert([path], FILES / "surfaces", "--format", "ply")
    check.line("houdini: surfaces", f"{len(frames)} frames", [] if status == 0 and len(frames) == 3 else [text])
    check.end()


def add_points(stage, path, count, codes=(None,)):
    """Points on a spiral, with attributes of all types that compress differently."""
    points = UsdGeom.Points.Define(stage, path)
    index = np.arange(count)
    spiral = np.stack([np.cos(index), np.sin(index), 0.01 * index], axis=1).astype(np.float32)
    for code in codes:
        time, shift = (Usd.TimeCode.Default(), 0) if code is None else (code, code)
        points.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(spiral + np.float32(shift)), time)
        points.GetVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(spiral * np.float32(0.5)), time)
    points.GetWidthsAttr().Set(Vt.FloatArray.FromNumpy(np.full(count, 0.2, np.float32)))
    points.GetIdsAttr().Set(Vt.Int64Array.FromNumpy(index * 3 + 2**40))
    primvars, types = UsdGeom.PrimvarsAPI(points), Sdf.ValueTypeNames
    for name, kind, values in (
        ("half", types.HalfArray, Vt.HalfArray.FromNumpy((index % 7).astype(np.float16))),
        ("double", types.DoubleArray, Vt.DoubleArray.FromNumpy(np.sqrt(index))),
        ("few", types.FloatArray, Vt.FloatArray.FromNumpy((index % 3 * 0.1).astype(np.float32))),
        ("int", types.IntArray, Vt.IntArray.FromNumpy((index * index).astype(np.int32))),
        ("word", types.TokenArray, Vt.TokenArray(["a" if i % 2 else "b" for i in range(count)])),
    ):
        primvars.CreatePrimvar(name, kind, "vertex").Set(values)


def still(path):
    stage = Usd.Stage.CreateNew(str(path))
    world = UsdGeom.Xform.Define(stage, "/World")
    world.AddTranslateOp().Set((100, 200, 300))
    world.AddRotateXYZOp().Set((10, 20, 30))
    tank = UsdGeom.Xform.Define(stage, "/World/Tank")
    tank.AddOrientOp().Set(Gf.Quatf(0.5, 0.5, 0.5, 0.5))
    tank.AddScaleOp().Set((2, 2, 2))
    add_points(stage, "/World/Tank/water", COUNT)
    hidden = UsdGeom.Xform.Define(stage, "/World/Hidden")
    hidden.GetVisibilityAttr().Set("invisible")
    add_points(stage, "/World/Hidden/water", 9)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.Save()


def moving(path):
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(30)
    add_points(stage, "/water", COUNT, CODES)
    stage.Save()


def composed(path):
    def further(name):
        return path.with_name(f"{name}{path.suffix}")

    asset = Usd.Stage.CreateNew(str(further("asset")))
    asset.SetDefaultPrim(UsdGeom.Xform.Define(asset, "/Asset").GetPrim())
    add_points(asset, "/Asset/water", 40)
    asset.Save()
    weak = Usd.Stage.CreateNew(str(further("weak")))
    add_points(weak, "/weak", 30)
    weak.Save()
    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().subLayerPaths.append(f"./{further('weak').name}")
    referring = UsdGeom.Xform.Define(stage, "/Referring")
    referring.GetPrim().GetReferences().AddReference(f"./{further('asset').name}")
    referring.AddTranslateOp().Set((5, 0, 0))
    loading = UsdGeom.Xform.Define(stage, "/Loading").GetPrim()
    loading.GetPayloads().AddPayload(f"./{further('asset').name}", "/Asset")
    varying = UsdGeom.Xform.Define(stage, "/Varying").GetPrim()
    sets = varying.GetVariantSets().AddVariantSet("size")
    for name, count in (("small", 20), ("large", 60)):
        sets.AddVariant(name)
        sets.SetVariantSelection(name)
        with sets.GetVariantEditContext():
            add_points(stage, "/Varying/water", count)
    sets.SetVariantSelection("small")
    stage.Save()


HOUDINI_COUNT = 3000
HOUDINI_CODES = [1001, 1002, 1003]
HOUDINI_POINTS = "/sopimport1/points_0"


def houdini_attributes(code):
    """Names, types and values at a time code. Few distinct widths become a table, and whole ages compressed integers."""
    random, types = np.random.default_rng(code), Sdf.ValueTypeNames
    vectors = random.random((2, HOUDINI_COUNT, 3)).astype(np.float16)
    widths = np.array([0.1, 0.2, 0.25], np.float16)[random.integers(0, 3, HOUDINI_COUNT)]
    ages = random.integers(0, 900, HOUDINI_COUNT).astype(np.float16)
    return {
        "velocities": (types.Vector3hArray, vectors[0], Vt.Vec3hArray),
        "primvars:Cd": (types.Color3hArray, vectors[1], Vt.Vec3hArray),
        "widths": (types.HalfArray, widths, Vt.HalfArray),
        "primvars:age": (types.HalfArray, ages, Vt.HalfArray),
        "ids": (types.Int64Array, random.permutation(HOUDINI_COUNT) + 2**40, Vt.Int64Array),
    }


def houdini(path):
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(24)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/sopimport1").GetPrim())
    points, layer = UsdGeom.Points.Define(stage, HOUDINI_POINTS), stage.GetRootLayer()
    # The schema has 32 bits for widths and velocities, so these are written into the layer.
    for name, (kind, _, _) in houdini_attributes(0).items():
        Sdf.AttributeSpec(layer.GetPrimAtPath(HOUDINI_POINTS), name, kind).SetInfo("interpolation", "vertex")
    for code in HOUDINI_CODES:
        positions = np.random.default_rng(code + 1000).random((HOUDINI_COUNT, 3)).astype(np.float32)
        points.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(positions), code)
        for name, (_, values, array) in houdini_attributes(code).items():
            layer.SetTimeSample(f"{HOUDINI_POINTS}.{name}", code, array.FromNumpy(values))
    stage.Save()


def same_attributes(path):
    """Compares the attributes in the .ply of each frame with those that were written."""
    faults = []
    for code in HOUDINI_CODES:
        vertices = read_vertices(FILES / "out" / path.name / f"houdini.{code}.ply")
        for name, (_, values, _) in houdini_attributes(code).items():
            name = name.removeprefix("primvars:")
            columns = [name] if values.ndim == 1 else [f"{name}_{axis}" for axis in "xyz"]
            if not all(map(np.array_equal, [vertices[column] for column in columns], np.atleast_2d(values.T))):
                faults.append(f"other {name} at the time code {code}")
    return f"{len(houdini_attributes(0))} attributes in {len(HOUDINI_CODES)} frames", faults


def columns_of(prim, time):
    """The visible particles of a prim, as columns of a PLY."""
    matrix = np.array(prim.ComputeLocalToWorldTransform(time))
    # Widths are lengths, so a transform scales them.
    scale = abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3)
    columns = {"ids": prim.GetIdsAttr().Get(time), "widths": scale * np.array(prim.GetWidthsAttr().Get(time))}
    columns |= zip("xyz", (np.array(prim.GetPointsAttr().Get(time), float) @ matrix[:3, :3] + matrix[3, :3]).T)
    velocities = np.array(prim.GetVelocitiesAttr().Get(time), float) @ matrix[:3, :3]
    columns |= {f"velocities_{axis}": values for axis, values in zip("xyz", velocities.T)}
    primvars = UsdGeom.PrimvarsAPI(prim)
    columns |= {name: primvars.GetPrimvar(name).Get(time) for name in SHOWN if primvars.HasPrimvar(name) and name != "word"}
    return {name: np.array(values, float) for name, values in columns.items()}


def expected_columns(stage):
    """The columns of each frame, by its number."""
    prims = [UsdGeom.Points(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]
    codes = sorted({code for prim in prims for code in prim.GetPointsAttr().GetTimeSamples()})
    frames = {}
    for code in codes or [None]:
        time = Usd.TimeCode.Default() if code is None else Usd.TimeCode(code)
        parts = [columns_of(prim, time) for prim in prims if prim.ComputeVisibility(time) != "invisible"]
        frames[code] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return frames


def compared(path):
    out, faults = FILES / "out" / path.name, []
    status, text, _ = convert([path], out, "--particles-only", "--format", "ply")
    if status != 0:
        return "could not be converted", [text]
    written = sorted(out.glob("*.ply"))
    stage = Usd.Stage.Open(str(path))
    frames = expected_columns(stage)
    rate = stage.GetTimeCodesPerSecond()
    faults += same_times(path, [None if code is None else code / rate for code in frames])
    if len(written) != len(frames):
        faults.append(f"{len(written)} frames, and OpenUSD has {len(frames)}")
    for ply, (code, columns) in zip(written, frames.items()):
        vertices = read_vertices(ply)
        for name, values in columns.items():
            found = vertices[name] if name in vertices.dtype.names else np.zeros(0)
            if found.shape != values.shape or (abs(found - values) / (1 + abs(values))).max() > 1e-6:
                faults.append(f"{ply.name}: {name} is not that at the time code {code}")
    shown = subprocess.run([PROGRAM, "info", "--json", path], capture_output=True, text=True, timeout=600)
    for name in HOUDINI_SHOWN if path.stem == "houdini" else SHOWN:
        if shown.stdout.count(f'"{name}"') != len(frames):
            faults.append(f"info does not show {name} of each frame")
    first = next(iter(frames.values()))
    return f"{len(frames)} frames of {len(first['x'])} particles, {len(first)} columns", faults


if __name__ == "__main__":
    main()
