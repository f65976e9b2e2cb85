"""Close the holes of a surface, and remove the stumps of branches that were cut off.

Every boundary loop is closed unless it is an opening: the `keep_openings` longest loops, or those at the landmarks with
roles opening_1 and opening_2. A hole in a wall gets a patch that continues the curvature around it; the stump of a branch is
first removed to its base.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.arrays import Ints
from ssmpipe.core.errors import LandmarkError, TopologyError
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.filling import fill
from ssmpipe.core.repair.holes import check_loops
from ssmpipe.core.repair.stump import flatten
from ssmpipe.core.repair.tube_ends import opening_at

OPENINGS = ("opening_1", "opening_2")
STUMPS = tuple(f"stump_{k}" for k in range(1, 9))


class Config(StageConfig):
    """Options of fill-holes."""

    keep_openings: Annotated[
        int,
        Field(ge=0, description="Number of loops that stay open: those at landmarks first, then the longest [count]."),
    ] = 0
    opening_share: Annotated[
        float,
        Field(
            ge=0,
            lt=1,
            description="A loop shorter than this share of the longest one is a hole, even if fewer than keep_openings stay open "
            "then; 0: length does not matter [-].",
        ),
    ] = 0.0
    method: Annotated[
        Literal["auto", "implicit", "biharmonic", "membrane"],
        Field(
            description="Shape of a patch: implicit (continues the curvature through noise), biharmonic (smooth at the rim), "
            "membrane (flattest), or auto: biharmonic for holes of a few edges, otherwise implicit."
        ),
    ] = "auto"
    smooth_iterations: Annotated[
        int,
        Field(ge=0, description="Taubin iterations on the copy of the surroundings that a patch continues [count]."),
    ] = 20
    stumps: Annotated[
        Literal["auto", "landmarks", "none"],
        Field(
            description="Which holes are stumps: those around which the girth stays narrow and then opens, only those at landmarks "
            "with roles stump_1 to stump_8, or none: all are closed where they are."
        ),
    ] = "auto"
    stump_reach_mm: Annotated[float, Field(gt=0, description="Longest stump that is looked for [mm].")] = 25.0
    stump_margin_mm: Annotated[
        float, Field(ge=0, description="Distance beyond a stump's base where it is cut [mm].")
    ] = 1.5
    stump_radius_mm: Annotated[
        float | None,
        Field(
            gt=0,
            description="All within this distance of a landmark with role stump_k is removed, on the surface [mm].",
        ),
    ] = None


def run(mesh: TriMesh, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Fill the holes of one shape; see :mod:`ssmpipe.core.repair.filling` and :mod:`ssmpipe.core.repair.stump`."""
    check_loops(mesh)
    marks = landmarks if landmarks is not None else Landmarks()
    openings = _openings(mesh, marks, cfg.keep_openings, cfg.opening_share, ctx)
    places = [] if cfg.stumps == "none" else [p for p in map(marks.role, STUMPS) if p is not None]
    before = len(boundary_loops(mesh.faces))
    flat, holes, removed = flatten(
        mesh,
        openings,
        reach=cfg.stump_reach_mm,
        margin=cfg.stump_margin_mm,
        marks=places,
        mark_radius=cfg.stump_radius_mm,
        search=cfg.stumps == "auto",
    )
    filled, patches = fill(flat, holes, method=cfg.method, n_smooth=cfg.smooth_iterations)
    ctx.metric("n_loops_before", before)
    ctx.metric("n_openings_kept", len(openings))
    ctx.metric("n_stumps_removed", len(removed))
    ctx.metric("stump_lengths_mm", [round(done.length, 2) for done in removed])
    ctx.metric("n_filled", len(patches))
    ctx.metric("loop_lengths_mm", [round(p.length, 2) for p in patches])
    ctx.metric("places_mm", [[round(c, 2) for c in p.middle] for p in patches])
    ctx.metric("methods", [p.method for p in patches])
    ctx.metric("noise_mm", [round(p.noise, 4) for p in patches])
    ctx.metric("new_faces", [p.n_faces for p in patches])
    ctx.metric("euler_characteristic", euler_characteristic(filled.faces))
    for patch in patches:
        if patch.width > patch.radius:
            ctx.warn(
                f"the hole of {patch.length:.1f} mm at ({', '.join(f'{c:.1f}' for c in patch.middle)}) mm is {patch.width:.1f} mm "
                f"wide, as wide as the surface is curved (radius {patch.radius:.1f} mm): its patch is a guess; look at it"
            )
    return {"mesh": filled}


def _openings(mesh: TriMesh, marks: Landmarks, n: int, share: float, ctx: Context) -> list[Ints]:
    loops = sorted(boundary_loops(mesh.faces), key=lambda loop: -loop_length(mesh, loop))
    chosen: list[int] = []
    for role in OPENINGS:
        mark = marks.role(role)
        if mark is None:
            continue
        meant = opening_at(mesh, loops, mark)
        if meant is None:
            ctx.warn(
                f"no opening lies within its own diameter of the landmark with role {role}: is the surface closed there?"
            )
        elif meant in chosen:
            raise LandmarkError(
                f"opening_1 and opening_2 lie at the same loop of {loop_length(mesh, loops[meant]):.1f} mm",
                "put each landmark at its own opening",
            )
        else:
            chosen.append(meant)
    least = share * max((loop_length(mesh, loop) for loop in loops), default=0.0)
    large = [k for k in range(len(loops)) if k not in chosen and loop_length(mesh, loops[k]) >= least]
    chosen += large[: max(0, n - len(chosen))]
    if len(chosen) < n and share == 0:
        raise TopologyError(
            f"the surface has {len(loops)} boundary loops, {n} shall stay open (fill-holes.keep_openings)",
            "lower fill-holes.keep_openings, or open the scan",
        )
    return [loops[k] for k in chosen]


STAGE = Stage(
    name="fill-holes",
    scope="shape",
    version=3,  # landmarks of openings in their middles
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"), Port("landmarks", "landmarks", optional=True)),
    outputs=(Port("mesh", "trimesh"),),
    methods="Holes were closed by patches that continue the curvature around them (method {method}); stumps of branches were "
    "removed to their bases first.",
    roles=(*OPENINGS, *STUMPS),
)
