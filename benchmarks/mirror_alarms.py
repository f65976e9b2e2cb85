"""How often ``align.check_mirror`` warns of domes that have a side, and of those that have none.

    python -m benchmarks.mirror_alarms

Twelve domes with one rim per cohort, in any pose. All differ by symmetric modes (4 % of the radius) and by antisymmetric ones of their
own; those of some cohorts have a bump off the middle as well, which is what tells left from right. Each is aligned to the medoid, as
the stage does, and so is its mirror image.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from ssmpipe.core.align.icp import align, fits_better_mirrored
from ssmpipe.core.align.medoid import medoid
from ssmpipe.core.align.rigid import move, reflection, rotation_vector_matrix
from ssmpipe.core.mesh.trimesh import TriMesh

N, RINGS, RADIUS = 12, 40, 20.0
COHORTS = [  # own asymmetry, common asymmetry (both in radii), left and right mixed
    (0.00, 0.00, False),
    (0.01, 0.00, False),
    (0.02, 0.00, False),
    (0.04, 0.00, False),
    (0.02, 0.05, False),
    (0.02, 0.05, True),
    (0.02, 0.15, False),
    (0.02, 0.15, True),
]


def disk() -> tuple[np.ndarray, np.ndarray]:
    """Return points of rings in the unit disk and triangles of one orientation."""
    angles = [np.arange(6 * k) * (2 * np.pi / (6 * k)) for k in range(1, RINGS + 1)]
    rings = [k / RINGS * np.column_stack([np.cos(t), np.sin(t)]) for k, t in enumerate(angles, start=1)]
    points = np.concatenate([np.zeros((1, 2)), *rings])
    faces = Delaunay(points).simplices
    a, b = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    faces = np.where(area[:, None] < 0, faces[:, ::-1], faces)
    return points, faces[np.abs(area) > 1e-9]


def dome(rng: np.random.Generator, points: np.ndarray, faces: np.ndarray, own: float, common: float) -> TriMesh:
    """Return one dome in a random pose; its plane of symmetry, if it has one, is y = 0 before."""
    x, y = points.T
    inside = 1 - x * x - y * y
    z = 0.6 * np.sqrt(np.maximum(0.05 + 0.95 * inside, 0)) + 0.15 * x * inside
    z += 0.2 * np.exp(-((x - 0.4) ** 2 + y**2) / 0.05)
    z += common * (np.exp(-((x + 0.2) ** 2 + (y - 0.4) ** 2) / 0.06) + 0.5 * x * y)
    even = [x, x * x, y * y, x**3, x * y * y, np.cos(3 * x) * inside]
    odd = [x * y, 2 * x * x * y, y**3, np.sin(3 * y) * inside, y * inside]
    z += 0.04 * rng.normal(size=len(even)) @ np.array(even) + own * rng.normal(size=len(odd)) @ np.array(odd)
    wide = 1 + 0.04 * rng.normal(size=2)
    vertices = RADIUS * np.column_stack([1.3 * wide[0] * x, wide[1] * y, z])
    vertices += 0.002 * RADIUS * rng.normal(size=vertices.shape)
    return TriMesh(vertices @ rotation_vector_matrix(rng.normal(size=3)).T, faces)


def main() -> None:
    points, faces = disk()
    print("| own asymmetry | of a side | mixed | warned: rightly, of | wrongly, of | mirrored/own distance |")
    print("|---|---|---|---|---|---|")
    for own, common, mixed in COHORTS:
        rng = np.random.default_rng(7)
        domes = {str(i): dome(rng, points, faces, own, common) for i in range(N)}
        other = {i for i in domes if mixed and int(i) % 2}
        domes = {i: move(mesh, reflection()) if i in other else mesh for i, mesh in domes.items()}
        chosen = medoid(domes)
        right = {i for i in domes if (i in other) != (chosen in other)}
        warned, ratios = set(), []
        for i in sorted(set(domes) - {chosen}):
            result = align(domes[i], domes[chosen])
            better, cost = fits_better_mirrored(domes[i], domes[chosen], result)
            ratios.append(cost / result.cost)
            warned |= {i} if better else set()
        told = f"{len(warned & right)}, {len(right)} | {len(warned - right)}, {N - 1 - len(right)}"
        print(
            f"| {own:.0%} | {common:.0%} | {'yes' if mixed else 'no'} | {told} | {min(ratios):.2f} to {max(ratios):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
