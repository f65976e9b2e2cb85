"""Cohorts with known truth or expert landmarks, as splines, for the study of the defaults."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import dijkstra

from ssmpipe.core.align.rigid import rigid_fit
from ssmpipe.core.correspondence.description_length import automatic_lambda_cut
from ssmpipe.core.evaluation.correspondence_error import correspondence_error
from ssmpipe.core.evaluation.landmark_transfer import landmark_transfer
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.operators import adjacency, edge_lengths
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import edge_indices
from ssmpipe.core.parameterize.boundary import rim_of, split_chords
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.parameterize.stretch import parameterize_square
from ssmpipe.core.spline.evaluate import Spline
from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import read_mesh
from ssmpipe.io.splines import read_spline
from ssmpipe.runner.presets import PRESETS


@dataclass(frozen=True)
class Cohort:
    """Splines and the error of a correspondence on them.

    ``error(points, grid)`` takes (n_S, n_P, d) points in the frame of the splines and returns mean and 95th percentile.
    """

    name: str
    unit: str
    splines: list[Spline]
    error: Callable[[np.ndarray, tuple[int, ...]], tuple[float, float]]
    landmarks: tuple[int, ...] = (51, 51)
    n_coefficients: tuple[int, ...] = (8, 8)
    closed: bool = False

    def automatic_lambda_cut(self) -> float:
        """The default threshold of the engine for this cohort."""
        control = np.stack([s.control_points.reshape(-1, s.dimension) for s in self.splines]).mean(axis=0)
        return automatic_lambda_cut(float(np.sqrt(((control - control.mean(axis=0)) ** 2).sum(axis=1).mean())))


def run_to_fit(config: Path, out: Path, *sets: str) -> None:
    """Run the per-shape stages."""
    command = [sys.executable, "-m", "ssmpipe", "run", str(config), "--to", "fit", "--set", f"output={out}"]
    subprocess.run([*command, *[a for s in sets for a in ("--set", s)]], check=True)


def fitted(out: Path) -> tuple[list[str], list[Spline], np.ndarray]:
    """Return ids, splines and scan-to-spline transforms of a run."""
    ids, splines, matrices = [], [], []
    for shape in sorted((out / "shapes").iterdir()):
        ids.append(shape.name)
        splines.append(read_spline(next(shape.glob("*-fit")) / "surface.npz"))
        matrices.append(json.loads((next(shape.glob("*-align")) / "transform.json").read_text()))
    return ids, splines, np.array(matrices)


def expert_error(ids: list[str], marks: dict[str, dict[str, np.ndarray]]) -> Callable:
    def error(points: np.ndarray, grid: tuple[int, ...]) -> tuple[float, float]:
        transfers = landmark_transfer(points, grid_faces(*grid), ids, marks, max_distance=8.0)
        e = np.concatenate([t.off_diagonal() for t in transfers])
        return float(e.mean()), float(np.percentile(e, 95))

    return error


def truth_error(truth: np.ndarray) -> Callable:
    def error(points: np.ndarray, grid: tuple[int, ...]) -> tuple[float, float]:
        e = correspondence_error(points, grid_faces(*grid), truth)[~np.eye(len(points), dtype=bool)]
        return float(e.mean()), float(np.percentile(e, 95))

    return error


def real_femora(config: Path, data: Path, work: Path) -> Cohort:
    """Distal femora with nine expert landmarks."""
    out = work / "femora"
    sets = [
        f"input.scans={data}/scans/*.ply",
        f"input.cohort={data}/cohort.csv",
        f"input.landmarks={data}/landmarks.json",
    ]
    run_to_fit(config, out, *sets)
    ids, splines, matrices = fitted(out)
    every = read_landmarks(data / "landmarks.json")
    marks = {i: {n: m[:3, :3] @ p + m[:3, 3] for n, p in every[i].items()} for i, m in zip(ids, matrices, strict=True)}
    return Cohort("12 real distal femora, expert landmarks", "mm", splines, expert_error(ids, marks))


def synthetic_femora(config: Path, work: Path, n: int, seed: int) -> Cohort:
    """Synthetic distal femora with dense truth."""
    folder = work / f"synthetic_{n}_{seed}"
    subprocess.run(
        [sys.executable, "-m", "ssmpipe", "synth", "femur-distal", str(folder), "--n", str(n), "--seed", str(seed)],
        check=True,
    )
    out = work / f"synthetic_{n}_{seed}_out"
    run_to_fit(
        config, out, f"input.scans={folder}/scans/*.ply", f"input.cohort={folder}/cohort.csv", "input.landmarks=null"
    )
    ids, splines, matrices = fitted(out)
    with np.load(folder / "truth.npz") as known:
        points = known["points"][[list(known["ids"]).index(i) for i in ids]]
    truth = points @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]
    return Cohort(f"{n} synthetic distal femora, dense truth", "mm", splines, truth_error(truth))


def aorta_walls(data: Path) -> Cohort:
    """The largest disk of aortic wall without a branch; shared vertices are the truth, each shape has its own parameterization."""
    meshes = [read_mesh(f) for f in sorted((data / "scans").glob("*.ply"))]
    faces = meshes[0].faces
    keep = _largest_disk(meshes[0])
    patches = [compact(TriMesh(m.vertices, faces), keep) for m in meshes]
    rim = rim_of(patches[0])
    corners = rim[np.linspace(0, len(rim), 4, endpoint=False).astype(int)]
    splines: list[Spline] = []
    truth = []
    for patch in patches:
        matrix = rigid_fit(patch.vertices, patches[0].vertices)
        moved = TriMesh(patch.vertices @ matrix[:3, :3].T + matrix[:3, 3], patch.faces)
        disk = split_chords(moved)
        uv = parameterize_square(disk, corners).value
        splines.append(fit_surface(sample_grid(disk, uv, 120, 120), n_control=(40, 40)))
        truth.append(moved.vertices)
    return Cohort(
        "12 synthetic aortas, a branch-free wall, shared vertices", "mm", splines, truth_error(np.array(truth))
    )


def mouse_outlines(config: Path, data: Path, work: Path) -> Cohort:
    """Closed outlines of mouse vertebrae with six expert landmarks each."""
    out = work / "mice"
    sets = [
        f"input.scans={data}/contours/*.csv",
        f"input.cohort={data}/cohort.csv",
        f"input.landmarks={data}/landmarks.csv",
    ]
    run_to_fit(config, out, *sets)
    ids, splines, matrices = fitted(out)
    every = read_landmarks(data / "landmarks.csv")
    marks = {i: {n: m[:2, :2] @ p + m[:2, 3] for n, p in every[i].items()} for i, m in zip(ids, matrices, strict=True)}
    size = float(np.mean([np.linalg.norm(np.ptp(s.control_points, axis=0)) for s in splines]))

    def error(points: np.ndarray, grid: tuple[int, ...]) -> tuple[float, float]:
        edges = edge_indices(grid[0], True)
        transfers = landmark_transfer(points, edges, ids, marks, max_distance=0.05 * size)
        e = np.concatenate([t.off_diagonal() for t in transfers])
        return float(e.mean()), float(np.percentile(e, 95))

    optimize = dict(PRESETS["curve"].stages)["optimize"]
    n_coefficients = tuple(optimize["n_coefficients"])
    name = f"{len(ids)} outlines of mouse vertebrae, expert landmarks"
    return Cohort(name, "units", splines, error, tuple(optimize["landmarks"]), n_coefficients, closed=True)


def _largest_disk(mesh: TriMesh) -> np.ndarray:
    """Return the faces of the largest geodesic disk around a vertex that meets no opening."""
    edges = unique_edges(mesh.faces).vertices
    graph = adjacency(mesh).astype(float)
    graph[edges[:, 0], edges[:, 1]] = edge_lengths(mesh, edges)
    graph[edges[:, 1], edges[:, 0]] = edge_lengths(mesh, edges)
    rim = np.concatenate(boundary_loops(mesh.faces))
    best, size = None, 0
    for centre in range(0, mesh.n_vertices, 7):
        distance = dijkstra(graph, indices=centre)
        for share in (0.95, 0.8, 0.65):
            inside = distance < share * distance[rim].min()
            keep = inside[mesh.faces].all(axis=1)
            if (
                keep.sum() > size
                and euler_characteristic(mesh.faces[keep]) == 1
                and len(boundary_loops(mesh.faces[keep])) == 1
            ):
                best, size = keep, int(keep.sum())
                break
    if best is None:
        raise ValueError("no disk found")
    return np.flatnonzero(best)
