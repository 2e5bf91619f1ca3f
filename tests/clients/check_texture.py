"""Checks that other programs find the texture coordinates of a surface at its vertices.

    usd           OpenUSD: each .usdc
    vtk           VTK, ParaView's library: each .vtp
    alembic       the Alembic library: each .abc, and the sequence file shot.abc
    blender       Blender: each .usdc, .abc, .glb and .obj, and the sequence file, frame by frame

The coordinates of a ball of particles are those of the .obj. The words after the name of this script choose the programs:
it runs in separate Pythons, each with some of them.
"""

import shutil
import sys

import numpy as np

from project import WORK, Check, convert

SPACING = 0.1
NUMBERS = (1, 2)
FPS = 24
# The largest error of coordinates that were rounded twice: a .glb has 1 - v.
ERROR_MAX = 2e-7
FOLDER = WORK / "texture"


def main():
    check = Check(f"texture: coordinates, in {' and '.join(sys.argv[1:])}")
    shutil.rmtree(FOLDER, ignore_errors=True)
    (FOLDER / "in").mkdir(parents=True)
    for number in NUMBERS:
        written(FOLDER / f"in/ball.{number}.npz", number)
    options = ("--format", "obj,usdc,abc,glb,vtp", "--spacing", SPACING, "--attributes", "uv", "--fps", FPS, "--up", "z")
    status, said, _ = convert([FOLDER / "in"], FOLDER / "out", *options, "--sequence", FOLDER / "shot.abc")
    check.line("convert", f"status {status}", [] if status == 0 else [said.strip()])
    expected = {number: of_obj(path(number, "obj")) for number in NUMBERS}
    for program in sys.argv[1:]:
        try:
            {"usd": usd, "vtk": in_vtk, "alembic": alembic, "blender": blender}[program](check, expected)
        except Exception as error:
            check.line(program, "could not be read", [f"{type(error).__name__}: {error}"])
    check.end()


def path(number, ending):
    return FOLDER / "out" / f"ball.{number}.{ending}"


def written(file, number):
    """Writes a ball of jittered particles, with a picture on it."""
    cells = np.argwhere(np.ones((17, 17, 17))) - 8
    position = SPACING * (cells + 0.4 * (np.random.default_rng(number).random(cells.shape) - 0.5))
    position = position[np.linalg.norm(position, axis=1) < 0.8]
    uv = 0.5 + position[:, [0, 2]] / 2
    np.savez(file, position=position.astype(np.float32), uv=uv.astype(np.float32))


def of_obj(file):
    """The positions and coordinates of the corners of each face."""
    rows = {"v": [], "vt": [], "f": []}
    for line in file.read_text().splitlines():
        keyword, *words = line.split()
        if keyword in rows:
            rows[keyword].append(words)
    positions, uv = (np.array(rows[keyword], float) for keyword in ("v", "vt"))
    faces = np.array([[[int(part) for part in word.split("/")] for word in face] for face in rows["f"]]) - 1
    return positions[faces[..., 0]], uv[faces[..., 1]]


def compare(check, label, expected, corners, uv):
    """Prints the line of a mesh with these positions and coordinates of the corners of each face."""
    wanted_corners, wanted = expected
    faults = []
    if np.shape(uv) != wanted.shape:
        faults.append(f"it has coordinates of the shape {np.shape(uv)} and not {wanted.shape}")
    else:
        # The corners of a face may be in another order.
        away = np.linalg.norm(wanted_corners[:, :, None] - corners[:, None], axis=3)
        order = away.argmin(axis=2)[..., None]
        corners, uv = np.take_along_axis(corners, order, 1), np.take_along_axis(uv, order, 1)
        off = abs(uv - wanted).max()
        if abs(corners - wanted_corners).max() > 1e-5:
            faults.append("its faces have other corners")
        if off > ERROR_MAX:
            faults.append(f"its coordinates are off by {off:.1e}")
        label = f"{label}: {len(uv)} faces, off by {off:.0e}"
    check.line(label, "", faults)


def usd(check, expected):
    from pxr import Usd, UsdGeom, UsdValidation

    for number in NUMBERS:
        stage = Usd.Stage.Open(str(path(number, "usdc")))
        mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("surface"))
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        uv = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())[corners]
        points = np.array(mesh.GetPointsAttr().Get())
        compare(check, f"usd, ball.{number}.usdc", expected[number], points[corners], uv)
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        found = UsdValidation.ValidationContext(validators).Validate(stage)
        errors = [error.GetErrorAsString() for error in found]
        check.line(f"usd, ball.{number}.usdc", f"{len(validators)} validators, {len(errors)} errors", errors)


def in_vtk(check, expected):
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    for number in NUMBERS:
        reader = vtk.vtkXMLPolyDataReader()
        reader.SetFileName(str(path(number, "vtp")))
        reader.Update()
        surface = reader.GetOutput()
        corners = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        uv = vtk_to_numpy(surface.GetPointData().GetTCoords())[corners]
        points = vtk_to_numpy(surface.GetPoints().GetData())[corners]
        compare(check, f"vtk, ball.{number}.vtp", expected[number], points, uv)


def alembic(check, expected):
    from alembic3d.Abc import ISampleSelector

    from check_alembic import Archive, vectors

    for number in NUMBERS:
        for name, index in ((path(number, "abc"), 0), (FOLDER / "shot.abc", number - 1)):
            archive = Archive(name)
            index = min(index, len(archive.times()) - 1) if name.stem != "shot" else archive.times().index(number / FPS)
            sample, select = archive.sample(index), ISampleSelector(archive.times()[index])
            corners = np.array(sample["faces"])
            param = archive.schema.getUVsParam()
            uv = np.array([tuple(row) for row in param.getExpandedValue(select).getVals()])
            compare(check, f"alembic, {name.name} at {number}", expected[number], sample["positions"][corners], uv[corners])


def blender(check, expected):
    import bpy

    from check_blender import positions_of, to_log, transformed

    importers = {
        "usdc": bpy.ops.wm.usd_import, "abc": bpy.ops.wm.alembic_import,
        "glb": bpy.ops.import_scene.gltf,
        "obj": lambda filepath: bpy.ops.wm.obj_import(filepath=filepath, forward_axis="Y", up_axis="Z"),
    }
    to_log(WORK / "blender_texture.log")
    files = [(path(number, kind), [number]) for number in NUMBERS for kind in ("usdc", "abc", "glb", "obj")]
    for file, frames in [*files, (FOLDER / "shot.abc", NUMBERS)]:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.render.fps = FPS
        importers[file.suffix[1:]](filepath=str(file))
        obj = next(obj for obj in bpy.data.objects if obj.type == "MESH")
        for number in frames:
            bpy.context.scene.frame_set(number)
            mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
            label = f"blender, {file.name} in frame {number}"
            if not mesh.uv_layers:
                check.line(label, "", ["it has no texture coordinates"])
                continue
            loops, uv = np.zeros(len(mesh.loops), np.int32), np.zeros(2 * len(mesh.loops), np.float32)
            mesh.loops.foreach_get("vertex_index", loops)
            mesh.uv_layers.active.data.foreach_get("uv", uv)
            points = transformed(positions_of(mesh), obj.matrix_world)[loops]
            compare(check, label, expected[number], points.reshape(-1, 3, 3), uv.reshape(-1, 3, 2))


if __name__ == "__main__":
    main()
