"""How ``trim`` works when it cuts both ends of a tube."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError, LandmarkError
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.topology import boundary_loops, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.mesh.tube_profile import places_on_line
from ssmpipe.core.repair.sinuses import Sinuses, find_sinuses, planes_at_sinuses, sinus_valleys
from ssmpipe.core.repair.tube_ends import (
    EndPlane,
    open_closed_end,
    openings,
    planes_at_fractions,
    planes_inside_rims,
    planes_through_points,
    trim_tube,
)
from ssmpipe.stages._candidates import propose

ROLES = ("opening_1", "opening_2")


def trim_both_ends(
    mesh: TriMesh,
    marks: Landmarks,
    transform: Floats,
    ctx: Context,
    *,
    at: Literal["rims", "fractions", "landmarks", "sinuses"],
    margin: float,
    fractions: tuple[float, float],
    below_sinuses: float,
    tube_mm: float | None,
    extend_mm: float,
    snap: float,
) -> TriMesh:
    """Trim both ends of a tube and report; see :mod:`ssmpipe.core.repair.tube_ends`."""
    given = [marks.role(role) for role in ROLES]
    if at == "landmarks" and any(mark is None for mark in given):
        raise LandmarkError(
            "trim.ends_at: landmarks needs both of the roles opening_1 and opening_2",
            "assign them in input.roles, or use ends_at: rims",
        )
    if len(boundary_loops(mesh.faces)) == 1:
        mesh = open_closed_end(mesh)
        ctx.warn("one end of the tube was closed by a lid, which was removed; check the picture")
    rims = openings(mesh, given)
    if at == "landmarks":
        planes = planes_through_points(mesh, rims, [mark for mark in given if mark is not None])
    elif at == "fractions":
        planes = planes_at_fractions(mesh, rims, fractions)
    else:
        planes = planes_inside_rims(mesh, rims, margin)
    if at == "sinuses":
        planes = _by_sinuses(mesh, rims, planes, transform, ctx, below_sinuses, tube_mm, marks.role("trim"), extend_mm)
    done = trim_tube(mesh, rims, planes, extend_mm=extend_mm, snap=snap)
    ctx.metric("cut_by", at)
    for k, (removed, added) in enumerate(zip(done.removed, done.added, strict=True), start=1):
        ctx.metric(f"removed_{k}_mm", removed)
        ctx.metric(f"added_{k}_mm", added)
        if added > 0:
            ctx.warn(
                f"the scan ended {added:.1f} mm before the plane of opening {k} and was continued by the curvature of its rim; "
                "what lies there was not measured"
            )
    ctx.metric("n_vertices", done.mesh.n_vertices)
    ctx.metric("n_faces", done.mesh.n_faces)
    ctx.metric("area_mm2", area(done.mesh))
    for k, plane in enumerate(done.planes, start=1):
        rim = min(
            boundary_loops(done.mesh.faces),
            key=lambda loop: float(abs((done.mesh.vertices[loop] - plane.point) @ plane.normal).max()),
        )
        ctx.metric(f"rim_{k}_mm", loop_length(done.mesh, rim))
    return done.mesh


def _by_sinuses(
    mesh: TriMesh,
    rims: tuple[Ints, Ints],
    at_rims: tuple[EndPlane, EndPlane],
    transform: Floats,
    ctx: Context,
    below: float,
    tube_mm: float | None,
    mark: Floats | None,
    extend_mm: float,
) -> tuple[EndPlane, EndPlane]:
    """Return planes by the sinuses, or those at the rims where there are none; the report says which."""
    try:
        sinuses = find_sinuses(mesh, rims)
    except GeometryError as error:
        ignored = " (the landmark of role trim is left aside)" if mark is not None else ""
        ctx.warn(f"{error.fact}; both ends are cut just inside the rims{ignored}, at places that need not correspond")
        ctx.metric("sinuses", "not found")
        return at_rims
    if mark is not None:
        _check_upper(mark, sinuses)
    lower, upper = planes_at_sinuses(mesh, sinuses, below, tube_mm if mark is None else mark)
    other = at_rims[1 if sinuses.first else 0]
    ctx.metric("sinuses", "first end" if sinuses.first else "second end")
    ctx.metric("sinus_height_mm", sinuses.height)
    ctx.metric("junction_diameter_mm", sinuses.diameter)
    valleys = sinus_valleys(mesh, sinuses)
    propose({f"sinus_valley_{k}": place for k, place in enumerate(valleys, start=1)}, transform, ctx)
    if upper is not None:
        rim = mesh.vertices[rims[1 if sinuses.first else 0]]
        missing = -float(((rim - upper.point) @ upper.normal).min())
        if missing > extend_mm:
            wanted = f"trim.tube_mm: {tube_mm:g}" if mark is None else "the landmark of role trim"
            ctx.warn(
                f"the scan ends {missing:.1f} mm before {wanted}, "
                "more than trim.extend_mm, and is cut just inside its rim, at a place that need not correspond"
            )
        else:
            other = upper
    return (lower, other) if sinuses.first else (other, lower)


def _check_upper(mark: Floats, sinuses: Sinuses) -> None:
    beside = float(np.linalg.norm(sinuses.line - mark, axis=1).min())
    if not beside < sinuses.diameter:
        raise LandmarkError(
            f"the landmark of role trim lies {beside:.1f} mm from the centre line of the tube, which is {sinuses.diameter:.1f} mm wide",
            "put it on the wall or on the centre line, where the upper end shall be cut; check its units and its frame",
        )
    if places_on_line(sinuses.line, mark[None])[0] <= sinuses.upper:
        raise LandmarkError(
            "the landmark of role trim lies below the upper end of the sinuses",
            "put it where the upper end shall be cut",
        )
