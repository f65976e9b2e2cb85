"""The stage ``fit`` for planar outlines."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.arrays import Floats
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, edge_indices, resample
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.fit_curve import Spacing, curve_points, fewest_control_points, fit_curve

_PER_CONTROL = 8
_MOST_CONTROL = 500
"""Where a tolerance is given; the solves for more take minutes."""


class Config(StageConfig):
    """Options of ``fit`` for outlines."""

    degree: Annotated[int, Field(ge=1, le=5, description="Degree of the spline.")] = 2
    n_control: Annotated[
        int, Field(ge=4, description="Control points, the same number for all shapes; see tolerance_mm [count].")
    ] = 80
    tolerance_mm: Annotated[
        float | None,
        Field(
            gt=0,
            description="RMS distance between outline and spline, the larger of both ways (points: given, of the points from the spline) "
            "[mm, or file units]. Each shape gets as few control points as keep it, and n_control is not read; optimize brings the "
            "shapes to common knots, exactly. The largest distance lies at corners and falls more slowly. null: n_control.",
        ),
    ] = None
    points: Annotated[
        Literal["polyline", "given"],
        Field(
            description="What is fitted. polyline: the outline with its edges, read at equal steps, so that sparse or uneven points do "
            "no harm; given: its points alone."
        ),
    ] = "polyline"
    parameters: Annotated[
        Spacing,
        Field(
            description="Parameters of given points: arc-length (of the fitted curve), chord, centripetal, or uniform (by number)."
        ),
    ] = "arc-length"
    fairness: Annotated[
        float,
        Field(
            ge=0,
            description="Weight of the squared second derivative [-]; the default only bridges spans without points.",
        ),
    ] = 1e-12
    max_rms: Annotated[
        float,
        Field(
            gt=0,
            description="Warn when the RMS distance between outline and spline exceeds this share of the size [-].",
        ),
    ] = 0.005


class _Fit(NamedTuple):
    """A curve, and its distances from the outline and the outline's points from it."""

    curve: BSplineCurve
    to_spline: Floats
    to_outline: Floats


def run(contour: Outline, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Fit, and report RMS and maximum distance both ways."""
    n_control = cfg.n_control if cfg.tolerance_mm is None else _fewest(contour, cfg, cfg.tolerance_mm)
    curve, to_spline, to_outline = _fitted(contour, n_control, cfg)
    ctx.metric("n_control", n_control)
    for name, distance in (("contour_to_spline", to_spline), ("spline_to_contour", to_outline)):
        ctx.metric(f"{name}_rms_mm", _rms(distance))
        ctx.metric(f"{name}_max_mm", float(distance.max()))
    rms = max(ctx.metrics["contour_to_spline_rms_mm"], ctx.metrics["spline_to_contour_rms_mm"])
    if rms > cfg.max_rms * contour.diagonal:
        ctx.warn(
            f"the spline is {rms:.3g} RMS away from the outline ({100 * rms / contour.diagonal:.2f} % of its size); "
            + ("raise fit.n_control" if cfg.tolerance_mm is None else "lower fit.tolerance_mm")
        )
    return {"surface": curve}


def _fitted(contour: Outline, n_control: int, cfg: Config) -> _Fit:
    data = contour
    if cfg.points == "polyline":
        data = resample(contour, max(len(contour.points), _PER_CONTROL * n_control))
    curve = fit_curve(
        data.points,
        degree=cfg.degree,
        n_control=n_control,
        closed=contour.closed,
        parameters=cfg.parameters,
        fairness=cfg.fairness,
    )
    dense = curve_points(curve, np.linspace(0.0, 1.0, 20 * n_control + 1))
    return _Fit(
        curve,
        point_to_segments(contour.points, dense, edge_indices(len(dense), False))[0],
        point_to_segments(dense, contour.points, contour.edges)[0],
    )


def _fewest(contour: Outline, cfg: Config, tolerance: float) -> int:
    """Return how many control points keep the tolerance; given points say nothing of the way between them."""

    def rms(n_control: int) -> float:
        fit = _fitted(contour, n_control, cfg)
        ways = [fit.to_spline, fit.to_outline] if cfg.points == "polyline" else [fit.to_spline]
        return max(_rms(way) for way in ways)

    return fewest_control_points(rms, tolerance, least=max(4, cfg.degree + 3), most=_MOST_CONTROL)


def _rms(distance: Floats) -> float:
    return float(np.sqrt((distance**2).mean()))


OUTLINE = Stage(
    name="fit",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("contour", "outline"),),
    outputs=(Port("surface", "surface"),),
    methods="A B-spline curve of degree {degree} with {n_control} control points was fitted to each outline by least squares "
    "({parameters} parameters; tolerance that decides on the number instead [mm]: {tolerance_mm}).",
    cites=("piegl1997",),
)
