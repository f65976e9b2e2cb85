"""Quality of the correspondence patient by patient, for the stage ``evaluate``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ssmpipe.contract import Context, Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.evaluation.quality import Distances, Geometry, dense_spline, distances, signed_distances
from ssmpipe.core.evaluation.reconstruction import leave_one_out_reconstructions
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import Outline, edge_indices
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.surface import BSplineSurface

WORDS = ("mean", "median", "p99", "max")
COMMENT = (
    "worst first; [mm], or file units with units: none; norm_*: divided by bbox_diag, the diagonal of the prepared shape's box; "
    "no prefix: from the shape as the model of all others reconstructs it to the prepared shape; back_: the other way; "
    "fit_, fit_back_: the same for the shape's own spline; distances to the surface, means and percentiles by area"
)
WINDOW = "what lies beyond the part that the model covers (optimize.rims: free) does not count in back_"
_UNUSUAL = 3.0


def measure_quality(
    correspondence: Correspondence,
    prepared: Mapping[str, TriMesh | Outline | None],
    splines: Mapping[str, BSplineSurface | BSplineCurve],
    transform: Mapping[str, Floats],
    n_modes: int | None,
    n_samples: int,
    ctx: Context,
) -> tuple[Table, dict[str, Floats]]:
    """Return the table of all shapes, worst first, and the reconstructions with their signed distance to the prepared shape.

    A shape without a prepared mesh or contour (its scan is a spline) is compared with its spline.
    """
    c = correspondence
    n_shapes = len(c.ids)
    used = n_shapes - 2 if n_modes is None else min(n_modes, n_shapes - 2)
    rebuilt = leave_one_out_reconstructions(c.points, used)
    cells = c.faces if len(c.faces) else edge_indices(c.points.shape[1], c.topology == "curve-closed")
    rows, signed = [], []
    for k, name in enumerate(c.ids):
        moved = c.transform[k] @ np.linalg.inv(transform[name])
        spline = dense_spline(splines[name]).moved(moved) if name in splines else None
        given = prepared.get(name)
        target = _geometry(given).moved(moved) if given is not None else spline
        if target is None:
            raise AssertionError("a shape has a mesh, a contour or a spline")
        source = Geometry(rebuilt[k], cells)
        row: dict[str, Any] = {"id": name, "is_reference": int(k == c.reference), "n_modes": used}
        row["bbox_diag"] = size = target.diagonal
        pairs = [("", source, target), ("back_", target, source)]
        if spline is not None and given is not None:
            pairs += [("fit_", spline, target), ("fit_back_", target, spline)]
        for prefix, a, b in pairs:
            n = n_samples if a.cells.shape[1] == 3 else max(n_samples // 5, 1)  # a curve needs fewer than a surface
            row |= _figures(prefix, distances(a, b, n, beyond=prefix != "back_" or c.window is None), size)
        rows.append(row)
        signed.append(signed_distances(rebuilt[k], target))
        ctx.progress(k + 1, n_shapes, "reconstructed from the others")
    rows.sort(key=lambda row: (-max(row["norm_p99"], row["back_norm_p99"]), row["id"]))
    _tell(rows, ctx)
    names = [name for name in rows[0] if name != "bbox_diag"]
    names.insert(names.index("max_dist") + 1, "bbox_diag")
    comment = COMMENT if c.window is None else f"{COMMENT}; {WINDOW}"
    table = Table({name: [row[name] for row in rows] for name in names}, comment)
    return table, {"ids": np.array(c.ids), "points": rebuilt, "distance": np.stack(signed)}


def _geometry(shape: TriMesh | Outline) -> Geometry:
    if isinstance(shape, Outline):
        return Geometry(shape.points, shape.edges)
    return Geometry(shape.vertices, shape.faces)


def _figures(prefix: str, found: Distances, size: float) -> dict[str, float]:
    values = (found.mean, found.median, found.p99, found.maximum)
    plain = {f"{prefix}{word}_dist": value for word, value in zip(WORDS, values, strict=True)}
    return plain | {f"{prefix}norm_{word}": value / size for word, value in zip(WORDS, values, strict=True)}


def _tell(rows: list[dict[str, Any]], ctx: Context) -> None:
    worst = [max(row["norm_p99"], row["back_norm_p99"]) for row in rows]
    ctx.metric("reconstruction_mean_mm", float(np.mean([max(row["mean_dist"], row["back_mean_dist"]) for row in rows])))
    ctx.metric("reconstruction_p99_worst_mm", max(max(row["p99_dist"], row["back_p99_dist"]) for row in rows))
    ctx.metric("reconstruction_worst", rows[0]["id"])
    usual = float(np.median(worst))
    for row, value in zip(rows, worst, strict=True):
        if value > _UNUSUAL * usual > 0:
            ctx.warn(
                f"{row['id']}: the other shapes reproduce it {value / usual:.1f} times worse than they reproduce each other "
                f"(99 % of it within {100 * value:.2g} % of its size); look at its page in the report: a wrong side, a "
                "wrong trim, a swapped region or an unusual patient"
            )
