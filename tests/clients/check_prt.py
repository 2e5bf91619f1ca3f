"""Checks that meniscus reads PRT files, the particles of Krakatoa, tyFlow and FumeFX.

No package on a registry writes PRT, so the files are written here, from the published description of the format:
versions 1.0 and 1.1, with every type of number, channels in another order than in the records, metadata, and
definitions of channels that are longer than version 1.0 has them. Positions, velocities and ids must be equal to
the last bit. Files that are cut off, and one whose count is −1, must fail, and be called incomplete.
"""

import shutil
import struct
import zlib

import numpy as np

from check_json import faults_of
from mesh_files import read_vertices
from project import WORK, Check, convert

FOLDER = WORK / "prt"
COUNT = 1000
# The numbers of the types of channels.
TYPES = {"i2": 0, "i4": 1, "i8": 2, "f2": 3, "f4": 4, "f8": 5, "u2": 6, "u4": 7, "u8": 8, "i1": 9, "u1": 10}
STRING = -1


def main():
    check = Check("prt: frames as the published description has them")
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    for label, kinds, options in (
        ("1_0", {"Position": "f4", "Velocity": "f4", "ID": "i4"}, {}),
        ("1_0_half", {"Velocity": "f2", "ID": "u4", "Position": "f4"}, {"reverse": True}),
        ("1_1", {"Position": "f8", "Velocity": "f8", "ID": "i2"}, {"version": 2, "channel_bytes": 60}),
        ("types", {"Position": "f4", **{f"As_{kind}": kind for kind in TYPES}}, {"version": 2}),
    ):
        rows, expected = particles(kinds)
        path = FOLDER / f"{label}.prt"
        path.write_bytes(prt(rows, **options))
        check.line(label, *compared(path, expected))
    whole = prt(particles({"Position": "f4", "Velocity": "f4"})[0])
    check.line("cut off", *refused("cut.prt", whole[: len(whole) // 2], "before the end"))
    unfinished = whole[:48] + struct.pack("<q", -1) + whole[56:]
    check.line("unfinished", *refused("unfinished.prt", unfinished, "has not finished"))
    check.end()


def particles(kinds):
    """Records with these channels, and the values that meniscus must find."""
    random = np.random.default_rng(50)
    arity = {"Position": 3, "Velocity": 3}
    rows = np.zeros(COUNT, np.dtype([(name, f"<{kind}", arity.get(name, 1)) for name, kind in kinds.items()]))
    for name, kind in kinds.items():
        values = random.normal(size=rows[name].shape) * 10
        if name == "ID":
            values = random.permutation(COUNT)
        elif kind[0] != "f":
            values = random.integers(0, 100, rows[name].shape)
        rows[name] = values.reshape(rows[name].shape)
    names = {"Position": "position", "Velocity": "velocity", "ID": "id"}
    return rows, {names[name]: rows[name].astype(float) for name in kinds if name in names}


def prt(rows, version=1, channel_bytes=44, reverse=False):
    """The bytes of a file with these records."""
    metadata = b""
    if version == 2:
        metadata += meta("", "CoordSys", TYPES["i4"], struct.pack("<i", 1))
        metadata += meta("", "LengthUnitInMeters", TYPES["f8"], struct.pack("<d", 0.01))
        metadata += meta("Position", "Interpretation", STRING, b"Point\0")
        metadata += b"Stop" + struct.pack("<i", 0)
    header = b"\xc0PRT\r\n\x1a\n" + struct.pack("<i32siq", 56 + len(metadata), b"Extensible Particle Format", version, len(rows))
    fields = sorted(rows.dtype.fields.items(), key=lambda field: field[1][1], reverse=reverse)
    channels = struct.pack("<iii", 4, len(fields), channel_bytes)
    for name, (kind, offset) in fields:
        base, shape = kind.subdtype or (kind, (1,))
        definition = struct.pack("<32siii", name.encode(), TYPES[base.str[1:]], shape[0], offset)
        channels += definition.ljust(channel_bytes, b"\xff")
    return header + metadata + channels + zlib.compress(rows.tobytes())


def meta(channel, name, kind, value):
    content = channel.encode() + b"\0" + name.encode() + b"\0" + struct.pack("<i", kind) + value
    return b"Meta" + struct.pack("<i", len(content)) + content


def compared(path, expected):
    out = FOLDER / "out"
    status, said, _ = convert([path], out, "--particles-only", "--format", "ply")
    if status:
        return f"exit status {status}", [said.strip()]
    return faults_of(renamed(read_vertices(out / f"{path.stem}.ply")), expected)


def renamed(found):
    """Properties under the names that `faults_of` knows."""
    usual = {"Velocity_x": "v_x", "Velocity_y": "v_y", "Velocity_z": "v_z", "ID": "id"}
    kinds = [(usual.get(name, name), found.dtype[name]) for name in found.dtype.names]
    return found.view(np.dtype(kinds))


def refused(name, data, words):
    path = FOLDER / name
    path.write_bytes(data)
    status, said, _ = convert([path], FOLDER / "out", "--particles-only", "--format", "ply")
    return f"exit status {status}", [] if status and words in said else [f"expected `{words}` in: {said.strip()}"]


if __name__ == "__main__":
    main()
