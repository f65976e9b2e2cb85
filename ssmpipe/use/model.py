"""A shape model loaded from a file, for scripts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.closing import close_openings, weld
from ssmpipe.core.mesh.distance import signed_point_to_mesh
from ssmpipe.core.mesh.quads import grid_quads, scaled_jacobian
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.completion import Completion, complete
from ssmpipe.core.model.posterior import Observations, Posterior, posterior
from ssmpipe.core.model.remainder import LeaveOneOut, Remainder, fit_remainder, leave_one_out
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.io.codecs import load_artifact

SURFACES = ("disk", "tube", "cone", "closed")


@dataclass(frozen=True, eq=False)
class Model:
    """Mean, modes and variances, and what follows from them.

    Lengths are in the unit of the model (mm unless its config said ``units: none``); coefficients are in standard deviations.

    Parameters
    ----------
    shape_model : ShapeModel
    path : Path
        Where it was read.
    """

    shape_model: ShapeModel
    path: Path

    def __repr__(self) -> str:
        """Return sizes instead of arrays."""
        n_points, d = self.mean.shape
        return f"<Model {self.path}: {self.topology}, {len(self.ids)} shapes, {n_points} points in {d}-D, {len(self.variances)} modes>"

    @property
    def ids(self) -> tuple[str, ...]:
        """Shapes that the model was built from."""
        return self.shape_model.ids

    @property
    def topology(self) -> str:
        """``disk``, ``tube``, ``cone``, ``closed``, ``curve-open`` or ``curve-closed``."""
        return self.shape_model.topology

    @property
    def mean(self) -> Floats:
        """Mean points, (n_P, d) [mm]."""
        return self.shape_model.mean

    @property
    def modes(self) -> Floats:
        """Orthonormal modes, (n_modes, n_P, d)."""
        return self.shape_model.modes

    @property
    def variances(self) -> Floats:
        """Variance along each mode, (n_modes,) [mm^2]."""
        return self.shape_model.variances

    @property
    def scores(self) -> Floats:
        """Coefficients of the shapes of the cohort, (n_S, n_modes)."""
        return self.shape_model.scores

    def instance(self, coefficients: Floats | list[float]) -> Floats:
        """Return the (n_P, d) points at ``coefficients`` along the leading modes.

        Raises
        ------
        ConfigError
            If there are more coefficients than modes.
        """
        sigmas = np.atleast_1d(np.asarray(coefficients, dtype=np.float64))
        if len(sigmas) > len(self.variances):
            raise ConfigError(f"{len(sigmas)} coefficients were given, the model has {len(self.variances)} modes")
        return self.shape_model.instance(sigmas)

    def sample(self, n: int, *, seed: int = 0, n_modes: int | None = None) -> tuple[Floats, Floats]:
        """Draw random instances from the normal distribution of the model.

        Returns
        -------
        points : (n, n_P, d)
        coefficients : (n, n_modes)
        """
        count = len(self.variances) if n_modes is None else min(n_modes, len(self.variances))
        drawn = np.random.default_rng(seed).standard_normal((n, count))
        return np.stack([self.shape_model.instance(row) for row in drawn]) if n else np.empty(
            (0, *self.mean.shape)
        ), drawn

    def project(self, points: Floats) -> Floats:
        """Return the coefficients of corresponded points in the frame of the model, (n_modes,)."""
        if points.shape != self.mean.shape:
            raise ConfigError(f"the points are {points.shape}, those of the model {self.mean.shape}")
        return self.shape_model.project(points)

    def reconstruct(self, points: Floats) -> Floats:
        """Return the instance of the model that is nearest to corresponded points in its frame, (n_P, d)."""
        return self.shape_model.instance(self.project(points))

    @cached_property
    def leave_one_out(self) -> LeaveOneOut:
        """Every shape of the cohort in the model of the others: residuals and Mahalanobis distances."""
        self._need_shapes()
        return leave_one_out(self.shape_model.training_points)

    @cached_property
    def remainder(self) -> Remainder:
        """What the modes do not reach, fitted to the leave-one-out residuals."""
        return fit_remainder(self.leave_one_out.residuals, self.mean)

    def log_likelihood(self, points: Floats) -> float:
        """Return the logarithm of the density of corresponded points in the frame of the model [nat].

        Probabilistic principal components (Tipping and Bishop 1999): the modes, and noise of the variance of the leave-one-out residuals.
        For comparing shapes with each other; alone it means little.
        """
        scores, noise = self.project(points), self.remainder.variance + self.remainder.noise
        left = float(((points - self.shape_model.instance(scores)) ** 2).sum())
        n, kept = points.size, self.variances
        log_det = float(np.log(kept + noise).sum() + (n - len(kept)) * np.log(noise))
        inside = float((scores**2 * kept / (kept + noise)).sum())
        return float(-0.5 * (n * np.log(2 * np.pi) + log_det + inside + left / noise))

    def given(self, points: Ints, places: Floats) -> Posterior:
        """Return the model given the places (n, d) of some of its points, numbered (n,), in its frame [mm].

        Expected points, coefficients with covariance, and the uncertainty of every point; see
        :func:`ssmpipe.core.model.posterior.posterior`.
        """
        return posterior(self.shape_model, self.remainder, Observations.of_places(np.asarray(points), places))

    def complete(self, fragment: TriMesh) -> Completion:
        """Complete a part of a surface in any pose, of the side of the model; see :func:`ssmpipe.core.model.completion.complete`.

        Raises
        ------
        ConfigError
            If the model is one of curves, or of fewer than three shapes.
        GeometryError
            If the fragment cannot be placed.
        """
        self._need_surface()
        return complete(fragment, self.shape_model, self.remainder)

    def surface_distance(self, surface: TriMesh, coefficients: Floats | list[float]) -> Floats:
        """Return the distance of every vertex of a surface in the frame of the model from an instance, positive outside [mm]."""
        return signed_point_to_mesh(surface.vertices, self.surface(self.instance(coefficients)))

    def distance(self, coefficients: Floats | list[float]) -> float:
        """Return the Mahalanobis distance from the mean [standard deviations]."""
        return float(np.linalg.norm(coefficients))

    def surface(self, points: Floats, *, watertight: bool = False) -> TriMesh:
        """Return a triangle surface over an instance; the copies of a pole are merged, ``watertight`` closes openings.

        Raises
        ------
        ConfigError
            If the model is one of curves.
        """
        self._need_surface()
        mesh = TriMesh(points, self.shape_model.faces)
        if self.topology in ("cone", "closed"):
            mesh = weld(mesh)
        return close_openings(mesh) if watertight else mesh

    def quads(self) -> Ints:
        """Return the quadrilaterals of the grid, (n_quads, 4); those at a pole have two equal corners.

        Raises
        ------
        ConfigError
            If the model is one of curves.
        """
        self._need_surface()
        n_u, n_v = self.shape_model.grid
        return grid_quads(n_u, n_v, periodic_u=self.topology != "disk")

    def quad_quality(self, points: Floats) -> Floats:
        """Return the scaled Jacobian of every quadrilateral that is not at a pole."""
        quads = self.quads()
        row = quads % self.shape_model.grid[1]
        at_apex = (row == self.shape_model.grid[1] - 1).any(axis=1) & (self.topology in ("cone", "closed"))
        at_antapex = (row == 0).any(axis=1) & (self.topology == "closed")
        return scaled_jacobian(points, quads[~at_apex & ~at_antapex])

    def _need_shapes(self) -> None:
        if len(self.scores) < 3:
            raise ConfigError(f"{self.path.name} holds {len(self.scores)} shapes, at least 3 are needed for this")

    def _need_surface(self) -> None:
        if self.topology not in SURFACES:
            raise ConfigError(f"{self.path.name} is a model of curves ({self.topology}), it has no surface")


def load_model(path: Path | str) -> Model:
    """Read ``model.npz``; a result folder stands for the model in it.

    Raises
    ------
    ConfigError
        If there is none.
    ArtifactError
        If it cannot be read.
    """
    place = Path(path)
    if place.is_dir():
        found = [p for p in (place / "model.npz", place / "cohort/model/model.npz") if p.is_file()]
        if not found:
            raise ConfigError(
                f"{place} holds no model.npz", "give the output folder of a finished run, or model.npz itself"
            )
        place = found[0]
    if not place.exists():
        raise ConfigError(f"there is no {place}", "give model.npz, or the output folder of a finished run")
    if place.suffix != ".npz":
        raise ConfigError(f"{place.name} is not a model.npz", "give model.npz, or the output folder of a run")
    return Model(load_artifact("model", "model", place.parent, [place.name]), place)
