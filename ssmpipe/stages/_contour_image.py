"""The stage ``contour`` for photographs and masks."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.errors import LandmarkError
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.outline.picture import Picture
from ssmpipe.core.outline.segmentation import Method, find_outline
from ssmpipe.stages._contour_ends import Ends, begun, directed, with_ends


class Config(StageConfig):
    """Options of ``contour`` for photographs and masks."""

    method: Annotated[
        Method,
        Field(
            description="How the shape is told from the background. mask: the picture has two values, or transparent pixels; skin: by "
            "its redness, on a plain background; silhouette: by its difference from the picture's edge; auto: the first of these "
            "that works."
        ),
    ] = "auto"
    longest_side: Annotated[
        int,
        Field(
            ge=64,
            description="Larger pictures are averaged over blocks before; coordinates stay those of the file [pixels].",
        ),
    ] = 2000
    closed: Annotated[
        Literal["auto"] | bool,
        Field(
            description="Whether the last point joins the first; auto: unless the shape leaves the picture, or there are landmarks of "
            "the roles `start` and `end`. A closed outline follows the picture's edge where the shape leaves it."
        ),
    ] = "auto"
    start: Annotated[
        Literal["farthest", "first"],
        Field(
            description="First point of a closed outline without a landmark of role `start`: farthest from the centroid, or as it is "
            "found; align may move it."
        ),
    ] = "farthest"
    ends: Ends = "given"
    stem_radii: Annotated[
        float,
        Field(
            gt=1,
            description="Where the stem is cut, from the centre of the largest inscribed circle [radii of it]; with ends: stem.",
        ),
    ] = 1.5


def run(image: Picture, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Find the outline of the largest object; it runs counter-clockwise with x right and y up, or from start to end."""
    marks = landmarks if landmarks is not None else Landmarks()
    found = find_outline(image, cfg.method, longest_side=cfg.longest_side)
    ctx.metric("method", found.method)
    ctx.metric("separation", found.separation)
    _say_oddities(found.n_leaves, found.other_share, ctx)
    outline = found.outline if cfg.closed is True else found.opened
    if cfg.closed is False and outline.closed:
        outline = Outline(outline.ring, False)
    _check_landmarks(outline, found.outline, marks, ctx)
    outline = with_ends(outline, marks, closed=cfg.closed, ends=cfg.ends, stem_radii=cfg.stem_radii, ctx=ctx)
    if outline.closed:
        outline = begun(outline, marks, cfg.start)
        ctx.metric("area_mm2", outline.signed_area)
    else:
        outline = directed(outline, marks)
    ctx.metric("n_points", len(outline.points))
    ctx.metric("length_mm", outline.length)
    ctx.metric("closed", outline.closed)
    return {"contour": outline}


def _say_oddities(n_leaves: int, other_share: float, ctx: Context) -> None:
    if n_leaves > 1:
        ctx.warn(
            f"the shape leaves the picture at {n_leaves} places; at all but the widest the outline follows the picture's edge: "
            "leave the shape out, or take a picture that shows all of it"
        )
    if other_share > 0.3:
        ctx.warn(
            f"another object has {100 * other_share:.0f} % of the area of the largest, which is taken; "
            "check the outline, or cut the picture"
        )


def _check_landmarks(outline: Outline, closed: Outline, marks: Landmarks, ctx: Context) -> None:
    """Refuse a picture whose landmarks lie elsewhere than its outline; name those that are far from it."""
    if not marks.points:
        return
    names = sorted(marks.points)
    places = np.array([marks.points[name] for name in names])
    distances = point_to_segments(places, closed.points, closed.edges)[0]
    limit = 0.05 * outline.diagonal
    far = [k for k in np.argsort(-distances, kind="stable") if distances[k] > limit]
    if len(far) == len(names) and len(names) > 2:
        raise LandmarkError(
            f"all {len(names)} landmarks are more than {limit:.3g} pixels away from the outline that was found",
            "check that they belong to this picture, in pixels with y down, or set contour.method",
        )
    ends = [marks.roles.get(role, role) for role in ("start", "end")]
    role = next((k for k in far if names[k] in ends), None)
    if role is not None:
        raise LandmarkError(
            f"landmark '{names[role]}' is {distances[role]:.1f} pixels away from the outline, at most {limit:.3g} is accepted",
            "move it to the outline, or set contour.method",
        )
    if far:
        ctx.warn(
            f"{len(far)} of {len(names)} landmarks are more than {limit:.3g} pixels away from the outline, farthest "
            f"'{names[far[0]]}' with {distances[far[0]]:.1f}; check the outline, or landmarks that do not lie on it"
        )


IMAGE = Stage(
    name="contour",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("image", "image"), Port("landmarks", "landmarks", optional=True)),
    outputs=(Port("contour", "outline"),),
    methods="Outlines were taken from pictures (method: {method}) by Fisher's linear discriminant of the colours, with a background that "
    "may vary quadratically, and traced halfway between the colours on both sides of the edge.",
    cites=(),
    roles=("start", "end"),
)
