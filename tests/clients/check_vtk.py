"""Checks that VTK, ParaView's library, reads the .vtp and .stl files of a sequence, and that OpenUSD reads
its .usda and .usdc files.

    .vtp          the number of points and polygons, the points of the .ply to the last bit, outward normals,
                  the attributes, the generator of the file; quads if requested
    .stl          the number of triangles, the bounds and the volume of the .ply
    .usda         the same points; up axis, unit, extent, normals and velocities in USD's own properties
    .usdc         every value is that of the .usda; the file is at most a tenth larger than the one by OpenUSD
"""

import numpy as np
import vtk
from pxr import Sdf, Usd, UsdGeom, UsdValidation
from vtk.util.numpy_support import vtk_to_numpy

from mesh_files import read_ply
from project import OUT, Check, frame_of


def main():
    check = Check(f"vtk: VTK {vtk.vtkVersion.GetVTKVersion()} and OpenUSD {'.'.join(map(str, Usd.GetVersion()))} read")
    for label in ("moving", "moving-quads"):
        for ply in sorted((OUT / label).glob("moving.*.ply")):
            frame, (points, triangles) = frame_of(ply), read_ply(ply)
            for examine, suffix in ((vtp, ".vtp"), (stl, ".stl"), (usda, ".usda"), (usdc, ".usdc")):
                path = ply.with_suffix(suffix)
                check.line(f"{label}/{path.name}", *attempted(examine, path, frame, points, triangles))
    check.end()


def attempted(examine, *arguments):
    try:
        return examine(*arguments)
    except Exception as error:
        return "could not be read", [f"{type(error).__name__}: {error}"]


def vtp(path, frame, points, triangles):
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    mesh, faults = reader.GetOutput(), []
    if not np.array_equal(vtk_to_numpy(mesh.GetPoints().GetData()), points):
        faults.append("its points are not those of the .ply")
    data, fields = mesh.GetPointData(), mesh.GetFieldData()
    corners = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray())
    quads = 3 * len(triangles) - len(corners)
    polys = mesh.GetNumberOfPolys()
    if polys != len(triangles) - quads // 2 or ("quads" in str(path)) != (quads > 0):
        faults.append(f"{polys} polygons, {quads // 2} of them quads, of {len(triangles)} triangles")
    normals = vtk_to_numpy(data.GetNormals())
    if abs(np.linalg.norm(normals, axis=1) - 1).max() > 1e-5:
        faults.append("its normals are not unit vectors")
    velocity = vtk_to_numpy(data.GetArray("velocity" if data.HasArray("velocity") else "v"))
    if velocity.shape != points.shape or abs(velocity[:, 1] - 2).max() > 1e-6:
        faults.append("its velocities are not those of the particles")
    filled = vtk.vtkTriangleFilter()
    filled.SetInputData(mesh)
    faults += volume_faults(filled, frame)
    made_by = fields.GetAbstractArray("meniscus_input")
    if not made_by or made_by.GetValue(0) != f"{path.stem}.csv":
        faults.append("it does not say what it was made from")
    return f"{mesh.GetNumberOfPoints()} points, {polys} polygons, {quads // 2} of them quads", faults


def stl(path, frame, points, triangles):
    reader = vtk.vtkSTLReader()
    reader.SetFileName(str(path))
    reader.Update()
    mesh, faults = reader.GetOutput(), []
    if mesh.GetNumberOfPolys() != len(triangles) or mesh.GetNumberOfPoints() != len(points):
        faults.append(f"{mesh.GetNumberOfPolys()} triangles, {mesh.GetNumberOfPoints()} distinct points")
    found = vtk_to_numpy(mesh.GetPoints().GetData())
    if not (np.array_equal(found.min(axis=0), points.min(axis=0)) and np.array_equal(found.max(axis=0), points.max(axis=0))):
        faults.append("its bounds are not those of the .ply")
    edges = vtk.vtkFeatureEdges()
    edges.SetInputData(mesh)
    edges.FeatureEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    if edges.GetOutput().GetNumberOfCells():
        faults.append(f"{edges.GetOutput().GetNumberOfCells()} edges that are open")
    filled = vtk.vtkTriangleFilter()
    filled.SetInputData(mesh)
    return f"{len(triangles)} triangles, closed", faults + volume_faults(filled, frame)


def volume_faults(triangles, frame):
    measured = vtk.vtkMassProperties()
    measured.SetInputConnection(triangles.GetOutputPort())
    volume = measured.GetVolume()
    return [] if abs(volume / frame["volume"] - 1) < 1e-3 else [f"its volume is {volume}, {frame['volume']} was reported"]


def usda(path, frame, points, triangles):
    stage = Usd.Stage.Open(str(path))
    mesh = mesh_under_root(stage)
    faults = mesh_faults(mesh, Usd.TimeCode.Default(), points, triangles)
    if (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) != ("Z", 1):
        faults.append("its axis or its unit is another")
    made_by = stage.GetRootLayer().customLayerData["meniscus"]
    if made_by["input"] != f"{path.stem}.csv":
        faults.append(f"it says that it was made from {made_by['input']}")
    return f"{len(points)} points, {len(mesh.GetFaceVertexCountsAttr().Get())} faces", faults


def usdc(path, frame, points, triangles):
    said, faults = usda(path, frame, points, triangles)
    return said, faults + layer_faults(path)


def layer_faults(path):
    """Faults of a .usdc: differences from the .usda, messages of OpenUSD's validators, and a size that is too
    large."""
    layer, text = Sdf.Layer.FindOrOpen(str(path)), Sdf.Layer.FindOrOpen(str(path.with_suffix(".usda")))
    found, expected = values_of(layer), values_of(text)
    faults = sample_faults(found)
    # What only stages need: samples, and a translation even if it is zero.
    is_extra = lambda name: name.endswith(SAMPLE) or "xformOp:translate" in name and name not in expected
    found = {name: value for name, value in found.items() if not is_extra(name)}
    faults += [f"{name} is not that of the .usda" for name in sorted(found.keys() | expected.keys())
              if name not in found or name not in expected or not is_same(found[name], expected[name])]
    # The validators of the command `usdchecker`, which the Python package does not contain.
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(layer))
    faults += [error.GetErrorAsString() for error in errors]
    exported = path.with_name(f"exported.{path.name}")
    layer.Export(str(exported))
    size, usual = path.stat().st_size, exported.stat().st_size
    exported.unlink()
    # The constant allows for small files, which consist mostly of names and contain the provenance twice.
    return faults if size < 1.1 * usual + 4096 else [*faults, f"it has {size} bytes, and OpenUSD writes {usual}"]


# The time code of the only sample.
SAMPLE = " at 0.0"


def sample_faults(values):
    """Samples of the file of a frame that are not its defaults, which are for programs that know no times."""
    samples = {name.removesuffix(SAMPLE): value for name, value in values.items() if name.endswith(SAMPLE)}
    return [f"the sample of {name} is not its default" for name, value in samples.items()
            if not is_same(value, values[f"{name} default"])] or ([] if samples else ["it has no samples"])


def values_of(layer):
    """Every field of a layer and every time sample, by path and name."""
    found = {}

    def add(path):
        spec = layer.GetObjectAtPath(path)
        for key in spec.ListInfoKeys():
            if key not in ("default", "timeSamples"):
                found[f"{path} {key}"] = spec.GetInfo(key)
        if isinstance(spec, Sdf.AttributeSpec):
            found[f"{path} default"] = spec.default
            for time in layer.ListTimeSamplesForPath(path):
                found[f"{path} at {time}"] = layer.QueryTimeSample(path, time)

    layer.Traverse("/", add)
    # The provenance contains the format of the file: ignore it.
    found["/ customLayerData"] = found["/ customLayerData"]["meniscus_mesh"]
    return found


def is_same(one, other):
    return type(one) is type(other) and np.array_equal(np.array(one), np.array(other))


def mesh_under_root(stage):
    """The mesh below the root prim, an Xform, so that a stage that references the layer gets both."""
    root = stage.GetDefaultPrim()
    if not UsdGeom.Xform(root):
        raise ValueError("its default prim is not an Xform")
    return UsdGeom.Mesh(root.GetChild("surface"))


def mesh_faults(mesh, time, points, triangles):
    faults = []
    found = np.array(mesh.GetPointsAttr().Get(time))
    if found.shape != points.shape or (found != points).any():
        faults.append("its points are not those of the .ply")
    ok, why = UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(time), mesh.GetFaceVertexCountsAttr().Get(time), len(found)
    )
    if not ok:
        faults.append(why)
    if len(mesh.GetFaceVertexIndicesAttr().Get(time)) > 3 * len(triangles):
        faults.append("it has other faces than the .ply")
    if mesh.GetSubdivisionSchemeAttr().Get() != "none" or mesh.GetNormalsInterpolation() != "vertex":
        faults.append("it would be subdivided, or its normals are of something else")
    normals, velocities = mesh.GetNormalsAttr().Get(time), np.array(mesh.GetVelocitiesAttr().Get(time))
    if len(normals) != len(points) or velocities.shape != points.shape or abs(velocities[:, 1] - 2).max() > 1e-6:
        faults.append("its normals or velocities are not those of its points")
    extent = np.array(mesh.GetExtentAttr().Get(time))
    if abs(extent - [found.min(axis=0), found.max(axis=0)]).max() > 1e-6:
        faults.append(f"its extent is {extent.tolist()}")
    return faults


if __name__ == "__main__":
    main()
