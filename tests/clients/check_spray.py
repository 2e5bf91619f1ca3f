"""Checks that other programs open a surface and the spray beside it together.

    usd           OpenUSD: each .usdc with its .spray.usdc, and the stage that plays both, at and between its time codes
    vtk           VTK, ParaView's library: each .vtp with its .spray.vtp, and both appended to one data set
    alembic       the Alembic library: each .abc with its .spray.abc, and the sequence file, at and between its samples
    blender       Blender: the stage, and the sequence file, as a mesh and a point cloud that change from frame to frame

The points are the particles that are spray, with their ids, velocities and heat, the class of their piece, and the
radius of the ball that has the volume of a particle. The vertices are those of the .ply. All are near the origin, and
again far from it with positions of 64 bits. Frame 4 is missing, frames 1 and 6 have no spray, and frame 7 no surface.
The words after the name of this script choose the programs: it runs in separate Pythons, each with some of them.
"""

import shutil
import sys

import numpy as np

from mesh_files import read_ply
from project import WORK, Check, convert

FPS = 24
SPACING = 0.1
# The radius of a ball that has the volume of a cube with this edge.
RADIUS = (0.75 / np.pi) ** (1 / 3) * SPACING
NUMBERS = (1, 2, 3, 5, 6, 7)
DROP, CLUSTER, FILAMENT = 0, 1, 2
# The pieces of spray: their class, and their particles, in spacings.
PIECES = (
    (DROP, [(0, 0, 0)]),
    (CLUSTER, [(0, 0, 0), (1, 0, 0)]),
    (FILAMENT, [(0, step, 0) for step in range(5)]),
    (CLUSTER, [(0, 0, 0), (1, 0, 0), (0, 1, 0)]),
)
# The largest error of positions, as a part of the size of the spray, and of other numbers, of the largest.
ERROR_MAX = 1e-6
# The largest error of positions that are rounded to 32 bits two or three times, or turned by a matrix of 32 bits, as a
# part of the largest coordinate.
ROUNDING = 2e-7


def main():
    check = Check(f"spray: surfaces and points together, in {' and '.join(sys.argv[1:])}")
    for label, shift in (("near", 0.0), ("far", 1000.0)):
        case = Case(check, label, shift)
        for program in sys.argv[1:]:
            try:
                {"usd": usd, "vtk": in_vtk, "alembic": alembic, "blender": blender}[program](case)
            except Exception as error:
                check.line(f"{label}, {program}", "could not be read", [f"{type(error).__name__}: {error}"])
    check.end()


class Case:
    """A converted sequence, and the points that each of its frames must have, as columns."""

    def __init__(self, check, label, shift):
        self.check, self.label, self.folder = check, label, WORK / "spray" / label
        shutil.rmtree(self.folder, ignore_errors=True)
        (self.folder / "in").mkdir(parents=True)
        self.points = {number: written(self.folder / f"in/dam.{number}.npz", number, shift) for number in NUMBERS}
        stage = ("--stage", self.folder / "shot.usda", "--fps", FPS, "--up", "z", "--attributes", "velocity")
        shot = ("--sequence", self.folder / "sequence.abc")
        options = ("--format", "glb,usdc,abc,vtp,ply", "--spacing", SPACING, "--spray", 20, *stage, *shot)
        status, said, report = convert([self.folder / "in"], self.folder / "out", *options)
        counts = [frame["spray"]["particles"] for _, frame in sorted(report.items())]
        is_right = status == 0 and counts == [len(columns["id"]) for columns in self.points.values()]
        check.line(label, f"{' '.join(map(str, counts))} particles are spray", [] if is_right else [said.strip()])

    def path(self, number, ending):
        return self.folder / "out" / f"dam.{number}.{ending}"

    def compare(self, label, number, vertices, found, faults=(), rounding=0.0):
        """Prints the line of a frame."""
        expected, mesh, faults = self.points[number], read_ply(self.path(number, "ply"))[0], list(faults)
        if (len(mesh) == 0) != (number == 7):
            faults.append(f"its .ply has {len(mesh)} vertices")
        size, worst = np.ptp(expected["position"], axis=0).max() if len(expected["id"]) else 1.0, 0
        for name, values in {"vertices": vertices, **found}.items():
            wanted = mesh if name == "vertices" else expected[name]
            if len(values) != len(wanted):
                faults.append(f"it has {len(values)} values of {name} and not {len(wanted)}")
            elif name == "spray_class":
                faults += [] if np.ravel(values).tolist() == wanted else [f"its classes are {list(values)} and not {wanted}"]
            else:
                off = abs(np.reshape(values, wanted.shape) - wanted)
                scale = size if name in ("vertices", "position") else abs(wanted).max(initial=0) or 1.0
                worst = max(worst, 0 if name == "vertices" else off.max(initial=0) / scale)
                part = ROUNDING if name == "vertices" else rounding
                if off.max(initial=0) > ERROR_MAX * scale + part * abs(wanted).max(initial=0):
                    faults.append(f"{name} is off by {off.max():.1e}: {values[0]} and not {wanted[0]}")
        figures = f"{len(vertices)} vertices, {len(found['position'])} points, {len(found)} columns"
        self.check.line(f"{self.label}, {label}", f"{figures}, differ by {worst:.0e}", faults)


def written(path, number, shift):
    """Writes a block that grows, and pieces that fly above it. Returns the particles of the pieces, as columns."""
    block = SPACING * np.argwhere(np.ones((5 + number, 5, 5)))[: 0 if number == 7 else None]
    flying = () if number in (1, 6) else PIECES
    velocities = [(0.0, 0.0, 0.0), *((1.0, 0.5 * index, 2.0) for index in range(len(flying)))]
    pieces = [np.array([index, 0.2, 1]) + SPACING * np.array(shape) + np.array(velocities[index + 1]) * number / FPS
              for index, (_, shape) in enumerate(flying)]
    position, sizes = np.concatenate([block, *pieces]) + [shift, 0, -shift], [len(block), *map(len, pieces)]
    ids = np.r_[: len(block), 1000 : 1000 + len(position) - len(block)].astype(np.int32)
    columns = {
        "position": position.astype(np.float64 if shift else np.float32), "id": ids,
        "velocity": np.repeat(velocities, sizes, axis=0).astype(np.float32),
        "heat": (ids % 7 + number / 4).astype(np.float32),
    }
    np.savez(path, **columns)
    spray = {name: values[len(block) :].astype(float) for name, values in columns.items()}
    classes = [name for name, shape in flying for _ in shape]
    return {**spray, "radius": np.full(len(classes), RADIUS), "spray_class": classes}


def latest(time):
    """The number of the frame that is shown at a time, in frames."""
    return max(number for number in NUMBERS if number <= time)


def usd(case):
    from pxr import Usd, UsdGeom, UsdValidation

    def compare(label, number, mesh, points, time):
        schema, primvars = UsdGeom.Points(points), UsdGeom.PrimvarsAPI(points)
        vertices, position = (
            np.reshape(UsdGeom.PointBased(prim).GetPointsAttr().Get(time), (-1, 3))
            + np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time))[3, :3] for prim in (mesh, points)
        )
        case.compare(f"usd, {label}", number, vertices, {
            "position": position, "id": schema.GetIdsAttr().Get(time), "velocity": schema.GetVelocitiesAttr().Get(time),
            "radius": np.array(schema.GetWidthsAttr().Get(time)) / 2,
            "heat": primvars.GetPrimvar("heat").ComputeFlattened(time),
            "spray_class": primvars.GetPrimvar("spray_class").ComputeFlattened(time),
        }, [] if mesh.IsA(UsdGeom.Mesh) and points.IsA(UsdGeom.Points) else ["its prims are of other types"])

    for number in NUMBERS:
        files = [Usd.Stage.Open(str(case.path(number, ending))) for ending in ("usdc", "spray.usdc")]
        prims = [file.GetDefaultPrim().GetPrimAtPath(name) for file, name in zip(files, ("surface", "spray"))]
        compare(f"dam.{number}.spray.usdc", number, *prims, Usd.TimeCode.Default())
    stage = Usd.Stage.Open(str(case.folder / "shot.usda"))
    prims = [stage.GetDefaultPrim().GetPrimAtPath(path) for path in ("dam/surface", "dam_spray/spray")]
    for code in np.arange(1, 7.5, 0.5):
        compare(f"shot.usda at {code}", latest(code), *prims, code)
    # What the command usdchecker does, which the package does not have.
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = [error.GetErrorAsString() for error in UsdValidation.ValidationContext(validators).Validate(stage)]
    case.check.line(f"{case.label}, usd, shot.usda", f"{len(validators)} validators, {len(errors)} errors", errors)


def in_vtk(case):
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    for number in NUMBERS:
        readers, both = [vtk.vtkXMLPolyDataReader(), vtk.vtkXMLPolyDataReader()], vtk.vtkAppendPolyData()
        for reader, ending in zip(readers, ("vtp", "spray.vtp")):
            reader.SetFileName(str(case.path(number, ending)))
            both.AddInputConnection(reader.GetOutputPort())
        both.Update()
        points, filters = readers[1].GetOutput(), (*readers, both)
        vertices, position, joined = (vtk_to_numpy(each.GetOutput().GetPoints().GetData()) for each in filters)
        names = ("id", "velocity", "radius", "heat", "spray_class")
        found = {name: vtk_to_numpy(points.GetPointData().GetArray(name)) for name in names}
        faults = [] if points.GetNumberOfVerts() == len(position) else ["it has points without cells"]
        if not np.array_equal(joined, np.concatenate([vertices, position])):
            faults.append(f"vtkAppendPolyData makes {len(joined)} points of {len(vertices)} and {len(position)}")
        case.compare(f"vtk, dam.{number}.spray.vtp", number, vertices, {"position": position, **found}, faults)


def alembic(case):
    from alembic3d.Abc import IArchive, ISampleSelector
    from alembic3d.AbcGeom import IFloatGeomParam, IInt32GeomParam, IPoints, IXform

    from check_alembic import TURNED, Archive, vectors

    placed = lambda points, matrix: (points.astype(float) @ matrix[:3, :3] + matrix[3, :3]) @ TURNED.T

    def compare(label, number, mesh, archive, name, time):
        select = ISampleSelector(time)
        transform = IXform(archive.getTop(), name)
        matrix = np.array(transform.getSchema().getValue(select).getMatrix())
        schema = IPoints(transform, f"{name}Shape").getSchema()
        sample, params = schema.getValue(select), schema.getArbGeomParams()
        case.compare(f"alembic, {label}", number, placed(mesh["positions"], mesh["matrix"]), {
            "position": placed(vectors(sample.getPositions()), matrix),
            "velocity": vectors(sample.getVelocities()), "id": np.array(sample.getIds()),
            "radius": np.array(schema.getWidthsParam().getExpandedValue(select).getVals()) / 2,
            "heat": np.array(IFloatGeomParam(params, "heat").getExpandedValue(select).getVals()),
            "spray_class": np.array(IInt32GeomParam(params, "spray_class").getExpandedValue(select).getVals()),
        })

    for number in NUMBERS:
        mesh, archive = Archive(case.path(number, "abc")).sample(0), IArchive(str(case.path(number, "spray.abc")))
        compare(f"dam.{number}.spray.abc", number, mesh, archive, "spray", 0.0)
    path = case.folder / "sequence.abc"
    shot, archive = Archive(path), IArchive(str(path))
    for index, time in enumerate(shot.times()):
        frame = time * FPS
        # The library takes the nearest sample.
        for later in (0, 0.25) if abs(frame - round(frame)) < 1e-6 else (0,):
            label = f"{path.name} at {frame + later:.2f}"
            compare(label, latest(frame + 1e-6), shot.sample(index), archive, "surface_spray", time + later / FPS)


def blender(case):
    import bpy

    from check_blender import numbers_of, positions_of, to_log, transformed

    if case.label == "near":
        to_log(WORK / "blender_spray.log")
    for name in ("shot.usda", "sequence.abc"):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.render.fps = FPS
        read = bpy.ops.wm.alembic_import if name.endswith(".abc") else bpy.ops.wm.usd_import
        read(filepath=str(case.folder / name))
        objects = {obj.type: obj for obj in bpy.data.objects}
        kinds = ("MESH", "POINTCLOUD")
        faults = [f"the {kind} has no cache of a sequence" for kind in kinds
                  if "MESH_SEQUENCE_CACHE" not in [modifier.type for modifier in objects[kind].modifiers]]
        # Blender reads no other attributes of points in Alembic.
        names = ("radius",) if name.endswith(".abc") else ("radius", "heat", "spray_class", "id")
        for frame in range(1, 8):
            bpy.context.scene.frame_set(frame)
            mesh, points = (objects[kind].evaluated_get(bpy.context.evaluated_depsgraph_get()) for kind in kinds)
            # Point clouds without points have no attributes.
            column = lambda name: numbers_of(points.data, name) if len(points.data.points) else np.empty((0, 3))
            case.compare(f"blender, {name} in frame {frame}", latest(frame),
                         transformed(positions_of(mesh.data), mesh.matrix_world),
                         {"position": transformed(column("position"), points.matrix_world),
                          **{name: column(name) for name in names},
                          "velocity": column("velocity") @ np.array(points.matrix_world)[:3, :3].T}, faults, ROUNDING)


if __name__ == "__main__":
    main()
