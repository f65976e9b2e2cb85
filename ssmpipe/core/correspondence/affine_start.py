"""A start for the optimization of surfaces: the closest points of one shape on all others after an affine registration."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.procrustes import rotation_between
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.prior import bending_matrix
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.spline.evaluate import SplineStack

_SMOOTHNESS = 2.5e-6  # bending energy against squared distance in the square, mean over the nodes
LEAST_JACOBIAN = 0.05
_SIMILAR_ROUNDS = 12
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
    ahead = np.zeros(stack.n_shapes) if turns is None else turns
    coefficients = turned_identity(space, ahead)
    dense = DensePoints(stack, space, n_dense)
    partners = np.array(stack.evaluate(space.evaluate(coefficients)).points)
    fit = MapFit(space)
    free = bool(space.window.open_edges)  # rims tell nothing of where places are then
    for i in range(stack.n_shapes):
        if i != skip:
            found = dense.registered(i, fixed, area, None if free else partners[i], n_rounds)
            if found is not None:
                coefficients[i] = fit.maps(*found, float(ahead[i]))
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
    x = taken_back(identity, towards, lambda x: objective.walls(x.ravel()).min(axis=1))
    return objective.coefficients(x.ravel())


def taken_back(start: Floats, way: Floats, least: Callable[[Floats], Floats], n_tries: int = 25) -> Floats:
    """Return the places farthest on their ways, in steps of 15 %, where no map folds.

    Parameters
    ----------
    start, way : (n, m) float64
        A row per map.
    least : function
        Of (n, m) unknowns: the smallest Jacobian of every map, (n,).
    n_tries : int
        After which a map stays at its start.

    Examples
    --------
    >>> taken_back(np.zeros((3, 1)), np.array([[0.5], [1.1], [99.0]]), lambda x: 1 - x[:, 0])
    array([[0.5  ],
           [0.935],
           [0.   ]])
    """
    share = np.ones(len(start))
    for _ in range(n_tries):
        x = start + share[:, None] * way
        folded = least(x) < LEAST_JACOBIAN
        if not folded.any():
            return x
        share[folded] *= 0.85
    share[folded] = 0.0
    return np.asarray(start + share[:, None] * way)


def _tangential(tangents: Floats, offset: Floats) -> Floats:
    """Return the step in the parameters, (n, 2), that comes nearest to an offset (n, 3)."""
    metric = np.einsum("nac,nad->ncd", tangents, tangents)
    size = np.trace(metric, axis1=1, axis2=2)
    metric = metric + (1e-9 * size + 1e-300)[:, None, None] * np.eye(2)
    return np.asarray(np.linalg.solve(metric, np.einsum("nac,na->nc", tangents, offset)[..., None])[..., 0])


def _similarity(source: Floats, target: Floats, weights: Floats) -> Floats:
    """Return the motion with a change of size, (4, 3), that brings (n, 3) points nearest to others: rows of ``[x, 1] @ motion``."""
    share = weights / weights.sum()
    a, b = source - share @ source, target - share @ target
    rotation = rotation_between(a, b, weights)
    turned = a @ rotation.T
    scale = float((share[:, None] * turned * b).sum() / (share[:, None] * a * a).sum())
    linear = scale * rotation.T
    return np.vstack([linear, share @ target - share @ source @ linear])


class DensePoints:
    """Points of every shape on a dense grid, among which closest points are looked up."""

    def __init__(self, stack: SplineStack, space: Reparameterization, n: int) -> None:
        grid = [np.linspace(0.0, 1.0, n, endpoint=not p) for p in space.periodic]
        self.u = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 2)
        jet = stack.evaluate(np.repeat(self.u[None], stack.n_shapes, axis=0))
        self.points, self.first = np.array(jet.points), [np.array(f) for f in jet.first]
        self.spacing, self.space = 1.0 / n, space
        self.own = space.evaluate(space.identity()[None])[0]

    def registered(
        self,
        i: int,
        fixed: Floats,
        area: Floats,
        partner: Floats | None,
        n_rounds: int,
        beyond: Sequence[tuple[int, int]] = (),
    ) -> tuple[Floats, Floats] | None:
        """Return parameters (n_P, 2) of the closest points on shape ``i``, and their weights; None where it does not fit.

        Parameters
        ----------
        i : int
        fixed, area : (n_P, 3)
            Places to register, and ``S_u x S_v`` there.
        partner : (n_P, 3) or None
            First partners on the shape. None: those in the pose that the shape has, and a similarity before the affine map, which
            would take a longer shaft for a stretched one.
        n_rounds : int
            With an affine map.
        beyond : sequence of (direction, end)
            Past these edges parameters go on along the tangent; other edges stop them.
        """
        element = np.linalg.norm(area, axis=1)
        tiny = 1e-12 * element.max()
        normal = area / np.maximum(element, tiny)[:, None]
        points, tree = self.points[i], cKDTree(self.points[i])
        tangents = np.stack([self.first[0][i], self.first[1][i]], axis=-1)
        normals = np.cross(self.first[0][i], self.first[1][i])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), tiny)
        weight, target = element, self.own
        rows = np.column_stack([fixed, np.ones(len(fixed))])
        n_similar = _SIMILAR_ROUNDS if partner is None else 0
        for k in range(n_similar + n_rounds):
            if partner is None:
                affine = np.eye(4, 3)  # the pose it has
            elif k < n_similar:
                affine = _similarity(fixed, partner, weight)
            else:
                root = np.sqrt(weight)[:, None]
                affine = np.linalg.lstsq(rows * root, partner * root, rcond=None)[0]
            moved = rows @ affine
            near = tree.query(moved)[1]
            full = _tangential(tangents[near], moved - points[near])
            step = np.clip(full, -self.spacing, self.spacing)
            target = self.u[near] + step
            partner = points[near] + np.einsum("nab,nb->na", tangents[near], step)
            turned = normal @ np.linalg.pinv(affine[:3]).T
            cosine = np.einsum("na,na->n", turned, normals[near])
            kept = cosine > _SAME_SIDE * np.maximum(np.linalg.norm(turned, axis=1), 1e-12)
            passed = target.copy()
            usable = kept.copy()
            for axis, periodic in enumerate(self.space.periodic):
                if periodic:
                    continue
                target[:, axis] = np.clip(target[:, axis], 0.0, 1.0)
                # beyond the edge of this shape; a place on the same edge may stay there, unless it is open
                inside = (self.own[:, axis] > 0) & (self.own[:, axis] < 1)
                out = inside & ((target[:, axis] <= 0) | (target[:, axis] >= 1))
                past = np.zeros(len(out), dtype=bool)
                for end in (end for a, end in beyond if a == axis):
                    at_edge = self.u[near, axis] == (0.0 if end == 0 else 1.0)
                    past |= at_edge & (full[:, axis] < 0 if end == 0 else full[:, axis] > 0)
                kept &= ~(out | past)
                usable &= ~out | past
                passed[:, axis] = np.where(past, self.u[near, axis] + full[:, axis], target[:, axis])
            if kept.mean() < 0.5:
                return None
            weight = element * kept
        return (passed, element * usable) if len(beyond) else (target, weight)


class MapFit:
    """Least squares fit of a map to scattered targets at the nodes; ``open_edges`` may move."""

    def __init__(self, space: Reparameterization, open_edges: Sequence[tuple[int, int]] = ()) -> None:
        self.space = space
        nodes = np.stack(np.meshgrid(*space.nodes, indexing="ij"), axis=-1).reshape(-1, 2)
        self.own = space.window.image(nodes)
        self.rows = space.rows_at(nodes)
        self.bending = bending_matrix(space)
        free = space.free.copy()
        for axis, end in open_edges:
            free[(slice(None),) * axis + (end,)] = True
        self.free = free.reshape(-1, 2)

    def maps(self, target: Floats, weight: Floats, turn: float) -> Floats:
        """Return the (*n_coefficients, 2) map that is nearest to (n_P, 2) targets and smooth, from the turned identity."""
        identity = turned_identity(self.space, np.array([turn]))[0]
        coefficients = identity.reshape(-1, 2).copy()
        away = target - self.own
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
