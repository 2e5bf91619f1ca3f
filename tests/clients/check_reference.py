"""Compares the surfaces of the authors' program with ours at the same settings.

For our integrators `fast` and `implicit` and each frame, the mean distance between the surfaces, in both
directions, must be at most 0.15 h: two correct integrations of the flow differ by 0.06 to 0.15 h. Our bending
energy ∫H² must be at most theirs. Curvature depends on the mesher. OpenVDB's mesher made their mesh, so ∫H²
is measured on the mesh that it makes from our .vdb. In both meshes, vertices that almost coincide are merged
first.

Runs in Debian's own Python, because Debian's build of OpenVDB's Python module is for that Python.
"""

import shutil

import pyopenvdb as vdb

from mesh_files import read_ply
from project import DATA, OUT, Check, convert, data_is_there
from surface import bending_energy, distances, openvdb_surface, volume, without_slivers

VOXEL_SIZE = 0.025
DISTANCE_MAX_VOXELS = 0.15
SLIVER_VOXELS = 0.005
FRAMES = [
    "dam_break_frame_9_6859_particles.bgeo",
    "double_dam_break_frame_26_4732_particles.csv",
    "dam_break_frame_23_24389_particles.bgeo",
    "hilbert_46843_particles.bgeo",
]


def main():
    check = Check("reference: the authors' surfaces")
    if not data_is_there():
        return
    print("         integrator, frame: mean distance ours to theirs / theirs to ours, largest; ∫H² (raw), volume: ours / theirs")
    for integrator in ("fast", "implicit"):
        out = OUT / "reference" / integrator
        shutil.rmtree(out, ignore_errors=True)
        inputs = [DATA / "third-party" / "splashsurf" / name for name in FRAMES]
        options = ["--preset", "paper", "--voxel-size", VOXEL_SIZE, "--integrator", integrator, "--format", "vdb,ply,glb"]
        status, said, frames = convert(inputs, out, *options)
        if status:
            check.line(integrator, f"exit status {status}", [said.strip()])
        for name in FRAMES:
            stem = name.rsplit(".", 1)[0]
            if frames.get(name, {}).get("status") == "converted":
                seconds = sum(frames[name]["seconds"].values())
                check.line(f"{integrator:8} {stem}", *compared(out / f"{stem}.vdb", seconds))
    check.end()


def compared(path, seconds):
    """The figures of one frame, and the faults: figures that are too large."""
    grid = vdb.read(str(path), "surface")
    ours, theirs = openvdb_surface(grid), read_ply(DATA / "reference" / f"{path.stem}.authors_implicit.ply")
    ways = [distances(*pair) / VOXEL_SIZE for pair in ((ours, theirs), (theirs, ours))]
    raw = [bending_energy(*mesh) for mesh in (ours, theirs)]
    energies = [bending_energy(*without_slivers(*mesh, SLIVER_VOXELS * VOXEL_SIZE)) for mesh in (ours, theirs)]
    volumes = [volume(*mesh) for mesh in (ours, theirs)]
    faults = []
    if max(way.mean() for way in ways) > DISTANCE_MAX_VOXELS:
        faults.append(f"the mean distance is over {DISTANCE_MAX_VOXELS} h")
    for what, (our_energy, their_energy) in (("∫H²", energies), ("raw ∫H²", raw)):
        if our_energy > their_energy:
            faults.append(f"{what} is {our_energy / their_energy:.3f} times theirs")
    figures = (
        f"{ways[0].mean():.4f} h / {ways[1].mean():.4f} h, {max(way.max() for way in ways):.2f} h; "
        f"∫H² {energies[0]:.1f} / {energies[1]:.1f} ({raw[0]:.1f} / {raw[1]:.1f}); volume {volumes[0]:.4f} / {volumes[1]:.4f}; {seconds:.1f} s"
    )
    return figures, faults


if __name__ == "__main__":
    main()
