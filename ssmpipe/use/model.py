"""A shape model loaded from a file, for scripts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError, ConfigError
from ssmpipe.core.mesh.closing import close_openings, weld
from ssmpipe.core.mesh.quads import grid_quads, scaled_jacobian
from ssmpipe.core.mesh.trimesh import TriMesh
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

    def _need_surface(self) -> None:
        if self.topology not in SURFACES:
            raise ConfigError(f"{self.path.name} is a model of curves ({self.topology}), it has no surface")


def load_model(path: Path | str) -> Model:
    """Read ``model.npz``; a result folder stands for the model in it.

    Raises
    ------
    ArtifactError
        If there is none, or it cannot be read.
    """
    place = Path(path)
    if place.is_dir():
        found = [p for p in (place / "model.npz", place / "cohort/model/model.npz") if p.is_file()]
        if not found:
            raise ArtifactError(
                f"{place} holds no model.npz", "give the output folder of a finished run, or model.npz itself"
            )
        place = found[0]
    if place.suffix != ".npz":
        raise ArtifactError(f"{place.name} is not a model.npz", "give model.npz, or the output folder of a run")
    return Model(load_artifact("model", "model", place.parent, [place.name]), place)
