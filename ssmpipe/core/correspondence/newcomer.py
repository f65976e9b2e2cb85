"""One more shape into a finished correspondence: its reparameterization alone is optimized, all other shapes stay as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.align.affine import affine_to_cohort, affine_to_mean
from ssmpipe.core.align.procrustes import generalized_procrustes, rotation_between
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.affine_start import affine_start_onto, taken_back, turned_identity
from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.certificate import Certificate, certify
from ssmpipe.core.correspondence.covariance import Spectrum, centred_spectrum
from ssmpipe.core.correspondence.gauss_newton import gauss_newton_inverse
from ssmpipe.core.correspondence.inequalities import Inequalities, centred_where_open
from ssmpipe.core.correspondence.jacobian import JacobianForm, largest_feasible_step
from ssmpipe.core.correspondence.measure import grid_size_weights, grid_tangents
from ssmpipe.core.correspondence.normals import NormalFields, carried
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.prior import bending_matrix
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.spectral import SpectralFunction, spectral_function
from ssmpipe.core.correspondence.turns import starting_turns
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.optim.interior import DescentOptions, minimize_interior
from ssmpipe.core.result import Result, Status
from ssmpipe.core.spline.evaluate import Jet, Spline, SplineStack


@dataclass(frozen=True, eq=False)
class Newcomer:
    """A shape that was brought into a fixed correspondence.

    Parameters
    ----------
    coefficients : (*n_b, d_par)
        Of its ``D``.
    parameters : (n_P, d_par)
    points, initial_points : (n_P, d)
        On the fitted spline in the frame of the fixed shapes, size kept [mm]; before: with ``D`` the identity.
    matrix : (4, 4)
        Rigid motion from the frame of the spline to that of the fixed shapes.
    scale : float
        Size factor inside the objective only.
    description_length : (float, float)
        Of the fixed shapes and this one together, before and after [nat].
    certificate : Certificate
    """

    coefficients: Floats
    parameters: Floats
    points: Floats
    initial_points: Floats
    matrix: Floats
    scale: float
    description_length: tuple[float, float]
    certificate: Certificate


class NewcomerObjective:
    """``f(b) = sum phi(lambda_m) + prior + mu * barrier`` in the ``D`` of one shape; the other shapes are points that stay.

    Parameters
    ----------
    spline : Spline
        As the objective shall see it.
    space : Reparameterization
        Its nodes belong to the points of the fixed shapes.
    fixed : (n_S, n_P, d) float64
    weights : (n_P,) float64
        Sum 1.
    spectral : SpectralFunction
    prior, barrier : float
        Weights [nat].
    constraint : Barrier, optional
    form : {"bezier", "bspline", "sampled"}

    Notes
    -----
    The gradient is the adjoint of [2.20] of Li 2015, of which one row is needed. Cost of an evaluation: one pass over the
    landmarks of one spline and a product of size ``n_S x n_S x d n_P``.
    """

    def __init__(
        self,
        spline: Spline,
        space: Reparameterization,
        fixed: Floats,
        weights: Floats,
        spectral: SpectralFunction,
        *,
        prior: float = 0.0,
        barrier: float = 1.0,
        constraint: Barrier | None = None,
        form: JacobianForm = "bezier",
    ) -> None:
        self.stack = SplineStack([spline], space.periodic)
        self.space, self.fixed, self.weights, self.spectral = space, fixed, weights, spectral
        self.prior, self.barrier = prior, barrier
        self.constraint = centred_where_open(constraint or Barrier(), space)
        self.inequalities = Inequalities(space, form)
        self._free = space.free
        self._identity = space.identity()
        self._bending = bending_matrix(space)
        self._last: tuple[bytes, Jet, Floats, Spectrum] | None = None

    def unknowns(self, coefficients: Floats) -> Floats:
        """Return the unknowns of (*n_b, d_par) coefficients."""
        return coefficients[self._free]

    def coefficients(self, x: Floats) -> Floats:
        """Return the (*n_b, d_par) coefficients."""
        out = self._identity.copy()
        out[self._free] = x
        return out

    def _evaluate(self, x: Floats) -> tuple[Jet, Floats, Spectrum]:
        key = x.tobytes()
        if self._last is None or self._last[0] != key:
            jet = self.stack.evaluate(self.space.evaluate(self.coefficients(x)[None]))
            self._last = (key, jet, *centred_spectrum(np.concatenate([self.fixed, jet.points]), self.weights))
        return self._last[1:]

    def spectral_value(self, x: Floats) -> float:
        """Return the spectral function alone."""
        return self._evaluate(x)[2].value(self.spectral)

    def _direction(self, vector: Floats) -> Floats:
        out = np.zeros_like(self._identity)
        out[self._free] = vector
        return out

    def value(self, x: Floats) -> float:
        """Return ``f`` alone."""
        return self.value_and_gradient(x)[0]

    def value_and_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return ``f`` and its gradient; infinite outside the feasible set."""
        coefficients = self.coefficients(x)
        local = self.inequalities.at(coefficients[None])
        penalty = self.constraint.value(local.values) if self.barrier > 0 else 0.0
        if not np.isfinite(penalty):
            return np.inf, np.zeros_like(x)
        jet, centred, spec = self._evaluate(x)
        n = len(centred)
        row = spec.slope(self.spectral)[-1]
        d_points = (row @ centred.reshape(n, -1)).reshape(centred.shape[1:])
        d_points *= (2.0 / (n - 1) * self.weights)[:, None]
        d_parameters = np.stack([np.einsum("ld,ld->l", d_points, s[0]) for s in jet.first], axis=-1)
        gradient = self.space.pull_back(d_parameters[None])[0]
        value = spec.value(self.spectral)
        if self.barrier > 0:
            value += self.barrier * penalty
            gradient += self.barrier * local.pull_back(self.constraint.slope(local.values))[0]
        if self.prior > 0:
            displacement = coefficients - self._identity
            bent = (self._bending @ displacement.reshape(len(self._bending), -1)).reshape(displacement.shape)
            value += 0.5 * self.prior * float((bent * displacement).sum())
            gradient += self.prior * bent
        return value, gradient[self._free]

    def largest_step(self, x: Floats, direction: Floats) -> float:
        """Return how far ``direction`` can be followed before a coefficient of the Jacobian meets the floor; exact."""
        local = self.inequalities.at(self.coefficients(x)[None])
        first, second = local.along(self._direction(direction)[None])
        return largest_feasible_step(local.values - self.constraint.floor, first, second)

    def step_taken(self, x: Floats, direction: Floats) -> None:
        """Hear of an accepted step; nothing follows from it."""

    def preconditioner(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return the inverse of the Gauss-Newton matrix."""
        coefficients = self.coefficients(x)[None]
        jet, centred, spec = self._evaluate(x)
        n_d = self.space.n_directions
        free = np.flatnonzero(self._free.ravel())
        bending = np.kron(self._bending, np.eye(n_d))[free[:, None], free]
        own = np.asarray(self.prior * bending[None], dtype=np.float64)
        if self.barrier > 0:
            jacobians = self.inequalities.coefficients(coefficients)
            multipliers = self.barrier * self.constraint.multipliers(jacobians)
            own = own + self.inequalities.normal_blocks(coefficients, self.constraint.curvature(jacobians, multipliers))
        coupling = spec.slope(self.spectral)[-1:, -1:] * (2.0 / (len(centred) - 1))
        return gauss_newton_inverse(self.space, coupling, self.weights, jet.first, own)


class FixedCohort:
    """The shapes of a finished correspondence, seen as the objective of the group saw them at its end.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
        In their final pose, sizes kept [mm].
    grid : tuple of int
        Landmark grid; a seam is stored once.
    closes : bool
        Whether the first direction closes over its ends.
    options : EngineOptions
        Of the group; the boundary mode resolved, the threshold given.
    normals : (n_S, n_P, d) float64, optional
        Unit normals of the points (curves: tangents), where the group weighed them.
    normal_scale : float
        What the group multiplied them with [mm].

    Notes
    -----
    Only points and normals are needed, so nodes are those of the landmark grid: with covariance ``I`` and ``II`` the trapezoidal rule
    stands for the quadrature of the group, and the weights of ``II`` are those of the mean of the fixed shapes.

    Raises
    ------
    GeometryError
        If there are fewer than two shapes, or the threshold is not known.
    """

    def __init__(
        self,
        points: Floats,
        grid: tuple[int, ...],
        *,
        closes: bool,
        options: EngineOptions,
        normals: Floats | None = None,
        normal_scale: float = 0.0,
    ) -> None:
        if len(points) < 2:
            raise GeometryError(f"a correspondence of {len(points)} shape cannot take another one, two are needed")
        if options.lambda_cut is None or not np.isfinite(options.lambda_cut):
            raise GeometryError("the threshold of the description length is not known")
        if len(options.n_coefficients) != len(grid):
            raise GeometryError(f"n_coefficients {options.n_coefficients} do not fit the landmark grid {grid}")
        self.points, self.options = points, options
        periodic = tuple(closes and axis == 0 for axis in range(len(grid)))
        self.periodic = periodic
        nodes = tuple(np.linspace(0.0, 1.0, n, endpoint=not p) for n, p in zip(grid, periodic, strict=True))
        self.space = Reparameterization(
            options.n_coefficients, nodes, degree=options.degree, boundary=options.boundary, window=options.window
        )
        mean = points.mean(axis=0)
        self.pose_weights = grid_size_weights(mean, grid, periodic)
        if options.covariance == "discrete":
            self.weights = np.full(len(mean), 1.0 / len(mean))
        elif options.covariance == "II":
            self.weights = self.pose_weights
        else:
            ends = [np.ones(n) for n in grid]
            for e, wraps in zip(ends, periodic, strict=True):
                if not wraps:
                    e[[0, -1]] = 0.5
            base = ends[0] if len(ends) == 1 else np.multiply.outer(ends[0], ends[1]).ravel()
            self.weights = base / base.sum()
        alignment = generalized_procrustes(points, self.pose_weights, remove_size=options.normalize != "none")
        self.mean_size = float(_size(points[0], self.pose_weights) * alignment.scale[0])
        self.centre = alignment.centre
        self._sized = self.centre + (points - self.centre) * alignment.scale[:, None, None]
        self.fixed = self._sized
        if options.normalize == "affine":
            linear, offset = affine_to_mean(self._sized, self.pose_weights)
            self.fixed = self._sized @ np.swapaxes(linear, 1, 2) + offset[:, None]
            normals = carried(normals, linear, tangents=len(grid) == 1) if normals is not None else None
        self.normal_scale = normal_scale if normals is not None else 0.0
        self.seen = self.fixed
        if normals is not None:
            self.seen = np.concatenate([self.fixed, normal_scale * normals], axis=2)
        self.size = float(np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean()))

    def at_equal_size(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the mean of the fixed shapes, and (n_P, d) posed points, of its size unless sizes count."""
        scale = 1.0 if self.options.normalize == "none" else self.mean_size / _size(points, self.pose_weights)
        return self._sized.mean(axis=0), self.centre + scale * (points - self.centre)

    def normalization(self, points: Floats) -> tuple[Floats, Floats, float]:
        """Return the linear map, the offset and the size factor that show (n_P, d) posed points as the objective sees them."""
        if self.options.normalize == "none":
            return np.eye(points.shape[1]), np.zeros(points.shape[1]), 1.0
        scale = self.mean_size / _size(points, self.pose_weights)
        linear = scale * np.eye(points.shape[1])
        offset = self.centre - linear @ self.centre
        if self.options.normalize == "affine":
            sized = points @ linear.T + offset
            more, shift = affine_to_cohort(sized, self._sized, self.fixed, self.pose_weights)
            linear, offset = more @ linear, more @ offset + shift
        return linear, offset, scale

    def pose(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the rotation and translation that bring (n_P, d) points onto the mean of the fixed shapes."""
        weights = self.pose_weights
        mean = self._sized.mean(axis=0)
        from_, to = weights @ points, weights @ mean
        rotation = rotation_between(points - from_, mean - to, weights)
        return rotation, self.centre - rotation @ from_


def _size(points: Floats, weights: Floats) -> float:
    centred = points - weights @ points
    return float(np.sqrt(np.einsum("l,ld,ld->", weights, centred, centred)))


def bring_in(spline: Spline, cohort: FixedCohort) -> Result[Newcomer]:
    """Find the reparameterization of one shape that adds least to the description length of a fixed cohort.

    Rounds, barrier weights, pose and normalization are those of the group optimization, so that a shape of the cohort comes back
    nearly as it was. The answer depends on the spline and the cohort only.

    Parameters
    ----------
    spline : BSplineCurve or BSplineSurface
        Roughly in the frame of the cohort [mm]; any degree and knots.
    cohort : FixedCohort

    Returns
    -------
    Result[Newcomer]

    Raises
    ------
    GeometryError
        If a curve is to join surfaces, or the other way round, or the dimension differs.

    Examples
    --------
    >>> from ssmpipe.core.spline.curve import BSplineCurve
    >>> knots = np.array([0, 0, 0, 1.0, 1, 1])
    >>> def arc(height):
    ...     return BSplineCurve(2, knots, np.array([[-1.0, 0], [0, height], [1, 0]]))
    >>> u = np.linspace(0, 1, 21)[None]
    >>> points = SplineStack([arc(h) for h in (1.0, 1.2, 1.5)]).evaluate(np.repeat(u, 3, axis=0)[..., None]).points
    >>> options = EngineOptions(n_coefficients=(5,), landmarks=(21,), lambda_cut=1e-6, normalize="none", pose="keep")
    >>> found = bring_in(arc(1.3), FixedCohort(points, (21,), closes=False, options=options)).value
    >>> found.certificate.verdict, bool(np.abs(found.parameters[:, 0] - u[0]).max() < 0.02)
    ('proved', True)
    """
    options, space = cohort.options, cohort.space
    if len(spline.degrees) != space.n_directions or spline.dimension != cohort.points.shape[2]:
        raise GeometryError(
            f"a spline with {len(spline.degrees)} parameters in {spline.dimension} dimensions cannot join shapes with "
            f"{space.n_directions} in {cohort.points.shape[2]}"
        )
    stack = SplineStack([spline], space.periodic)
    identity = space.identity()
    given = stack.evaluate(space.evaluate(identity[None])).points[0].copy()
    d = given.shape[1]
    rotation, translation = np.eye(d), np.zeros(d)
    if options.pose == "procrustes":
        rotation, translation = cohort.pose(given)
    turn = _turn(given @ rotation.T + translation, cohort) if space.periodic[0] else 0.0
    coefficients = turned_identity(space, np.array([turn]))[0]
    if options.start == "affine" and space.n_directions == 2 and spline.dimension == 3:
        coefficients = _affine_start(stack, cohort, coefficients, turn)
    fields = NormalFields(spline, space.periodic) if cohort.normal_scale > 0 else None
    spectral = spectral_function(options.objective, float(options.lambda_cut or 0.0))
    constraint = Barrier(options.aggregate, options.floor, options.sharpness)
    moves_pose = options.pose in ("refined", "each-evaluation")
    rounds = options.pose_rounds if moves_pose or options.normalize == "affine" else 0
    barriers, n_iterations, n_evaluations = options.barriers, 0, 0
    status: Status = "converged"
    current = stack.evaluate(space.evaluate(coefficients[None])).points[0]
    linear, offset, scale = cohort.normalization(current @ rotation.T + translation)
    for _ in range(1 + rounds):
        seen = spline.with_control(spline.control_points @ (linear @ rotation).T + (linear @ translation + offset))
        objective = NewcomerObjective(
            fields.beside(seen, cohort.normal_scale) if fields is not None else seen,
            space,
            cohort.seen,
            cohort.weights,
            spectral,
            prior=options.prior,
            constraint=constraint,
            form=options.form,
        )
        x = objective.unknowns(coefficients)
        for k, barrier in enumerate(barriers):
            objective.barrier = barrier
            last = k == len(barriers) - 1
            decrease = options.relative_decrease if last else max(options.relative_decrease, 1e-4)
            found = minimize_interior(
                objective, x, DescentOptions(max_iterations=options.max_iterations, relative_decrease=decrease)
            )
            x, status = found.value, found.status
            n_iterations, n_evaluations = n_iterations + found.n_iterations, n_evaluations + found.n_evaluations
        coefficients = objective.coefficients(x)
        current = stack.evaluate(space.evaluate(coefficients[None])).points[0]
        before = (current @ rotation.T + translation) @ linear.T + offset
        if moves_pose:
            rotation, translation = cohort.pose(current)
        posed = current @ rotation.T + translation
        linear, offset, scale = cohort.normalization(posed)
        if float(np.sqrt(((posed @ linear.T + offset - before) ** 2).sum(axis=1).mean())) < 1e-3 * cohort.size:
            break
        barriers = options.barriers[-1:]
    matrix = np.eye(4)
    matrix[:d, :d], matrix[:d, 3] = rotation, translation
    return Result(
        Newcomer(
            coefficients=coefficients,
            parameters=space.evaluate(coefficients[None])[0],
            points=current @ rotation.T + translation,
            initial_points=given @ rotation.T + translation,
            matrix=matrix,
            scale=scale,
            description_length=(
                objective.spectral_value(objective.unknowns(space.identity())),
                objective.spectral_value(x),
            ),
            certificate=certify(coefficients, space),
        ),
        status,
        n_iterations,
        n_evaluations,
    )


def _turn(posed: Floats, cohort: FixedCohort) -> float:
    """Return by how much the first parameter is turned before the descent, as the group was; see :func:`starting_turns`."""
    both = np.stack(cohort.at_equal_size(posed))
    return float(starting_turns(both.reshape(2, cohort.space.grid[0], -1, posed.shape[1]))[1])


def _affine_start(stack: SplineStack, cohort: FixedCohort, turned: Floats, turn: float) -> Floats:
    """Return a map without folds near the affine closest points of the mean, (*n_b, 2)."""
    space, mean = cohort.space, cohort.points.mean(axis=0)
    tangents = grid_tangents(mean, space.grid, cohort.periodic)
    area = np.cross(tangents[0], tangents[1])
    found = affine_start_onto(stack, space, mean, area, turns=np.array([turn]))
    inequalities = Inequalities(space, cohort.options.form)
    x = taken_back(
        turned.reshape(1, -1),
        (found[0] - turned).reshape(1, -1),
        lambda x: inequalities.coefficients(x.reshape(1, *turned.shape)).min(axis=1),
        n_tries=29,
    )
    return x.reshape(turned.shape)
