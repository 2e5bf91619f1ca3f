"""Checks that the Alembic library opens each .abc, and finds the arrays of the .ply of the same frame.

    frame         one sample: positions, faces, normals, velocities, and the program's name
    shot.abc      a sample for each frame, at its time; the frame before a missing frame has two samples
    attributes    colours, floats, integers of 32 and 64 bits, vectors, and strings with `.vals` and `.indices`; frames
                  without particles, and frames without velocities, at other rates

Runs in a separate Python, because the bindings contain their own copies of libraries.
"""

import numpy as np
from alembic3d.Abc import GetArchiveInfo, IArchive, ISampleSelector
from alembic3d.AbcGeom import (
    IC3fGeomParam, IFloatGeomParam, IInt32GeomParam, IInt64GeomParam, IPolyMesh, IStringGeomParam, IV2fGeomParam, IXform,
    MeshTopologyVariance,
)

from mesh_files import read_ply, read_vertices
from project import OUT, Check

FPS = 24
# The samples of a shot: the time in frames, and the frame whose mesh it has. Frame 3 is missing, so frame 2 has a
# second sample just before frame 4.
SAMPLES = ((1, 1), (2, 2), (4 - 1 / 64, 2), (4, 4))
# The sequences with attributes, and their frames per second; see check_convert.py. Frame 2 is empty.
DESCRIBED = {"described": 30, "described-still": 12.5}


def main():
    check = Check("Alembic: the library opens frames and shots")
    for label in ("moving", "moving-quads"):
        folder = OUT / label
        for path in sorted(folder.glob("moving.*.abc")):
            check.line(f"{label}/{path.name}", *attempted(frame, path))
        check.line(f"{label}/shot.abc", *attempted(shot, folder / "shot.abc"))
    for label, fps in DESCRIBED.items():
        for path in sorted((OUT / label).glob(f"{label}.*.abc")):
            check.line(f"{label}/{path.name}", *attempted(described, path))
        check.line(f"{label}/shot.abc", *attempted(lambda path: described_shot(path, fps), OUT / label / "shot.abc"))
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


    def params(self, index):
        """The attributes of a sample by name: their metadata, and a row for each vertex. Strings are resolved."""
        group = self.schema.getArbGeomParams()
        found = {}
        for number in range(group.getNumProperties() if group else 0):
            header = group.getPropertyHeader(number)
            # A compound does not keep its type of values, but the metadata have it.
            metadata = dict(pair.split("=") for pair in header.getMetaData().serialize().split(";"))
            kind, width = PARAMS[metadata["podName"], metadata["podExtent"]]
            param = kind(group, header.getName())
            value = param.getExpandedValue(ISampleSelector(self.times()[index])).getVals()
            rows = [tuple(row) if width > 1 else row for row in value]
            found[header.getName()] = metadata, np.array(rows).reshape(-1, width * param.getArrayExtent())
        return found

    def string_table(self, name):
        """The distinct strings of an attribute, whose values are indices."""
        param = IStringGeomParam(self.schema.getArbGeomParams(), name)
        if not param.isIndexed():
            raise ValueError(f"{name} has no indices")
        return list(param.getIndexedValue(ISampleSelector(self.times()[0])).getVals())


# The class of an attribute, and the numbers in each of its values, by the type and extent in its metadata.
PARAMS = {
    ("float32_t", "1"): (IFloatGeomParam, 1), ("float32_t", "2"): (IV2fGeomParam, 2),
    ("float32_t", "3"): (IC3fGeomParam, 3), ("int32_t", "1"): (IInt32GeomParam, 1),
    ("int64_t", "1"): (IInt64GeomParam, 1), ("string", "1"): (IStringGeomParam, 1),
}


def vectors(array):
    return np.array(memoryview(array)).reshape(-1, 3)


# The particles have z up, and Alembic has y up.
TURNED = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def faults_of(sample, ply):
    """Compares the arrays with those of a frame's .ply."""
    positions, triangles = read_ply(ply)
    vertices = read_vertices(ply)
    columns = lambda names: np.stack([vertices[name] for name in names.split()], axis=1)
    off = lambda found, expected: abs(found - expected).max(initial=0) if len(found) == len(expected) else np.inf
    faults = []
    if off(sample["positions"] + sample["matrix"][3, :3] @ TURNED.T, positions) > 0:
        faults.append("its positions are others")
    if off(sample["normals"], columns("nx ny nz")) > 0:
        faults.append("its normals are others")
    if "vx" not in vertices.dtype.names or not len(positions):
        if sample["velocities"] is not None:
            faults.append("it has velocities, and its particles or its mesh have none")
    elif sample["velocities"] is None or off(sample["velocities"], columns("vx vy vz")) > 0:
        faults.append("its velocities are others")
    if (sample["matrix"][:3, :3] != TURNED).any():
        faults.append(f"its axes are {sample['matrix'][:3, :3].tolist()}")
    local = sample["positions"].astype(float)
    if len(local) and off(sample["bounds"], np.array([local.min(axis=0), local.max(axis=0)])) > 0:
        faults.append(f"its bounds are {sample['bounds'].tolist()}")
    fans = [[face[0], *pair] for face in sample["faces"] for pair in zip(face[1:], face[2:])]
    if not same_triangles(sample["faces"], fans, triangles):
        faults.append("its faces are others")
    return faults


def same_triangles(faces, fans, triangles):
    """Whether two meshes have the same triangles: exactly, or for quads the same corners."""
    if all(len(face) == 3 for face in faces):
        return np.array_equal(np.reshape(faces, (-1, 3)), triangles)
    return len(fans) == len(triangles) and set(np.concatenate(faces)) == set(triangles.ravel())


def frame(path):
    archive = Archive(path)
    sample = archive.sample(0)
    faults = faults_of(sample, path.with_suffix(".ply"))
    if archive.times() != [0.0]:
        faults.append(f"its times are {archive.times()}")
    if not archive.program.startswith("meniscus "):
        faults.append(f"it was made by {archive.program}")
    has_quads = any(len(face) == 4 for face in sample["faces"])
    if has_quads != ("quads" in str(path)):
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
        faults += [f"sample at {time}: {fault}" for fault in faults_of(sample, ply)]
    return f"{' '.join(map(str, counts))} vertices", faults


# The attributes of the frames of check_convert.py: the type, the interpretation, and the columns of the .ply. A .ply has
# colours as bytes, and indices of strings.
ATTRIBUTES = {
    "color": ("float32_t", "rgb", "red green blue"),
    "density": ("float32_t", None, "density"),
    "id": ("int32_t", None, "id"),
    "big": ("int64_t", None, "big"),
    "kind": ("string", None, "kind"),
    "uvw": ("int32_t", None, "uvw_x uvw_y"),
}
STRINGS = np.array(["water", "oil", ""])
# In a shot, integers are floats, those beyond 2²⁴ are missing, and so are strings.
SHOT_TYPES = {"color": "float32_t", "density": "float32_t", "id": "float32_t", "uvw": "float32_t"}


def of_attribute(name, metadata, found, vertices, in_shot):
    """Compares the values of an attribute with those of a frame's .ply."""
    kind, interpretation, columns = ATTRIBUTES[name]
    kind = SHOT_TYPES[name] if in_shot else kind
    faults = []
    if metadata["podName"] != kind or metadata["geoScope"] != "vtx":
        faults.append(f"{name} is {metadata}")
    # In a shot, two or three floats are a vector.
    if metadata.get("interpretation") != ("vector" if in_shot and name == "uvw" else interpretation):
        faults.append(f"{name} is interpreted as {metadata.get('interpretation')}")
    columns = columns.split()
    expected = np.stack([vertices[column] for column in columns], axis=1)
    if not len(expected):
        return faults + ([f"{name} has {len(found)} values without vertices"] if found.size else [])
    if found.shape != expected.shape:
        return faults + [f"{name} has the shape {found.shape}, and its .ply {expected.shape}"]
    if kind == "string":
        is_same = (found == STRINGS[expected]).all()
    elif name == "big":
        # The bindings return the lower 32 bits of integers.
        is_same = (found.astype(np.int64) & 0xFFFFFFFF == expected.astype(np.int64) & 0xFFFFFFFF).all()
    elif name == "color":
        is_same = abs(found - expected / 255).max() <= 0.5 / 255 + 1e-6
    else:
        is_same = (found == expected).all()
    return faults if is_same else [*faults, f"the values of {name} are others"]


def of_attributes(archive, index, vertices, in_shot):
    params = archive.params(index)
    # Colours have another name in a shot.
    is_color = lambda metadata: metadata.get("interpretation") == "rgb"
    params = {"color" if is_color(about) else name: (about, values) for name, (about, values) in params.items()}
    wanted = SHOT_TYPES if in_shot else ATTRIBUTES
    if params.keys() != wanted.keys():
        return [f"its attributes are {sorted(params)}; expected {sorted(wanted)}"]
    return [fault for name, param in params.items() for fault in of_attribute(name, *param, vertices, in_shot)]


def described(path):
    """A frame with attributes. Those of frame 2 have no values, and thus no type in its .csv."""
    archive = Archive(path)
    sample, vertices = archive.sample(0), read_vertices(path.with_suffix(".ply"))
    faults = faults_of(sample, path.with_suffix(".ply"))
    if len(vertices):
        faults += of_attributes(archive, 0, vertices, in_shot=False)
        if archive.string_table("kind") != list(STRINGS):
            faults.append(f"its strings are {archive.string_table('kind')}")
    elif any(values.size for _, values in archive.params(0).values()):
        faults.append("it is empty, and has values")
    return f"{len(vertices)} vertices, {len(archive.params(0))} attributes", faults


def described_shot(path, fps):
    archive = Archive(path)
    faults = []
    expected = [frame / fps for frame in (1, 2, 3)]
    if not np.allclose(archive.times(), expected, rtol=0, atol=1e-12):
        faults.append(f"its times are {archive.times()}; expected {expected}")
    counts = []
    for index in range(3):
        ply = path.with_name(f"{path.parent.name}.{index + 1:03}.ply")
        sample, vertices = archive.sample(index), read_vertices(ply)
        counts.append(len(vertices))
        found = faults_of(sample, ply) + of_attributes(archive, index, vertices, in_shot=True)
        faults += [f"frame {index + 1}: {fault}" for fault in found]
    if counts[1] != 0 or not counts[0] or not counts[2]:
        faults.append(f"its frames have {counts} vertices; the second one should be empty")
    return f"{' '.join(map(str, counts))} vertices at {fps} frames per second", faults


if __name__ == "__main__":
    main()
