"""Checks that meniscus reads Points of archives that the Alembic library writes.

    uniform.abc   four samples, all attributes, under two animated transforms with all kinds of operations
    acyclic.abc   five samples, some of them equal, at other times than those of a missing frame; a transform that does
                  not inherit; several Points, one of them hidden
    cyclic.abc    two samples per frame, ids only

The expected positions, velocities and other attributes are those that the library computes, and so are the times.
Runs in a separate Python, because the bindings contain their own copies of libraries.
"""

import random
import shutil

import imath
import numpy as np
from alembic3d.Abc import IArchive, ISampleSelector, OArchive, WrapExistingFlag
from alembic3d.AbcCoreAbstract import AcyclicFlag, TimeSampling, TimeSamplingType, TimeVector
from alembic3d.AbcGeom import (
    CreateVisibilityProperty, GeometryScope, GetVisibility, IFloatGeomParam, IInt32GeomParam, IPoints, IXform,
    OFloatGeomParam, OFloatGeomParamSample, OInt32GeomParam, OInt32GeomParamSample, OPoints, OPointsSchemaSample, OXform,
    XformSample,
)

from mesh_files import read_vertices
from project import WORK, Check, convert, same_times

FOLDER = WORK / "alembic-points"
VARYING = GeometryScope.kVaryingScope


def main():
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    check = Check("Alembic: meniscus reads the Points of the library")
    for name, write in (("uniform", uniform), ("acyclic", acyclic), ("cyclic", cyclic)):
        path = FOLDER / f"{name}.abc"
        times = write(path)
        check.line(path.name, *compared(path, times))
    check.end()


def compared(path, times):
    """Compares each frame that meniscus writes with what the library reads. `times` has the time of each number."""
    out = FOLDER / path.stem
    status, said, _ = convert([path], out, "--particles-only", "--format", "ply")
    if status:
        return "could not be converted", [said.strip()]
    outputs = {int(output.stem.split(".")[-1]): output for output in out.glob("*.ply")}
    faults = [] if outputs.keys() == times.keys() else [f"the frames are {sorted(outputs)} and not {sorted(times)}"]
    worst = 0.0
    for number in outputs.keys() & times.keys():
        found, expected = read_vertices(outputs[number]), library(path, times[number])
        for name, values in expected.items():
            if name not in found.dtype.names:
                faults.append(f"frame {number} has no {name}")
            elif len(found) != len(values):
                faults.append(f"frame {number} has {len(found)} particles and not {len(values)}")
            else:
                worst = max(worst, abs(found[name] - values).max())
    if worst > 1e-5:
        faults.append(f"values differ by {worst:.1e}")
    faults += same_times(path, list(times.values()))
    return f"{len(outputs)} frames, {len(expected)} columns, values differ by {worst:.1e}", faults


def library(path, time):
    """The particles of an archive at a time, as columns."""
    parts, select = [], ISampleSelector(time)

    def visit(node, matrix):
        if IXform.matches(node.getMetaData()):
            sample = IXform(node, WrapExistingFlag.kWrapExisting).getSchema().getValue(select)
            local = sample.getMatrix()
            local = np.array([[local[row][column] for column in range(4)] for row in range(4)])
            matrix = local @ matrix if sample.getInheritsXforms() else local
        if IPoints.matches(node.getMetaData()) and int(GetVisibility(node, select)) != 0:
            schema = IPoints(node, WrapExistingFlag.kWrapExisting).getSchema()
            value, columns = schema.getValue(select), {}
            points = np.array([[p.x, p.y, p.z, 1] for p in value.getPositions()]) @ matrix
            columns.update(zip("xyz", points.T))
            columns["id"] = np.array(value.getIds())
            if value.getVelocities():
                velocities = np.array([[v.x, v.y, v.z] for v in value.getVelocities()]) @ matrix[:3, :3]
                columns.update(zip(("velocity_x", "velocity_y", "velocity_z"), velocities.T))
                params = schema.getArbGeomParams()
                # Widths are lengths, so a transform scales them.
                scale = abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3)
                columns["width"] = scale * expanded(schema.getWidthsParam(), select)
                columns["heat"] = expanded(IFloatGeomParam(params, "heat"), select)
                columns["phase"] = expanded(IInt32GeomParam(params, "phase"), select)
            parts.append(columns)
        for index in range(node.getNumChildren()):
            visit(node.getChild(index), matrix)

    archive = IArchive(str(path))
    visit(archive.getTop(), np.eye(4))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def expanded(param, select):
    """The values of a parameter, with its indices resolved."""
    return np.array(param.getExpandedValue(select).getVals(), dtype=float)


def uniform(path):
    archive = OArchive(str(path), True)
    sampling = archive.addTimeSampling(TimeSampling(1 / 24, 10 / 24))
    outer = transform(archive.getTop(), "outer", sampling, lambda sample, frame: (
        sample.setTranslation(imath.V3d(frame, 1, 0)), sample.setRotation(imath.V3d(1, 1, 0), 30 * frame),
        sample.setScale(imath.V3d(2, 2, 2))), 4)
    inner = transform(outer, "inner", sampling, lambda sample, frame: (
        sample.setXRotation(10.0), sample.setYRotation(20.0), sample.setZRotation(30.0),
        sample.setMatrix(imath.M44d(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1))), 1)
    write_points(inner, "fluid", sampling, [cloud(frame, 5) for frame in range(4)])
    return {10 + frame: (10 + frame) / 24 for frame in range(4)}


def acyclic(path):
    archive = OArchive(str(path), True)
    frames, times = (1, 2, 5, 6, 7), TimeVector()
    for frame in frames:
        times.append(frame / 30)
    sampling = archive.addTimeSampling(TimeSampling(TimeSamplingType(AcyclicFlag.kAcyclic), times))
    outer = transform(archive.getTop(), "outer", sampling, lambda s, _: s.setTranslation(imath.V3d(9, 9, 9)), 1)
    root = transform(outer, "root", sampling, lambda sample, _: (
        sample.setInheritsXforms(False), sample.setScale(imath.V3d(1, 2, 3))), 1)
    one, other = cloud(20, 3), cloud(21, 4)
    write_points(root, "one", sampling, [one, one, other, one, one])
    write_points(archive.getTop(), "other", sampling, [other] * 5)
    hidden = write_points(archive.getTop(), "hidden", sampling, [other])
    CreateVisibilityProperty(hidden, sampling).setValue(0)
    return {frame: frame / 30 for frame in frames}


def cyclic(path):
    archive = OArchive(str(path), True)
    times = TimeVector()
    times.append(0.0)
    times.append(0.25 / 24)
    sampling = archive.addTimeSampling(TimeSampling(TimeSamplingType(2, 1 / 24), times))
    schema = OPoints(archive.getTop(), "fluid", sampling).getSchema()
    for frame in range(6):
        points, ids = cloud(frame, 2)
        schema.set(OPointsSchemaSample(vectors(points), array(imath.IntArray, ids)))
    # The shortest step is a quarter of a frame at 24 frames per second.
    return {4 * (index // 2) + index % 2: (index // 2) / 24 + index % 2 * 0.25 / 24 for index in range(6)}


def transform(parent, name, sampling, fill, count):
    made = OXform(parent, name, sampling)
    for frame in range(count):
        sample = XformSample()
        fill(sample, frame)
        made.getSchema().set(sample)
    return made


def cloud(seed, count):
    """Random points, and their ids."""
    chance = random.Random(seed)
    points = [[round(chance.uniform(-2, 2), 3) for _ in range(3)] for _ in range(count)]
    return points, [10 * seed + index for index in range(count)]


def write_points(parent, name, sampling, clouds):
    made = OPoints(parent, name, sampling)
    schema = made.getSchema()
    params = schema.getArbGeomParams()
    heat = OFloatGeomParam(params, "heat", False, VARYING, 1, sampling)
    phase = OInt32GeomParam(params, "phase", True, VARYING, 1, sampling)
    for points, ids in clouds:
        count = len(points)
        widths = OFloatGeomParamSample(array(imath.FloatArray, [0.5 + index / 8 for index in range(count)]), VARYING)
        velocities = vectors([[x, y, 1] for x, y, _ in points])
        schema.set(OPointsSchemaSample(vectors(points), array(imath.IntArray, ids), velocities, widths))
        heat.set(OFloatGeomParamSample(array(imath.FloatArray, [index / 4 for index in range(count)]), VARYING))
        indices = array(imath.UnsignedIntArray, [index % 2 for index in range(count)])
        phase.set(OInt32GeomParamSample(array(imath.IntArray, [7, 6]), indices, VARYING))
    return made


def vectors(points):
    return array(imath.V3fArray, [imath.V3f(*map(float, point)) for point in points])


def array(kind, values):
    made = kind(len(values))
    for index, value in enumerate(values):
        made[index] = value
    return made


if __name__ == "__main__":
    main()
