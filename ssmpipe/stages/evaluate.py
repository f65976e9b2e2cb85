"""Measure the model before and after, carry landmarks, and rebuild every shape from the others."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig, Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.evaluation.landmark_transfer import landmark_transfer
from ssmpipe.core.evaluation.measures import compactness, generalization, specificity
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.outline.outline import Outline, edge_indices
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.stages._quality import measure_quality


class Config(StageConfig):
    """Options of ``evaluate``."""

    n_specificity_samples: Annotated[int, Field(ge=10, description="Random instances for specificity.")] = 1000
    max_landmark_distance: Annotated[
        Annotated[float, Field(gt=0)] | Literal["auto"],
        Field(
            description="A landmark farther from the corresponded surface does not lie on it and is left out [mm]; auto: 8 mm, "
            "for planar curves a twentieth of the mean size.",
        ),
    ] = "auto"
    reconstruction_modes: Annotated[
        Annotated[int, Field(ge=0)] | Literal["all"],
        Field(
            description="Modes of the model of all other shapes that rebuild the one left out, for quality.csv; all: as many as there are."
        ),
    ] = "all"
    n_distance_samples: Annotated[
        int,
        Field(
            ge=100,
            description="Points spread over each surface for the mean, median and p99 of quality.csv; a fifth of them on curves.",
        ),
    ] = 10000


def run(
    *,
    correspondence: Correspondence,
    landmarks: dict[str, Landmarks] | None,
    transform: dict[str, Floats],
    mesh: dict[str, TriMesh] | None = None,
    contour: dict[str, Outline] | None = None,
    surface: dict[str, BSplineSurface | BSplineCurve] | None = None,
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """Both correspondences get the same treatment and the same random draws."""
    stages = {"initial": correspondence.initial_points, "optimized": correspondence.points}
    columns: dict[str, list[Any]] = {
        name: []
        for name in (
            "correspondence",
            "n_modes",
            "compactness",
            "compactness_error",
            "generalization",
            "generalization_se",
            "specificity",
            "specificity_se",
        )
    }
    seed = int(ctx.rng.integers(2**63))
    n_shapes, n_points = correspondence.points.shape[:2]
    for label, points in stages.items():
        variances = principal_components(points)[2]
        ratio, error = compactness(variances / n_points, n_shapes)
        n_modes = max(n_shapes - 2, 1)
        general, general_se = generalization(points, n_modes)
        specific, specific_se = specificity(
            points, n_modes, n_samples=cfg.n_specificity_samples, rng=np.random.default_rng(seed)
        )
        for m in range(min(n_modes, len(specific))):
            row = (label, m + 1, ratio[m], error[m], general[m], general_se[m], specific[m], specific_se[m])
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value if isinstance(value, (str, int)) else float(value))
        ctx.metric(f"generalization_1_mode_{label}_mm", float(general[0]))
    comment = (
        f"generalization, specificity and their standard errors: RMS per point [{ctx.unit}]; compactness: cumulative variance "
        f"ratio [-]; compactness_error: sum of sqrt(2/n_S) lambda [{ctx.unit}^2 per point]"
    )
    made: dict[str, Any] = {
        "measures": Table(columns, comment),
        "landmark_transfer": _transfer(correspondence, landmarks or {}, transform, cfg, ctx),
    }
    if n_shapes > 2 and (mesh or contour or surface):
        n_used = None if cfg.reconstruction_modes == "all" else cfg.reconstruction_modes
        made["quality"], made["reconstructions"] = measure_quality(
            correspondence, mesh or contour or {}, surface or {}, transform, n_used, cfg.n_distance_samples, ctx
        )
    return made


def _transfer(
    correspondence: Correspondence,
    landmarks: dict[str, Landmarks],
    transform: dict[str, Floats],
    cfg: Config,
    ctx: Context,
) -> Table:
    """Landmark transfer over all ordered pairs, one row per landmark and correspondence, and one for all of them."""
    columns: dict[str, list[Any]] = {
        name: []
        for name in ("landmark", "correspondence", "n_shapes", "n_pairs", "mean_mm", "median_mm", "p95_mm", "max_mm")
    }
    cells, limit = correspondence.faces, 8.0
    if not len(cells):
        closed = correspondence.topology == "curve-closed"
        cells = edge_indices(correspondence.points.shape[1], closed)
        limit = 0.05 * float(np.linalg.norm(np.ptp(correspondence.points, axis=1), axis=1).mean())
    if cfg.max_landmark_distance != "auto":
        limit = cfg.max_landmark_distance
    marks = {}
    for i, matrix in zip(correspondence.ids, correspondence.transform, strict=True):
        if i in landmarks:
            marks[i] = dict(landmarks[i].transformed(matrix @ np.linalg.inv(transform[i])).points)
    for label, points in (("initial", correspondence.initial_points), ("optimized", correspondence.points)):
        transfers = landmark_transfer(points, cells, correspondence.ids, marks, max_distance=limit)
        rows = [(t.name, len(t.ids), t.off_diagonal()) for t in transfers]
        if rows:
            rows.append(("all", max(n for _, n, _ in rows), np.concatenate([e for _, _, e in rows])))
            ctx.metric(f"landmark_transfer_{label}_mm", float(rows[-1][2].mean()))
        for name, n_shapes, errors in rows:
            values = (
                name,
                label,
                n_shapes,
                len(errors),
                errors.mean(),
                np.median(errors),
                np.percentile(errors, 95),
                errors.max(),
            )
            for column, value in zip(columns, values, strict=True):
                columns[column].append(value if isinstance(value, (str, int)) else float(value))
    comment = f"distance between a carried landmark and the shape's own one, over all ordered pairs [{ctx.unit}]"
    if ctx.unit != "mm":
        comment += f"; columns whose names end in _mm are in {ctx.unit}"
    return Table(columns, comment)


STAGE = Stage(
    name="evaluate",
    scope="cohort",
    version=5,  # with rims: free, the way back leaves out what lies beyond the part that the model covers
    config=Config,
    run=run,
    inputs=(
        Port("correspondence", "correspondence"),
        Port("landmarks", "landmarks", optional=True),
        Port("transform", "transform"),
        Port("mesh", "trimesh", optional=True),
        Port("contour", "outline", optional=True),
        Port("surface", "surface", optional=True),
    ),
    outputs=(
        Port("measures", "table"),
        Port("landmark_transfer", "table"),
        Port("quality", "table", optional=True),
        Port("reconstructions", "arrays", optional=True),
    ),
    methods="Compactness, leave-one-out generalization and specificity were computed before and after the optimization"
    " ({n_specificity_samples} random instances). Every shape was reconstructed by the model of all others, and the distance between"
    " the reconstruction and the prepared surface was measured both ways.",
    cites=("styner2003", "li2015"),
)
