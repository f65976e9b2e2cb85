"""The choices of the group optimization, and of one more shape that joins its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ssmpipe.core.correspondence.barrier import Aggregate
from ssmpipe.core.correspondence.jacobian import JacobianForm
from ssmpipe.core.correspondence.measure import Quadrature
from ssmpipe.core.correspondence.objective import Covariance
from ssmpipe.core.correspondence.reparameterization import Boundary
from ssmpipe.core.correspondence.spectral import Objective
from ssmpipe.core.correspondence.window import Window

Normalization = Literal["none", "size", "affine"]
Solver = Literal["auto", "newton", "quasi-newton"]
Rims = Literal["kept", "free"]
Sensitivity = Literal["adjoint", "direct", "finite-difference"]


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
