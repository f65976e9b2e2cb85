"""What the cohorts of raw-looking scans have in common: scores, poses, noise, a surface without order, and the files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from ssmpipe.core.arrays import Bools, Floats, Ints


def spread_scores(
    n: int, n_modes: int, rng: np.random.Generator, n_draws: int = 300, sizes: Floats | None = None
) -> Floats:
    """Return (n, n_modes) scores: in each mode the n quantiles of the normal distribution, in random order.

    Of ``n_draws`` random orders the one whose modes are least correlated is taken, so that few shapes tell them apart;
    with the ``sizes`` (n_modes,) of the modes, correlation between large ones counts more.

    Examples
    --------
    >>> spread_scores(3, 2, np.random.default_rng(0)).std(axis=0, ddof=1).round(2).tolist()
    [0.97, 0.97]
    """
    quantiles = ndtri((np.arange(n) + 0.5) / n)
    draws = [rng.permuted(np.tile(quantiles[:, None], n_modes), axis=0) for _ in range(n_draws)]
    weight = np.ones((n_modes, n_modes)) if sizes is None else np.outer(sizes, sizes)
    apart = [np.abs(np.triu(weight * (draw.T @ draw), k=1)).max() for draw in draws]
    return draws[int(np.argmin(apart))]


def grain(
    points: Floats, rng: np.random.Generator, rms: float = 0.12, length: float = 2.0, n_waves: int = 200
) -> Floats:
    """Return correlated Gaussian noise at (n, 3) points (random Fourier features; Rahimi and Recht, 2007) [mm].

    Correlated over ``length``, so that the slivers of a marching-cubes surface do not fold over.
    """
    waves = rng.normal(scale=1 / length, size=(n_waves, 3))
    phases = rng.uniform(0, 2 * np.pi, n_waves)
    return rms * np.sqrt(2 / n_waves) * np.cos(points @ waves.T + phases).sum(axis=1)


def roughened(vertices: Floats, normals: Floats, rng: np.random.Generator) -> Floats:
    """Return (n, 3) vertices with noise of 0.12 mm along their unit normals and with the terraces of a scanner's slices."""
    vertices = vertices + normals * grain(vertices, rng)[:, None]
    slice_axis = Rotation.random(random_state=rng).as_matrix()[0]
    terraces = 0.1 * np.sin(2 * np.pi * (vertices @ slice_axis) / 1.6)
    return np.asarray(vertices + terraces[:, None] * (normals @ slice_axis)[:, None] * slice_axis)


def specks(vertices: Floats, normals: Floats, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Return two small balls of debris beside a surface, with face indices that go on behind its vertices."""
    import trimesh  # slow to import: only when needed

    points, faces, start = [], [], len(vertices)
    for at in rng.integers(0, len(vertices), 2):
        ball = trimesh.creation.icosphere(subdivisions=1, radius=rng.uniform(1.0, 2.0))
        points.append(np.asarray(ball.vertices) + vertices[at] + 7.0 * normals[at])
        faces.append(np.asarray(ball.faces, dtype=np.int64) + start)
        start += len(ball.vertices)
    return np.concatenate(points), np.concatenate(faces)


def turned_grid(rng: np.random.Generator, spacing: float) -> Floats:
    """Return a random (4, 4) motion of a grid: every scan gets a connectivity of its own."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    turn[:3, 3] = rng.uniform(-spacing, spacing, 3)
    return turn


def scanner_pose(rng: np.random.Generator, left: bool = False) -> Floats:
    """Return a (4, 4) map from the anatomical frame to scanner coordinates [mm]; a left shape is mirrored in x first."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.uniform(-300.0, 300.0, 3)
    return pose @ np.diag([-1.0 if left else 1.0, 1.0, 1.0, 1.0])


def apply(matrix: Floats, points: Floats) -> Floats:
    """Apply a (4, 4) matrix to (n, 3) points."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def without(vertices: Floats, faces: Ints, removed: Bools) -> tuple[Floats, Ints]:
    """Take away every face at a removed vertex, then what only hangs on by single vertices; keep the largest piece.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int64
        A closed manifold, or one with clean holes.
    removed : (n,) bool

    Returns
    -------
    vertices, faces
        Manifold, every vertex in use.

    Examples
    --------
    >>> fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 6], [0, 6, 1]])
    >>> _, left = without(np.zeros((7, 3)), fan, np.arange(7) == 1)
    >>> left.tolist()
    [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    """
    import igl  # slow to import: only when needed

    removed = removed.copy()
    while True:
        faces = faces[~removed[faces].any(axis=1)]
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, count = np.unique(edges, axis=0, return_counts=True)
        at_rim = np.bincount(unique[count == 1].ravel(), minlength=len(vertices))
        if not (at_rim > 2).any():
            break
        removed |= at_rim > 2
    _, label = igl.facet_components(faces)
    faces = faces[label == np.bincount(label).argmax()]
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def shuffled(vertices: Floats, faces: Ints, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Return the same surface with vertices, faces and the first corner of every face in random order."""
    order = rng.permutation(len(vertices))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    start = rng.integers(0, 3, size=(len(faces), 1))
    turned = np.take_along_axis(rank[faces], (start + np.arange(3)) % 3, axis=1)
    return vertices[order], turned[rng.permutation(len(faces))]


def write_scan(path: Path, vertices: Floats, faces: Ints) -> None:
    """Write a surface as binary ``.ply`` or ``.stl`` by its suffix; the same input gives the same bytes."""
    import trimesh  # slow to import: only when needed

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    path.write_bytes(mesh.export(file_type=path.suffix[1:]))


def write_json(path: Path, content: object) -> None:
    """Write plain data as JSON with a final line break."""
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8", newline="\n")


def rounded(points: Floats) -> list[float]:
    """Return one (3,) point as plain numbers, to 0.1 micrometre."""
    return [round(float(c), 4) for c in points]
