"""The group optimization: pose the cohort, choose the reference, relax the barrier round by round."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from ssmpipe.core.align.procrustes import Alignment, generalized_procrustes
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.certificate import Certificate, certify
from ssmpipe.core.correspondence.description_length import description_length
from ssmpipe.core.correspondence.objective import Covariance, GroupObjective
from ssmpipe.core.correspondence.reparameterization import Boundary, Reparameterization
from ssmpipe.core.correspondence.weights import MeanAreaWeights
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.optim.interior import DescentOptions, minimize_interior
from ssmpipe.core.result import Result
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.surface import BSplineSurface


@dataclass(frozen=True)
class EngineOptions:
    """Choices of the group optimization; the defaults come from the study in the docs.

    Parameters
    ----------
    n_coefficients : (int, int)
        Coefficients of every ``D_i`` per direction.
    landmarks : (int, int)
        Landmark grid.
    degree : int
        Of ``D``.
    boundary : {"fixed", "sliding"}
    covariance : {"discrete", "II"}
    lambda_cut : float or None
        Threshold of the description length [mm^2]; None for the rule of :func:`automatic_lambda_cut`.
    pose : {"refined", "procrustes", "keep"}
        ``keep``: as given. ``procrustes``: refined once before the optimization, from the initial correspondence.
        ``refined``: as given first, then refined from the optimized correspondence, ``pose_rounds`` times.
    pose_rounds : int
        At most so many; they end when the landmarks move by less than a thousandth of the size (root mean square).
    remove_size : bool
        Whether sizes are removed inside the objective.
    prior : float
        Weight of the thin-plate energy of every ``D_i`` [nat].
    barriers : tuple of float
        Decreasing barrier weights, one round each; the last one is the weight of the result.
    floor : float
        Lower bound kept for every Bernstein coefficient of ``det dD/du``.
    reference : int or {"nearest-to-mean", "none"}
    max_iterations : int
        Per round.
    relative_decrease : float
        A round ends when the objective falls by less than this share twice in a row.
    """

    n_coefficients: tuple[int, int] = (8, 8)
    landmarks: tuple[int, int] = (51, 51)
    degree: int = 2
    boundary: Boundary = "fixed"
    covariance: Covariance = "discrete"
    lambda_cut: float | None = None
    pose: Literal["refined", "procrustes", "keep"] = "refined"
    pose_rounds: int = 6
    remove_size: bool = True
    prior: float = 0.01
    barriers: tuple[float, ...] = (30.0, 10.0, 3.0)
    floor: float = 0.0
    reference: int | Literal["nearest-to-mean", "none"] = "nearest-to-mean"
    max_iterations: int = 300
    relative_decrease: float = 1e-5


@dataclass(frozen=True, eq=False)
class Optimum:
    """Result of the group optimization.

    Parameters
    ----------
    coefficients : (n_S, n_b1, n_b2, 2)
    parameters : (n_S, n_P, 2)
        ``D_i(u_l)``.
    points, initial_points : (n_S, n_P, 3)
        In the refined pose [mm], sizes kept.
    alignment : Alignment
        From the input frame to the refined pose.
    eigenvalues, eigenvalues_initial : (n_S - 1,)
        Inside the objective [mm^2].
    description_length : (before, after)
    lambda_cut : float
    reference : int
        -1 when all shapes move.
    certificates : tuple of Certificate
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


def optimize_correspondence(
    surfaces: Sequence[BSplineSurface],
    options: EngineOptions | None = None,
    *,
    record: Callable[[dict[str, float]], None] | None = None,
) -> Result[Optimum]:
    """Find the reparameterizations of a cohort that minimize its description length (Li 2015, ch. 2).

    Parameters
    ----------
    surfaces : sequence of BSplineSurface
        At least two; equal degree and knots; roughly aligned [mm].
    options : EngineOptions, optional
    record : callable, optional
        Called after every iteration with ``iteration, description_length, max_constraint, min_jacobian``, where
        ``max_constraint`` is the largest ``floor - J_z`` and is never positive.

    Returns
    -------
    Result[Optimum]
        ``history`` holds the recorded columns.

    Raises
    ------
    GeometryError
        If fewer than two surfaces are given or they cannot be compared.
    """
    opts = options or EngineOptions()
    if len(surfaces) < 2:
        raise GeometryError(f"correspondence needs at least two shapes, got {len(surfaces)}")
    reparameterization = Reparameterization(
        opts.n_coefficients, opts.landmarks, degree=opts.degree, boundary=opts.boundary
    )
    identity = reparameterization.identity()[None]
    at_identity = np.repeat(reparameterization.evaluate(identity), len(surfaces), axis=0)
    raw = SplineStack(surfaces)
    given = raw.evaluate(at_identity).points
    alignment = _align(given, opts, keep_pose=opts.pose != "procrustes")
    start_points = _apply(alignment, given, scaled=True)
    mean = start_points.mean(axis=0)
    size = float(np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean()))
    lambda_cut = opts.lambda_cut if opts.lambda_cut is not None else automatic_lambda_cut(size)
    if opts.reference == "none":
        reference = -1
    elif opts.reference == "nearest-to-mean":
        reference = int(((start_points - mean) ** 2).sum(axis=(1, 2)).argmin())
    else:
        reference = opts.reference
    recorder = _Recorder(opts.floor, record)
    barriers = opts.barriers
    pose_rounds = opts.pose_rounds if opts.pose == "refined" else 0
    x = np.tile(reparameterization.identity()[reparameterization.free], len(surfaces) - (reference >= 0))
    n_iterations = n_evaluations = 0
    for pose_round in range(1 + pose_rounds):
        objective = GroupObjective(
            SplineStack([_posed(s, alignment, i) for i, s in enumerate(surfaces)]),
            reparameterization,
            lambda_cut=lambda_cut,
            covariance=opts.covariance,
            prior=opts.prior,
            floor=opts.floor,
            reference=reference,
        )
        if pose_round == 0:
            recorder.note(objective, x)
        for barrier in barriers:
            objective.barrier = barrier
            result = minimize_interior(
                objective,
                x,
                DescentOptions(max_iterations=opts.max_iterations, relative_decrease=opts.relative_decrease),
                callback=partial(recorder.note_iteration, objective),
            )
            x = result.value
            n_iterations += result.n_iterations
            n_evaluations += result.n_evaluations
        if pose_round < pose_rounds:
            current = raw.evaluate(reparameterization.evaluate(objective.coefficients(x))).points
            refined = _align(current, opts, keep_pose=False)
            moved = _apply(refined, current, scaled=True) - _apply(alignment, current, scaled=True)
            if float(np.sqrt((moved**2).sum(axis=-1).mean())) < 1e-3 * size:
                break
            alignment = refined
            barriers = opts.barriers[-1:]
    coefficients = objective.coefficients(x)
    parameters = reparameterization.evaluate(coefficients)
    eigenvalues = objective.evaluate(x)[0].spectrum.eigenvalues
    eigenvalues_initial = objective.evaluate(objective.start())[0].spectrum.eigenvalues
    optimum = Optimum(
        coefficients=coefficients,
        parameters=parameters,
        points=_apply(alignment, raw.evaluate(parameters).points, scaled=False),
        initial_points=_apply(alignment, given, scaled=False),
        alignment=alignment,
        eigenvalues=eigenvalues,
        eigenvalues_initial=eigenvalues_initial,
        description_length=(
            description_length(eigenvalues_initial, lambda_cut),
            description_length(eigenvalues, lambda_cut),
        ),
        lambda_cut=lambda_cut,
        reference=reference,
        certificates=tuple(certify(c, reparameterization) for c in coefficients),
    )
    return Result(optimum, result.status, n_iterations, n_evaluations, recorder.history())


class _Recorder:
    """Collects the history rows and hands each one on."""

    def __init__(self, floor: float, record: Callable[[dict[str, float]], None] | None) -> None:
        self._floor = floor
        self._record = record
        self._rows: list[dict[str, float]] = []

    def note(self, objective: GroupObjective, x: Floats) -> None:
        smallest = objective.smallest_jacobian(x)
        row = {
            "iteration": float(len(self._rows)),
            "description_length": objective.description_length(x),
            "max_constraint": self._floor - smallest,
            "min_jacobian": smallest,
        }
        self._rows.append(row)
        if self._record is not None:
            self._record(row)

    def note_iteration(self, objective: GroupObjective, _k: int, x: Floats, _f: float, _g: Floats) -> None:
        self.note(objective, x)

    def history(self) -> dict[str, Floats]:
        return {key: np.array([row[key] for row in self._rows]) for key in self._rows[0]}


def _align(points: Floats, options: EngineOptions, *, keep_pose: bool) -> Alignment:
    """Return poses and size factors for the (n_S, n_P, 3) points of a correspondence, landmarks weighed by their area."""
    weights = MeanAreaWeights(options.landmarks).value(points.mean(axis=0))
    alignment = generalized_procrustes(points, weights, remove_size=options.remove_size)
    if not keep_pose:
        return alignment
    n_shapes = len(points)
    unturned = np.repeat(np.eye(3)[None], n_shapes, axis=0)
    return Alignment(unturned, np.zeros((n_shapes, 3)), alignment.scale, alignment.centre)


def _apply(alignment: Alignment, points: Floats, *, scaled: bool) -> Floats:
    """Move (n_S, n, 3) points to their poses, and scale them about the common centre if asked."""
    moved = points @ np.swapaxes(alignment.rotation, 1, 2) + alignment.translation[:, None]
    if not scaled:
        return moved
    return alignment.centre + alignment.scale[:, None, None] * (moved - alignment.centre)


def _posed(surface: BSplineSurface, alignment: Alignment, i: int) -> BSplineSurface:
    """Move and scale the control points of shape ``i``; splines are affinely invariant."""
    control = surface.control_points @ alignment.rotation[i].T + alignment.translation[i]
    control = alignment.centre + alignment.scale[i] * (control - alignment.centre)
    return BSplineSurface(surface.degree, surface.knots_u, surface.knots_v, control)
