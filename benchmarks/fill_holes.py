"""Patch against the removed truth: a tube with sinuses, holes of several radii, noise along the normals.

python -m benchmarks.fill_holes              three places, 2 to 7 mm radius, noise 0 to 0.2 mm, all methods
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.common import head
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import face_areas, vertex_normals
from ssmpipe.core.mesh.topology import boundary_loops, compact, face_components
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import separate_fans
from ssmpipe.core.repair.filling import Method, fill
from ssmpipe.synth.aorta import SINUSES, Wall
from ssmpipe.synth.implicit import polygonize

WALL = Wall(np.zeros(7), np.zeros((2, 4, 5)))
PLACES = {
    "sinus": (SINUSES["non"], 12.5),
    "groove between sinuses": (SINUSES["non"] + np.pi / 3, 21.0),
    "tube": (1.0, 36.0),
}


def truth(spacing: float = 0.62) -> TriMesh:
    """Return the wall from 7 mm below the sinuses to 49 mm above, by marching cubes."""

    def body(points: Floats) -> Floats:
        theta, t, distance = WALL.material(points)
        return np.maximum(distance - WALL.radius(theta, t), np.maximum(t - 50, -8 - t))

    low, high = np.array([-26.0, -26.0, -12.0]), np.array([34.0, 26.0, 56.0])
    vertices, faces = polygonize(body, low, high, spacing, np.eye(4))
    t = WALL.material(vertices)[1]
    return compact(TriMesh(vertices, faces), ((t < 49) & (t > -7))[faces].all(axis=1))


def error(
    mesh: TriMesh, place: str, radius: float, sigma: float, method: Method, seed: int
) -> tuple[float, float, float]:
    """Return the root mean square and the largest distance of a patch from the truth [mm], and the time [s]."""
    middle = WALL.point(*PLACES[place])
    noise = sigma * np.random.default_rng(seed).normal(size=(mesh.n_vertices, 1))
    far = np.linalg.norm(mesh.vertices - middle, axis=1) > radius
    holed, _ = separate_fans(
        compact(TriMesh(mesh.vertices + noise * vertex_normals(mesh), mesh.faces), far[mesh.faces].all(axis=1))
    )
    label = face_components(holed.faces)
    holed = compact(holed, label == int(np.argmax(np.bincount(label, weights=face_areas(holed)))))
    loop = min(
        boundary_loops(holed.faces), key=lambda x: float(np.linalg.norm(holed.vertices[x].mean(axis=0) - middle))
    )
    begin = time.perf_counter()
    filled, _ = fill(holed, [loop], method=method)
    seconds = time.perf_counter() - begin
    away = point_to_mesh(filled.vertices[holed.n_vertices :], mesh)[0]
    return float(np.sqrt((away**2).mean())), float(away.max()), seconds


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--radii", type=float, nargs="+", default=[2, 4, 7])
    parser.add_argument("--sigmas", type=float, nargs="+", default=[0, 0.1, 0.2])
    parser.add_argument("--methods", nargs="+", default=["implicit", "biharmonic", "membrane"])
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    head("Patches against the removed wall: RMS / max [mm], seconds")
    mesh = truth()
    print(f"{mesh.n_faces} faces\n")
    print("| place | radius [mm] | noise [mm] | " + " | ".join(args.methods) + " |")
    print("|---|---|---|" + "---|" * len(args.methods))
    for place in PLACES:
        for radius in args.radii:
            for sigma in args.sigmas:
                found = [error(mesh, place, radius, sigma, method, args.seed) for method in args.methods]
                cells = " | ".join(f"{rms:.3f} / {worst:.3f}, {seconds:.1f} s" for rms, worst, seconds in found)
                print(f"| {place} | {radius:g} | {sigma:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
