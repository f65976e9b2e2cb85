"""A made-up run with everything a report needs: bumpy caps whose bump moves, without any file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssmpipe.contract import Table
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.model.shape_model import ShapeModel

STAGES = ("repair", "orient", "trim", "smooth", "decimate", "align", "parameterize", "sample", "fit")


@dataclass(frozen=True)
class SmallRun:
    record: dict[str, Any]
    correspondence: Correspondence
    model: ShapeModel
    measures: Table
    landmark_transfer: Table
    history: Table
    certificate: dict[str, Any]
    quality: Table
    landmarks: dict[str, dict[str, np.ndarray]]

    def arguments(self) -> dict[str, Any]:
        return dict(vars(self))


def grid_faces(n_1: int, n_2: int) -> np.ndarray:
    at = np.arange(n_1 * n_2).reshape(n_1, n_2)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    return np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def cap(uv: np.ndarray, size: float, place: float, height: float) -> np.ndarray:
    """A dome of about 80 mm that opens upwards, with two rounded bumps below; ``uv`` is (n, 2)."""
    x, y = 2 * uv[:, 0] - 1, 2 * uv[:, 1] - 1
    # square to disk, then disk to dome
    dx, dy = x * np.sqrt(1 - y * y / 2), y * np.sqrt(1 - x * x / 2)
    r = np.hypot(dx, dy)
    theta, phi = 0.72 * np.pi * r, np.arctan2(dy, dx)
    out = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi) * 0.8, -np.cos(theta)], axis=1)
    for side, k in ((-1, 1.0), (1, 0.8)):
        centre = np.array([0.55 * side, -0.25 + place, -0.75])
        out += out * (height * k * np.exp(-((out - centre) ** 2).sum(axis=1) / 0.16))[:, None]
    return 40 * size * out


def small_run(
    ids: tuple[str, ...] = ("P01_left", "P02_right", "P03_left", "P04_right", "P05_left", "P06_right"),
    n: int = 21,
    n_modes: int = 5,
) -> SmallRun:
    rng = np.random.default_rng(7)
    axis = np.linspace(0, 1, n)
    uv = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    bubble = (uv[:, 0] * (1 - uv[:, 0]) * uv[:, 1] * (1 - uv[:, 1]))[:, None]
    n_shapes = len(ids)
    size, place, height = (
        1 + 0.06 * rng.standard_normal(n_shapes),
        0.1 * rng.standard_normal(n_shapes),
        rng.uniform(0.2, 0.5, n_shapes),
    )
    parameters = np.stack(
        [
            uv + bubble * a * np.array([np.sin(3 * uv[:, 1]), np.cos(4 * uv[:, 0])]).T
            for a in rng.normal(0, 1.1, n_shapes)
        ]
    )
    parameters[0] = uv
    initial = np.stack([cap(uv, *p) for p in zip(size, place, height, strict=True)])
    points = np.stack([cap(d, *p) for d, *p in zip(parameters, size, place, height, strict=True)])
    faces = grid_faces(n, n)
    centred = (points - points.mean(axis=0)).reshape(n_shapes, -1)
    _, singular, modes = np.linalg.svd(centred, full_matrices=False)
    k = min(n_modes, n_shapes - 1)
    variances = singular[:k] ** 2 / (n_shapes - 1)
    modes = modes[:k].reshape(k, -1, 3)
    model = ShapeModel(
        ids,
        points.mean(axis=0),
        modes,
        variances,
        centred @ modes.reshape(k, -1).T / np.sqrt(variances),
        (n, n),
        faces,
        "disk",
    )
    eigenvalues = singular[:-1] ** 2 / (n_shapes - 1)
    correspondence = Correspondence(
        ids, points, points, initial, initial, np.tile(np.eye(4), (n_shapes, 1, 1)), np.ones(n_shapes), parameters, (n, n), faces,
        "disk", 0, np.array([27.61, 14.79]), 1e-3, eigenvalues * 1.4, eigenvalues, np.zeros((n_shapes, 8, 8, 2)),
    )  # fmt: skip
    m = np.arange(1, k + 1)
    share = np.cumsum(variances) / variances.sum()
    measures = Table(
        {
            "correspondence": ["initial"] * k + ["optimized"] * k,
            "n_modes": [*m, *m],
            "compactness": [*(share * 0.93), *share],
            "compactness_error": [*(3.4 * share), *(2.9 * share)],
            "generalization": [*(2.4 / m**0.35), *(1.5 / m**0.4)],
            "generalization_se": [*(0.3 / m**0.5), *(0.2 / m**0.5)],
            "specificity": [*(2.6 * m**0.1), *(1.9 * m**0.12)],
            "specificity_se": [0.05] * 2 * k,
        }
    )
    marks = ["lateral epicondyle", "medial epicondyle", "notch", "all"]
    transfer = Table(
        {
            "landmark": marks * 2,
            "correspondence": ["initial"] * 4 + ["optimized"] * 4,
            "n_pairs": [n_shapes * (n_shapes - 1)] * 8,
            "mean_mm": [3.9, 3.1, 3.2, 3.4, 2.8, 2.6, 2.3, 2.58],
            "p95_mm": [7.1, 6.2, 6.0, 6.6, 5.9, 5.1, 4.4, 5.2],
        }
    )
    step = np.arange(60)
    history = Table(
        {
            "iteration": step,
            "elapsed_s": step * 0.08,
            "description_length": 14.79 + 12.82 * np.exp(-step / 9),
            "max_constraint": -0.02 - 0.4 * np.exp(-step / 15),
            "min_jacobian": 0.12 + 0.88 * np.exp(-step / 12),
        }
    )
    bounds = 0.12 + 0.1 * rng.random(n_shapes)
    certificate = {
        "shapes": {
            i: {"lower_bound": float(b), "status": "proved", "method": "Bezier coefficients"}
            for i, b in zip(ids, bounds, strict=True)
        }
    }
    quality = small_quality(ids, rng)
    near = {"notch": n * (n // 2) + n // 2, "epicondyle": n * (n // 4) + n // 3}
    landmarks = {i: {name: points[k, p] + rng.normal(0, 0.5, 3) for name, p in near.items()} for k, i in enumerate(ids)}
    return SmallRun(
        small_record(ids), correspondence, model, measures, transfer, history, certificate, quality, landmarks
    )


def planar_run(topology: str) -> SmallRun:
    """The same with outlines in the plane, which all are a circle."""
    run = small_run()
    n_shapes, n = len(run.model.ids), 30
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    mean = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    u = np.tile(np.linspace(0, 1, n)[:, None], (n_shapes, 1, 1))
    shared = {"grid": (n,), "faces": np.zeros((0, 3), dtype=np.int64), "topology": topology}
    model = replace(
        run.model,
        mean=mean,
        modes=np.ones((2, n, 2)) / n,
        variances=np.array([2.0, 1.0]),
        scores=run.model.scores[:, :2],
        **shared,
    )
    planar = {
        name: np.tile(mean, (n_shapes, 1, 1))
        for name in ("points", "points_scan", "initial_points", "initial_points_scan")
    }
    marks = {i: {name: p[:2] / 40 for name, p in own.items()} for i, own in run.landmarks.items()}
    correspondence = replace(run.correspondence, parameters=u, **planar, **shared)
    return replace(run, model=model, correspondence=correspondence, landmarks=marks)


def small_quality(ids: tuple[str, ...], rng: np.random.Generator) -> Table:
    """As ``evaluate`` writes it: worst first."""
    rows = []
    for i in ids:
        size, mean = 100 + 10 * rng.random(), 0.5 + rng.random()
        row: dict[str, Any] = {"id": i, "is_reference": int(i == ids[0]), "n_modes": len(ids) - 2, "bbox_diag": size}
        for block, factor in (("", 1.0), ("back_", 1.1), ("fit_", 0.05), ("fit_back_", 0.06)):
            for word, times in (("mean", 1.0), ("median", 0.8), ("p99", 3.0), ("max", 4.0)):
                row[f"{block}{word}_dist"] = factor * times * mean
                row[f"{block}norm_{word}"] = factor * times * mean / size
        rows.append(row)
    rows.sort(key=lambda row: -max(row["norm_p99"], row["back_norm_p99"]))
    return Table({name: [row[name] for row in rows] for name in rows[0]}, "worst first; [mm]")


def small_record(ids: tuple[str, ...]) -> dict[str, Any]:
    rng = np.random.default_rng(3)
    shapes: dict[str, Any] = {}
    for key in ids:
        raw = int(rng.integers(14000, 26000))
        sizes = {
            "repair": raw - 12,
            "orient": raw - 12,
            "trim": raw // 2,
            "smooth": raw // 2,
            "decimate": 5040,
            "align": 5040,
        }
        stages = []
        for i, name in enumerate(STAGES, start=1):
            metrics: dict[str, Any] = {}
            if name in sizes:
                metrics = {"n_vertices": sizes[name], "n_faces": 2 * sizes[name] - 40}
            if name == "repair":
                metrics |= {"n_vertices_in": raw, "n_faces_in": 2 * raw}
            if name == "fit":
                metrics = {"rms_mm": float(rng.uniform(0.05, 0.09)), "max_mm": float(rng.uniform(0.4, 0.9))}
            stages.append(
                {"stage": name, "folder": f"{i:02d}-{name}", "status": "done", "metrics": metrics, "warnings": []}
            )
        shapes[key] = {
            "file": f"{key}.stl",
            "info": {
                "side": "L" if "left" in key else "R",
                "age": str(rng.integers(40, 80)),
                "site": "here" if len(shapes) % 3 else "there",
            },
            "stages": stages,
        }
    first = shapes[ids[0]]["stages"][0]
    first["warnings"] = ["2 small components with 41 faces in all were dropped; keep them with repair.components=all"]
    shapes["P99_broken"] = {
        "info": {"side": "L"},
        "stages": [{"stage": "repair", "folder": "01-repair", "status": "failed"}],
    }
    return {
        "name": "Distal femora",
        "ssmpipe_version": "0.1.0",
        "versions": {"python": "3.11.9", "numpy": "2.4.6", "scipy": "1.17.1", "libigl": "2.6.3", "trimesh": "5.2.0"},
        "machine": {"system": "Linux", "n_cpus": 2},
        "config": {
            "name": "Distal femora",
            "input": {"units": "mm"},
            "stages": [{"optimize": {"landmarks": [51, 51]}}],
            "seed": 0,
        },
        "seed": 0,
        "shapes": shapes,
        "cohort_stages": [
            {"stage": "optimize", "metrics": {"n_iterations": 60, "status": "converged"}, "warnings": []}
        ],
        "failures": {
            "P99_broken": {
                "stage": "repair",
                "error": "the surface has 2 handles (genus 2)",
                "remedy": "segment again, or choose the preset 'closed' only for surfaces without handles",
            }
        },
        "methods": [
            {
                "stage": "smooth",
                "sentence": "Surfaces were smoothed with 10 steps of Taubin's filter.",
                "cites": ["taubin1995"],
            },
            {
                "stage": "decimate",
                "sentence": "They were reduced to 10000 faces by quadric edge collapse.",
                "cites": ["garland1997"],
            },
            {
                "stage": "optimize",
                "sentence": "Correspondence was found by minimizing the description length over B-spline reparameterizations.",
                "cites": ["li2015", "davies2002", "thodberg2003"],
            },
        ],
    }
