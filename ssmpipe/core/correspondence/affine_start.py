"""A start for the optimization of surfaces: the closest points of one shape on all others after an affine registration."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.prior import bending_matrix
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.spline.evaluate import SplineStack

_SMOOTHNESS = 2.5e-6  # bending energy against squared distance in the square, mean over the nodes
LEAST_JACOBIAN = 0.05
_SAME_SIDE = 0.5  # cosine between normals of places that belong together


def affine_start(
    stack: SplineStack,
    space: Reparameterization,
    reference: int,
    *,
    turns: Floats | None = None,
    n_dense: int = 101,
    n_rounds: int = 12,
) -> Floats:
    """Return maps that bring the landmarks of the reference near their affine closest points on every shape.

    Every shape is registered by itself: an affine map of the reference's landmarks to their present partners, the closest points
    of the moved landmarks as the next partners (Besl and McKay 1992), from the turned identity on. Smooth maps are then fitted
    to the parameters of the closest points. They may fold: see :func:`without_folds`.

    Parameters
    ----------
    stack : SplineStack
        Surfaces in three dimensions.
    space : Reparameterization
        With the landmarks as nodes.
    reference : int
    turns : (n_S,) float64, optional
        By how much the first parameter of every shape is turned before (:func:`.turns.starting_turns`): an affine map would take a
        turn of the parameters for one of the shape. Zero by default, and for the reference.
    n_dense : int
        Places per direction among which the closest one is looked up, before one step on the surface.
    n_rounds : int

    Returns
    -------
    (n_S, *n_coefficients, 2) float64
        The identity for the reference.
    """
    u = space.evaluate(space.identity()[None])[0]
    nodes = stack.evaluate(np.repeat(u[None], stack.n_shapes, axis=0))
    fixed = np.array(nodes.points[reference])
    area = np.cross(nodes.first[0][reference], nodes.first[1][reference])
    return affine_start_onto(stack, space, fixed, area, turns=turns, n_dense=n_dense, n_rounds=n_rounds, skip=reference)


def affine_start_onto(
    stack: SplineStack,
    space: Reparameterization,
    fixed: Floats,
    area: Floats,
    *,
    turns: Floats | None = None,
    n_dense: int = 101,
    n_rounds: int = 12,
    skip: int = -1,
) -> Floats:
    """Return maps that bring given landmarks near their affine closest points on every shape; see :func:`affine_start`.

    Parameters
    ----------
    stack, space, turns, n_dense, n_rounds
        As there.
    fixed, area : (n_P, 3) float64
        Places of the landmarks, and ``S_u x S_v`` there.
    skip : int
        Shape that keeps the identity.
    """
    u = space.evaluate(space.identity()[None])[0]
    ahead = np.zeros(stack.n_shapes) if turns is None else turns
    coefficients = turned_identity(space, ahead)
    partners = np.array(stack.evaluate(space.evaluate(coefficients)).points)
    element = np.linalg.norm(area, axis=1)
    normal = area / np.maximum(element, 1e-12 * element.max())[:, None]
    grid = [np.linspace(0.0, 1.0, n_dense, endpoint=not p) for p in space.periodic]
    dense_u = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 2)
    dense = stack.evaluate(np.repeat(dense_u[None], stack.n_shapes, axis=0))
    points, first = np.array(dense.points), [np.array(f) for f in dense.first]
    fit = _Fit(space, u)
    for i in range(stack.n_shapes):
        if i == skip:
            continue
        tree = cKDTree(points[i])
        tangents = np.stack([first[0][i], first[1][i]], axis=-1)
        normals = np.cross(first[0][i], first[1][i])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12 * element.max())
        partner, weight, target = partners[i], element, u
        for _ in range(n_rounds):
            root = np.sqrt(weight)[:, None]
            rows = np.column_stack([fixed, np.ones(len(fixed))])
            affine = np.linalg.lstsq(rows * root, partner * root, rcond=None)[0]
            moved = rows @ affine
            near = tree.query(moved)[1]
            step = _tangential(tangents[near], moved - points[i][near], 1.0 / n_dense)
            target = dense_u[near] + step
            partner = points[i][near] + np.einsum("nab,nb->na", tangents[near], step)
            turned = normal @ np.linalg.pinv(affine[:3]).T
            cosine = np.einsum("na,na->n", turned, normals[near])
            kept = cosine > _SAME_SIDE * np.maximum(np.linalg.norm(turned, axis=1), 1e-12)
            for axis, periodic in enumerate(space.periodic):
                if not periodic:
                    target[:, axis] = np.clip(target[:, axis], 0.0, 1.0)
                    # beyond the edge of this shape
                    inside = (u[:, axis] > 0) & (u[:, axis] < 1)
                    kept &= ~(inside & ((target[:, axis] <= 0) | (target[:, axis] >= 1)))
            if kept.mean() < 0.5:
                break
            weight = element * kept
        else:
            coefficients[i] = fit.maps(target, weight, float(ahead[i]))
    return coefficients


def turned_identity(space: Reparameterization, turns: Floats) -> Floats:
    """Return the identity with the first parameter ahead by a turn, for every shape: (n_S, *n_coefficients, d_par).

    Examples
    --------
    >>> space = Reparameterization((5,), (np.linspace(0, 1, 9)[:-1],), boundary="periodic")
    >>> space.evaluate(turned_identity(space, np.array([0.0, 0.25])))[:, 0, 0]
    array([0.  , 0.25])
    """
    out = np.repeat(space.identity()[None], len(turns), axis=0)
    out[..., 0] += turns.reshape(-1, *[1] * space.n_directions)
    return out


def without_folds(objective: GroupObjective, coefficients: Floats, turned: Floats) -> Floats:
    """Take every map back towards the turned identity, in steps of 15 %, until its Jacobian is clearly positive."""
    identity = objective.unknowns(turned).reshape(len(objective.moving), -1)
    towards = objective.unknowns(coefficients).reshape(identity.shape) - identity
    share = np.ones(len(identity))
    for _ in range(25):
        x = identity + share[:, None] * towards
        folded = objective.jacobians(x.ravel()).min(axis=1) < LEAST_JACOBIAN
        if not folded.any():
            return objective.coefficients(x.ravel())
        share[folded] *= 0.85
    share[folded] = 0.0
    return objective.coefficients((identity + share[:, None] * towards).ravel())


def _tangential(tangents: Floats, offset: Floats, limit: float) -> Floats:
    """Return the step in the parameters, (n, 2), that comes nearest to an offset (n, 3)."""
    metric = np.einsum("nac,nad->ncd", tangents, tangents)
    size = np.trace(metric, axis1=1, axis2=2)
    metric = metric + (1e-9 * size + 1e-300)[:, None, None] * np.eye(2)
    step = np.linalg.solve(metric, np.einsum("nac,na->nc", tangents, offset)[..., None])[..., 0]
    return np.clip(step, -limit, limit)


class _Fit:
    """Least squares fit of a map to scattered targets at the nodes."""

    def __init__(self, space: Reparameterization, u: Floats) -> None:
        self.space, self.u = space, u
        self.rows = space.rows_at(u)
        self.bending = bending_matrix(space)
        self.free = space.free.reshape(-1, 2)

    def maps(self, target: Floats, weight: Floats, turn: float) -> Floats:
        identity = turned_identity(self.space, np.array([turn]))[0]
        coefficients = identity.reshape(-1, 2).copy()
        away = target - self.u
        away[:, 0] -= turn
        share = weight / weight.sum()
        for axis, periodic in enumerate(self.space.periodic):
            if periodic:
                away[:, axis] -= np.round(away[:, axis])
            free = self.free[:, axis]
            rows = self.rows[:, free]
            system = rows.T @ (share[:, None] * rows) + _SMOOTHNESS * self.bending[np.ix_(free, free)]
            system += 1e-12 * np.trace(system) * np.eye(len(system))
            coefficients[free, axis] += np.linalg.solve(system, rows.T @ (share * away[:, axis]))
        return coefficients.reshape(identity.shape)
