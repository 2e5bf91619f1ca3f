"""Checks that the Alembic library opens each .abc, and finds the arrays of the .ply of the same frame.

    frame       one sample: positions, faces, normals, velocities, and the program's name
    shot.abc    a sample for each frame, at its time; the frame before a missing frame has two samples

Runs in a separate Python, because the bindings contain their own copies of libraries.
"""

import numpy as np
from alembic3d.Abc import GetArchiveInfo, IArchive, ISampleSelector
from alembic3d.AbcGeom import IPolyMesh, IXform, MeshTopologyVariance

from mesh_files import read_ply, read_vertices
from project import OUT, Check

FPS = 24
# The samples of a shot: the time in frames, and the frame whose mesh it has. Frame 3 is missing, so frame 2 has a
# second sample just before frame 4.
SAMPLES = ((1, 1), (2, 2), (4 - 1 / 64, 2), (4, 4))


def main():
    check = Check("Alembic: the library opens frames and shots")
    for label in ("moving", "moving-quantized"):
        folder = OUT / label
        for path in sorted(folder.glob("moving.*.abc")):
            check.line(f"{label}/{path.name}", *attempted(frame, path))
        check.line(f"{label}/shot.abc", *attempted(shot, folder / "shot.abc"))
    check.end()


def attempted(examine, path):
    try:
        return examine(path)
    except Exception as error:
        return "could not be read", [f"{type(error).__name__}: {error}"]


class Archive:
    """The mesh of an archive, and its transform."""

    def __init__(self, path):
        archive = IArchive(str(path))
        self.program = GetArchiveInfo(archive)["appName"]
        self.transform = IXform(archive.getTop(), "surface")
        self.schema = IPolyMesh(self.transform, "surfaceShape").getSchema()
        self.archive = archive

    def times(self):
        sampling = self.schema.getTimeSampling()
        return [sampling.getSampleTime(index) for index in range(self.schema.getNumSamples())]

    def is_varying(self):
        return self.schema.getTopologyVariance() == MeshTopologyVariance.kHeterogenousTopology

    def sample(self, index):
        """The arrays of a sample: positions and triangles as in the .ply, normals, and velocities."""
        # Select by time: the bindings treat an integer as a time, too.
        selector = ISampleSelector(self.times()[index])
        value = self.schema.getValue(selector)
        counts, corners = np.array(value.getFaceCounts()), np.array(value.getFaceIndices())
        ends = np.cumsum(counts)
        # Faces are clockwise in Alembic.
        faces = [corners[end - count : end][::-1] for count, end in zip(counts, ends)]
        normals = vectors(self.schema.getNormalsParam().getExpandedValue(selector).getVals())
        velocities = value.getVelocities()
        matrix = self.transform.getSchema().getValue(selector).getMatrix()
        matrix = np.array([[matrix[row][column] for column in range(4)] for row in range(4)])
        bounds = value.getSelfBounds()
        return {
            "positions": vectors(value.getPositions()),
            "faces": faces,
            "normals": normals,
            "velocities": vectors(velocities) if velocities else None,
            "matrix": matrix,
            "bounds": np.array([list(bounds.min()), list(bounds.max())]),
        }


def vectors(array):
    return np.array(memoryview(array)).reshape(-1, 3)


# The particles have z up, and Alembic has y up.
TURNED = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def faults_of(sample, ply, is_exact):
    """Compares the arrays with those of a frame's .ply."""
    positions, triangles = read_ply(ply)
    vertices = read_vertices(ply)
    columns = lambda names: np.stack([vertices[name] for name in names.split()], axis=1)
    off = lambda found, expected: abs(found - expected).max() if len(found) == len(expected) else np.inf
    faults = []
    # Shots are made from quantized .glb files, which have rounded positions and normals.
    step, turn = (0, 0) if is_exact else (2e-5 * np.ptp(positions, axis=0).max(), 0.02)
    if off(sample["positions"] + sample["matrix"][3, :3] @ TURNED.T, positions) > step:
        faults.append("its positions are others")
    if off(sample["normals"], columns("nx ny nz")) > turn:
        faults.append("its normals are others")
    if sample["velocities"] is None or off(sample["velocities"], columns("vx vy vz")) > 0:
        faults.append("its velocities are others")
    if (sample["matrix"][:3, :3] != TURNED).any():
        faults.append(f"its axes are {sample['matrix'][:3, :3].tolist()}")
    local = sample["positions"].astype(float)
    if off(sample["bounds"], np.array([local.min(axis=0), local.max(axis=0)])) > step:
        faults.append(f"its bounds are {sample['bounds'].tolist()}")
    fans = [[face[0], *pair] for face in sample["faces"] for pair in zip(face[1:], face[2:])]
    if not same_triangles(sample["faces"], fans, triangles):
        faults.append("its faces are others")
    return faults


def same_triangles(faces, fans, triangles):
    """Whether two meshes have the same triangles: exactly, or for quads the same corners."""
    if all(len(face) == 3 for face in faces):
        return np.array_equal(np.array(faces), triangles)
    return len(fans) == len(triangles) and set(np.concatenate(faces)) == set(triangles.ravel())


def frame(path):
    archive = Archive(path)
    sample = archive.sample(0)
    faults = faults_of(sample, path.with_suffix(".ply"), is_exact=True)
    if archive.times() != [0.0]:
        faults.append(f"its times are {archive.times()}")
    if not archive.program.startswith("meniscus "):
        faults.append(f"it was made by {archive.program}")
    has_quads = any(len(face) == 4 for face in sample["faces"])
    if has_quads != ("quantized" in str(path)):
        faults.append(f"has quads: {has_quads}")
    return f"{len(sample['positions'])} vertices, {len(sample['faces'])} faces", faults


def shot(path):
    archive = Archive(path)
    times = archive.times()
    faults = []
    expected = [time / FPS for time, _ in SAMPLES]
    if len(times) != len(expected) or not np.allclose(times, expected, rtol=0, atol=1e-9):
        faults.append(f"its times are {times}; expected {expected}")
    if not archive.is_varying():
        faults.append("its topology does not vary")
    counts = []
    for index, (time, frame) in enumerate(SAMPLES):
        sample = archive.sample(index)
        counts.append(len(sample["positions"]))
        ply = path.with_name(f"moving.{frame:03}.ply")
        faults += [f"sample at {time}: {fault}" for fault in faults_of(sample, ply, "quantized" not in str(path))]
    return f"{' '.join(map(str, counts))} vertices", faults


if __name__ == "__main__":
    main()
