"""Writes the HDF5 files of this folder, which formats/tests/hdf5.rs reads. Needs h5py.

Particle i of step s is at (i/2 + s, i/4 - 1, 3 - i), has the velocity (i, 2, -i) and the number 100 + i.
"""

from pathlib import Path

import h5py
import numpy as np

FOLDER = Path(__file__).resolve().parent
N = 6
I = np.arange(N)
VELOCITY = np.stack([I, np.full(N, 2), -I], axis=1).astype("f4")
IDS = 100 + I


def position(step=0):
    return np.stack([I / 2 + step, I / 4 - 1, 3.0 - I], axis=1)


def new(name, libver="earliest"):
    return h5py.File(FOLDER / name, "w", libver=(libver, "latest"))


with new("gadget.h5") as file:
    for kind in (1, 0):
        group = file.create_group(f"PartType{kind}")
        group["Coordinates"] = position(10 * kind)
        group["Velocities"] = VELOCITY
        group["ParticleIDs"] = IDS.astype("u4")
        group["Masses"] = np.full(N, 0.5, "f4")
    header = file.create_group("Header")
    header.attrs["Time"] = 0.25
    header.attrs["NumPart_Total"] = [N, N, 0, 0, 0, 0]

# New groups with links and attributes in heaps, filters, names for the same groups, a link to another file.
with new("swift.h5", "latest") as file:
    group = file.create_group("PartType0", track_order=True)
    options = {"chunks": (4, 3), "compression": "gzip", "shuffle": True, "fletcher32": True}
    group.create_dataset("Coordinates", data=position(), maxshape=(None, 3), **options)
    group.create_dataset("Velocities", data=VELOCITY, **options)
    group.create_dataset("ParticleIDs", data=IDS, chunks=(N,), compression="gzip")
    group.create_dataset("Densities", data=(1000 + I).astype(">f4"), chunks=(4,), maxshape=(None,))
    for index in range(9):
        group.create_dataset(f"Extra{index}", data=I.astype("i2"))
    group["Tensors"] = np.zeros((N, 3, 3))
    group["Names"] = np.array([b"abc"] * N)
    file["GasParticles"] = h5py.SoftLink("/PartType0")
    file["DMParticles"] = h5py.ExternalLink("other.h5", "/PartType1")
    header = file.create_group("Header")
    header.attrs["Time"] = [0.5]
    for index in range(12):
        header.attrs[f"attribute {index}"] = index

with new("steps.h5part") as file:
    for step in (10, 0, 2):
        group = file.create_group(f"Step#{step}")
        group.attrs["TimeValue"] = step / 4
        group["x"], group["y"], group["z"] = position(step).T.copy()
        group["vx"], group["vy"], group["vz"] = VELOCITY.T.copy()
        group["id"] = IDS

# Groups as scripts name them, beside one without particles; the particles have the names of a simulator.
with new("frames.h5") as file:
    for step in (10, 0, 2):
        group = file.create_group(f"frame_{step:04}")
        group["particle_q"], group["particle_qd"], group["id"] = position(step), VELOCITY, IDS
    file["step_of_time"] = 0.5

with new("numbered.h5") as file:
    for step in (10, 0, 2):
        group = file.create_group(f"frames/{step}")
        group["x"], group["v"] = position(step), VELOCITY
    file.create_group("data/0")["density"] = np.zeros((4, 4, 4))
    file.create_group("t5").attrs["dt"] = 0.1

# All steps in one data set.
with new("stacked.h5") as file:
    stack = np.stack([position(step) for step in range(3)])
    file.create_dataset("F_x", data=np.zeros((3, 3)))
    file.create_dataset("pos", data=stack, chunks=(1, 4, 3), compression="gzip")
    file["vel"] = np.stack([VELOCITY] * 3)
    file["box"] = np.ones((3, 3))
    file["kind"] = np.zeros((3, N), "i2")
    file["mass"] = np.full((3, N), 0.5)
    file["id"] = IDS
    file["time"] = np.arange(3.0)

# The same under names that mean positions and velocities only together.
with new("stacked_pair.h5") as file:
    file["q"], file["qd"] = stack, np.stack([VELOCITY] * 3)

# Neither a picture nor a tensor field is a stack of positions.
with new("picture.h5") as file:
    file["image"] = np.zeros((4, 5, 3))

# A box at each step, and positions below a group.
with new("h5md.h5") as file:
    file.create_group("h5md").attrs["version"] = [1, 1]
    file["particles/all/position/value"] = stack
    file["particles/all/box/edges/value"] = np.ones((20, 3))

# Without the name of a position: the only vector of real numbers, as long as all else.
with new("unnamed.h5") as file:
    file["cell"] = np.eye(3)
    group = file.create_group("sim/state")
    group["points of water"], group["kind"] = position(), IDS.astype("i4")

with new("pysph.hdf5") as file:
    for name in ("boundary", "fluid"):
        arrays = file.create_group(f"particles/{name}/arrays")
        for key, values in zip("xyzuvw", [*position(0 if name == "fluid" else 9).T, *VELOCITY.T]):
            arrays.create_dataset(key, data=values.copy(), compression="gzip")
            arrays[key].attrs["stored"] = True
        arrays["rho"] = 1000.0 + I
        arrays["au"] = np.zeros(0)
        file.create_group(f"particles/{name}/constants")["cs"] = [10.0]
    file.create_group("solver_data").attrs["t"] = 1.5

with new("openpmd.h5") as file:
    file.attrs["openPMD"] = "1.1.0"
    for step in (100, 20):
        file.create_group(f"data/{step}").attrs.update(time=step, timeUnitSI=0.5)
        water = file.create_group(f"data/{step}/particles/water")
        for axis, values in zip("xyz", position(step).T):
            water[f"position/{axis}"] = values.copy()
            water[f"position/{axis}"].attrs["unitSI"] = 0.001
            water.create_group(f"positionOffset/{axis}").attrs.update(value=0.0, shape=[N])
        for axis, values in zip("xyz", VELOCITY.T):
            water[f"velocity/{axis}"] = values.copy()
        water.create_group("mass").attrs.update(value=0.125, shape=[N])
        water["id"] = IDS.astype("u8")

with new("species.h5") as file:
    file.attrs["openPMD"] = "1.1.0"
    for name, ids in (("water", IDS[:4]), ("air", IDS[4:])):
        group = file.create_group(f"data/7/particles/{name}")
        for axis, values in zip("xyz", position()[ids - 100].T):
            group[f"position/{axis}"] = values.copy()
        group["id"], group["diameter"] = ids, np.full(len(ids), 0.5)
        if name == "water":
            group["only_here"] = np.zeros(4)

with new("vtk.vtkhdf") as file:
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = (2, 0)
    root["Points"] = position().astype("f4")
    root["NumberOfPoints"] = [N]
    root["PointData/Velocity"] = VELOCITY

record = np.zeros(N, dtype=[("pos", ">f4", 3), ("label", "S2"), ("vel", "f8", 3), ("id", "u2")])
record["pos"], record["vel"], record["id"] = position(), VELOCITY, IDS
with new("records.h5") as file:
    file["particles"] = record

# A data set for each index of chunks, filter and type, with the position in three of them.
for name, libver in (("old.h5", "earliest"), ("new.h5", "latest")):
    with new(name, libver) as file:
        x, y, z = position().T
        file.create_dataset("x", data=x.astype("f2"), chunks=(4,), compression="lzf")
        file.create_dataset("y", data=y, chunks=(1,), maxshape=(None,))
        file.create_dataset("z", data=z.astype(">i4"), chunks=(4,))
        file.create_dataset("single", data=np.repeat(I, 50).reshape(N, 50), chunks=(N, 50), compression="lzf")
        file.create_dataset("tree", data=VELOCITY, chunks=(2, 2), maxshape=(None, None), compression="gzip")
        file.create_dataset("fill", shape=(N,), chunks=(2,), dtype="f8", fillvalue=2.5)
        file["flags"] = I > 2
        for kind in ("i1", ">u2", "u4", ">i8", "u8"):
            file[f"type {kind[-2:]}"] = IDS.astype(kind)
        file["scalar"] = 7.0
        file["other"] = np.zeros(N + 1)

# A file that its program has open.
with new("open.h5", "latest") as file:
    file["pos"] = position()
    file.flush()
    unfinished = (FOLDER / "open.h5").read_bytes()
(FOLDER / "open.h5").write_bytes(unfinished)

with new("none.h5") as file:
    file["density"] = np.zeros((4, 4, 4))
    grid = file.create_group("grid")
    for axis in "xyz":
        grid[axis] = np.arange(4.0)
        grid[axis].make_scale()
