"""Find dense correspondence across the cohort by B-spline reparameterization of minimal description length."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from ssmpipe.contract import Context, Landmarks, NamesShape, Port, Stage, StageConfig, Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.checkpoints import Checkpoints
from ssmpipe.core.correspondence.choices import boundary_of, closes, normals_of, rims_of, start_of
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.optimum import Optimum
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.reparameterization import Boundary
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.spline.evaluate import Spline
from ssmpipe.core.spline.poles import surface_topology
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.stages._optimize_certificate import certificate_of, warn_of_poles
from ssmpipe.stages._optimize_correspondence import corresponded_surfaces, correspondence_of

_DEFAULT = EngineOptions()
APART = 0.04
"""Rims that are kept and lie farther apart than this are worth a word [mean share of the parameter]; see docs/rims.md."""


class Config(StageConfig):
    """Options of ``optimize``."""

    degree: Annotated[int, Field(ge=2, le=5, description="Degree of the reparameterization.")] = _DEFAULT.degree
    n_coefficients: Annotated[
        tuple[int, ...],
        Field(description="B-spline coefficients of every reparameterization, per direction (one number for curves)."),
    ] = _DEFAULT.n_coefficients
    landmarks: Annotated[
        tuple[int, ...],
        Field(
            validate_default=True,
            description="Landmark grid of the covariance, per direction (one number for curves).",
        ),
    ] = _DEFAULT.landmarks
    boundary: Annotated[
        Literal["auto", "fixed", "sliding", "periodic"],
        Field(
            description="fixed: boundary points stay; sliding: they may slide along their edge, corners stay; periodic: "
            "closed curves, tubes and surfaces with poles, the seam may move; auto: periodic where the splines close, else fixed."
        ),
    ] = "auto"
    rims: Annotated[
        Literal["kept", "free"],
        Field(
            description="kept: rims correspond to rims. free: rims are cuts at places that differ between the shapes; the model covers the "
            "part that all shapes have, and its rims may lie anywhere on a shape."
        ),
    ] = _DEFAULT.rims
    max_crop: Annotated[
        float,
        Field(
            ge=0.01,
            le=0.45,
            description="Farthest that rims: free moves a rim of the reference inward; shapes that lack more are named "
            "[share of the parameter].",
        ),
    ] = _DEFAULT.max_crop
    covariance: Annotated[
        Literal["discrete", "I", "II"],
        Field(
            description="Landmark weights. discrete: equal; I: integral over the domain; II: integral over the mean shape."
        ),
    ] = _DEFAULT.covariance
    quadrature: Annotated[
        Literal["grid", "midpoint", "gauss", "closed-form"],
        Field(
            description="Landmarks of covariance I and II; discrete takes the grid. closed-form: curves and covariance I, the integral "
            "itself; time grows with the square of the number of shapes."
        ),
    ] = _DEFAULT.quadrature
    objective: Annotated[
        Literal["description-length", "log-determinant", "trace"],
        Field(description="Function of the eigenvalues to minimize."),
    ] = _DEFAULT.objective
    normals: Annotated[
        float | Literal["auto"],
        Field(
            description="Weight of unit normals (curves: tangents) beside positions in the covariance, so that flanks and edges count "
            "[how far shapes reach across their longest axis]; 0: positions alone, as in the thesis. auto: 0.8 for surfaces, 0 for curves "
            "and with pose: each-evaluation."
        ),
    ] = "auto"
    lambda_cut: Annotated[
        float | Literal["auto"],
        Field(description="Variance below which a mode counts as noise [mm^2]; auto: (RMS radius / 1000)^2."),
    ] = "auto"
    pose: Annotated[
        Literal["refined", "procrustes", "keep", "each-evaluation"],
        Field(
            description="Rigid poses. keep: as aligned; procrustes: refined once before, from the initial correspondence; "
            "refined: refined from the optimized correspondence, at most pose_rounds times; each-evaluation: also inside "
            "every evaluation, differentiated."
        ),
    ] = _DEFAULT.pose
    pose_rounds: Annotated[int, Field(ge=0, description="Refinements of the poses when pose is refined.")] = (
        _DEFAULT.pose_rounds
    )
    normalize: Annotated[
        Literal["none", "size", "affine"],
        Field(
            description="Removed inside the objective only; results keep it. size: sizes; affine: sizes and, after the first "
            "round, the linear map of every shape to the mean."
        ),
    ] = _DEFAULT.normalize
    prior: Annotated[
        float, Field(ge=0, description="Weight of the bending energy of every reparameterization [nat].")
    ] = _DEFAULT.prior
    barriers: Annotated[
        tuple[float, ...],
        Field(min_length=1, description="Decreasing weights of the barrier on det dD/du, one round each [nat]."),
    ] = _DEFAULT.barriers
    floor: Annotated[float, Field(ge=0, lt=1, description="Lower bound that det dD/du is kept above [-].")] = (
        _DEFAULT.floor
    )
    form: Annotated[
        Literal["bezier", "bspline", "sampled"], Field(description="Form of det dD/du that the barrier sees.")
    ] = _DEFAULT.form
    aggregate: Annotated[
        Literal["each", "ks"],
        Field(description="Barrier on each coefficient, or on their Kreisselmeier-Steinhauser aggregate."),
    ] = _DEFAULT.aggregate
    sharpness: Annotated[float, Field(gt=0, description="K of the Kreisselmeier-Steinhauser aggregate [-].")] = (
        _DEFAULT.sharpness
    )
    reference: Annotated[
        str,
        NamesShape(("nearest-to-mean", "none")),
        Field(description="Shape that is not reparameterized: nearest-to-mean, none, or a shape id."),
    ] = "nearest-to-mean"
    start: Annotated[
        Literal["auto", "identity", "affine"],
        Field(
            description="Where the maps begin. identity: as the shapes were parameterized; affine: near the closest points of the "
            "reference on every shape after an affine registration; auto: affine for surfaces with poles (cone, closed) with normalize: "
            "affine and no guides, else identity."
        ),
    ] = "auto"
    coarse_to_fine: Annotated[bool, Field(description="Solve coarser nested spaces first, by knot insertion.")] = (
        _DEFAULT.coarse_to_fine
    )
    guides: Annotated[
        tuple[str, ...],
        Field(description="Names of landmarks that guide the correspondence; empty: none, landmarks only measure."),
    ] = ()
    guide_weight: Annotated[float, Field(gt=0, description="Pull of the guides [nat / mm^2].")] = _DEFAULT.guide_weight
    guide_mode: Annotated[
        Literal["penalty", "interpolate"],
        Field(description="interpolate: every guide is met exactly, as a condition on the maps."),
    ] = _DEFAULT.guide_mode
    guide_tolerance: Annotated[
        float,
        Field(
            gt=0,
            description="Largest miss of an interpolated guide that no map meets exactly, on a fixed edge, say [mm].",
        ),
    ] = _DEFAULT.guide_tolerance
    sensitivity: Annotated[
        Literal["adjoint", "direct", "finite-difference"],
        Field(description="Gradient; the last two are slow, for comparison."),
    ] = _DEFAULT.sensitivity
    solver: Annotated[
        Literal["auto", "quasi-newton", "newton"],
        Field(
            description="newton: exact second derivatives; more time per iteration, deeper where the barrier is weak. auto: newton "
            "in the last round of small cohorts if its barrier weight is below 1, else quasi-newton."
        ),
    ] = _DEFAULT.solver
    max_iterations: Annotated[int, Field(ge=1, description="Iterations per round.")] = _DEFAULT.max_iterations
    relative_decrease: Annotated[
        float,
        Field(gt=0, description="A round ends when the objective falls by less than this share twice in a row [-]."),
    ] = _DEFAULT.relative_decrease

    landmark_blocks: Annotated[
        int | Literal["auto"],
        Field(
            description="Blocks of landmark rows whose sums are taken apart: the most processes that can share an iteration "
            "(--executor dask), at least 1. The last digits depend on it. auto: 4 from 64 shapes on, else 1. Covariance II, pose "
            "each-evaluation and closed-form have one."
        ),
    ] = "auto"

    @field_validator("landmark_blocks")
    @classmethod
    def _some_blocks(cls, count: int | str) -> int | str:
        if isinstance(count, int) and count < 1:
            raise ValueError("must be at least 1, or auto")
        return count

    @field_validator("normals")
    @classmethod
    def _not_negative(cls, weight: float | str) -> float | str:
        if not isinstance(weight, str) and not 0 <= weight <= 1e6:
            raise ValueError("must be 0 or more, at most 1e6, or auto")
        return weight

    @field_validator("n_coefficients")
    @classmethod
    def _enough_coefficients(cls, counts: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
        least = info.data.get("degree", _DEFAULT.degree) + 2
        if len(counts) not in (1, 2) or min(counts) < least:
            raise ValueError(
                f"needs one number (curves) or two (surfaces), each at least degree + 2 = {least}; "
                "raise it, or lower optimize.degree"
            )
        return counts

    @field_validator("landmarks")
    @classmethod
    def _enough_landmarks(cls, counts: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
        if len(counts) not in (1, 2) or min(counts) < 3:
            raise ValueError("needs one number (curves) or two (surfaces), each at least 3; raise it")
        directions = len(info.data.get("n_coefficients", counts))
        if len(counts) != directions:
            raise ValueError(
                f"optimize.landmarks has {len(counts)} numbers and optimize.n_coefficients has {directions}; "
                "give both one (curves) or both two (surfaces)"
            )
        return counts

    @model_validator(mode="after")
    def _rims_are_found(self) -> Config:
        if self.rims == "kept":
            return self
        for wrong, remedy in (
            (bool(self.guides), "guides are for rims: kept"),
            (self.start == "identity", "its start is a registration: use start: auto"),
            (self.coarse_to_fine, "coarse_to_fine is for rims: kept"),
            (len(self.n_coefficients) != 2, "curves have none: use rims: kept"),
        ):
            if wrong:
                raise ValueError(f"optimize.rims is free, but {remedy}")
        return self

    @model_validator(mode="after")
    def _normals_are_there(self) -> Config:
        if self.pose == "each-evaluation" and self.normals not in ("auto", 0):
            raise ValueError(
                f"optimize.normals is {self.normals}, but pose: each-evaluation has none: use pose: refined, or normals: 0"
            )
        return self

    @model_validator(mode="after")
    def _closed_form_exists(self) -> Config:
        if self.quadrature != "closed-form":
            return self
        for wrong, remedy in (
            (len(self.n_coefficients) != 1, "surfaces have none: use quadrature: gauss"),
            (self.covariance != "I", "only covariance I has one: set covariance: I"),
            (self.pose == "each-evaluation", "poses may not move inside an evaluation: use pose: refined"),
            (self.form == "sampled", "the maps must be increasing everywhere: use form: bezier"),
        ):
            if wrong:
                raise ValueError(f"optimize.quadrature is closed-form, but {remedy}")
        return self


def run(
    *,
    surface: dict[str, Spline],
    transform: dict[str, Floats],
    landmarks: dict[str, Landmarks] | None,
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """Optimize, prove, and carry the result back to the scans."""
    ids = tuple(sorted(surface))
    splines = [surface[i] for i in ids]
    chosen = cfg.model_dump(exclude={"lambda_cut", "reference", "boundary", "guides", "landmark_blocks", "start"})
    chosen["landmark_blocks"] = None if cfg.landmark_blocks == "auto" else cfg.landmark_blocks
    chosen["lambda_cut"] = None if cfg.lambda_cut == "auto" else cfg.lambda_cut
    topology = _topology(ids, splines)
    dimension = splines[0].dimension
    chosen["normals"] = normals_of(cfg.normals, topology=topology, dimension=dimension, pose=cfg.pose)
    chosen["boundary"] = _boundary(cfg.boundary, topology)
    chosen["open_edges"] = _rims(cfg, topology, splines)
    options = EngineOptions(**chosen, reference=_reference(cfg.reference, ids), start=_start(cfg, topology, splines))
    start = time.perf_counter()
    elapsed: list[float] = []

    def record(row: dict[str, float]) -> None:
        elapsed.append(time.perf_counter() - start)
        text = f"description length {row['description_length']:.3f}, smallest Jacobian bound {row['min_jacobian']:.3f}"
        ctx.progress(int(row["iteration"]), _expected(cfg), text)

    checkpoints = _timed(ctx.checkpoints, elapsed)
    if elapsed:
        start -= elapsed[-1]  # the time of the run that is continued counts
    result = optimize_correspondence(
        splines,
        options,
        guides=_guides(cfg.guides, ids, landmarks),
        record=record,
        checkpoints=checkpoints,
        engine=ctx.engine,
        threads=ctx.threads,
    )
    optimum = result.value
    if result.status == "out-of-iterations":
        ctx.warn(
            f"the last round stopped at {cfg.max_iterations} iterations before it settled; raise optimize.max_iterations"
        )
    before, after = optimum.description_length
    for name, value in (
        ("description_length_before", before),
        ("description_length_after", after),
        ("lambda_cut_mm2", optimum.lambda_cut),
        ("n_iterations", result.n_iterations),
        ("n_evaluations", result.n_evaluations),
        ("evaluator", optimum.evaluator),
        ("smallest_jacobian_bound", min(c.lower_bound for c in optimum.certificates)),
        ("reference", ids[optimum.reference] if optimum.reference >= 0 else "none"),
        ("boundary", options.boundary),
        ("topology", topology),
        ("normals", options.normals),
        ("normal_scale_mm", optimum.normal_scale),
    ):
        ctx.metric(name, value)
    if optimum.guide_residuals.size:
        ctx.metric("largest_guide_residual_mm", float(np.nanmax(optimum.guide_residuals)))
    unproved = [i for i, c in zip(ids, optimum.certificates, strict=True) if c.verdict != "proved"]
    if unproved:
        ctx.metric("unproved", unproved)
        ctx.warn(
            f"the reparameterization of {', '.join(unproved)} is not proved one-to-one; "
            "use optimize.form: bezier, or raise the last of optimize.barriers"
        )
    _tell_of_rims(optimum, ids, cfg, ctx)
    correspondence = correspondence_of(optimum, ids, topology, transform, options)
    certificate = certificate_of(optimum, ids, splines)
    warn_of_poles(certificate["shapes"], ctx)
    history = {key: values.tolist() for key, values in result.history.items()}
    columns = {"iteration": [int(k) for k in history.pop("iteration")], "elapsed_s": elapsed, **history}
    comment = "description_length [nat], normals included, in the pose of the moment; elapsed_s is a timing and differs from run to run"
    return {
        "correspondence": correspondence,
        "certificate": certificate,
        "history": Table(columns, comment),
        "corresponded": corresponded_surfaces(correspondence),
    }


def _tell_of_rims(optimum: Optimum, ids: tuple[str, ...], cfg: Config, ctx: Context) -> None:
    """Say what a model with free rims covers and who lacks a part of it; where rims are kept, whether they lie apart."""
    if not optimum.rim_shifts.size:
        return
    shift = float(optimum.rim_shifts.mean())
    ctx.metric("mean_rim_shift_percent", 100 * shift)
    if optimum.window is not None:
        ctx.metric("window", [list(optimum.window.low), list(optimum.window.high)])
        if optimum.lacking:
            ctx.warn(
                f"{', '.join(ids[i] for i in optimum.lacking)} end before the part that the model covers; raise optimize.max_crop "
                f"(now {cfg.max_crop:g}), cut the others shorter, or leave them out"
            )
    elif shift > APART and not cfg.guides:
        farthest = ids[int(optimum.rim_shifts.argmax())]
        ctx.warn(
            f"the rims lie at different places ({100 * shift:.1f} % of the parameter on average, most for {farthest}: "
            f"{100 * optimum.rim_shifts.max():.1f} %); if they are cuts and no anatomy, use optimize.rims: free"
        )


def _timed(checkpoints: Checkpoints | None, elapsed: list[float]) -> Checkpoints | None:
    """Return checkpoints that hold the times of the history as well; ``elapsed`` gets those of the state to continue from."""
    if checkpoints is None:
        return None
    if checkpoints.resume is not None:
        elapsed.extend(float(t) for t in checkpoints.resume["elapsed_s"])
    save = checkpoints.save
    return replace(checkpoints, save=lambda state: save({**state, "elapsed_s": np.array(elapsed)}))


def _topology(ids: tuple[str, ...], splines: list[Spline]) -> str:
    """Return what the splines are, by their control points; they must agree."""
    kinds: list[str] = []
    for spline in splines:
        if isinstance(spline, BSplineSurface):
            kinds.append(surface_topology(spline))
        else:
            ends = spline.control_points[[0, -1]]
            kinds.append("curve-closed" if np.allclose(ends[0], ends[1], rtol=0, atol=1e-9) else "curve-open")
    for i, kind in zip(ids, kinds, strict=True):
        if kind != kinds[0]:
            raise ConfigError(
                f"'{ids[0]}' is a {kinds[0]} and '{i}' is a {kind}; one model needs shapes of one topology",
                "leave one kind out, or parameterize all of them the same way",
            )
    return kinds[0]


def _start(cfg: Config, topology: str, splines: Sequence[Spline]) -> Literal["identity", "affine"]:
    return start_of(
        cfg.start,
        topology=topology,
        dimension=splines[0].dimension,
        normalize=cfg.normalize,
        guided=bool(cfg.guides),
        reference=cfg.reference,
        rims=cfg.rims,
    )


def _rims(cfg: Config, topology: str, splines: Sequence[Spline]) -> tuple[tuple[int, int], ...]:
    """Return the rims of surfaces in three dimensions; a seam that stays in place is not looked at."""
    stays = closes(topology) and _boundary(cfg.boundary, topology) != "periodic"
    rims = () if splines[0].dimension != 3 or stays else rims_of(topology)
    if cfg.rims == "free" and not rims:
        raise ConfigError(
            f"optimize.rims: free needs surfaces with rims, and a seam that may move; these are {topology} with boundary: {cfg.boundary}",
            "use rims: kept",
        )
    return rims


def _boundary(choice: Boundary | Literal["auto"], topology: str) -> Boundary:
    if choice == "periodic" and not closes(topology):
        raise ConfigError(f"optimize.boundary: periodic needs shapes that close, these are {topology}", "auto")
    return boundary_of(choice, topology)


def _expected(cfg: Config) -> int:
    """Return a rough number of iterations, for the progress bar only."""
    return 25 * (len(cfg.barriers) + (cfg.pose_rounds if cfg.pose == "refined" else 0))


def _reference(choice: str, ids: tuple[str, ...]) -> Any:
    if choice in ("nearest-to-mean", "none"):
        return choice
    if choice not in ids:
        raise ConfigError(f"optimize.reference: there is no shape '{choice}' among {', '.join(ids)}", "nearest-to-mean")
    return ids.index(choice)


def _guides(
    names: tuple[str, ...], ids: tuple[str, ...], landmarks: dict[str, Landmarks] | None
) -> list[dict[str, Floats]] | None:
    """Return the chosen landmarks per shape; every chosen name must be known to some shape."""
    if not names:
        return None
    known = landmarks or {}
    have = {n for i in ids if i in known for n in known[i].points}
    missing = [n for n in names if n not in have]
    if missing:
        raise ConfigError(
            f"optimize.guides: no shape has a landmark '{missing[0]}'",
            f"one of: {', '.join(sorted(have)) or 'none were given'}",
        )
    return [{n: p for n, p in known[i].points.items() if n in names} if i in known else {} for i in ids]


STAGE = Stage(
    name="optimize",
    scope="cohort",
    version=15,
    config=Config,
    run=run,
    inputs=(Port("surface", "surface"), Port("transform", "transform"), Port("landmarks", "landmarks", optional=True)),
    outputs=(
        Port("correspondence", "correspondence"),
        Port("certificate", "json"),
        Port("history", "table", volatile=True),
        Port("corresponded", "meshes"),
    ),
    methods="Correspondence was found by B-spline reparameterization of all shapes at once ({n_coefficients} coefficients each), "
    "minimizing the {objective} of the covariance of {landmarks} landmarks with adjoint gradients "
    "(removed inside the objective: {normalize}; weight of unit normals beside positions: {normals}, where auto is 0.8 for surfaces and "
    "0 for curves); every "
    "reparameterization was proved to be a diffeomorphism by Bernstein bounds of its Jacobian.",
    cites=("li2015", "thodberg2003", "davies2002", "thodberg2003curvature"),
)
