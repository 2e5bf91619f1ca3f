"""Checks that meniscus reads the particles of HDF5 and XDMF files by the library HDF5, in the layouts of several programs.

    gadget, swift   PartType0; old and new groups, chunks that grow, gzip, shuffle and checksums
    h5part          a group for each step: each is a frame
    openpmd         an iteration for each frame, with constants
    pysph           arrays in groups by their names; check_solvers.py reads files by PySPH itself
    xdmf            indices of the frames in an HDF5 file, some of them by meshio

Positions, velocities, ids and times must be equal.
"""

import os

import h5py
import meshio
import numpy as np

from mesh_files import PLY_TYPES
from project import WORK, Check, convert, same_times

FOLDER = WORK / "hdf5"
COUNT = 5000


def main():
    check = Check(f"hdf5: meniscus reads files by HDF5 {h5py.version.hdf5_version}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for write in (gadget, swift, h5part, openpmd, pysph, xdmf, *map(xdmf_of_meshio, ("HDF", "Binary"))):
        path, frames, times = write()
        label, figures, faults = compared(path, frames)
        check.line(label, figures, faults + same_times(path, times))
    check.end()


def particles(step):
    """Positions, velocities and ids of a step."""
    random = np.random.default_rng(step)
    return random.random((COUNT, 3)), random.random((COUNT, 3)).astype("f4"), random.permutation(COUNT).astype("i4")


def compared(path, steps):
    """The label, figures and faults of a file with these steps: the particles that meniscus writes are those of the file."""
    out = FOLDER / path.stem
    for old in out.glob("*.ply"):
        old.unlink()
    status, text, _ = convert([path], out, "--particles-only")
    # Frames are numbered by step.
    found = sorted(out.glob("*.ply"), key=lambda ply: [int(word) for word in ply.stem.split(".") if word.isdigit()])
    faults = [] if status == 0 else [text.strip()]
    if len(found) != len(steps):
        faults.append(f"{len(found)} frames of {len(steps)}")
    for ply, step in zip(found, steps):
        positions, velocities, ids = particles(step)
        rows = read_rows(ply)
        columns = [name for name in rows.dtype.names if name not in "xyz"]
        faults += [f"{ply.name}: other positions" for axis, name in enumerate("xyz")
                   if not np.array_equal(rows[name], positions[:, axis].astype(rows[name].dtype))]
        for values, what in ((velocities.T, "velocities"), (ids[None], "ids")):
            for column in values:
                if not any(np.array_equal(rows[name], column) for name in columns):
                    faults.append(f"{ply.name}: other {what}")
    return path.name, f"{len(found)} frames", faults


def read_rows(path):
    """The properties of the particles of a binary little-endian PLY, by name."""
    data = path.read_bytes()
    head, rows = data.split(b"end_header\n", 1)
    words = [line.split() for line in head.decode().splitlines()]
    return np.frombuffer(rows, [(name, PLY_TYPES[kind]) for word, *rest in words if word == "property" for kind, name in [rest]])


def gadget():
    path = FOLDER / "gadget.hdf5"
    with h5py.File(path, "w") as file:
        for kind in (0, 1):
            group = file.create_group(f"PartType{kind}")
            group["Coordinates"], group["Velocities"], group["ParticleIDs"] = particles(kind)
        file.create_group("Header").attrs["Time"] = 0.5
    return path, [0], [0.5]


def swift():
    path = FOLDER / "swift.hdf5"
    with h5py.File(path, "w", libver="latest") as file:
        group = file.create_group("PartType0")
        options = {"compression": "gzip", "shuffle": True, "fletcher32": True}
        for name, values in zip(("Coordinates", "Velocities", "ParticleIDs"), particles(2)):
            chunks, largest = (512, *values.shape[1:]), (None, *values.shape[1:])
            group.create_dataset(name, data=values, chunks=chunks, maxshape=largest, **options)
        for index in range(20):
            group.create_dataset(f"Extra{index}", data=np.zeros(COUNT, ">i2"), chunks=(100,))
        file["GasParticles"] = h5py.SoftLink("/PartType0")
    return path, [2], [None]


def h5part():
    path, steps = FOLDER / "steps.h5part", [0, 5, 10]
    with h5py.File(path, "w") as file:
        for step in steps:
            group = file.create_group(f"Step#{step}")
            group.attrs["TimeValue"] = step / 10
            position, velocity, group["id"] = particles(step)
            for axis, x, v in zip("xyz", position.T, velocity.T):
                group[axis], group["v" + axis] = x, v
    return path, steps, [step / 10 for step in steps]


def openpmd():
    path, steps = FOLDER / "openpmd.h5", [100, 200]
    with h5py.File(path, "w") as file:
        file.attrs["openPMD"] = "1.1.0"
        for step in steps:
            file.create_group(f"data/{step}").attrs.update(time=step, timeUnitSI=0.1)
            group = file.create_group(f"data/{step}/particles/water")
            position, velocity, group["id"] = particles(step)
            for axis, x, v in zip("xyz", position.T, velocity.T):
                group[f"position/{axis}"], group[f"velocity/{axis}"] = x, v
                group.create_group(f"positionOffset/{axis}").attrs.update(value=0.0, shape=[COUNT])
            group.create_group("mass").attrs.update(value=0.5, shape=[COUNT])
    return path, steps, [step * 0.1 for step in steps]


def pysph():
    path = FOLDER / "pysph_0.hdf5"
    position, velocity, ids = particles(3)
    columns = dict(zip("xyzuvw", [*position.T, *velocity.T.astype(float)]), id=ids)
    with h5py.File(path, "w") as file:
        for name, arrays in (("boundary", {axis: np.zeros(9) for axis in "xyz"}), ("fluid", columns)):
            for key, values in arrays.items():
                file.create_dataset(f"particles/{name}/arrays/{key}", data=values, compression="gzip")
        file.create_group("solver_data").attrs["t"] = 0.25
    return path, [3], [0.25]


def xdmf():
    path, steps = FOLDER / "run.xmf", [0, 1]
    grids = ""
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        for step in steps:
            group = file.create_group(str(step))
            group["points"], group["v"], group["id"] = particles(step)
            item = f'<DataItem Dimensions="{COUNT} {{}}" Format="HDF">run.h5:/{step}/{{}}</DataItem>'
            grids += f'<Grid><Time Value="{step / 4}"/><Geometry GeometryType="XYZ">{item.format(3, "points")}</Geometry>'
            for name, arity in (("v", 3), ("id", 1)):
                grids += f'<Attribute Name="{name}" Center="Node">{item.format(arity, name)}</Attribute>'
            grids += "</Grid>"
    collection = f'<Grid GridType="Collection" CollectionType="Temporal">{grids}</Grid>'
    path.write_text(f'<?xml version="1.0"?><Xdmf Version="3.0"><Domain>{collection}</Domain></Xdmf>\n')
    return path, steps, [step / 4 for step in steps]


def xdmf_of_meshio(place):
    """What writes an index with its data in this place."""

    def write():
        # meshio states the name of the other file as it was given.
        os.chdir(FOLDER)
        name = f"meshio_{place}.xdmf"
        positions, velocities, ids = particles(4)
        cells = [("vertex", np.arange(COUNT)[:, None])]
        mesh = meshio.Mesh(positions, cells, point_data={"v": velocities, "id": ids})
        meshio.xdmf.write(name, mesh, data_format=place)
        return FOLDER / name, [4], [None]

    return write


if __name__ == "__main__":
    main()
