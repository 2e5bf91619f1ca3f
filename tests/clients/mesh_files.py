"""Reads the .ply and .glb that meniscus writes, without any of the programs under test.

A mesh is two arrays: the positions of vertices, and the three vertex indices of each triangle.
"""

import json
import struct

import numpy as np


def read_ply(path):
    """Positions and triangles of a binary little-endian PLY whose faces are all triangles."""
    vertices, faces = tables_of(path)
    positions = np.stack([vertices[axis].astype(float) for axis in "xyz"], axis=1)
    return positions, faces[faces.dtype.names[-1]].astype(np.int64).reshape(-1, 3)


def read_vertices(path):
    """All vertex properties of a PLY as read by `read_ply`, by name."""
    return tables_of(path)[0]


def tables_of(path):
    """The vertices and faces of a PLY as read by `read_ply`, as structured arrays."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    rows, counts, element = {"vertex": [], "face": []}, {}, None
    for line in data[:end].decode("ascii").splitlines():
        words = line.split()
        if words[0] == "format" and words[1] != "binary_little_endian":
            raise ValueError(f"{path}: format {words[1]}")
        if words[0] == "element":
            element = words[1]
            counts[element] = int(words[2])
        elif words[0] == "property" and words[1] == "list":
            rows[element] += [("count", PLY_TYPES[words[2]]), (words[4], PLY_TYPES[words[3]], 3)]
        elif words[0] == "property":
            rows[element].append((words[2], PLY_TYPES[words[1]]))
    vertices = np.frombuffer(data, np.dtype(rows["vertex"]), counts["vertex"], end)
    # Particles have no faces.
    face = np.dtype(rows["face"] or [("count", "u1")])
    faces = np.frombuffer(data, face, counts.get("face", 0), end + vertices.nbytes)
    if end + vertices.nbytes + faces.nbytes != len(data):
        raise ValueError(f"{path}: {len(data)} bytes, but its header says otherwise")
    if len(faces) and (faces["count"] != 3).any():
        raise ValueError(f"{path}: not all faces are triangles")
    return vertices, faces


PLY_TYPES = {
    "uchar": "u1", "uint8": "u1", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}


def read_glb(path):
    """Positions in world space and triangles of a GLB with one mesh."""
    data = path.read_bytes()
    json_length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + json_length])
    buffer = data[20 + json_length + 8 :]

    def array(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        width = 3 if accessor["type"] == "VEC3" else 1
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]]
        return np.frombuffer(buffer, kind, accessor["count"] * width, start).reshape(-1, width)

    if not document.get("meshes"):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    node = next(node for node in document["nodes"] if "mesh" in node)
    primitive = document["meshes"][node["mesh"]]["primitives"][0]
    positions = array(primitive["attributes"]["POSITION"]).astype(float)
    triangles = array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
    if "rotation" in node:
        positions = rotated(positions, np.array(node["rotation"]))
    return positions + np.array(node.get("translation", [0, 0, 0])), triangles


def rotated(points, quaternion):
    """Points rotated by a quaternion x, y, z, w."""
    axis, w = quaternion[:3], quaternion[3]
    twice = 2 * np.cross(axis, points)
    return points + w * twice + np.cross(axis, twice)
