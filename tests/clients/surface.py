"""Measures and compares triangle meshes, given as positions and vertex indices of triangles.

Distances are exact: from points spread over one surface to the nearest triangle of the other. The curvature
comes from the cotangent formula with barycentric areas. Its square depends on the mesh as much as on the
surface, so compare it only between meshes of the same mesher.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def openvdb_surface(grid):
    """The mesh of a level set by OpenVDB's mesher: triangles face outward, and quads are split along a
    diagonal."""
    positions, triangles, quads = grid.convertToPolygons()
    parts = [part.astype(np.int64) for part in (quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])] if len(quads) else []
    if len(triangles):
        parts.append(triangles.astype(np.int64))
    # The mesher's triangles are clockwise seen from outside: reverse them.
    faces = np.concatenate(parts)[:, ::-1] if parts else np.zeros((0, 3), np.int64)
    return positions.astype(float).reshape(-1, 3), faces


def volume(positions, triangles):
    """The volume inside a closed mesh whose triangles are counterclockwise seen from outside."""
    if not len(triangles):
        return 0.0
    corners = positions[triangles] - positions.mean(axis=0)
    return np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6


def without_slivers(positions, triangles, distance):
    """Merges vertices that are closer than `distance`, and removes the triangles that vanish.

    If φ is almost 0 at a voxel, a mesher makes several vertices that almost coincide with the voxel. They
    hardly change the surface, but the triangles around such a vertex have almost no area, so its curvature is
    meaningless.
    """
    pairs = cKDTree(positions).query_pairs(distance, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), (len(positions), len(positions)))
    count, group_of = connected_components(links, directed=False)
    sizes = np.bincount(group_of, minlength=count)
    merged = np.stack([np.bincount(group_of, positions[:, axis], count) / sizes for axis in range(3)], axis=1)
    a, b, c = corners = group_of[triangles].T
    return merged, corners.T[(a != b) & (b != c) & (c != a)]


def bending_energy(positions, triangles):
    """∫H², from cotangent mean curvature normals over barycentric areas."""
    corners = positions[triangles]
    # Edge k is opposite corner k.
    edges = [corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)]
    double_areas = np.maximum(np.linalg.norm(np.cross(edges[1], edges[2]), axis=1), 1e-20)
    normals = np.zeros_like(positions)
    for k in range(3):
        a, b = triangles[:, (k + 1) % 3], triangles[:, (k + 2) % 3]
        cotangent = -np.einsum("ij,ij->i", edges[(k + 1) % 3], edges[(k + 2) % 3]) / double_areas
        pull = 0.5 * cotangent[:, None] * edges[k]
        for axis in range(3):
            normals[:, axis] += np.bincount(b, pull[:, axis], len(positions))
            normals[:, axis] -= np.bincount(a, pull[:, axis], len(positions))
    areas = sum(np.bincount(triangles[:, k], double_areas / 6, len(positions)) for k in range(3))
    return (np.einsum("ij,ij->i", normals, normals) / np.maximum(areas, 1e-20)).sum() / 4


def piece_sizes(positions, triangles):
    """For each vertex, the largest extent of the connected piece that it belongs to."""
    ends = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    links = coo_matrix((np.ones(len(ends[0]), np.int8), ends), (len(positions), len(positions)))
    count, piece_of = connected_components(links, directed=False)
    sizes = np.zeros(count)
    for axis in range(3):
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, piece_of, positions[:, axis])
        np.maximum.at(high, piece_of, positions[:, axis])
        sizes = np.maximum(sizes, high - low)
    return sizes[piece_of]


def distances(from_surface, to_surface):
    """The distances from samples of one surface (its vertices, and a point of each triangle) to the other
    surface."""
    positions, triangles = from_surface
    corners = positions[triangles]
    random = np.random.default_rng(1)
    a, b = random.random((2, len(triangles), 1))
    over = a + b > 1
    a, b = np.where(over, 1 - a, a), np.where(over, 1 - b, b)
    inner = corners[:, 0] + a * (corners[:, 1] - corners[:, 0]) + b * (corners[:, 2] - corners[:, 0])
    return distances_to_surface(np.concatenate([positions, inner]), *to_surface)


def distances_to_surface(points, positions, triangles):
    """The distance of each point to the nearest triangle.

    The triangles with the nearest centroids are the first candidates. A triangle reaches no farther from its
    centroid than `reach`. So it is known for which points another triangle could be nearer; these get more
    candidates.
    """
    corners = positions[triangles]
    centroids = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centroids[:, None], axis=2).max()
    tree = cKDTree(centroids)
    nearest = np.full(len(points), np.inf)
    open_points, count = np.arange(len(points)), 8
    while len(open_points):
        count = min(count, len(triangles))
        away, candidates = tree.query(points[open_points], count)
        away, candidates = away.reshape(-1, count), candidates.reshape(-1, count)
        best = nearest[open_points]
        for k in range(count):
            best = np.minimum(best, point_triangle_distances(points[open_points], corners[candidates[:, k]]))
        nearest[open_points] = best
        if count == len(triangles):
            break
        open_points = open_points[away[:, -1] - reach < best]
        count *= 3
    return nearest


def point_triangle_distances(points, corners):
    """The distance of each point to the triangle with the same index."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal) + 1e-300
    w = np.einsum("ij,ij->i", np.cross(b - a, points - a), normal) / square
    v = np.einsum("ij,ij->i", np.cross(points - a, c - a), normal) / square
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    above = np.abs(np.einsum("ij,ij->i", points - a, normal)) / np.sqrt(square)
    beside = np.minimum.reduce([point_segment_distances(points, *ends) for ends in ((a, b), (b, c), (c, a))])
    return np.where(inside, above, beside)


def point_segment_distances(points, start, end):
    """The distance of each point to the segment with the same index."""
    along = end - start
    square = np.einsum("ij,ij->i", along, along) + 1e-300
    t = np.clip(np.einsum("ij,ij->i", points - start, along) / square, 0, 1)
    return np.linalg.norm(points - start - t[:, None] * along, axis=1)
