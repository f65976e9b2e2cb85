"""What the synthetic spline cohorts have in common: arc length of a dense polyline, and the files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.surface import BSplineSurface


def arc_parameters(points: Floats) -> Floats:
    """Return the share of the arc length at every point of a dense polyline, from 0 to 1."""
    sums = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.asarray(sums / sums[-1])


def shape_ids(name: str, n: int) -> list[str]:
    """Return ``name_01 ...``."""
    return [f"{name}_{i + 1:02d}" for i in range(n)]


def write_splines(
    out_dir: Path,
    ids: Sequence[str],
    splines: Sequence[BSplineCurve | BSplineSurface],
    names: Sequence[str],
    landmarks: Floats,
    truth: Mapping[str, Any],
    description: Mapping[str, Any],
) -> None:
    """Write ``scans/<id>.npz``, ``landmarks.csv``, ``truth.npz`` and ``truth.json``; the same input gives the same bytes.

    Parameters
    ----------
    out_dir : Path
    ids : sequence of str
    splines : sequence of BSplineCurve or BSplineSurface
    names : sequence of str
        Of the landmarks.
    landmarks : (n_S, n_names, d) float64
    truth : mapping of str to array
    description : mapping
        Plain JSON data.
    """
    scans = Path(out_dir) / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    for shape_id, spline in zip(ids, splines, strict=True):
        arrays = {"degree": np.array(spline.degrees), "control_points": spline.control_points}
        _savez(scans / f"{shape_id}.npz", arrays | dict(zip(("knots_u", "knots_v"), spline.knot_vectors, strict=False)))
    write_truth(out_dir, ids, names, landmarks, truth, description)


def write_truth(
    out_dir: Path,
    ids: Sequence[str],
    names: Sequence[str],
    landmarks: Floats,
    truth: Mapping[str, Any],
    description: Mapping[str, Any],
) -> None:
    """Write ``landmarks.csv``, ``truth.npz`` and ``truth.json``; parameters as in :func:`write_splines`."""
    rows = [",".join(("id", "landmark", *"xyz"[: landmarks.shape[2]]))]
    for shape_id, points in zip(ids, landmarks, strict=True):
        rows += [",".join((shape_id, name, *map(repr, p))) for name, p in zip(names, points.tolist(), strict=True)]
    (Path(out_dir) / "landmarks.csv").write_text("\n".join(rows) + "\n", encoding="utf-8", newline="\n")
    arrays = {"ids": np.array(ids), "landmark_names": np.array(names), "landmarks": landmarks, **truth}
    _savez(Path(out_dir) / "truth.npz", arrays)
    text = json.dumps({"ids": list(ids), **description}, indent=1)
    (Path(out_dir) / "truth.json").write_text(text + "\n", encoding="utf-8", newline="\n")


def _savez(path: Path, arrays: Mapping[str, Any]) -> None:
    np.savez(path, **arrays)
