"""The model as the viewer reads it: 16-bit points, about a tenth of the size of decimal text."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.evaluation.locating import locate
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.outline.outline import edge_indices
from ssmpipe.report.figures import CATEGORIES

BUDGET = 2_400_000  # bytes of quantized modes; beyond it the last modes are left out of the viewer (not of the model)
MAX_GROUPS = 8
OFF_SURFACE = 0.05  # of the size: a landmark farther away than this is not on the corresponded part


@dataclass(frozen=True)
class Group:
    """Shapes (by number) that have the same value in a column of the cohort table."""

    column: str
    value: str
    members: tuple[int, ...]
    colour: str


def cohort_columns(ids: Sequence[str], shapes: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the columns of the cohort table by name, one text per id, empty where there is none.

    Examples
    --------
    >>> cohort_columns(["a", "b"], {"a": {"info": {"side": "L", "age": 40}}, "b": {"info": {"side": None}}})
    {'side': ['L', ''], 'age': ['40', '']}
    """
    info = [(shapes.get(i) or {}).get("info") or {} for i in ids]
    names = dict.fromkeys(name for row in info for name in row)
    columns = {name: ["" if row.get(name) is None else str(row[name]) for row in info] for name in names}
    return {name: column for name, column in columns.items() if any(column)}


def groups_of(columns: Mapping[str, Sequence[str]]) -> list[Group]:
    """Return the groups that the columns of a cohort table make: two to eight values, at least one of them twice.

    Examples
    --------
    >>> [(g.value, g.members) for g in groups_of({"side": ["L", "R", "L"], "name": ["x", "y", "z"]})]
    [('L', (0, 2)), ('R', (1,))]
    """
    found = []
    for name, column in columns.items():
        values = sorted({value for value in column if value})
        if not 2 <= len(values) <= MAX_GROUPS or len(values) == sum(bool(value) for value in column):
            continue
        for value, colour in zip(values, CATEGORIES, strict=False):
            found.append(Group(name, value, tuple(i for i, other in enumerate(column) if other == value), colour))
    return found


def landmark_places(
    points: Floats, faces: np.ndarray, topology: str, marks: Sequence[Mapping[str, Floats]]
) -> list[dict[str, Any]]:
    """Return where the landmarks of every shape lie on its corresponded surface: shape, points of the cell, weights.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    faces : (n_F, 3) int64
    topology : str
    marks : sequence of mapping name -> (d,)
        One per shape, in the frame of ``points``.
    """
    cells = faces if len(faces) else edge_indices(points.shape[1], topology == "curve-closed")
    places: dict[str, list[Any]] = {}
    for k, own in enumerate(marks):
        if not own:
            continue
        names = sorted(own)
        distance, cell, weights = locate(np.array([own[name][: points.shape[2]] for name in names]), points[k], cells)
        near = OFF_SURFACE * float(np.linalg.norm(np.ptp(points[k], axis=0)))
        for name, d, c, w in zip(names, distance, cell, weights, strict=True):
            if d <= near:
                places.setdefault(name, []).append([k, cells[c].tolist(), [round(float(x), 4) for x in w]])
    return [
        {"name": name, "colour": CATEGORIES[i % len(CATEGORIES)], "places": places[name]}
        for i, name in enumerate(sorted(places))
    ]


def in_space(points: Floats) -> Floats:
    """Return (..., 3) points: planar ones are put into the plane z = 0.

    Examples
    --------
    >>> in_space(np.ones((2, 2)))
    array([[1., 1., 0.],
           [1., 1., 0.]])
    """
    pad = 3 - points.shape[-1]
    return np.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, pad)]) if pad else points


def _base64(array: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


def quantized(points: Floats) -> dict[str, Any]:
    """Return points rounded to 1/65535 of the longest side of their box."""
    points = in_space(points)
    low = points.min(axis=0)
    step = float((points.max(axis=0) - low).max() / 65535) or 1.0
    data = _base64(np.rint((points - low) / step), "<u2")
    return {"offset": [float(x) for x in low], "step": step, "data": data}


def quantized_map(name: str, values: Floats) -> dict[str, Any]:
    """Return one number per point, rounded to 1/32767 of the largest."""
    step = float(np.abs(values).max(initial=0.0)) / 32767 or 1.0
    return {"name": name, "step": step, "data": _base64(np.rint(values / step), "<i2")}


def viewer_payload(
    model: ShapeModel,
    *,
    look: tuple[float, float],
    unit: str,
    groups: Sequence[Group] = (),
    landmarks: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Return what ``viewer.js`` needs, ready for JSON.

    Points of the mean are rounded to 1/65535 of the longest side of their box, displacements for one standard deviation of a
    mode to 1/32767 of its largest entry.
    """
    mean = in_space(model.mean)
    n_modes = max(1, min(len(model.modes), BUDGET // (mean.size * 2)))
    displacement = in_space(model.modes[:n_modes]) * np.sqrt(model.variances[:n_modes])[:, None, None]
    steps = np.abs(displacement).reshape(len(displacement), mean.size).max(axis=1, initial=0.0) / 32767
    steps = np.where(steps > 0, steps, 1.0)
    return {
        "n_points": len(mean),
        "grid": [int(n) for n in model.grid],
        "topology": str(model.topology),
        "unit": unit,
        "look": [float(angle) for angle in look],
        "mean": quantized(mean),
        "modes": {
            "step": [float(s) for s in steps],
            "data": _base64(np.rint(displacement / steps[:, None, None]), "<i2"),
        },
        "faces": _base64(model.faces, "<u2" if len(mean) <= 65535 else "<u4"),
        "scores": [[round(float(x), 4) for x in row[:n_modes]] for row in model.scores],
        "groups": [{"column": g.column, "members": list(g.members), "colour": g.colour} for g in groups],
        "landmarks": list(landmarks),
    }
