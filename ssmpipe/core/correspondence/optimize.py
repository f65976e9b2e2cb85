"""The group optimization: pose the cohort, choose the reference, relax the barrier round by round."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from ssmpipe.core.align.affine import affine_to_mean
from ssmpipe.core.align.procrustes import Alignment, generalized_procrustes
from ssmpipe.core.arrays import Floats
from ssmpipe.core.checkpoints import Checkpoints
from ssmpipe.core.correspondence.affine_start import affine_start, turned_identity, without_folds
from ssmpipe.core.correspondence.barrier import Aggregate, Barrier
from ssmpipe.core.correspondence.certificate import Certificate, certify
from ssmpipe.core.correspondence.direction import apply_directions, components_first, components_last
from ssmpipe.core.correspondence.exact_rule import ExactRule
from ssmpipe.core.correspondence.gauss_newton import FACTORED_UNKNOWNS
from ssmpipe.core.correspondence.guides import Guides
from ssmpipe.core.correspondence.interpolation import Interpolation
from ssmpipe.core.correspondence.jacobian import Jacobian, JacobianForm
from ssmpipe.core.correspondence.journal import Journal
from ssmpipe.core.correspondence.measure import Quadrature, grid_size_weights, landmark_rule
from ssmpipe.core.correspondence.normals import NormalFields
from ssmpipe.core.correspondence.objective import Covariance, GroupObjective
from ssmpipe.core.correspondence.open_rims import Registered, register_reference
from ssmpipe.core.correspondence.reparameterization import Boundary, Reparameterization
from ssmpipe.core.correspondence.rows import RowSums, automatic_blocks
from ssmpipe.core.correspondence.sensitivity import direct_gradient, finite_difference_gradient
from ssmpipe.core.correspondence.spectral import Objective, spectral_function
from ssmpipe.core.correspondence.turns import starting_turns
from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.engine import Engine
from ssmpipe.core.errors import FoldoverError, GeometryError, LandmarkError
from ssmpipe.core.optim.interior import DescentOptions
from ssmpipe.core.result import Result, Status
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import Spline, SplineStack
from ssmpipe.core.spline.project import nearest_parameters

Normalization = Literal["none", "size", "affine"]
Solver = Literal["auto", "newton", "quasi-newton"]
Rims = Literal["kept", "free"]
Sensitivity = Literal["adjoint", "direct", "finite-difference"]
_REFINED = ("refined", "each-evaluation")
_HINTED = 100
"""Cohorts up to this size are told how far their rims lie apart where rims are kept."""
_HINT_NODES = 26
_EARLY_DECREASE = 1e-4
"""Rounds before the last barrier weight end at this relative decrease; more would not pay."""
_ELIMINATING = 1e4
"""Guides that are held weigh so many times their weight in the preconditioner, which then nearly eliminates their conditions."""
_SLOW = {"direct": direct_gradient, "finite-difference": finite_difference_gradient}


@dataclass(frozen=True)
class EngineOptions:
    """Choices of the group optimization. The defaults come from the study in the docs, but for ``normals``: the stage weighs them.

    Parameters
    ----------
    n_coefficients : tuple of int
        Coefficients of every ``D_i`` per direction; one number for curves, two for surfaces.
    landmarks : tuple of int
        Landmark grid.
    degree : int
        Of ``D``.
    boundary : {"fixed", "sliding", "periodic"}
    rims : {"kept", "free"}
        ``kept``: rims correspond to rims. ``free``: rims are cuts, anywhere; the model covers what all shapes have
        (:mod:`.open_rims`), all shapes move and the mean of the maps stays where the start put it.
    open_edges : tuple of (direction, end)
        The rims: edges of the square that are neither seam nor pole, end 0 or -1. Given for ``kept`` too, the result tells how far
        rims lie apart.
    max_crop : float
        Farthest that ``free`` moves a rim of the reference inward [share of the parameter].
    window : Window or None
        What a model with free rims covers, for one more shape; found by the group optimization.
    covariance : {"discrete", "I", "II"}
        Equal weights; integral over the domain; integral over the mean shape, with exact gradient.
    quadrature : {"grid", "midpoint", "gauss", "closed-form"}
        Where the landmarks of the objective lie; ``discrete`` always takes the grid. ``closed-form``: the integral itself, for
        curves and covariance ``I`` (:class:`ExactRule`).
    objective : {"description-length", "log-determinant", "trace"}
    normals : float
        Weight of unit normals (curves: tangents) beside positions, in :meth:`.NormalFields.spread`; 0 is the objective of the thesis.
    lambda_cut : float or None
        Threshold of the description length [mm^2]; None for the rule of :func:`automatic_lambda_cut`.
    pose : {"refined", "procrustes", "keep", "each-evaluation"}
        ``keep``: as given. ``procrustes``: refined once before the optimization, from the initial correspondence.
        ``refined``: as given first, then refined from the optimized correspondence, ``pose_rounds`` times.
        ``each-evaluation``: the same, and inside every evaluation the landmarks of every shape are moved rigidly to the
        round's mean shape, with the exact derivative of that motion.
    pose_rounds : int
        At most so many; they end when the landmarks move by less than a thousandth of the size (root mean square).
    normalize : {"none", "size", "affine"}
        What is removed inside the objective only: nothing; sizes; sizes, and after the first round also the linear maps to the
        mean shape. Results keep sizes and shapes in every case.
    prior : float
        Weight of the bending energy of every ``D_i`` [nat].
    barriers : tuple of float
        Decreasing barrier weights, one round each; the last one is the weight of the result.
    floor : float
        Lower bound kept for every coefficient of ``det dD/du``.
    form : {"bezier", "bspline", "sampled"}
        Form of the Jacobian that the barrier sees.
    aggregate : {"each", "ks"}
        Barrier on every coefficient, or on their Kreisselmeier-Steinhauser aggregate.
    sharpness : float
        ``K`` of the aggregate.
    reference : int or {"nearest-to-mean", "none"}
    start : {"identity", "affine"}
        ``affine``, for surfaces: maps, poses and normalization begin where the reference lies closest to every shape after an
        affine registration (:func:`ssmpipe.core.correspondence.affine_start.affine_start`).
    coarse_to_fine : bool
        Whether coarser nested spaces of ``D`` are solved first, at the strongest barrier.
    guide_weight : float
        Pull of the guides [nat / mm^2].
    guide_mode : {"penalty", "interpolate"}
        ``interpolate``: every guide is met to rounding, as a linear condition on the maps that no step leaves.
    guide_tolerance : float
        Largest miss of an interpolated guide that no map can meet exactly, one on a fixed edge for example [mm].
    sensitivity : {"adjoint", "direct", "finite-difference"}
        How the gradient of the spectral function is computed; the last two are slow and for comparison.
    solver : {"auto", "newton", "quasi-newton"}
        ``newton``: truncated, with exact second derivatives; needs the adjoint. ``auto``: ``newton`` in the last round where
        its barrier weight is below 1 and the Gauss-Newton matrix is small enough to be factored, else ``quasi-newton``.
    max_iterations : int
        Per round.
    relative_decrease : float
        A round ends when the objective falls by less than this share twice in a row.
    landmark_blocks : int or None
        Blocks of landmark rows whose sums are taken apart; None for the rule of :func:`automatic_blocks`.
    """

    n_coefficients: tuple[int, ...] = (8, 8)
    landmarks: tuple[int, ...] = (51, 51)
    degree: int = 2
    boundary: Boundary = "fixed"
    rims: Rims = "kept"
    open_edges: tuple[tuple[int, int], ...] = ()
    max_crop: float = 0.15
    window: Window | None = None
    covariance: Covariance = "discrete"
    quadrature: Quadrature | Literal["closed-form"] = "midpoint"
    objective: Objective = "description-length"
    normals: float = 0.0
    lambda_cut: float | None = None
    pose: Literal["refined", "procrustes", "keep", "each-evaluation"] = "refined"
    pose_rounds: int = 6
    normalize: Normalization = "affine"
    prior: float = 0.01
    barriers: tuple[float, ...] = (30.0, 10.0, 3.0)
    floor: float = 0.0
    form: JacobianForm = "bezier"
    aggregate: Aggregate = "each"
    sharpness: float = 15.0
    reference: int | Literal["nearest-to-mean", "none"] = "nearest-to-mean"
    start: Literal["identity", "affine"] = "identity"
    coarse_to_fine: bool = False
    guide_weight: float = 1.0
    guide_mode: Literal["penalty", "interpolate"] = "penalty"
    guide_tolerance: float = 0.01
    sensitivity: Sensitivity = "adjoint"
    solver: Solver = "auto"
    max_iterations: int = 300
    relative_decrease: float = 1e-5
    landmark_blocks: int | None = None


@dataclass(frozen=True, eq=False)
class Optimum:
    """Result of the group optimization.

    Parameters
    ----------
    coefficients : (n_S, *n_b, d_par)
    parameters : (n_S, n_P, d_par)
        ``D_i(u_l)`` on the landmark grid.
    points, initial_points : (n_S, n_P, d)
        In the refined pose [mm], sizes kept.
    alignment : Alignment
        From the input frame to the refined pose.
    eigenvalues, eigenvalues_initial : (n_S - 1,)
        Inside the objective [mm^2], normals included, both in the refined pose.
    description_length : (before, after)
        Of the same.
    lambda_cut : float
    reference : int
        -1 when all shapes move.
    certificates : tuple of Certificate
    guide_residuals : (n_S, n_K)
        Distance on the surface between a guide and where it is carried [mm]; NaN where a shape lacks it.
    window : Window or None
        What the model covers of the registered reference where rims are free.
    lacking : tuple of int
        Shapes that end before the window does.
    rim_shifts : (n_S,) or empty
        By how much rims lie elsewhere than those of the reference [share of the parameter]; empty where it was not asked for.
    normals : (n_S, n_P, d), or None where they have no weight
        Unit normals in the refined pose.
    normal_scale : float
        What they were multiplied with [mm].
    evaluator : {"numpy", "numba"}
        Which one evaluated the splines; both give the same bits.
    """

    coefficients: Floats
    parameters: Floats
    points: Floats
    initial_points: Floats
    alignment: Alignment
    eigenvalues: Floats
    eigenvalues_initial: Floats
    description_length: tuple[float, float]
    lambda_cut: float
    reference: int
    certificates: tuple[Certificate, ...]
    guide_residuals: Floats = field(default_factory=lambda: np.empty((0, 0)))
    window: Window | None = None
    lacking: tuple[int, ...] = ()
    rim_shifts: Floats = field(default_factory=lambda: np.empty(0))
    normals: Floats | None = None
    normal_scale: float = 0.0
    evaluator: str = "numpy"


def automatic_lambda_cut(size: float) -> float:
    """Return the threshold ``(size / 1000)^2``: variation below a thousandth of the size counts as noise.

    Parameters
    ----------
    size : float
        Root mean square distance of the mean shape's points from their centroid [mm].

    Returns
    -------
    float
        [mm^2]. The printed rule [1.13] of the thesis is not a squared length and changes with the landmark density.

    Examples
    --------
    >>> automatic_lambda_cut(40.0)
    0.0016
    """
    return (size / 1000.0) ** 2


THREADS_FROM = 32
"""Number of shapes from which threads are used: with fewer, a busy machine takes longer to wake them than the work takes."""


def optimize_correspondence(
    splines: Sequence[Spline],
    options: EngineOptions | None = None,
    *,
    guides: Sequence[Mapping[str, Floats]] | None = None,
    record: Callable[[dict[str, float]], None] | None = None,
    checkpoints: Checkpoints | None = None,
    engine: Engine | None = None,
    threads: int = 1,
) -> Result[Optimum]:
    """Find the reparameterizations of a cohort that minimize its description length (Li 2015, ch. 2).

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        At least two; equal degree and knots; roughly aligned [mm].
    options : EngineOptions, optional
    guides : sequence of mapping name -> (d,), optional
        Named landmarks per shape, in the frame of the splines, that guide the correspondence.
    record : callable, optional
        Called after every iteration with ``iteration, description_length, max_constraint, min_jacobian``;
        ``max_constraint`` is the constraint of the barrier and is never positive.
    checkpoints : Checkpoints, optional
        Where the state goes every few iterations, and the state to continue from: result and history are the same to the bit as
        without a break. Iterations before that state are not recorded again.
    engine : Engine, optional
        Processes that share the blocks of landmark rows; the result has the same bits as without.
    threads : int, default=1
        They share the evaluation, the gradient and the preconditioner of 32 shapes or more; the result has the same bits for any
        number.

    Returns
    -------
    Result[Optimum]
        ``history`` holds the recorded columns.

    Raises
    ------
    GeometryError
        If fewer than two splines are given or they cannot be compared.
    FoldoverError
        If guides cannot be interpolated by a one-to-one map.
    """
    opts = options or EngineOptions()
    if len(splines) < 2:
        raise GeometryError(f"correspondence needs at least two shapes, got {len(splines)}")
    cohort = _Cohort(splines, opts, guides, engine, threads)
    rims = cohort.registered_rims()
    opened: Floats | None = None
    if rims is not None and opts.rims == "free":
        window = rims.window(opts.open_edges, opts.max_crop)
        opened = rims.within(window)
        opts = replace(opts, window=window, reference="none")
        cohort = _Cohort(splines, opts, guides, engine, threads)
    recorder = _Recorder(record, Journal(checkpoints))
    reparameterization = cohort.space(opts.n_coefficients)
    levels = _levels(reparameterization) if opts.coarse_to_fine else []
    first = cohort.space(levels[0] if levels else opts.n_coefficients)
    if rims is not None and opened is not None:
        coefficients = without_folds(cohort.objective(first), opened, turned_identity(first, rims.turns))
        cohort.refine_pose(coefficients, first)
    elif opts.start == "affine":
        coefficients = cohort.affine_start(first)
        cohort.refine_pose(coefficients, first)
    else:
        coefficients = turned_identity(first, cohort.turns)
    for n, n_next in pairwise([*levels, opts.n_coefficients]):
        coefficients = cohort.descend(coefficients, cohort.space(n), opts.barriers[:1], recorder)[0]
        coefficients = _refined(coefficients, cohort.space(n), cohort.space(n_next))
    if cohort.guided and opts.guide_mode == "interpolate":
        coefficients = cohort.meet_guides(coefficients, reparameterization, recorder)
    pose_rounds = opts.pose_rounds if opts.pose in _REFINED or opts.normalize == "affine" else 0
    barriers = opts.barriers
    for pose_round in range(1 + pose_rounds):
        coefficients, status = cohort.descend(coefficients, reparameterization, barriers, recorder)
        if pose_round < pose_rounds and not cohort.refine_pose(coefficients, reparameterization):
            break
        barriers = opts.barriers[-1:]
    optimum = cohort.optimum(coefficients, reparameterization)
    if rims is not None:
        lacking = rims.lacking(optimum.window) if optimum.window is not None else ()
        optimum = replace(optimum, lacking=lacking, rim_shifts=rims.rim_shifts(opts.open_edges))
    return Result(
        optimum,
        status,
        recorder.n_iterations,
        recorder.n_evaluations,
        recorder.history(),
    )


class _Cohort:
    """The splines with their current pose, and what stays fixed over all rounds."""

    def __init__(
        self,
        splines: Sequence[Spline],
        opts: EngineOptions,
        guides: Sequence[Mapping[str, Floats]] | None,
        engine: Engine | None = None,
        threads: int = 1,
    ) -> None:
        self.splines = splines
        self.engine = engine
        self.threads = threads if len(splines) >= THREADS_FROM else 1
        self.opts = opts
        n_directions = len(splines[0].degrees)
        if not len(opts.n_coefficients) == len(opts.landmarks) == n_directions:
            raise GeometryError(
                f"n_coefficients {opts.n_coefficients} and landmarks {opts.landmarks} must have one number per parameter direction, "
                f"the splines have {n_directions}"
            )
        self.output = Reparameterization(
            opts.n_coefficients,
            opts.landmarks,
            degree=opts.degree,
            boundary=opts.boundary,
            window=opts.window,
        )
        self.raw = SplineStack(splines, self.output.periodic)
        at_identity = np.repeat(self.output.evaluate(self.output.identity()[None]), len(splines), axis=0)
        self.given = self.raw.evaluate(at_identity).points
        self.alignment = self._align(self.given, keep_pose=opts.pose != "procrustes")
        self.normal = _sizes(self.alignment)
        self.turns = np.zeros(len(splines))
        start = self._normalized(self.given)
        if self.output.periodic[0] and guides is None:
            self.turns, start = self._turned(start)
        mean = start.mean(axis=0)
        self.size = float(np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean()))
        self.lambda_cut = opts.lambda_cut if opts.lambda_cut is not None else automatic_lambda_cut(self.size)
        self.spectral = spectral_function(opts.objective, self.lambda_cut)
        self.constraint = Barrier(opts.aggregate, opts.floor, opts.sharpness)
        if not 0 <= opts.normals < np.inf:
            raise GeometryError(f"normals is {opts.normals}, it must be 0 or more")
        self._fields = NormalFields(splines[0], self.output.periodic) if opts.normals > 0 else None
        self._normal_scale = opts.normals * self._fields.spread(splines) if self._fields is not None else 0.0
        if opts.reference == "none":
            self.reference = -1
        elif opts.reference == "nearest-to-mean":
            self.reference = int(((start - mean) ** 2).sum(axis=(1, 2)).argmin())
        else:
            self.reference = opts.reference
        if self.reference >= 0:
            self.turns = (self.turns - self.turns[self.reference] + 0.5) % 1.0 - 0.5
        self.guide_weight = opts.guide_weight
        self.interpolating = False
        self._guides = self._locate_guides(guides) if guides is not None else None

    def _turned(self, start: Floats) -> tuple[Floats, Floats]:
        """Return by how much each shape is turned before the descent, and the points at the start after that."""
        turns = starting_turns(start.reshape(len(start), self.output.grid[0], -1, start.shape[2]))
        if not turns.any():
            return turns, start
        coefficients = turned_identity(self.output, turns)
        return turns, self._normalized(self.raw.evaluate(self.output.evaluate(coefficients)).points)

    @property
    def guided(self) -> bool:
        return self._guides is not None

    def space(self, n_coefficients: tuple[int, ...]) -> Reparameterization:
        """Return the maps with the nodes of the objective."""
        space = Reparameterization(
            n_coefficients,
            self.opts.landmarks,
            degree=self.opts.degree,
            boundary=self.opts.boundary,
            window=self.opts.window,
        )
        return space.at(landmark_rule(space, self.opts.landmarks, self._quadrature())[0])

    def _quadrature(self) -> Quadrature:
        if self.opts.quadrature == "closed-form":
            return "gauss"
        return "grid" if self.opts.covariance == "discrete" else self.opts.quadrature

    def _rule(self, space: Reparameterization) -> ExactRule | None:
        """Return the moving nodes of the closed form."""
        if self.opts.quadrature != "closed-form":
            return None
        first = self.splines[0]
        if self.opts.covariance != "I" or not isinstance(first, BSplineCurve):
            raise GeometryError(
                "the closed form is that of covariance I and curves; a reparameterized surface is no polynomial on any fixed cells",
                "covariance: I for curves, quadrature: gauss for surfaces",
            )
        return ExactRule(space.directions[0], first.knots, first.degree)

    def objective(self, space: Reparameterization, coefficients: Floats | None = None) -> GroupObjective:
        """Return the objective in the current pose; ``coefficients`` tell the mean shape of ``each-evaluation``."""
        target = None
        if self.opts.pose == "each-evaluation" and coefficients is not None:
            target = self._normalized(self.raw.evaluate(space.evaluate(coefficients)).points).mean(axis=0)
        splines = [self._normalized_spline(i) for i in range(len(self.splines))]
        n_positions = splines[0].dimension
        if self._fields is not None:
            splines = [self._fields.beside(spline, self._normal_scale) for spline in splines]
        stack = SplineStack(splines, space.periodic, threads=self.threads)
        weights = landmark_rule(space, self.opts.landmarks, self._quadrature())[1]
        n_blocks = self.opts.landmark_blocks or automatic_blocks(len(splines))
        whole = self.opts.covariance == "II" or target is not None or self.opts.quadrature == "closed-form"
        return GroupObjective(
            stack,
            space,
            self.spectral,
            base_weights=weights,
            covariance=self.opts.covariance,
            prior=self.opts.prior,
            constraint=self.constraint,
            form=self.opts.form,
            guides=self._guides_in(space),
            reference=self.reference,
            other_gradient=_SLOW.get(self.opts.sensitivity),
            target=target,
            rule=self._rule(space),
            interpolate=self.interpolating,
            sums=None if whole or n_blocks == 1 else RowSums(splines, stack, space, weights, n_blocks, self.engine),
            n_positions=n_positions,
        )

    def descend(
        self, coefficients: Floats, space: Reparameterization, barriers: tuple[float, ...], recorder: _Recorder
    ) -> tuple[Floats, Status]:
        """Minimize at each barrier weight in turn."""
        objective = self.objective(space, coefficients)
        x = objective.unknowns(coefficients)
        recorder.start(objective, x)
        status: Status = "converged"
        for k, barrier in enumerate(barriers):
            objective.barrier = barrier
            last = k == len(barriers) - 1
            decrease = self.opts.relative_decrease if last else max(self.opts.relative_decrease, _EARLY_DECREASE)
            result = recorder.journal.descend(
                objective,
                x,
                DescentOptions(
                    max_iterations=self.opts.max_iterations,
                    relative_decrease=decrease,
                    method=self._method(x.size, barrier, last),
                ),
                partial(recorder.note_iteration, objective),
            )
            x, status = result.value, result.status
            recorder.n_iterations += result.n_iterations
            recorder.n_evaluations += result.n_evaluations
        return objective.coefficients(x), status

    def _method(self, n_unknowns: int, barrier: float, last: bool) -> Literal["newton", "quasi-newton"]:
        if self.opts.sensitivity != "adjoint":
            return "quasi-newton"
        if self.opts.solver == "auto":
            return "newton" if last and barrier < 1.0 and n_unknowns <= FACTORED_UNKNOWNS else "quasi-newton"
        return self.opts.solver

    # -- pose ----------------------------------------------------------------------------------------------------------

    def _align(self, points: Floats, *, keep_pose: bool) -> Alignment:
        """Return poses and size factors for (n_S, n_P, d) points on the grid, landmarks weighed by the size they stand for."""
        weights = grid_size_weights(points.mean(axis=0), self.output.grid, self.output.periodic)
        alignment = generalized_procrustes(points, weights, remove_size=self.opts.normalize != "none")
        if not keep_pose:
            return alignment
        unturned = np.repeat(np.eye(points.shape[2])[None], len(points), axis=0)
        return replace(alignment, rotation=unturned, translation=np.zeros((len(points), points.shape[2])))

    def _normalized(self, points: Floats) -> Floats:
        """Return (n_S, n, d) points of the input frame as the objective sees them."""
        linear, offset = self.normal
        return _apply(self.alignment, points) @ np.swapaxes(linear, 1, 2) + offset[:, None]

    def _normalized_spline(self, i: int) -> Spline:
        """Return spline ``i`` as the objective sees it; splines are affinely invariant."""
        spline = self.splines[i]
        shape = spline.control_points.shape
        linear, offset = self.normal[0][i], self.normal[1][i]
        moved = spline.control_points @ self.alignment.rotation[i].T + self.alignment.translation[i]
        return spline.with_control((moved @ linear.T + offset).reshape(shape))

    def registered_rims(self) -> Registered | None:
        """Return the reference registered with rims that may lie anywhere; None where nothing asks for it."""
        free = self.opts.rims == "free"
        if free and (not self.opts.open_edges or self.guided or self.opts.coarse_to_fine):
            raise GeometryError(
                "rims: free is for surfaces in three dimensions that have rims, and takes neither guides nor coarse_to_fine",
                "use rims: kept",
            )
        if not self.opts.open_edges or self.opts.window is not None or (not free and len(self.splines) > _HINTED):
            return None
        space, fixed = self.space(self.opts.n_coefficients), max(self.reference, 0)
        if not free:
            space = space.at((_HINT_NODES, _HINT_NODES))
        return register_reference(self.raw, space, fixed, self.opts.open_edges, turns=self.turns - self.turns[fixed])

    def affine_start(self, space: Reparameterization) -> Floats:
        """Return maps without folds near the affine closest points of the reference; see :mod:`.affine_start`."""
        if space.n_directions != 2 or self.splines[0].dimension != 3:
            raise GeometryError("start: affine is for surfaces", "use start: identity")
        fixed = max(self.reference, 0)
        turns = self.turns - self.turns[fixed]
        found = affine_start(self.raw, space, fixed, turns=turns)
        return without_folds(self.objective(space), found, turned_identity(space, turns))

    def refine_pose(self, coefficients: Floats, space: Reparameterization) -> bool:
        """Refine poses and normalization from the current correspondence; return whether that moved anything noticeably."""
        current = self.raw.evaluate(space.at(self.opts.landmarks).evaluate(coefficients)).points
        before = self._normalized(current)
        saved = self.alignment, self.normal
        self.alignment = self._align(current, keep_pose=self.opts.pose not in _REFINED)
        self.normal = _sizes(self.alignment)
        if self.opts.normalize == "affine":
            sized = self._normalized(current)
            weights = grid_size_weights(sized.mean(axis=0), self.output.grid, self.output.periodic)
            linear, offset = affine_to_mean(sized, weights)
            self.normal = linear @ self.normal[0], np.einsum("iab,ib->ia", linear, self.normal[1]) + offset
        moved = self._normalized(current) - before
        if float(np.sqrt((moved**2).sum(axis=-1).mean())) < 1e-3 * self.size:
            self.alignment, self.normal = saved
            return False
        return True

    # -- guides --------------------------------------------------------------------------------------------------------

    def _locate_guides(self, guides: Sequence[Mapping[str, Floats]]) -> tuple[Floats, Floats, Floats, np.ndarray]:
        """Return common and own parameters, tangents and presence of the guides that at least two shapes have."""
        names = sorted({n for g in guides for n in g if sum(n in other for other in guides) >= 2})
        if not names:
            raise LandmarkError(
                "no guide is marked on two shapes or more", "name landmarks that the shapes share in optimize.guides"
            )
        n_d = len(self.splines[0].degrees)
        own = np.zeros((len(self.splines), len(names), n_d))
        present = np.zeros((len(self.splines), len(names)), dtype=bool)
        for i, (spline, marks) in enumerate(zip(self.splines, guides, strict=True)):
            have = [k for k, name in enumerate(names) if name in marks]
            if have:
                own[i, have] = nearest_parameters(spline, np.array([marks[names[k]] for k in have]))[0]
                present[i, have] = True
        if self.reference >= 0:
            anchor = np.where(present[self.reference][:, None], own[self.reference], np.nan)
        else:
            anchor = np.full((len(names), n_d), np.nan)
        offset = np.where(present[..., None], own, np.nan)
        if self.output.periodic[0]:
            first = np.where(
                np.isnan(anchor[:, 0]), offset[present.argmax(axis=0), np.arange(len(names)), 0], anchor[:, 0]
            )
            offset[..., 0] -= np.round(offset[..., 0] - first)
        common = np.where(np.isnan(anchor), np.nanmean(offset, axis=0), anchor)
        return common, own, np.stack(self.raw.evaluate(own).first, axis=2), present

    def _guides_in(self, space: Reparameterization) -> Guides | None:
        if self._guides is None:
            return None
        common, own, tangents, present = self._guides
        wrapped = np.where(np.array(space.periodic), common - np.floor(common), common)
        return Guides(space, wrapped, own, tangents, present, self.guide_weight)

    def guide_residuals(self, coefficients: Floats, space: Reparameterization) -> Floats:
        """Return the (n_S, n_K) distances on the surface [mm], NaN where a shape lacks the guide."""
        guides = self._guides_in(space)
        if guides is None or self._guides is None:
            return np.empty((len(self.splines), 0))
        moved = np.einsum("ika,ikad->ikd", guides.residual(coefficients), self._guides[2])
        return np.where(self._guides[3], np.linalg.norm(moved, axis=-1), np.nan)

    def meet_guides(self, coefficients: Floats, space: Reparameterization, recorder: _Recorder) -> Floats:
        """Return one-to-one maps that meet every guide, and hold them from now on.

        The nearest maps that meet the guides may fold; then the guides pull, harder and harder, until those do not.
        """
        guides = self._guides_in(space)
        assert guides is not None
        if self.reference < 0 and not guides.present.all():
            raise LandmarkError(
                f"guides are met without a reference only if every shape has all of them; shape number "
                f"{int(guides.present.all(axis=1).argmin()) + 1} lacks one",
                "name a reference, mark the landmark, or use guide_mode: penalty",
            )
        moving = np.array([i for i in range(len(self.splines)) if i != self.reference])
        interpolation = Interpolation(guides, space.free, moving)
        jacobian = Jacobian(space, self.opts.form)
        for _ in range(9):
            met = interpolation.meet(coefficients)
            feasible = self.constraint.constraint(jacobian.coefficients(met[moving])).max() < 0
            left = float(np.nanmax(self.guide_residuals(met, space)))
            if feasible and left <= self.opts.guide_tolerance:
                self.interpolating = True
                self.guide_weight = max(self.guide_weight, _ELIMINATING * self.opts.guide_weight)
                return met
            coefficients = self.descend(coefficients, space, self.opts.barriers[:1], recorder)[0]
            self.guide_weight *= 10.0
        worst = float(np.nanmax(self.guide_residuals(coefficients, space)))
        raise FoldoverError(
            f"the guides cannot all be met by one-to-one maps with {self.opts.n_coefficients} coefficients: "
            f"{worst:.3g} mm are left, {self.opts.guide_tolerance:g} mm are allowed",
            "raise n_coefficients, use guide_mode: penalty, or check the landmarks",
        )

    # -- result --------------------------------------------------------------------------------------------------------

    def optimum(self, coefficients: Floats, space: Reparameterization) -> Optimum:
        """Evaluate and certify the result on the landmark grid."""
        objective = self.objective(space)
        x = objective.unknowns(coefficients)
        eigenvalues = objective.evaluate(x).spectrum.eigenvalues
        eigenvalues_initial = objective.evaluate(objective.start()).spectrum.eigenvalues
        parameters = self.output.evaluate(coefficients)
        length = spectral_function("description-length", self.lambda_cut).value
        normals = None
        if self._fields is not None:
            normals = self._fields.at(self.splines, parameters) @ np.swapaxes(self.alignment.rotation, 1, 2)
        return Optimum(
            coefficients=coefficients,
            parameters=parameters,
            points=_apply(self.alignment, self.raw.evaluate(parameters).points),
            initial_points=_apply(self.alignment, self.given),
            alignment=self.alignment,
            eigenvalues=eigenvalues,
            eigenvalues_initial=eigenvalues_initial,
            description_length=(length(eigenvalues_initial), length(eigenvalues)),
            lambda_cut=self.lambda_cut,
            reference=self.reference,
            certificates=tuple(certify(c, space) for c in coefficients),
            guide_residuals=self.guide_residuals(coefficients, space),
            window=self.opts.window,
            normals=normals,
            normal_scale=self._normal_scale,
            evaluator=self.raw.evaluator,
        )


class _Recorder:
    """Collects the history rows and hands each one on."""

    def __init__(self, record: Callable[[dict[str, float]], None] | None, journal: Journal) -> None:
        self._record = record
        self.journal = journal
        self._rows = journal.rows
        self.n_iterations = 0
        self.n_evaluations = 0

    def start(self, objective: GroupObjective, x: Floats) -> None:
        """Note the state before the first iteration of all."""
        if not self._rows:
            self._note(objective, x)

    def note_iteration(self, objective: GroupObjective, _k: int, x: Floats, _f: float, _g: Floats) -> None:
        """Note an accepted step."""
        self._note(objective, x)

    def _note(self, objective: GroupObjective, x: Floats) -> None:
        jacobians = objective.jacobians(x)
        row = {
            "iteration": float(len(self._rows)),
            "description_length": objective.spectral_value(x),
            "max_constraint": float(objective.constraint.constraint(jacobians).max()),
            "min_jacobian": float(jacobians.min()),
        }
        self._rows.append(row)
        if self._record is not None:
            self._record(row)

    def history(self) -> dict[str, Floats]:
        """Return the columns."""
        return {key: np.array([row[key] for row in self._rows]) for key in self._rows[0]}


def _levels(space: Reparameterization) -> list[tuple[int, ...]]:
    """Return the coarser nested spaces, coarsest first: spans halved while they can be and two are left."""
    levels: list[tuple[int, ...]] = []
    spans = [d.n_spans for d in space.directions]
    while all(s % 2 == 0 and s >= 4 for s in spans):
        spans = [s // 2 for s in spans]
        extra = [0 if p else space.degree for p in space.periodic]
        levels.append(tuple(s + e for s, e in zip(spans, extra, strict=True)))
    return levels[::-1]


def _refined(coefficients: Floats, coarse: Reparameterization, fine: Reparameterization) -> Floats:
    """Return the same maps in the finer space, by knot insertion."""
    matrices = tuple(c.refinement(f) for c, f in zip(coarse.directions, fine.directions, strict=True))
    displacement = components_first(coefficients - coarse.identity())
    return fine.identity() + components_last(apply_directions(matrices, displacement))


def _apply(alignment: Alignment, points: Floats) -> Floats:
    """Move (n_S, n, d) points to their poses, sizes kept."""
    return points @ np.swapaxes(alignment.rotation, 1, 2) + alignment.translation[:, None]


def _sizes(alignment: Alignment) -> tuple[Floats, Floats]:
    """Return the linear maps (n_S, d, d) and offsets (n_S, d) that remove sizes about the common centre."""
    linear = alignment.scale[:, None, None] * np.eye(len(alignment.centre))
    return linear, alignment.centre - np.einsum("iab,b->ia", linear, alignment.centre)
