"""Map the surface one-to-one to the unit square; what is not a disk with period 1 in u."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.align.affine_icp import affine_onto
from ssmpipe.core.align.rigid import apply
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError, GeometryError, LandmarkError, TopologyError
from ssmpipe.core.mesh.topology import compact, euler_characteristic, face_components
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import (
    aligned_axes,
    corners_of_any_rim,
    follow_each_other,
    insert_corners,
    order_corners,
    places_on_rim,
    rim_axes,
    rim_fractions,
    rim_of,
    split_chords,
)
from ssmpipe.core.parameterize.cone import parameterize_poles
from ssmpipe.core.parameterize.distortion import folded
from ssmpipe.core.parameterize.poles import apex_of, ends_of
from ssmpipe.core.parameterize.seam import Seam
from ssmpipe.core.parameterize.slim import parameterize_slim
from ssmpipe.core.parameterize.stretch import parameterize_square
from ssmpipe.core.parameterize.traced import parameterize_traced
from ssmpipe.core.parameterize.tube import parameterize_tube
from ssmpipe.core.result import Result

_QUARTERS = "quarters of the rim"
ROLES = ("corner_1", "corner_2", "corner_3", "corner_4")
POLE_ROLES = ("apex", "antapex", "seam")
_REMEDY_CARRIED = (
    "see whether it is of the other side (align.chirality: best-fit) or was cut far from where the others were; else give landmarks "
    "with the roles corner_1 to corner_4"
)
_REMEDY_OWN = "give landmarks with the roles corner_1 to corner_4"
Vector = tuple[float, float, float]


class Config(StageConfig):
    """Options of parameterize."""

    topology: Annotated[
        Literal["auto", "disk", "tube", "cone", "closed"],
        Field(
            description="What the surface is. auto: a tube where it was cut open, else a disk; disk: one rim, laid around the square; "
            "tube: cut open, rims at v = 0 and v = 1 by arc length, periodic in u; cone: one rim (v = 0) and an apex (v = 1), periodic "
            "in u; closed: two poles, periodic in u."
        ),
    ] = "auto"
    seam: Annotated[
        Literal["periodic", "straight"],
        Field(
            description="Cut of a tube in the square. periodic: where the map is smooth across it; straight: u = 0, by arc length."
        ),
    ] = "periodic"
    cone: Annotated[
        Literal["periodic", "traced"],
        Field(
            description="How u of a cone is found. periodic: one solve with period 1, then relaxed; traced, for comparison: between two "
            "traced lines of steepest ascent of v, in two regions, not relaxed (max_iterations has no part in it)."
        ),
    ] = "periodic"
    method: Annotated[
        Literal["mean-value-stretch", "slim"],
        Field(
            description="How a disk is relaxed. mean-value-stretch: averages weighted by the stretch of the neighbours; slim: least "
            "symmetric Dirichlet energy, which punishes shrinking as well."
        ),
    ] = "mean-value-stretch"
    corner_angles_deg: Annotated[
        tuple[float, float, float, float],
        Field(
            description="Places of the four corners around the rim's centroid, from the first to the second corner axis [deg]."
        ),
    ] = (45.0, 135.0, 225.0, 315.0)
    corner_axes: Annotated[
        Literal["frame", "aligned", "rim"],
        Field(
            description="Axes in which the angles count. frame: x and y of the aligned frame; aligned: the axes of the aligned "
            "frame turned into the plane of the rim; rim: the principal axes of the rim, each shape's own."
        ),
    ] = "frame"
    weighting: Annotated[
        Literal["mean-value", "harmonic", "uniform"],
        Field(description="Weights of the first map; only harmonic may fold."),
    ] = "mean-value"
    eta: Annotated[
        float, Field(ge=0, le=1, description="Exponent of the neighbour's stretch in the relaxation [-].")
    ] = 0.5
    max_iterations: Annotated[int, Field(ge=0, description="Rounds of stretch relaxation at most [count].")] = 50
    n_remap: Annotated[
        int,
        Field(
            ge=0,
            le=50,
            description="Coefficients of the monotone changes of u and of v that end a map with poles; 0 makes none [count].",
        ),
    ] = 10
    places: Annotated[
        Literal["reference", "own"],
        Field(
            description="Poles and corners where no landmarks have these roles. reference: those of the reference of align, carried to "
            "every shape by an affine registration; own: each shape's own. Without a reference each shape has its own."
        ),
    ] = "reference"
    seam_direction: Annotated[
        Vector,
        Field(
            description="Side on which u = 0 runs where a map has poles and no landmark has the role seam, in the aligned frame [-]."
        ),
    ] = (0.0, 1.0, 0.0)
    pole_direction: Annotated[
        Vector,
        Field(
            description="The end of a closed surface that lies farther along it is the apex, the other one the antapex, where no "
            "landmarks have these roles; in the aligned frame [-]."
        ),
    ] = (1.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        if not any(self.seam_direction) or not any(self.pole_direction):
            raise ValueError("seam_direction and pole_direction must not be zero vectors")
        if 0 < self.n_remap < 4:
            raise ValueError("n_remap must be 0 or at least 4")
        if self.method == "slim" and self.topology not in ("auto", "disk"):
            raise ValueError(f"method: slim is for topology: disk, not for {self.topology}")
        if self.cone == "traced" and self.topology != "cone":
            raise ValueError(f"cone: traced is for topology: cone, not for {self.topology}")
        return self


def run(
    mesh: TriMesh,
    landmarks: Landmarks | None = None,
    seam: Seam | None = None,
    reference: TriMesh | None = None,
    *,
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """Parameterize one shape by its corners, its seam or its poles."""
    reference = None if reference is None or cfg.places == "own" else _first_piece(reference)
    topology = cfg.topology
    if topology == "auto":
        topology = "disk" if seam is None else seam.topology
    if cfg.method == "slim" and topology != "disk":
        raise ConfigError(
            f"parameterize.method: slim is for a disk, this is a {topology}", "method: mean-value-stretch"
        )
    ctx.metric("topology", topology)
    if topology == "disk":
        return _square(mesh, landmarks, reference, cfg, ctx)
    if topology == "tube":
        if seam is None or seam.topology != "tube":
            raise TopologyError(
                "a tube must be cut open before it is parameterized", "put the stage cut before parameterize"
            )
        return _tube(mesh, seam, cfg, ctx)
    return _poles(mesh, landmarks if landmarks is not None else Landmarks(), reference, topology, cfg, ctx)


def _first_piece(reference: TriMesh) -> TriMesh:
    """Return the first shape of a reference that is a whole group (align.reference: group)."""
    piece = face_components(reference.faces)
    return reference if piece.max() == 0 else compact(reference, piece == 0)


def _tube(mesh: TriMesh, seam: Seam, cfg: Config, ctx: Context) -> dict[str, Any]:
    """See :func:`ssmpipe.core.parameterize.tube.parameterize_tube`."""
    if cfg.seam == "straight":
        mesh = split_chords(mesh)
    result = parameterize_tube(
        mesh, seam, sides=cfg.seam, weighting=cfg.weighting, eta=cfg.eta, max_iterations=cfg.max_iterations
    )
    _report(result, mesh, cfg, ctx)
    return {"mesh": mesh, "uv": result.value, "seam": seam}


def _report(result: Result[Floats], mesh: TriMesh, cfg: Config, ctx: Context) -> None:
    stretch = result.history["stretch"]
    ctx.metric("stretch_before", float(stretch[0]))
    ctx.metric("stretch", float(stretch[-1]))
    ctx.metric("n_iterations", result.n_iterations)
    ctx.metric("n_flips", int(folded(result.value, mesh.faces).sum()))
    ctx.metric("n_vertices", mesh.n_vertices)
    ctx.metric("n_faces", mesh.n_faces)
    ctx.metric("euler_characteristic", euler_characteristic(mesh.faces))
    if result.status == "out-of-iterations" and cfg.max_iterations > 0:
        ctx.warn(f"stretch still fell after {result.n_iterations} iterations; raise parameterize.max_iterations")


def _poles(
    mesh: TriMesh,
    marks: Landmarks,
    reference: TriMesh | None,
    topology: Literal["cone", "closed"],
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """See :func:`ssmpipe.core.parameterize.cone.parameterize_poles` and :mod:`ssmpipe.core.parameterize.traced`."""
    apex, seam_point = marks.role("apex"), marks.role("seam")
    antapex = marks.role("antapex") if topology == "closed" else None
    ctx.metric("apex_from", "landmark" if apex is not None else "geometry" if reference is None else "reference")
    ctx.metric("seam_from", "direction" if seam_point is None else "landmark")
    if topology == "closed" and (apex is None) != (antapex is None):
        raise LandmarkError(
            f"a closed surface needs both poles; missing: {'apex' if apex is None else 'antapex'}",
            "assign the missing one in input.roles, or none of the two to let geometry decide",
        )
    if apex is not None and seam_point is not None:
        reference = None
    onto = np.eye(4) if reference is None else affine_onto(reference, mesh)
    if apex is None:
        poles = apply(onto, _own_poles(mesh if reference is None else reference, topology, cfg, ctx))
        antapex, apex = (None if topology == "cone" else poles[0]), poles[-1]
    assert apex is not None
    # heights along the direction where the shape lies on the reference
    side = np.linalg.inv(onto[:3, :3]).T @ np.array(cfg.seam_direction)
    if cfg.cone == "traced":
        found = parameterize_traced(mesh, apex, seam_point=seam_point, seam_direction=side, n_remap=cfg.n_remap)
        ctx.metric("kink", found.kink)
    else:
        found = parameterize_poles(
            mesh,
            apex,
            antapex,
            seam_point=seam_point,
            seam_direction=side,
            eta=cfg.eta,
            max_iterations=cfg.max_iterations,
            n_remap=cfg.n_remap,
        )
    ctx.metric("stretch_before", float(found.stretch[0]))
    ctx.metric("stretch", float(found.stretch[-1]))
    ctx.metric("n_iterations", found.n_rounds)
    ctx.metric("n_flips", 0)
    ctx.metric("n_flips_harmonic", found.n_folds_harmonic)
    ctx.metric("pole_ring_percent", [float(100.0 * r) for r in found.ring])
    if ctx.metrics["apex_from"] == "landmark":
        wanted = [p for p in (antapex, apex) if p is not None]
        made = found.mesh.vertices[list(found.seam.poles)]
        ctx.metric("pole_distance_max_mm", float(np.linalg.norm(made - wanted, axis=1).max()))
    ctx.metric("apex_mm", [float(x) for x in found.mesh.vertices[found.seam.poles[-1]]])
    ctx.metric("n_vertices", found.mesh.n_vertices)
    ctx.metric("n_faces", found.mesh.n_faces)
    ctx.metric("euler_characteristic", euler_characteristic(found.mesh.faces))
    if found.n_folds_harmonic:
        ctx.warn(
            f"the harmonic map turned {found.n_folds_harmonic} triangles over, so negative weights were raised; smooth or decimate "
            "the mesh first to avoid it"
        )
    if not found.settled and cfg.max_iterations > 0:
        ctx.warn(f"stretch still fell after {found.n_rounds} iterations; raise parameterize.max_iterations")
    return {"mesh": found.mesh, "uv": found.uv, "seam": found.seam}


def _own_poles(mesh: TriMesh, topology: Literal["cone", "closed"], cfg: Config, ctx: Context) -> Floats:
    """Return the apex, (1, 3), or antapex and apex, (2, 3), that geometry tells."""
    if topology == "cone":
        return apex_of(mesh)[None]
    antapex, apex, factor, cosine = ends_of(mesh, np.array(cfg.pole_direction))
    ctx.metric("long_axis_factor", factor)
    if factor < 1.1:
        ctx.warn(
            f"the surface has no distinct longest way (the next one is within {100 * (factor - 1):.0f} %), so its poles are nearly "
            "arbitrary; assign landmarks to apex and antapex"
        )
    if cosine < 0.3:
        ctx.warn(
            "the poles lie across parameterize.pole_direction, so which one is the apex is nearly arbitrary; set the direction along "
            "the surface, or assign landmarks to apex and antapex"
        )
    return np.array([antapex, apex])


def _square(
    mesh: TriMesh, landmarks: Landmarks | None, reference: TriMesh | None, cfg: Config, ctx: Context
) -> dict[str, Any]:
    """See :func:`ssmpipe.core.parameterize.stretch.parameterize_square`."""
    wanted, source = _wanted_corners(mesh, landmarks, reference, cfg, ctx)
    with_corners, corners, away = insert_corners(mesh, wanted)
    disk = split_chords(with_corners)
    try:
        ordered = order_corners(rim_of(disk), corners)
    except GeometryError as error:
        if source == "landmarks":
            raise
        raise GeometryError(error.fact, _REMEDY_CARRIED if source == "reference" else _REMEDY_OWN) from error
    if cfg.method == "slim":
        result = parameterize_slim(disk, ordered, weighting=cfg.weighting, max_iterations=cfg.max_iterations)
    else:
        result = parameterize_square(
            disk, ordered, weighting=cfg.weighting, eta=cfg.eta, max_iterations=cfg.max_iterations
        )
    _report(result, disk, cfg, ctx)
    ctx.metric("corners_from", source)
    if source == "landmarks":
        ctx.metric("corner_distance_max_mm", float(away.max()))
    return {"mesh": disk, "uv": result.value, "seam": None}


def _wanted_corners(
    mesh: TriMesh, landmarks: Landmarks | None, reference: TriMesh | None, cfg: Config, ctx: Context
) -> tuple[Floats, str]:
    given = [landmarks.role(role) if landmarks is not None else None for role in ROLES]
    missing = [role for role, point in zip(ROLES, given, strict=True) if point is None]
    if not missing:
        return np.array(given), "landmarks"
    if len(missing) < 4:
        raise LandmarkError(
            f"the square needs all four corners; missing: {', '.join(missing)}",
            "assign the missing ones in input.roles, or none of the four to let geometry decide",
        )
    if reference is not None:
        corners, source = _own_corners(reference, cfg, ctx)
        carried = apply(affine_onto(reference, mesh), corners)
        if source != _QUARTERS:
            return carried, "reference"
        rim = rim_of(mesh)
        at = rim_fractions(mesh, rim, carried)
        if follow_each_other(at):
            return carried, f"reference, {source}"
        # such a rim bends so that nearest places may change their order: the first one leads, the others follow by arc length
        along = rim_fractions(reference, rim_of(reference), corners)
        return places_on_rim(mesh, rim, at[0] + along - along[0]), "reference, by arc length from the first"
    return _own_corners(mesh, cfg, ctx)


def _own_corners(mesh: TriMesh, cfg: Config, ctx: Context) -> tuple[Floats, str]:
    """Return the four places of the rim that geometry tells, and how."""
    rim = rim_of(mesh)
    axes, ratio = rim_axes(mesh, rim) if cfg.corner_axes == "rim" else (np.eye(3)[:2], np.inf)
    if cfg.corner_axes == "aligned":
        axes, margin = aligned_axes(mesh, rim)
        if margin < 0.1:
            ctx.warn(
                "the rim lies askew to the aligned frame, so the choice of its axes is nearly arbitrary; assign landmarks to "
                "corner_1 to corner_4"
            )
    if ratio < 1.1:
        ctx.warn(
            f"the rim is nearly round (its axes differ by {100 * (ratio - 1):.0f} %), so its principal axes are arbitrary; "
            "assign landmarks to corner_1 to corner_4, or use corner_axes: aligned"
        )
    corners, quarters = corners_of_any_rim(mesh, rim, cfg.corner_angles_deg, axes)
    if quarters:
        ctx.warn(
            "the rim bends so much that no four corners can be seen from its centroid; they lie at quarters of its length, from the place "
            f"farthest under {cfg.corner_angles_deg[0]:g} degrees; assign landmarks to corner_1 to corner_4 if that does not suit"
        )
    return corners, _QUARTERS if quarters else cfg.corner_axes


STAGE = Stage(
    name="parameterize",
    scope="shape",
    version=5,
    config=Config,
    run=run,
    inputs=(
        Port("mesh", "trimesh"),
        Port("landmarks", "landmarks", optional=True),
        Port("seam", "seam", optional=True),
        Port("reference", "trimesh", optional=True),
    ),
    outputs=(Port("mesh", "trimesh"), Port("uv", "uv"), Port("seam", "seam", optional=True)),
    methods="Surfaces were mapped to the unit square ({weighting} weights, boundary by arc length between four corners) and their "
    "stretch was minimized.",
    cites=("floater2003", "yoshizawa2004", "li2015"),
    roles=(*ROLES, *POLE_ROLES),
)
