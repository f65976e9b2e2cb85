"""The objective of the group optimization: a spectral function, a smoothness prior, guides and a barrier, with gradients."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from ssmpipe.core.align.differentiable import align_to, align_to_adjoint
from ssmpipe.core.arrays import Floats
from ssmpipe.core.blocks import map_blocks, side_by_side
from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.covariance import (
    SlopeProduct,
    Spectrum,
    centred_spectrum,
    parameter_adjoint,
    spectral_adjoint,
    weight_adjoint,
)
from ssmpipe.core.correspondence.exact_rule import ExactRule
from ssmpipe.core.correspondence.gauss_newton import SHAPES_PER_BLOCK, gauss_newton_inverse
from ssmpipe.core.correspondence.guides import Guides
from ssmpipe.core.correspondence.inequalities import Inequalities, LocalInequalities, centred_where_open
from ssmpipe.core.correspondence.interpolation import Interpolation
from ssmpipe.core.correspondence.jacobian import JacobianForm, largest_feasible_step
from ssmpipe.core.correspondence.prior import bending_matrix
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.rows import RowSums
from ssmpipe.core.correspondence.spectral import SpectralFunction
from ssmpipe.core.covariance.formulation_two import size_weights, size_weights_adjoint
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import Jet, SplineStack, shapes_per_block

Covariance = Literal["discrete", "I", "II"]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one evaluation of the cohort knows: kept for the gradient, the preconditioner and the records."""

    space: Reparameterization
    parameters: Floats
    jet: Jet
    points: Floats
    centred: Floats
    rotations: Floats
    slopes: tuple[Floats, ...]
    weights: Floats
    mean_tangents: tuple[Floats, ...]
    spectrum: Spectrum


class GroupObjective:
    """``f(b) = sum phi(lambda_m) + prior + guides + mu * barrier`` over all moving shapes.

    Parameters
    ----------
    stack : SplineStack
        The cohort's splines, posed (and scaled) as the objective shall see them.
    reparameterization : Reparameterization
        Its nodes are the landmarks of the covariance, unless ``rule`` is given.
    spectral : SpectralFunction
    base_weights : (n_P,) float64, optional
        Quadrature weights of the nodes; equal by default.
    covariance : {"discrete", "I", "II"}, default="discrete"
        ``discrete`` and ``I`` use the base weights; ``II`` multiplies them by the size element of the mean shape, and the
        gradient holds the derivative of these weights.
    prior : float, default=0
        Weight of the bending energy of every ``D_i`` [nat].
    barrier : float, default=1
        Weight ``mu`` of the barrier [nat].
    constraint : Barrier, optional
    form : {"bezier", "bspline", "sampled"}, default="bezier"
        Form of the Jacobian that the barrier sees.
    guides : Guides, optional
        Named landmarks that pull.
    reference : int, default=-1
        Shape whose ``D`` stays the identity; with -1 all shapes move and the mean of all displacements stays zero.
    other_gradient : callable, optional
        ``(objective, x) -> gradient`` of the spectral part in place of the adjoint, for comparison.
    target : (n_P, d) float64, optional
        When given, every shape's landmarks are moved rigidly to this target inside each evaluation, and the gradient
        contains the derivative of these motions.
    rule : ExactRule, optional
        Nodes and weights that follow the maps, for the integral of formulation I in closed form.
    interpolate : bool, default=False
        Hold the guides where they are: every direction leaves them met. Their weight then matters to the preconditioner only,
        which is the nearer to the eliminated one the larger it is.
    sums : RowSums, optional
        Evaluates Gram matrix and gradient in blocks of landmark rows, here or in other processes.
    n_positions : int, optional
        Leading components of the splines that are positions; all by default. The others, normals, have no size element.

    Raises
    ------
    GeometryError
        For a target with formulation II or with normals, which is not implemented, or a rule with anything but formulation I and
        given poses.

    Notes
    -----
    One spline evaluation gives value and gradient. Cost: one pass over the landmarks, two products of size
    ``n_S x n_S x 3 n_P`` and one ``n_S^3`` eigendecomposition.
    """

    def __init__(
        self,
        stack: SplineStack,
        reparameterization: Reparameterization,
        spectral: SpectralFunction,
        *,
        base_weights: Floats | None = None,
        covariance: Covariance = "discrete",
        prior: float = 0.0,
        barrier: float = 1.0,
        constraint: Barrier | None = None,
        form: JacobianForm = "bezier",
        guides: Guides | None = None,
        reference: int = -1,
        other_gradient: Callable[[GroupObjective, Floats], Floats] | None = None,
        target: Floats | None = None,
        rule: ExactRule | None = None,
        interpolate: bool = False,
        sums: RowSums | None = None,
        n_positions: int | None = None,
    ) -> None:
        self.stack = stack
        self._positions = slice(0, n_positions or stack.dimension)
        self.reparameterization = reparameterization
        self.spectral = spectral
        self.covariance = covariance
        self.prior = prior
        self.barrier = barrier
        self.constraint = centred_where_open(constraint or Barrier(), reparameterization)
        self.guides = guides
        self.reference = reference
        self.other_gradient = other_gradient
        self.target = target
        self.rule = rule
        self.sums = sums
        if sums is not None and (covariance == "II" or target is not None or rule is not None):
            raise GeometryError("sums by rows need landmarks whose weights and poses are given", "landmark_blocks: 1")
        if rule is not None and (covariance != "I" or target is not None or form == "sampled"):
            raise GeometryError(
                "the closed form is that of covariance I, with poses kept inside an evaluation and a form of the Jacobian that bounds it",
                "covariance: I, pose: refined and form: bezier",
            )
        if target is not None and (covariance == "II" or self._positions.stop < stack.dimension):
            raise GeometryError(
                "aligning inside each evaluation is implemented for covariance discrete and I, without normals",
                "use pose: refined",
            )
        self.moving = np.array([i for i in range(stack.n_shapes) if i != reference])
        self.inequalities = Inequalities(reparameterization, form)
        n_p = int(np.prod(reparameterization.grid))
        self._base = np.full(n_p, 1.0 / n_p) if base_weights is None else base_weights
        self._bending = bending_matrix(reparameterization)
        self._free = reparameterization.free
        self._identity = reparameterization.identity()
        self._last: tuple[bytes, Evaluation] | None = None
        self._last_spectrum: tuple[bytes, Spectrum] | None = None
        self._interpolation: Interpolation | None = None
        if interpolate and guides is not None:
            self._interpolation = Interpolation(guides, self._free, self.moving)
        self._multipliers: Floats | None = None
        self._local: tuple[bytes, LocalInequalities] | None = None
        self._along: tuple[bytes, tuple[Floats, Floats]] | None = None
        self._curved: Jet | None = None
        self._parameters = np.empty(0)
        self._d_parameters = np.empty(0)

    # -- unknowns ------------------------------------------------------------------------------------------------------

    def start(self) -> Floats:
        """Return the unknowns of the identity."""
        return np.tile(self._identity[self._free], len(self.moving))

    def unknowns(self, coefficients: Floats) -> Floats:
        """Return the unknowns of (n_S, *n_b, d_par) coefficients."""
        return coefficients[self.moving][:, self._free].ravel()

    def coefficients(self, x: Floats) -> Floats:
        """Return the (n_S, *n_b, d_par) coefficients of all shapes."""
        out = np.repeat(self._identity[None], self.stack.n_shapes, axis=0)
        out[self.moving] = self._moved(x)
        return out

    def _moved(self, x: Floats) -> Floats:
        """Return the coefficients of the moving shapes."""
        out = np.repeat(self._identity[None], len(self.moving), axis=0)
        out[:, self._free] = x.reshape(len(self.moving), -1)
        return out

    def _direction(self, direction: Floats) -> Floats:
        out = np.zeros((len(self.moving), *self._identity.shape))
        out[:, self._free] = direction.reshape(len(self.moving), -1)
        return out

    def _keep_gauge(self, vector: Floats) -> Floats:
        """Remove the mean over the shapes when all of them move, and what would move an interpolated guide."""
        if self.reference >= 0 and self._interpolation is None:
            return vector
        rows = vector.reshape(len(self.moving), -1)
        if self.reference < 0:
            rows = rows - rows.mean(axis=0)
        if self._interpolation is not None:
            rows = self._interpolation.along(rows)
        return rows.ravel()

    # -- value and gradient --------------------------------------------------------------------------------------------

    def evaluate(self, x: Floats) -> Evaluation:
        """Evaluate the cohort at ``x``; the last evaluation is remembered, and its memory is taken over by the next."""
        key = x.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        coefficients = self.coefficients(x)
        space, weights = self.reparameterization, self._base
        if self.rule is not None:
            nodes, weights = self.rule(coefficients)
            space = space.at((nodes,))
        second = self.covariance == "II"
        old = self._last[1] if self._last is not None else None
        self._last = None
        shape = (self.stack.n_shapes, space.n_directions, math.prod(space.grid))
        if self._parameters.shape != shape:
            self._parameters = np.empty(shape)
        jet = self.stack.room(shape[2], second=second, reuse=old.jet if old is not None else None)

        def some(block: slice) -> None:
            self.stack.evaluate_some(block, space.evaluate(coefficients[block], self._parameters[block]), jet)

        map_blocks(some, self.stack.n_shapes, shapes_per_block(shape[2]), self.stack.threads)
        parameters = np.swapaxes(self._parameters, 1, 2)
        slopes: tuple[Floats, ...] = ()
        tangents: tuple[Floats, ...] = ()
        if second:
            slopes = space.slopes(coefficients)
            tangents = tuple(
                sum(
                    np.einsum("ild,il->ld", jet.first[c][..., self._positions], slope[..., c])
                    for c in range(len(jet.first))
                )
                / self.stack.n_shapes
                for slope in slopes
            )
            weights = size_weights(self._base, tangents)
        points, rotations = jet.points, np.empty(0)
        if self.target is not None:
            aligned = [align_to(p, self.target, weights) for p in jet.points]
            points, rotations = np.stack([a[0] for a in aligned]), np.stack([a[1] for a in aligned])
        fits = old is not None and old.centred.shape == points.shape
        centred, spec = centred_spectrum(
            points,
            weights,
            threads=self.stack.threads,
            evaluator=self.stack.evaluator,
            out=old.centred if old is not None and fits else None,
        )
        if self.sums is not None:
            spec = self._spectrum(x)  # one spectrum for all: the two differ in the last digits
        evaluation = Evaluation(space, parameters, jet, points, centred, rotations, slopes, weights, tangents, spec)
        self._last = (key, evaluation)
        return evaluation

    def spectral_value(self, x: Floats) -> float:
        """Return the spectral function alone."""
        return self._spectrum(x).value(self.spectral)

    def _spectrum(self, x: Floats) -> Spectrum:
        if self.sums is None:
            return self.evaluate(x).spectrum
        key = x.tobytes()
        if self._last_spectrum is None or self._last_spectrum[0] != key:
            self._last_spectrum = key, Spectrum(self.sums.gram(self.coefficients(x)))
        return self._last_spectrum[1]

    def smallest_jacobian(self, x: Floats) -> float:
        """Return the smallest coefficient of all Jacobians; in the Bernstein form a lower bound of ``det dD/du``."""
        return float(self.jacobians(x).min())

    def jacobians(self, x: Floats) -> Floats:
        """Return the (n, m) coefficients of the Jacobians of the moving shapes."""
        return self._walls_at(x).jacobians

    def walls(self, x: Floats) -> Floats:
        """Return all that must stay above the floor, (n, m): the Jacobians, then the slacks of open edges; see :class:`Inequalities`."""
        return self._walls_at(x).values

    def _walls_at(self, x: Floats) -> LocalInequalities:
        key = x.tobytes()
        if self._local is None or self._local[0] != key:
            self._local = key, self.inequalities.at(self._moved(x))
        return self._local[1]

    def _walls_along(self, x: Floats, direction: Floats) -> tuple[Floats, Floats]:
        """Return the first and second change of the Jacobians; the last answer is remembered."""
        key = x.tobytes() + direction.tobytes()
        if self._along is None or self._along[0] != key:
            self._along = key, self._walls_at(x).along(self._direction(direction))
        return self._along[1]

    def _slope_product(self, spectrum: Spectrum, beside: Callable[[], None] | None) -> SlopeProduct:
        """Return the slope of the spectral function; ``beside`` is called meanwhile, on a thread of its own if there are two."""
        if beside is None:
            return spectrum.slope_product(self.spectral)
        return side_by_side(lambda: spectrum.slope_product(self.spectral), beside, self.stack.threads)

    def spectral_gradient(self, x: Floats, beside: Callable[[], None] | None = None) -> tuple[float, Floats]:
        """Return the spectral function and its gradient in the unknowns, by the adjoint [2.20].

        ``beside`` is called while the spectrum is decomposed, which one thread does alone.
        """
        if self.sums is not None:
            spectrum = self._spectrum(x)
            pulled = self.sums.pull_back(self.coefficients(x), self._slope_product(spectrum, beside))
            return spectrum.value(self.spectral), pulled[self.moving][:, self._free].ravel()
        evaluation = self.evaluate(x)
        jet = evaluation.jet
        centred = evaluation.centred
        slope_product = self._slope_product(evaluation.spectrum, beside)
        moving = self.moving
        d_tangents: tuple[Floats, ...] = ()
        through: Floats | None = None
        if self.covariance == "II":
            d_weights = weight_adjoint(centred, evaluation.spectrum.slope(self.spectral))
            d_tangents = size_weights_adjoint(self._base, evaluation.mean_tangents, d_weights)
            through = self._through_tangents(evaluation, d_tangents)

        if self._d_parameters.shape != self._parameters.shape:
            self._d_parameters = np.empty(self._parameters.shape)
        d_parameters = np.swapaxes(self._d_parameters, 1, 2)
        d_gram = evaluation.spectrum.slope(self.spectral) if self.target is not None else np.empty(0)

        def by_shapes(block: slice) -> Floats:
            if self.target is not None:
                d_points = spectral_adjoint(centred, evaluation.weights, lambda columns: d_gram[block] @ columns)
                each = zip(jet.points[block], evaluation.rotations[block], d_points, strict=True)
                d_points = np.stack([align_to_adjoint(p, self.target, evaluation.weights, r, d) for p, r, d in each])
                d_parameters[block] = np.stack([_dot(d_points, s[block]) for s in jet.first], axis=-1)
            if through is not None:
                d_parameters[block] += through[block]
            d_slopes = tuple(
                np.stack([np.einsum("ld,ild->il", d, s[block][..., self._positions]) for s in jet.first], axis=-1)
                / self.stack.n_shapes
                for d in d_tangents
            )
            return evaluation.space.pull_back(d_parameters[block], d_slopes)

        n_p, threads = jet.points.shape[1], self.stack.threads
        if self.target is None:
            parameter_adjoint(
                centred,
                evaluation.weights,
                slope_product,
                jet.first,
                self._d_parameters,
                threads=threads,
                evaluator=self.stack.evaluator,
            )
        blocks = map_blocks(by_shapes, self.stack.n_shapes, shapes_per_block(n_p), threads)
        gradient = np.concatenate(blocks)[moving][:, self._free].ravel()
        return evaluation.spectrum.value(self.spectral), gradient

    def _through_tangents(self, evaluation: Evaluation, d_tangents: tuple[Floats, ...]) -> Floats:
        """Return df/dD through ``dx/du_k = sum_c S_c(D) dD^c/du_k``: second derivatives of the splines."""
        n = len(evaluation.jet.first)
        out = np.zeros((*evaluation.jet.points.shape[:2], n))
        for d_tangent, slope in zip(d_tangents, evaluation.slopes, strict=True):
            for c in range(n):
                for e in range(n):
                    bent = evaluation.jet.second[c + e][..., self._positions]
                    out[..., c] += np.einsum("ld,ild->il", d_tangent, bent) * slope[..., e]
        return out / self.stack.n_shapes

    def value_and_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return ``f`` and its gradient; infinite outside the feasible set."""
        penalty = self.constraint.value(self.walls(x)) if self.barrier > 0 else 0.0
        if not np.isfinite(penalty):
            return np.inf, np.zeros_like(x)
        moving = self._moved(x)
        extra = np.zeros_like(moving)
        slope = self.constraint.slope(self.walls(x)) if self.barrier > 0 else extra

        def some(block: slice) -> None:
            extra[block] = self.barrier * self._walls_at(x).part(block).pull_back(slope[block])

        def penalties() -> None:
            if self.barrier > 0:
                map_blocks(some, len(moving), shapes_per_block(self.inequalities.n_jacobian))

        if self.other_gradient is None:
            value, gradient = self.spectral_gradient(x, penalties)
        else:
            value, gradient = self.spectral_value(x), self.other_gradient(self, x)
            penalties()
        if self.barrier > 0:
            value += self.barrier * penalty
        if self.prior > 0:
            displacement = moving - self._identity
            bent = self._bent(displacement)
            value += 0.5 * self.prior * float((bent * displacement).sum())
            extra += self.prior * bent
        if self.guides is not None:
            pull, d_pull = self.guides.value_and_gradient(self.coefficients(x))
            value += pull
            extra += d_pull[self.moving]
        return value, self._keep_gauge(gradient + extra[:, self._free].ravel())

    def value(self, x: Floats) -> float:
        """Return ``f`` alone; a gradient at the same ``x`` then costs only what the value did not."""
        value = self.barrier * self.constraint.value(self.walls(x)) if self.barrier > 0 else 0.0
        if not np.isfinite(value):
            return np.inf
        value = self.spectral_value(x) + value
        if self.prior > 0:
            displacement = self._moved(x) - self._identity
            value += 0.5 * self.prior * float((self._bent(displacement) * displacement).sum())
        if self.guides is not None:
            value += self.guides.value_and_gradient(self.coefficients(x))[0]
        return value

    @cached_property
    def _bending_of_free(self) -> Floats:
        free = np.flatnonzero(self._free.ravel())
        n_d = self.reparameterization.n_directions
        return np.asarray(np.kron(self._bending, np.eye(n_d))[free[:, None], free], dtype=np.float64)

    def _bent(self, displacement: Floats) -> Floats:
        flat = displacement.reshape(len(displacement), -1, displacement.shape[-1])
        return (self._bending @ flat).reshape(displacement.shape)

    # -- feasibility and curvature -------------------------------------------------------------------------------------

    def largest_step(self, x: Floats, direction: Floats) -> float:
        """Return how far ``direction`` can be followed before a coefficient of a Jacobian meets the floor; exact."""
        first, second = self._walls_along(x, direction)
        return largest_feasible_step(self.walls(x) - self.constraint.floor, first, second)

    def step_taken(self, x: Floats, direction: Floats) -> None:
        """Let the multipliers of the constraints follow an accepted step along ``direction`` (primal-dual).

        Value and gradient remain those of the barrier. Only the curvature is built with the multipliers: where a constraint is
        nearly active, the barrier's own is right in a tiny neighbourhood only, and steps would stop short at the walls.
        """
        if self.barrier > 0:
            current, first = self.walls(x), self._walls_along(x, direction)[0]
            self._multipliers = self.constraint.followed(current, first, self._multipliers_at(current), self.barrier)

    def memory(self) -> Floats | None:
        """Return the multipliers that followed the steps, None before the first one."""
        return self._multipliers

    def recall(self, memory: Floats | None) -> None:
        """Set the multipliers, to continue where they were returned."""
        self._multipliers = memory

    def _multipliers_at(self, walls: Floats) -> Floats:
        """Return the multipliers that followed the steps; before the first step those of the barrier."""
        return self.barrier * self.constraint.multipliers(walls) if self._multipliers is None else self._multipliers

    def preconditioner(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return the inverse of the Gauss-Newton matrix, shapes coupled: see :func:`gauss_newton_inverse`."""
        evaluation = self.evaluate(x)
        moving, threads = self.moving, self.stack.threads
        coefficients = self._moved(x)
        coupling = evaluation.spectrum.slope(self.spectral)[np.ix_(moving, moving)] * (2.0 / (self.stack.n_shapes - 1))
        walls = self.walls(x)
        stiffness = self.constraint.curvature(walls, self._multipliers_at(walls)) if self.barrier > 0 else None

        def own(part: slice) -> Floats:
            chunk = coefficients[part]
            if stiffness is not None:
                block = self.inequalities.normal_blocks(chunk, stiffness[part])
            else:
                block = np.zeros((len(chunk), *self._bending_of_free.shape))
            if self.prior > 0:
                block += self.prior * self._bending_of_free
            if self.guides is not None:
                block += np.stack([self.guides.hessian(int(i))[free[:, None], free] for i in moving[part]])
            return block

        tangents = self._posed(evaluation, evaluation.jet.first)
        free = np.flatnonzero(self._free.ravel())
        blocks = np.concatenate(map_blocks(own, len(moving), SHAPES_PER_BLOCK, threads))
        solve = gauss_newton_inverse(evaluation.space, coupling, evaluation.weights, tangents, blocks, threads, moving)
        return lambda vector: self._keep_gauge(solve(vector))

    def _posed(self, evaluation: Evaluation, fields: tuple[Floats, ...]) -> tuple[Floats, ...]:
        """Return derivatives (n_S, n_P, d) in the frame of the aligned points."""
        if self.target is None:
            return fields
        turns = np.swapaxes(evaluation.rotations, 1, 2)
        return tuple(s @ turns for s in fields)

    def hessian(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return the product of the second derivative with a vector; its cost is below that of a gradient.

        Exact for covariance ``discrete`` and ``I``: the change of the eigenvectors enters through the divided differences of
        ``phi'`` and the curvature of the shapes through their second derivatives. For ``II`` the weights are held, and so are
        rotations inside the evaluation.
        """
        evaluation = self.evaluate(x)
        coefficients = self.coefficients(x)
        space, moving, spec = evaluation.space, self.moving, evaluation.spectrum
        n_shapes, n_p, d = evaluation.jet.points.shape
        n_d = space.n_directions
        jet = evaluation.jet
        if not jet.second:
            jet = self._curved = self.stack.evaluate(evaluation.parameters, second=True, reuse=self._curved)
        # components before landmarks and roots of the weights inside: every pass below runs over contiguous memory
        root = np.sqrt(evaluation.weights * (2.0 / (n_shapes - 1)))

        def packed(field: Floats) -> Floats:
            return np.ascontiguousarray(np.swapaxes(field, 1, 2)) * root

        first, second = self._posed(evaluation, jet.first), self._posed(evaluation, jet.second)
        centred = packed(evaluation.centred).reshape(n_shapes, -1)
        tangents = [packed(s[moving]) for s in first]
        vectors, d_gram = spec.vectors, spec.slope(self.spectral)
        within = np.ascontiguousarray(d_gram[np.ix_(moving, moving)])
        differences = self.spectral.slope_differences(spec.eigenvalues)
        pulled = (d_gram[moving] @ centred).reshape(len(moving), d, n_p)
        bends = [(np.swapaxes(s[moving], 1, 2) * root * pulled).sum(axis=1) for s in second]
        local, walls = self._walls_at(x), self.walls(x)
        multipliers = self._multipliers_at(walls)
        wall = self.constraint.slope(walls, multipliers, self.barrier) if self.barrier > 0 else walls

        def tightened(change: Floats) -> Floats:
            return self.constraint.slope_along(walls, change, multipliers)

        def product(vector: Floats) -> Floats:
            direction = self._direction(vector)
            shift = space.displacements(direction)
            moved = tangents[0] * shift[:, 0, None]
            for c in range(1, n_d):
                moved += tangents[c] * shift[:, c, None]
            flat = moved.reshape(len(moving), -1)
            # centring is left out: the eigenvectors are orthogonal to the constant
            change = vectors[moving].T @ (flat @ centred.T) @ vectors
            turn = vectors @ (0.5 * differences * (change + change.T)) @ vectors.T
            force = (within @ flat + turn[moving] @ centred).reshape(moved.shape)
            out = np.stack([(t * force).sum(axis=1) for t in tangents], axis=1)
            for c in range(n_d):
                for e in range(n_d):
                    out[:, c] += bends[c + e] * shift[:, e]
            result = space.displacements_transposed(out)
            if self.barrier > 0:
                result = result + local.pull_back_along(direction, tightened, wall)
            if self.prior > 0:
                result = result + self.prior * self._bent(direction)
            if self.guides is not None:
                every = np.zeros_like(coefficients)
                every[moving] = direction
                result = result + self.guides.curvature_along(every)[moving]
            return self._keep_gauge(result[:, self._free].ravel())

        return product


def _dot(a: Floats, b: Floats) -> Floats:
    """Return the inner products over the last axis."""
    return np.asarray(np.einsum("...d,...d->...", a, b))
