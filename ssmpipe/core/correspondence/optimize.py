"""The group optimization: pose the cohort, choose the reference, relax the barrier round by round."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.checkpoints import Checkpoints
from ssmpipe.core.correspondence.affine_start import affine_start, turned_identity, without_folds
from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.certificate import certify
from ssmpipe.core.correspondence.coarse_to_fine import coarser_spaces, refined
from ssmpipe.core.correspondence.description_length import automatic_lambda_cut
from ssmpipe.core.correspondence.exact_rule import ExactRule
from ssmpipe.core.correspondence.gauss_newton import FACTORED_UNKNOWNS
from ssmpipe.core.correspondence.guide_places import GuidePlaces
from ssmpipe.core.correspondence.guides import Guides
from ssmpipe.core.correspondence.interpolation import Interpolation
from ssmpipe.core.correspondence.jacobian import Jacobian
from ssmpipe.core.correspondence.journal import Journal
from ssmpipe.core.correspondence.measure import Quadrature, landmark_rule
from ssmpipe.core.correspondence.normals import NormalFields
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.open_rims import Registered, register_reference
from ssmpipe.core.correspondence.optimum import Optimum
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.pose import Pose
from ssmpipe.core.correspondence.recorder import Recorder
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.rows import RowSums, automatic_blocks
from ssmpipe.core.correspondence.sensitivity import direct_gradient, finite_difference_gradient
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.correspondence.turns import starting_turns
from ssmpipe.core.engine import Engine
from ssmpipe.core.errors import FoldoverError, GeometryError, LandmarkError
from ssmpipe.core.optim.interior import DescentOptions
from ssmpipe.core.result import Result, Status
from ssmpipe.core.spline.common_knots import on_common_knots
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import Spline, SplineStack

_REFINED = ("refined", "each-evaluation")
_HINTED = 100
"""Cohorts up to this size are told how far their rims lie apart where rims are kept."""
_HINT_NODES = 26
_EARLY_DECREASE = 1e-4
"""Rounds before the last barrier weight end at this relative decrease; more would not pay."""
_ELIMINATING = 1e4
"""Guides that are held weigh so many times their weight in the preconditioner, which then nearly eliminates their conditions."""
_SLOW = {"direct": direct_gradient, "finite-difference": finite_difference_gradient}
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
        At least two, of equal degree; roughly aligned [mm]. Different knots are brought to their union, exactly.
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
    splines = on_common_knots(splines)
    cohort = _Cohort(splines, opts, guides, engine, threads)
    rims = cohort.registered_rims()
    opened: Floats | None = None
    if rims is not None and opts.rims == "free":
        window = rims.window(opts.open_edges, opts.max_crop)
        opened = rims.within(window)
        opts = replace(opts, window=window, reference="none")
        cohort = _Cohort(splines, opts, guides, engine, threads)
    recorder = Recorder(record, Journal(checkpoints))
    reparameterization = cohort.space(opts.n_coefficients)
    levels = coarser_spaces(reparameterization) if opts.coarse_to_fine else []
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
        coefficients = refined(coefficients, cohort.space(n), cohort.space(n_next))
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
        self.pose = self._aligned(self.given, keep_pose=opts.pose != "procrustes")
        self.turns = np.zeros(len(splines))
        start = self.pose.normalized(self.given)
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
        self._places: GuidePlaces | None = None
        if guides is not None:
            self._places = GuidePlaces.of(splines, self.raw, guides, self.reference, periodic=self.output.periodic[0])

    def _turned(self, start: Floats) -> tuple[Floats, Floats]:
        """Return by how much each shape is turned before the descent, and the points at the start after that."""
        turns = starting_turns(start.reshape(len(start), self.output.grid[0], -1, start.shape[2]))
        if not turns.any():
            return turns, start
        coefficients = turned_identity(self.output, turns)
        return turns, self.pose.normalized(self.raw.evaluate(self.output.evaluate(coefficients)).points)

    @property
    def guided(self) -> bool:
        return self._places is not None

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
            target = self.pose.normalized(self.raw.evaluate(space.evaluate(coefficients)).points).mean(axis=0)
        splines = [self.pose.normalized_spline(spline, i) for i, spline in enumerate(self.splines)]
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
        self, coefficients: Floats, space: Reparameterization, barriers: tuple[float, ...], recorder: Recorder
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

    def _aligned(self, points: Floats, *, keep_pose: bool) -> Pose:
        """Return poses and size factors for (n_S, n_P, d) points on the grid."""
        grid, periodic = self.output.grid, self.output.periodic
        return Pose.of(points, grid, periodic, remove_size=self.opts.normalize != "none", keep_pose=keep_pose)

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
        before = self.pose.normalized(current)
        pose = self._aligned(current, keep_pose=self.opts.pose not in _REFINED)
        if self.opts.normalize == "affine":
            pose = pose.mapped_to_mean(current, self.output.grid, self.output.periodic)
        moved = pose.normalized(current) - before
        if float(np.sqrt((moved**2).sum(axis=-1).mean())) < 1e-3 * self.size:
            return False
        self.pose = pose
        return True

    # -- guides --------------------------------------------------------------------------------------------------------

    def _guides_in(self, space: Reparameterization) -> Guides | None:
        return self._places.guides_in(space, self.guide_weight) if self._places is not None else None

    def guide_residuals(self, coefficients: Floats, space: Reparameterization) -> Floats:
        """Return the (n_S, n_K) distances on the surface [mm], NaN where a shape lacks the guide."""
        guides = self._guides_in(space)
        if guides is None or self._places is None:
            return np.empty((len(self.splines), 0))
        return self._places.distances(guides, coefficients)

    def meet_guides(self, coefficients: Floats, space: Reparameterization, recorder: Recorder) -> Floats:
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
            normals = self._fields.at(self.splines, parameters) @ np.swapaxes(self.pose.alignment.rotation, 1, 2)
        return Optimum(
            coefficients=coefficients,
            parameters=parameters,
            points=self.pose.placed(self.raw.evaluate(parameters).points),
            initial_points=self.pose.placed(self.given),
            alignment=self.pose.alignment,
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
