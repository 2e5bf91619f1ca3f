"""Checks that meniscus reads ParaView's lists of files, as VTK, pyevtk and meshio write them.

    .pvtp .pvtu   three pieces of one frame
    .vtm .vtpd    blocks and partitions, one of them without particles
    .pvd          three times, each of a .vtu, by pyevtk and by meshio; and each of a .pvtp, as solvers write it
    .vtp.series   three times, by VTK
    .vtk.series   three times, by meshio

Every frame is written as PLY by `meniscus convert --particles-only`. Positions, velocities and ids must be equal to the
last bit, in the order of the pieces, and the times must be those that were written.
"""

import json
import shutil

import meshio
import numpy as np
import vtk
from pyevtk.hl import pointsToVTK
from pyevtk.vtk import VtkGroup
from vtk.util.numpy_support import numpy_to_vtk
from vtk.util.vtkAlgorithm import VTKPythonAlgorithmBase

from mesh_files import read_vertices
from project import WORK, Check, convert, same_times

FOLDER = WORK / "paraview"
COUNT = 1000
TIMES = [0.0, 0.04, 0.08]
random = np.random.default_rng(50)


def main():
    versions = f"VTK {vtk.vtkVersion.GetVTKVersion()}, pyevtk and meshio {meshio.__version__}"
    check = Check(f"paraview: lists of files by {versions}")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    for name, write in (("a.pvtp", parallel), ("a.pvtu", parallel), ("b.vtm", blocks), ("b.vtpd", blocks)):
        particles = some_particles()
        write(FOLDER / name, particles)
        check.line(name, *compared(FOLDER / name, {FOLDER / name: particles}, [None]))
    for name, write in (
        ("c.pvd", collection_of_pyevtk),
        ("d.pvd", lambda path, steps: collection(path, steps, "pvtp", parallel)),
        ("e.vtp.series", lambda path, steps: series(path, steps, by_vtk)),
        ("f.vtk.series", lambda path, steps: series(path, steps, by_meshio)),
        ("g.pvd", lambda path, steps: collection(path, steps, "vtu", by_meshio)),
    ):
        steps = [some_particles() for _ in TIMES]
        write(FOLDER / name, steps)
        expected = {FOLDER / name / f"step={index}": particles for index, particles in enumerate(steps)}
        check.line(name, *compared(FOLDER / name, expected, TIMES))
    (FOLDER / "d" / "d_1_1.vtp").unlink()
    check.line("d.pvd without a piece", *without_a_piece(FOLDER / "d.pvd"))
    check.end()


def some_particles():
    return {
        "position": random.normal(size=(COUNT, 3)).astype(np.float32),
        "v": random.normal(size=(COUNT, 3)).astype(np.float32),
        "id": random.permutation(COUNT).astype(np.int32),
    }


def poly_data(particles):
    points, verts, data = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
    points.SetData(numpy_to_vtk(particles["position"], deep=True))
    for index in range(len(particles["position"])):
        verts.InsertNextCell(1, [index])
    data.SetPoints(points)
    data.SetVerts(verts)
    for name in ("v", "id"):
        array = numpy_to_vtk(particles[name], deep=True)
        array.SetName(name)
        data.GetPointData().AddArray(array)
    return data


def unstructured(particles):
    append = vtk.vtkAppendFilter()
    append.AddInputData(poly_data(particles))
    append.Update()
    return append.GetOutput()


def parts(particles, count):
    """The particles in this many parts, in order."""
    return [{name: part[index] for name, part in split(particles, count).items()} for index in range(count)]


def split(particles, count):
    return {name: np.array_split(values, count) for name, values in particles.items()}


def write_one(writer, path, data):
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    if not writer.Write():
        raise OSError(f"{path} was not written")


def parallel(path, particles):
    """The pieces, and the list of them: of VTK's writer, which asks a source for one piece after another."""
    is_poly = path.suffix == ".pvtp"
    datasets = [(poly_data if is_poly else unstructured)(part) for part in parts(particles, 3)]
    source = Pieces(datasets, "vtkPolyData" if is_poly else "vtkUnstructuredGrid")
    writer = vtk.vtkXMLPPolyDataWriter() if is_poly else vtk.vtkXMLPUnstructuredGridWriter()
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetNumberOfPieces(3)
    writer.SetStartPiece(0)
    writer.SetEndPiece(2)
    writer.SetFileName(str(path))
    if not writer.Write():
        raise OSError(f"{path} was not written")


class Pieces(VTKPythonAlgorithmBase):
    """A source of one data set for each piece."""

    def __init__(self, datasets, kind):
        super().__init__(nInputPorts=0, nOutputPorts=1, outputType=kind)
        self.datasets = datasets

    def RequestInformation(self, request, inputs, outputs):
        outputs.GetInformationObject(0).Set(vtk.vtkAlgorithm.CAN_HANDLE_PIECE_REQUEST(), 1)
        return 1

    def RequestData(self, request, inputs, outputs):
        information = outputs.GetInformationObject(0)
        piece = information.Get(vtk.vtkStreamingDemandDrivenPipeline.UPDATE_PIECE_NUMBER())
        vtk.vtkDataSet.GetData(information).ShallowCopy(self.datasets[piece])
        return 1


def blocks(path, particles):
    datasets = [poly_data(part) for part in parts(particles, 2)]
    if path.suffix == ".vtm":
        blocks, writer = vtk.vtkMultiBlockDataSet(), vtk.vtkXMLMultiBlockDataWriter()
        nested = vtk.vtkMultiBlockDataSet()
        nested.SetBlock(0, datasets[1])
        for index, block in enumerate((datasets[0], vtk.vtkPolyData(), nested)):
            blocks.SetBlock(index, block)
    else:
        blocks, writer = vtk.vtkPartitionedDataSet(), vtk.vtkXMLPartitionedDataSetWriter()
        for index, block in enumerate((datasets[0], vtk.vtkPolyData(), datasets[1])):
            blocks.SetPartition(index, block)
    write_one(writer, path, blocks)


def collection_of_pyevtk(path, steps):
    group = VtkGroup(str(path.with_suffix("")))
    for index, particles in enumerate(steps):
        x, y, z = (np.ascontiguousarray(column) for column in particles["position"].T)
        v = tuple(np.ascontiguousarray(column) for column in particles["v"].T)
        written = pointsToVTK(str(path.with_name(f"c_{index}")), x, y, z, data={"v": v, "id": particles["id"]})
        group.addFile(filepath=written, sim_time=TIMES[index])
    group.save()


def by_vtk(path, particles):
    write_one(vtk.vtkXMLPolyDataWriter(), path, poly_data(particles))


def by_meshio(path, particles):
    data = {name: particles[name] for name in ("v", "id")}
    meshio.Mesh(particles["position"], [("vertex", np.arange(COUNT)[:, None])], point_data=data).write(path)


def collection(path, steps, ending, write):
    folder = path.with_suffix("")
    folder.mkdir()
    for index, particles in enumerate(steps):
        write(folder / f"{folder.name}_{index}.{ending}", particles)
    entries = [
        f'<DataSet timestep="{time}" group="" part="0" file="{folder.name}/{folder.name}_{index}.{ending}"/>'
        for index, time in enumerate(TIMES)
    ]
    text = f'<VTKFile type="Collection" version="0.1"><Collection>{"".join(entries)}</Collection></VTKFile>\n'
    path.write_text(text)


def series(path, steps, write):
    stem, ending, _ = path.name.split(".")
    files = []
    for index, particles in enumerate(steps):
        name = f"{stem}_{index}.{ending}"
        write(path.with_name(name), particles)
        files.append({"name": name, "time": TIMES[index]})
    path.write_text(json.dumps({"file-series-version": "1.0", "files": files}))


def compared(path, expected, times):
    """The figures of a list, and what differs from the expected particles of its frames."""
    out = FOLDER / "out" / path.name
    status, said, _ = convert([path], out, "--particles-only", "--format", "ply")
    if status:
        return f"exit status {status}", [said.strip()]
    faults = []
    stem = path.name.split(".")[0]
    for frame, particles in expected.items():
        step = frame.name.partition("step=")[2]
        found = read_vertices(out / (f"{stem}.{step}.ply" if step else f"{stem}.ply"))
        columns = {"position": ["x", "y", "z"], "v": ["v_x", "v_y", "v_z"], "id": ["id"]}
        for name, names in columns.items():
            read = np.stack([found[column] for column in names], axis=1)
            if not np.array_equal(read, particles[name].reshape(len(read), -1)):
                faults.append(f"{name} of {frame.name} differs")
    return f"{len(expected)} frames, {COUNT} particles each", faults + same_times(path, times)


def without_a_piece(path):
    status, said, _ = convert([path], FOLDER / "out" / "gone", "--particles-only", "--format", "ply", "--on-error", "continue")
    faults = [] if status == 1 and "d/d_1_1.vtp" in said else [f"exit status {status}: {said.strip()}"]
    return "the error names it", faults


if __name__ == "__main__":
    main()
