"""Ways to map a surface to the square: stretch, energy, folds, fit and time, on real cohorts.

    python -m benchmarks.parameterizations --data FOLDER [--n N] [--n-cones N]

FOLDER holds ``femur_vsd``, ``teeth_molar`` and ``spleen``, each with ``scans/``. Stretch of a disk: of the map of the unit square
(1 scales only); of a map between poles: at the best ratio of the units of u and v. Fit: mesh to a 60 x 60 spline of degree 2 [mm].
The last table compares the two ways to the u of a cone on proximal femora: one periodic solve, and two traced gradient lines.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.common import head
from ssmpipe.core.align.frames import femur_distal_frame, principal_frame
from ssmpipe.core.align.rigid import move
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.operators import face_areas
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import (
    aligned_axes,
    corners_by_angle,
    insert_corners,
    order_corners,
    rim_of,
    split_chords,
)
from ssmpipe.core.parameterize.cone import PoleMap, parameterize_poles
from ssmpipe.core.parameterize.poles import apex_of, ends_of
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.parameterize.slim import parameterize_slim
from ssmpipe.core.parameterize.stretch import parameterize_square
from ssmpipe.core.parameterize.traced import parameterize_traced
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.core.repair.smoothing import taubin
from ssmpipe.core.repair.trimming import trim
from ssmpipe.core.spline.fit import fit_surface, surface_grid
from ssmpipe.io.meshes import read_mesh

X, Y, Z = np.eye(3)
DISK: dict[str, Callable] = {
    "uniform, relaxed": lambda m, c: parameterize_square(m, c, weighting="uniform"),
    "harmonic": lambda m, c: parameterize_square(m, c, weighting="harmonic", max_iterations=0),
    "mean value": lambda m, c: parameterize_square(m, c, max_iterations=0),
    "mean value, relaxed, eta 1": lambda m, c: parameterize_square(m, c, eta=1.0),
    "mean value, relaxed, eta 0.5 (default)": lambda m, c: parameterize_square(m, c),
    "slim": parameterize_slim,
}
POLES: dict[str, dict[str, int]] = {
    "harmonic": {"max_iterations": 0, "n_remap": 0},
    "harmonic, u and v changed": {"max_iterations": 0},
    "relaxed": {"n_remap": 0},
    "relaxed, u and v changed (default)": {},
}

CONES: dict[str, Callable[[TriMesh, Floats], PoleMap]] = {
    "periodic, harmonic": lambda m, a: parameterize_poles(m, a, max_iterations=0, n_remap=0),
    "traced, harmonic": lambda m, a: parameterize_traced(m, a, n_remap=0),
    "periodic, u and v changed": lambda m, a: parameterize_poles(m, a, max_iterations=0),
    "traced, u and v changed": parameterize_traced,
    "periodic, relaxed, u and v changed (default)": parameterize_poles,
}


def fit_error(mesh: TriMesh, samples: Floats) -> tuple[float, float]:
    dense = TriMesh(surface_grid(fit_surface(samples), 241, 241).reshape(-1, 3), grid_faces(241, 241))
    distance = point_to_mesh(mesh.vertices, dense)[0]
    return float(np.sqrt((distance**2).mean())), float(distance.max())


def prepared(path: Path) -> TriMesh:
    return clean(read_mesh(path)).mesh


def fine(mesh: TriMesh) -> TriMesh:
    return decimate(taubin(mesh, n_iterations=10), 10000).mesh


def disks(data: Path, n: int) -> Iterator[tuple[str, TriMesh]]:
    for path in sorted((data / "femur_vsd" / "scans").glob("*.ply"))[:n]:
        bone = prepared(path)
        bone = move(bone, femur_distal_frame(bone).matrix)
        yield "femur-distal", fine(trim(bone, 90.0 * Z, Z))
    for path in sorted((data / "teeth_molar" / "scans").glob("*"))[:n]:
        try:
            yield "tooth", fine(prepared(path))
        except SsmpipeError as error:
            print(f"{path.stem} left out: {error.fact}")


def lumps(data: Path, n: int) -> Iterator[tuple[str, TriMesh]]:
    for path in sorted((data / "femur_vsd" / "scans").glob("*.ply"))[:n]:
        bone = prepared(path)
        bone = move(bone, femur_distal_frame(bone).matrix)
        top = float(bone.vertices[:, 2].max())
        yield "femur-proximal, cone", fine(trim(bone, (top - 100.0) * Z, -Z))
        yield "femur, closed", fine(bone)
    for path in sorted((data / "spleen" / "scans").glob("*.vtk"))[:n]:
        organ = prepared(path)
        yield "spleen, closed", fine(move(organ, principal_frame(organ).matrix))


def disk_rows(mesh: TriMesh) -> dict[str, list[float]]:
    rim = rim_of(mesh)
    with_corners, corners, _ = insert_corners(
        mesh, corners_by_angle(mesh, rim, (45, 135, 225, 315), aligned_axes(mesh, rim)[0])
    )
    disk = split_chords(with_corners)
    ordered = order_corners(rim_of(disk), corners)
    rows = {}
    for name, method in DISK.items():
        start = time.process_time()
        try:
            result = method(disk, ordered)
        except SsmpipeError as error:
            rows[name] = [np.nan, float(error.fact.split()[0]), np.nan, np.nan, time.process_time() - start]
            continue
        spent = time.process_time() - start
        fit = fit_error(disk, sample_grid(disk, result.value, 200, 200))
        rows[name] = [float(result.history["stretch"][-1]), 0.0, *fit, spent]
    return rows


def pole_rows(mesh: TriMesh) -> dict[str, list[float]]:
    antapex, apex = (None, apex_of(mesh)) if boundary_loops(mesh.faces) else ends_of(mesh, X + Z)[:2]
    rows = {}
    for name, options in POLES.items():
        start = time.process_time()
        found = parameterize_poles(mesh, apex, antapex, **options)
        spent = time.process_time() - start
        fit = fit_error(mesh, sample_grid(found.mesh, found.uv, 200, 200, found.seam))
        rows[name] = [float(found.stretch[-1]), float(found.n_folds_harmonic), *fit, spent, 100 * found.ring.max()]
    return rows


def skewness(found: PoleMap) -> float:
    """Return the area-weighted mean deviation of the angle between the lines of u and of v from a right one [deg].

    Faces at the apex are left out: there the lines of v are ruled to it.
    """
    faces = found.mesh.faces[~np.isin(found.mesh.faces, found.seam.poles).any(axis=1)]
    p, (u, v) = found.mesh.vertices[faces], np.moveaxis(found.uv[faces], 2, 0)
    s_u = np.einsum("fkd,fk->fd", p, np.roll(v, -1, axis=1) - np.roll(v, -2, axis=1))
    s_v = np.einsum("fkd,fk->fd", p, np.roll(u, -2, axis=1) - np.roll(u, -1, axis=1))
    cosine = np.einsum("fd,fd->f", s_u, s_v) / (np.linalg.norm(s_u, axis=1) * np.linalg.norm(s_v, axis=1))
    away = np.abs(90.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return float(np.average(away, weights=face_areas(TriMesh(found.mesh.vertices, faces))))


def proximal(data: Path, n: int) -> Iterator[tuple[str, TriMesh]]:
    for path in sorted((data / "femur_vsd" / "scans").glob("*.ply"))[:n]:
        bone = prepared(path)
        bone = move(bone, femur_distal_frame(bone).matrix)
        top = float(bone.vertices[:, 2].max())
        yield path.stem, fine(trim(bone, (top - 100.0) * Z, -Z))


def cones(data: Path, n: int) -> None:
    """Print one row for each way to the u of a cone, over all femora, and one for each femur whose traced map folded at first."""
    rows: dict[str, list[list[float]]] = {name: [] for name in CONES}
    told = []
    for name, mesh in proximal(data, n):
        apex = apex_of(mesh)
        for way, method in CONES.items():
            start = time.process_time()
            try:
                found = method(mesh, apex)
            except SsmpipeError as error:
                told.append(f"{name}, {way}: {error.fact}")
                rows[way].append([np.nan, 1.0, *[np.nan] * 6])
                continue
            spent = time.process_time() - start
            fit = fit_error(mesh, sample_grid(found.mesh, found.uv, 200, 200, found.seam))
            rows[way].append(
                [
                    found.n_folds_harmonic,
                    0.0,
                    skewness(found),
                    found.stretch[-1],
                    *fit,
                    spent,
                    max(found.kink, 1 / found.kink),
                ]
            )
            if found.n_folds_harmonic:
                told.append(f"{name}, {way}: {found.n_folds_harmonic} triangles turned over, mended")
    print(f"\nThe u of a cone, {n} proximal femora (medians; in brackets the largest)\n")
    print(
        "| u | femora with folds at first (triangles) | femora refused | angle from 90 [deg] | stretch | fit RMS [mm] | "
        "fit max [mm] | processor time [s] | kink |\n|---|---|---|---|---|---|---|---|---|"
    )
    for way, found in rows.items():
        values = np.array(found)
        folds = values[:, 0]
        cells = [f"{np.nanmedian(c):.3g} ({np.nanmax(c):.3g})" for c in values[:, 2:].T]
        print(
            f"| {way} | {int((folds > 0).sum())} ({int(np.nansum(folds))}) | {int(values[:, 1].sum())} | {' | '.join(cells)} |"
        )
    print("\n".join(["", *told]))


def show(title: str, shapes: Iterator[tuple[str, TriMesh]], measure: Callable, header: str) -> None:
    print(f"\n{title}\n| shapes | map | {header} |\n|---|---|{'---|' * len(header.split('|'))}")
    found: dict[tuple[str, str], list[list[float]]] = {}
    for kind, mesh in shapes:
        for name, row in measure(mesh).items():
            found.setdefault((kind, name), []).append(row)
    for kind, name in sorted(found, key=lambda key: [k[0] for k in found].index(key[0])):
        values = np.array(found[kind, name])
        cells = [np.median(values[:, k]) if np.isfinite(values[:, k]).all() else np.nan for k in range(values.shape[1])]
        cells[1] = values[:, 1].max()
        print(f"| {kind} ({len(values)}) | {name} | {' | '.join(f'{c:.3g}' for c in cells)} |")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--n", type=int, default=4, help="shapes of each cohort; 0 compares cones only")
    parser.add_argument("--n-cones", type=int, default=12, help="proximal femora on which the ways to u are compared")
    options = parser.parse_args()
    head("Ways to map a surface to the square")
    if options.n == 0:
        cones(options.data, options.n_cones)
        return
    columns = "stretch | folds, most | fit RMS [mm] | fit max [mm] | processor time [s]"
    show("Disks", disks(options.data, options.n), disk_rows, columns)
    columns = columns.replace("folds, most", "folds of the harmonic map, most") + " | widest pole ring [% of v]"
    show("Maps between poles", lumps(options.data, options.n), pole_rows, columns)
    cones(options.data, options.n_cones)


if __name__ == "__main__":
    main()
