"""One shape in a model, in numbers: coefficients, their uncertainty, distances; what its page shows and what its folder holds."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.align.rigid import apply
from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.correspondence.newcomer import Newcomer
from ssmpipe.core.evaluation.quality import Geometry, facing
from ssmpipe.core.mesh.distance import signed_point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.posterior import NOWHERE, Observations, posterior
from ssmpipe.core.model.remainder import farthest_first
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, edge_indices
from ssmpipe.io.arrays import write_npz
from ssmpipe.io.codecs import write_json
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import write_mesh
from ssmpipe.io.outlines import write_outline
from ssmpipe.report.projected import ProjectedPage
from ssmpipe.runner.disk import disk_errors
from ssmpipe.runner.sources import Source
from ssmpipe.use.distance_numbers import rank, rms, summary
from ssmpipe.use.projected_pages import about
from ssmpipe.use.target import Target

_SEEN_POINTS = 300


def moved(shape: TriMesh | Outline, matrix: Floats) -> TriMesh | Outline:
    """Return a mesh or an outline moved by a (4, 4) matrix; outside stays outside where that mirrors."""
    if isinstance(shape, Outline):
        return Outline(shape.points @ matrix[:2, :2].T + matrix[:2, 3], shape.closed)
    faces = shape.faces if np.linalg.det(matrix[:3, :3]) > 0 else shape.faces[:, ::-1]
    return TriMesh(apply(matrix, shape.vertices), faces)


@dataclass(frozen=True, eq=False)
class Projection:
    """One shape in the model, in numbers.

    Parameters
    ----------
    target : Target
    points : (n_P, d)
        Corresponded, in the frame of the model [mm].
    scores, deviations : (n_modes,)
        Coefficients and their uncertainty [standard deviations of the model].
    covariance : (n_modes, n_modes)
    reconstruction : (n_P, d)
        The instance of the model at the scores.
    matrix : (4, 4)
        From the scan to the frame of the model.
    observed : TriMesh or Outline, optional
        The processed scan in the frame of the model.
    new : Newcomer
    """

    target: Target
    points: Floats
    scores: Floats
    deviations: Floats
    covariance: Floats
    reconstruction: Floats
    matrix: Floats
    observed: TriMesh | Outline | None
    new: Newcomer

    @classmethod
    def of(
        cls, target: Target, points: Floats, new: Newcomer, matrix: Floats, observed: TriMesh | Outline | None
    ) -> Projection:
        """Project corresponded points and say how sure the coefficients are."""
        model = target.model
        scores = model.project(points)
        few = farthest_first(model.mean, _SEEN_POINTS)
        seen = Observations.of_places(few, points[few])
        covariance = posterior(model, target.remainder, seen, deviation_at=NOWHERE).covariance
        return cls(
            target,
            points,
            scores,
            np.sqrt(np.diagonal(covariance)),
            covariance,
            model.instance(scores),
            matrix,
            observed,
            new,
        )

    def numbers(self, shape: str, side: str | None) -> dict[str, Any]:
        """Return what the table and the page say of the shape."""
        others = self.target.others
        distance = float(np.linalg.norm(self.scores))
        residual = rms(self.points - self.reconstruction)
        verdict = self.new.certificate
        to_scan, to_model = self.distances()
        covered = self.covered()
        return {
            "id": shape,
            "side": side or "",
            "scores": self.scores,
            "deviations": self.deviations,
            "mahalanobis": distance,
            "mahalanobis_p": rank(distance, others.mahalanobis),
            "residual_rms_mm": residual,
            "residual_p": rank(residual, self.target.residuals),
            **summary("to_scan", to_scan),
            **summary("from_scan", to_model[covered]),
            "beyond_share": 1.0 - float(covered.mean()) if len(covered) else 0.0,
            "description_length_before": self.new.description_length[0],
            "description_length_after": self.new.description_length[1],
            "certificate": {
                "quantity": "lower bound of det dD/du over the whole parameter domain",
                "lower_bound": verdict.lower_bound,
                "smallest_value_seen": verdict.upper_bound_of_minimum,
                "status": verdict.verdict,
                "subdivisions": verdict.n_subdivisions,
            },
        }

    def distances(self) -> tuple[Floats, Floats]:
        """Return signed distances from the reconstruction to the scan and back [mm], positive where the scan lies outside.

        Zero on the way back where the model does not cover the scan.
        """
        if self.observed is None:
            return np.empty(0), np.empty(0)
        if isinstance(self.observed, Outline):
            closed = self.target.model.topology == "curve-closed"
            edges = edge_indices(len(self.reconstruction), closed)
            return (
                point_to_segments(self.reconstruction, self.observed.points, self.observed.edges)[0],
                point_to_segments(self.observed.points, self.reconstruction, edges)[0],
            )
        model_surface = TriMesh(self.reconstruction, self.target.model.faces)
        to_model = signed_point_to_mesh(self.observed.vertices, model_surface)
        return -signed_point_to_mesh(self.reconstruction, self.observed), np.where(self.covered(), to_model, 0.0)

    def covered(self) -> Bools:
        """Say which vertices of the scan the model covers: all, but those beyond its rim where the rims of the model are free."""
        if isinstance(self.observed, TriMesh) and self.target.model.window is not None:
            return facing(self.observed.vertices, Geometry(self.reconstruction, self.target.model.faces))
        n = (
            0
            if self.observed is None
            else len(self.observed.points if isinstance(self.observed, Outline) else self.observed.vertices)
        )
        return np.ones(n, dtype=bool)

    def page(self, source: Source, warnings: Sequence[tuple[str, str]]) -> ProjectedPage:
        """Return what the page of the shape shows."""
        to_scan, to_model = self.distances()
        mesh = self.observed if isinstance(self.observed, TriMesh) else None
        return ProjectedPage(
            **about(self.target, source),
            numbers=self.numbers(source.id, source.side),
            points=self.points,
            reconstruction=self.reconstruction,
            matrix=self.matrix,
            map_name="Distance of the scan from its reconstruction",
            map_values=to_scan if len(to_scan) else None,
            scan=Geometry(mesh.vertices, mesh.faces) if mesh is not None else None,
            scan_distance=to_model if mesh is not None else None,
            warnings=warnings,
        )

    def write(self, folder: Path, shape: str, side: str | None) -> None:
        """Write meshes, arrays and numbers; everything in scan coordinates and units, distances in mm."""
        back = np.asarray(np.linalg.inv(self.matrix))
        model = self.target.model
        with disk_errors():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            to_scan, to_model = self.distances()
            d = self.points.shape[1]
            in_scan = {
                name: points @ back[:d, :d].T + back[:d, 3]
                for name, points in (("corresponded", self.points), ("reconstruction", self.reconstruction))
            }
            if d == 2:
                for name, points in in_scan.items():
                    write_outline(folder / f"{name}.csv", Outline(points, model.topology == "curve-closed"))
            elif len(model.faces):
                faces = model.faces if np.linalg.det(back[:3, :3]) > 0 else model.faces[:, ::-1]
                for name, points in in_scan.items():
                    write_mesh(folder / f"{name}.ply", TriMesh(points, faces))
                data = {"residual_mm": np.linalg.norm(self.points - self.reconstruction, axis=1)}
                if len(to_scan):
                    data = {"distance_mm": to_scan, **data}
                (folder / "reconstruction.vtp").write_bytes(vtp.dump(in_scan["reconstruction"], faces, data))
                if isinstance(self.observed, TriMesh):
                    scan = moved(self.observed, back)
                    assert isinstance(scan, TriMesh)
                    (folder / "scan.vtp").write_bytes(vtp.dump(scan.vertices, scan.faces, {"distance_mm": to_model}))
            write_npz(
                folder / "projection.npz",
                {
                    "scores": self.scores,
                    "scores_covariance": self.covariance,
                    "points": self.points,
                    "points_scan": in_scan["corresponded"],
                    "reconstruction": self.reconstruction,
                    "transform": self.matrix,
                    "parameters": self.new.parameters,
                    "coefficients": self.new.coefficients,
                    "distance_to_scan": to_scan,
                    "distance_from_scan": to_model,
                },
            )
            write_json(folder / "projection.json", self.numbers(shape, side))
