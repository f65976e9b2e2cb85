"""The stage ``align`` for planar outlines."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from ssmpipe.contract import Context, Landmarks, NamesShape, Port, Stage
from ssmpipe.core.align.rigid import reflection
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError, GeometryError
from ssmpipe.core.outline.align import OutlineFit, align_outline, medoid_outline, mirror_outline, move_outline
from ssmpipe.core.outline.outline import Outline, start_at
from ssmpipe.stages._chirality import ChiralityConfig, warn_of_both_images


class Config(ChiralityConfig):
    """Options of ``align`` for outlines."""

    reference: Annotated[
        str,
        NamesShape(("medoid",)),
        Field(
            description="Outline to align to: `medoid` (the most central one), a shape id, or a file in the aligned frame."
        ),
    ] = "medoid"
    n_points: Annotated[
        int,
        Field(ge=16, description="Points at equal arc lengths that are matched, and starting points tried [count]."),
    ] = 256
    start: Annotated[
        Literal["match", "keep"],
        Field(
            description="First point of closed outlines. match: all are tried, unless a landmark has the role `start`; keep: as it is."
        ),
    ] = "match"
    chirality_margin: Annotated[
        float, Field(ge=0, lt=1, description=ChiralityConfig.model_fields["chirality_margin"].description)
    ] = 0.2


def prepare(inputs: dict[str, dict[str, Any]], *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Choose the reference among the outlines of the cohort."""
    outlines: dict[str, Outline] = {shape_id: slots["contour"] for shape_id, slots in sorted(inputs.items())}
    if cfg.reference != "medoid" and cfg.reference not in outlines:
        some = ", ".join(list(outlines)[:5]) + (", ..." if len(outlines) > 5 else "")
        raise ConfigError(
            f"align.reference: there is no shape '{cfg.reference}'; the cohort has {some}",
            "use one of these ids, medoid, or a file",
        )
    keep = cfg.start == "keep" or all(_has_start(slots.get("landmarks")) for slots in inputs.values())
    chosen = medoid_outline(outlines, keep_start=keep) if cfg.reference == "medoid" else cfg.reference
    ctx.metric("reference", chosen)
    return {"reference": outlines[chosen]}


def _has_start(marks: Landmarks | None) -> bool:
    return marks is not None and marks.role("start") is not None


def run(
    contour: Outline,
    transform: Floats,
    reference: Outline,
    landmarks: Landmarks | None = None,
    *,
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """Align one outline; see :func:`ssmpipe.core.outline.align.align_outline`."""
    if contour.closed != reference.closed:
        kinds = ("closed", "open") if contour.closed else ("open", "closed")
        raise GeometryError(
            f"the outline is {kinds[0]}, the reference is {kinds[1]}",
            "set contour.closed to true or false for all shapes",
        )
    marks = landmarks if landmarks is not None else Landmarks()
    keep = cfg.start == "keep" or _has_start(marks)
    fit = align_outline(contour, reference, n=cfg.n_points, keep_start=keep)
    if cfg.chirality == "best-fit" or cfg.check_mirror:
        mirrored = mirror_outline(contour)
        other = align_outline(mirrored, reference, n=cfg.n_points, keep_start=keep)
        if _mirrored_wins(fit, other, cfg, ctx):
            flip = reflection(0)
            contour, marks, transform, fit = mirrored, marks.transformed(flip), flip @ transform, other
    aligned = move_outline(contour, fit.matrix)
    if aligned.closed and not keep:
        aligned = start_at(aligned, fit.start)
    ctx.metric("rms_mm", fit.rms)
    ctx.metric("turned_deg", fit.angle_deg)
    ctx.metric("start_moved_share", fit.start / contour.length)
    return {"contour": aligned, "landmarks": marks.transformed(fit.matrix), "transform": fit.matrix @ transform}


def _mirrored_wins(fit: OutlineFit, other: OutlineFit, cfg: Config, ctx: Context) -> bool:
    """Say whether the mirror image is to be taken, and warn where that is open."""
    best, worst = sorted((fit.rms, other.rms))
    clear = best < (1.0 - cfg.chirality_margin) * worst
    ctx.metric("other_image_rms_mm", other.rms)
    if cfg.chirality == "keep":
        if clear and other.rms < fit.rms:
            advice = "if left and right are mixed, set align.chirality: best-fit"
            if ctx.joins:
                advice = "if it shows the other side, mirror its file"
            ctx.warn(f"the outline fits better mirrored (distance {other.rms:.3g} instead of {fit.rms:.3g}); {advice}")
        return False
    wins = other.rms < fit.rms
    ctx.metric("mirrored", wins)
    if not clear:
        warn_of_both_images(best, worst, wins, "check the picture", ctx)
    return wins


OUTLINE = Stage(
    name="align",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(
        Port("contour", "outline"),
        Port("landmarks", "landmarks", optional=True),
        Port("transform", "transform"),
        Port("reference", "outline"),
    ),
    outputs=(Port("contour", "outline"), Port("landmarks", "landmarks"), Port("transform", "transform")),
    methods="Outlines were aligned rigidly (chirality: {chirality}) to one reference ({reference}) by equal arc lengths from the best "
    "of {n_points} starting points.",
    cites=("li2015",),
    prepare=prepare,
    prepared=(Port("reference", "outline"),),
)
