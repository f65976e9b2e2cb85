"""The whole shape from a fragment: pose, coefficients and what is missing, by the posterior of the model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssmpipe.core.align.rigid import apply, homogeneous, move, rotation_vector_matrix
from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.closing import weld
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import face_normals, vertex_normals
from ssmpipe.core.mesh.topology import boundary_half_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.fragment_pose import place_fragment
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.model.posterior import NOWHERE, Observations, Posterior, posterior, rigid_fields
from ssmpipe.core.model.remainder import Remainder, farthest_first
from ssmpipe.core.model.shape_model import ShapeModel

_MOTION = (0.3, 30.0)
"""Prior standard deviation of the pose about the start: rotation [rad], translation [mm]; next to nothing is known of it."""
_FACING = 0.5
_MISFIT = 0.3
"""Noise of a distance along a normal, in variances of the remainder: pairs are never quite right."""
_FARTHER = (1.25, -1.25, 2.5, -2.5)
"""Where along the first mode a pose is looked for when none is good on the mean [standard deviations]."""
_FARTHER_HAS_TO_GAIN = 1.25
"""How many times better a pose found on an unusual shape has to be than one on the mean, after a few iterations [-]."""
_EXPLAINED = 0.25
"""A pose is good when its :func:`_badness` is below this [typical deviations of a shape]; on femora right ones have 0.04 to 0.14, a wrong
one 0.7."""
_MOST_HIDDEN = 16
_FEWEST = 4
_LEAST_SEEN = 0.05


@dataclass(frozen=True, eq=False)
class Completion:
    """A shape of which a part was seen.

    Parameters
    ----------
    points : (n_P, d)
        Expected place of every point of the model, in its frame [mm].
    deviation : (n_P, d)
        Standard deviation of every coordinate, scaled by what :func:`hidden_training` finds [mm].
    seen : (n_P,) bool
        Which points have a counterpart on the fragment.
    scores, covariance : (n_modes,), (n_modes, n_modes)
    matrix : (4, 4)
        From the fragment to the frame of the model.
    rms : float
        Distance of the seen points from the fragment along its normals, root mean square [mm].
    n_iterations : int
    start_cost : float
        Of the rigid start [mm].
    expected_error : float
        Root mean square error of missing points where the same part of the training shapes was hidden [mm]; NaN with too few shapes.
    """

    points: Floats
    deviation: Floats
    seen: Bools
    scores: Floats
    covariance: Floats
    matrix: Floats
    rms: float
    n_iterations: int
    start_cost: float
    expected_error: float = float("nan")


def complete(
    fragment: TriMesh,
    model: ShapeModel,
    remainder: Remainder,
    *,
    start: Floats | None = None,
    n_iterations: int = 25,
    n_rows: int = 400,
) -> Completion:
    """Fit pose and shape of a model to a fragment, and predict what is missing (Albrecht et al. 2013; Luethi et al. 2018).

    In turn: every point of the present shape is paired with the nearest place of the fragment, unless that lies on its rim, faces away or
    is far; the model given these distances along the normals, and a small rigid motion with it, is the next shape. Only distances along
    normals count, so points may slide; where they end along the surface the model decides.

    Parameters
    ----------
    fragment : TriMesh
        Faces wound outward, of the side of the model's shapes [mm].
    model : ShapeModel
        Of surfaces.
    remainder : Remainder
    start : (4, 4) float64, optional
        From the fragment to the frame of the model; by default :func:`place_fragment` looks for it on the mean, and its best poses are
        tried; where none explains the fragment, on shapes to both sides of the mean along the first mode, which mostly is size.
    n_iterations : int
    n_rows : int
        Pairs that are used, far from each other.

    Raises
    ------
    GeometryError
        If no pose explains a fair part of the fragment.
    """
    size = _typical_deviation(model)
    found: list[tuple[float, Completion]] = []
    for sigmas in (0.0, *_FARTHER) if start is None else (0.0,):
        if found and min(bad for bad, _ in found) < _EXPLAINED * size:
            break
        starts = [(start, float("nan"))] if start is not None else _starts(fragment, model, sigmas)
        for matrix, cost in starts:
            one = _fit(fragment, model, remainder, matrix, 8 if len(starts) > 1 else n_iterations, n_rows)
            if one is not None:
                bad = _badness(one, fragment, model) * (1.0 if sigmas == 0.0 else _FARTHER_HAS_TO_GAIN)
                found.append((bad, replace(one, start_cost=cost)))
    if not found:
        raise GeometryError(
            "the fragment cannot be placed on the model", "check units, side and that it is of this anatomy"
        )
    best = min(range(len(found)), key=lambda k: (found[k][0], k))
    again = _fit(fragment, model, remainder, found[best][1].matrix, n_iterations, n_rows, last=True)
    if again is None:
        raise GeometryError("the fragment and the model came apart", "check units, side and that it is of this anatomy")
    places, scores, error = 1.0, 1.0, float("nan")
    if len(model.scores) >= _FEWEST:
        places, scores, error = hidden_training(model, remainder, again.seen)
    return replace(
        again,
        start_cost=found[best][1].start_cost,
        deviation=places * again.deviation,
        covariance=scores**2 * again.covariance,
        expected_error=error,
    )


def _starts(fragment: TriMesh, model: ShapeModel, sigmas: float) -> list[tuple[Floats, float]]:
    """Return rigid poses on a shape along the first mode, and what they cost [mm], cheapest first."""
    whole = TriMesh(model.instance(np.array([sigmas])), model.faces)
    if model.topology in ("cone", "closed"):
        whole = weld(whole)
    return [(p.matrix, p.cost) for p in place_fragment(fragment, whole)]


def _typical_deviation(model: ShapeModel) -> float:
    """Return the root mean square distance of a point of a shape from the mean [mm]."""
    return float(np.sqrt(model.variances.sum() / len(model.mean)))


def _badness(one: Completion, fragment: TriMesh, model: ShapeModel) -> float:
    """Return how badly the fragment is explained: its distance from the shape [mm], and how unusual the shape is."""
    places = apply(one.matrix, fragment.vertices[:: max(1, fragment.n_vertices // 1500)])
    distance = point_to_mesh(places, TriMesh(one.points, model.faces))[0]
    size = _typical_deviation(model)
    unusual = max(0.0, float((one.scores**2).mean()) - 1.0)
    return float(np.minimum(distance, 3.0 * size).mean() + 0.05 * size * unusual)


def _fit(
    fragment: TriMesh,
    model: ShapeModel,
    remainder: Remainder,
    matrix: Floats,
    n_iterations: int,
    n_rows: int,
    *,
    last: bool = False,
) -> Completion | None:
    """Alternate pairs and posterior from a start; None when they come apart."""
    rim = np.zeros(fragment.n_vertices, dtype=bool)
    rim[boundary_half_edges(fragment.faces).ravel()] = True
    rim_face: Bools = np.asarray(rim[fragment.faces].any(axis=1), dtype=np.bool_)
    centre, shape = model.mean.mean(axis=0), model.mean
    own = remainder.variance + remainder.noise
    along = remainder.noise + _MISFIT * remainder.variance
    loose = max(own, 0.1 * float(model.variances.sum()) / model.mean.size)
    n_done = 0
    for k in range(n_iterations):
        moved = move(fragment, matrix)
        pairs = _pairs(shape, model, moved, rim_face, 0.8**k)
        if pairs is None:
            return None
        rows = _rows(pairs, model, n_rows)
        result = posterior(
            model, remainder, rows, noise=along + loose * 0.5**k, motion_deviation=_MOTION, deviation_at=NOWHERE
        )
        matrix = _undone(result.motion, centre) @ matrix
        change = float(np.sqrt(((result.points - shape) ** 2).sum(axis=1).mean()))
        shape, n_done = result.points, k + 1
        if k > 5 and change < 1e-3 * np.sqrt(own) and np.linalg.norm(result.motion[3:]) < 1e-3 * np.sqrt(own):
            break
    moved = move(fragment, matrix)
    pairs = _pairs(shape, model, moved, rim_face, 0.0)
    if pairs is None:
        return None
    seen, normal = pairs
    rows = _rows(pairs, model, n_rows)
    at = None if last else NOWHERE
    final: Posterior = posterior(model, remainder, rows, noise=along, motion_deviation=_MOTION, deviation_at=at)
    mask = np.zeros(len(model.mean), dtype=bool)
    mask[seen] = True
    left = normal.values - np.einsum("jc,jc->j", final.points[seen], normal.directions)
    return Completion(
        points=final.points,
        deviation=final.deviation,
        seen=mask,
        scores=final.scores,
        covariance=final.covariance,
        matrix=_undone(final.motion, centre) @ matrix,
        rms=float(np.sqrt((left**2).mean())),
        n_iterations=n_done,
        start_cost=float("nan"),
    )


def _undone(motion: Floats, centre: Floats) -> Floats:
    """Return the rigid motion that takes a rotation about a centre and a translation back, (4, 4)."""
    turn = rotation_vector_matrix(motion[:3])
    return homogeneous(turn.T, centre - turn.T @ (centre + motion[3:]))


def _pairs(
    shape: Floats, model: ShapeModel, moved: TriMesh, rim_face: Bools, patience: float
) -> tuple[Ints, Observations] | None:
    """Return the points that are seen and what was seen of them; None when there are too few."""
    distance, face, weights = point_to_mesh(shape, moved)
    normals = face_normals(moved)[face]
    facing = np.einsum("ij,ij->i", normals, vertex_normals(TriMesh(shape, model.faces))) > _FACING
    inside = facing & ~rim_face[face]
    if inside.sum() < _LEAST_SEEN * len(shape):
        return None
    typical = float(np.median(distance[inside]))
    size = float(np.sqrt(((shape - shape.mean(axis=0)) ** 2).sum(axis=1).mean()))
    near = inside & (distance <= max(4.0 * typical, 0.02 * size, 0.25 * size * patience))
    if near.sum() < _LEAST_SEEN * len(shape):
        return None
    seen = np.flatnonzero(near)
    places = np.einsum("nk,nkd->nd", weights[seen], moved.vertices[moved.faces[face[seen]]])
    values = np.einsum("ij,ij->i", normals[seen], places)
    return seen, Observations(seen, normals[seen], values)


def _rows(pairs: tuple[Ints, Observations], model: ShapeModel, n_rows: int) -> Observations:
    seen, rows = pairs
    chosen = farthest_first(model.mean[seen], n_rows)
    return Observations(seen[chosen], rows.directions[chosen], rows.values[chosen])


def hidden_training(
    model: ShapeModel, remainder: Remainder, seen: Bools, n_rows: int = 300
) -> tuple[float, float, float]:
    """Hide the same part of the training shapes, complete each by the model of the others, and compare with what was hidden.

    A model of few shapes is too sure of itself; this tells by how much.

    Parameters
    ----------
    model : ShapeModel
        Of at least four shapes.
    remainder : Remainder
    seen : (n_P,) bool

    Returns
    -------
    places, scores : float
        Factors on the standard deviations of places and of coefficients, at least one.
    error : float
        Root mean square error of the hidden points [mm].
    """
    points = model.training_points
    hidden = np.flatnonzero(~seen) if not seen.all() else np.arange(len(seen))
    hidden = hidden[farthest_first(model.mean[hidden], 150)]
    shown = np.flatnonzero(seen)
    shown = shown[farthest_first(model.mean[shown], n_rows)]
    ratios, surprises, errors = [], [], []
    for j in np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_HIDDEN)).astype(int)):
        mean, modes, variances, scores = principal_components(np.delete(points, j, axis=0))
        others = replace(model, mean=mean, modes=modes, variances=variances, scores=scores, ids=())
        normals = vertex_normals(TriMesh(points[j], model.faces))[shown]
        rows = Observations(shown, normals, np.einsum("jc,jc->j", normals, points[j, shown]))
        noise = remainder.noise + _MISFIT * remainder.variance
        found = posterior(others, remainder, rows, noise=noise, motion_deviation=_MOTION, deviation_at=hidden)
        moved = found.points + np.einsum("m,mld->ld", found.motion, rigid_fields(mean))
        error = (moved - points[j])[hidden]
        ratios.append(float((error**2 / found.deviation**2).mean()))
        own = np.linalg.solve(found.covariance, found.scores - others.project(points[j]))
        surprises.append(float(own @ (found.scores - others.project(points[j]))) / len(variances))
        errors.append(float((error**2).sum(axis=1).mean()))
    return max(1.0, np.sqrt(np.mean(ratios))), max(1.0, np.sqrt(np.mean(surprises))), float(np.sqrt(np.mean(errors)))
