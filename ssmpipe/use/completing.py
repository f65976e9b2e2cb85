"""A fragment of one patient, completed by the model of others: what is missing, how sure it is, and the scan with its holes filled."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.closing import close_openings, weld
from ssmpipe.core.mesh.distance import signed_point_to_mesh
from ssmpipe.core.mesh.operators import area, vertex_normals
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.completion import Completion, complete
from ssmpipe.core.model.remainder import LeaveOneOut, Remainder
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.core.repair.guided_filling import fill_towards
from ssmpipe.io.arrays import write_npz
from ssmpipe.io.codecs import write_json
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.disk import disk_errors
from ssmpipe.use.distance_numbers import rank, summary

PARTIAL = "partial"
"""In place of a certificate: a completed fragment has no parameterization of its own."""
_FACES = 20_000


@dataclass(frozen=True, eq=False)
class Fragment:
    """A scan of a part.

    Parameters
    ----------
    mesh : TriMesh
        [mm]
    transform : (4, 4)
        From the scan to ``mesh`` (units).
    side : {"L", "R", None}
    steps : sequence of mapping
        Of the model's chain, which say what is mirrored.
    fill : bool
        Whether the scan is also written with its openings filled.
    """

    mesh: TriMesh
    transform: Floats
    side: str | None
    steps: Sequence[Mapping[str, Any]]
    fill: bool


@dataclass(frozen=True, eq=False)
class Completed:
    """A fragment that was completed: what ``projection.json`` says, and what its page shows, in the frame of the model.

    Parameters
    ----------
    numbers : mapping
    warnings : sequence of str
    points, deviation : (n_P, 3), (n_P,)
        The whole surface, and its standard deviation [mm].
    placed, distance : TriMesh, (n,)
        The fragment, and its signed distance from that surface [mm]; zero where it lies beyond the rim.
    matrix : (4, 4)
        From the scan.
    """

    numbers: Mapping[str, Any]
    warnings: Sequence[str]
    points: Floats
    deviation: Floats
    placed: TriMesh
    distance: Floats
    matrix: Floats


def complete_fragment(
    model: ShapeModel, remainder: Remainder, others: LeaveOneOut, fragment: Fragment, folder: Path, shape: str
) -> Completed:
    """Complete a fragment and write ``folder``."""
    warnings: list[str] = []
    whole = clean(fragment.mesh, components="largest").mesh
    light = whole if whole.n_faces <= _FACES else decimate(whole, _FACES).mesh
    found, flip = _best_image(light, fragment, model, remainder, warnings)
    to_model = found.matrix @ flip
    placed = move(whole, to_model)
    surface = TriMesh(found.points, model.faces)
    beyond = _beyond(placed, found)
    from_scan = signed_point_to_mesh(placed.vertices[~beyond], surface)
    if beyond.mean() > 0.2:
        warnings.append(
            f"{100 * beyond.mean():.0f} % of the fragment lies beyond the rim of the model and was not used; cut it if that is wrong"
        )
    matrix = to_model @ fragment.transform
    filled, share, n_left = (None, 0.0, 0)
    if fragment.fill:
        filled, share, n_left = _filled(placed, surface, model, warnings)
    back = np.asarray(np.linalg.inv(matrix))
    completed = move(surface, back)
    normals = vertex_normals(surface)
    along = np.sqrt(((normals * found.deviation) ** 2).sum(axis=1))
    spread = np.sqrt((found.deviation**2).mean(axis=1))
    to_scan = -signed_point_to_mesh(found.points[found.seen], placed)
    distance = float(np.linalg.norm(found.scores))
    numbers = {
        "id": shape,
        "side": fragment.side or "",
        "scores": found.scores,
        "deviations": np.sqrt(np.diagonal(found.covariance)),
        "mahalanobis": distance,
        "mahalanobis_p": rank(distance, others.mahalanobis),
        **summary("to_scan", to_scan),
        **summary("from_scan", from_scan),
        "seen_share": float(found.seen.mean()),
        "expected_error_mm": found.expected_error,
        "filled_share": share,
        "holes_left": n_left,
        "mirrored": bool(np.linalg.det(flip) < 0),
        "certificate": {"status": PARTIAL},
    }
    with disk_errors():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_mesh(folder / "completed.ply", completed)
        if filled is not None:
            write_mesh(folder / "filled.ply", move(filled, back))
        data = {"sd_mm": spread, "sd_along_normal_mm": along, "seen": found.seen.astype(np.float64)}
        (folder / "completed.vtp").write_bytes(vtp.dump(completed.vertices, completed.faces, data))
        write_npz(
            folder / "projection.npz",
            {
                "scores": found.scores,
                "scores_covariance": found.covariance,
                "points": found.points,
                "points_scan": completed.vertices,
                "deviation": found.deviation,
                "seen": found.seen,
                "transform": matrix,
            },
        )
        write_json(folder / "projection.json", numbers)
    apart = np.zeros(placed.n_vertices)
    apart[~beyond] = from_scan
    return Completed(numbers, warnings, found.points, spread, placed, apart, matrix)


def _filled(placed: TriMesh, surface: TriMesh, model: ShapeModel, warnings: list[str]) -> tuple[TriMesh, float, int]:
    """Return the fragment with its holes filled along the completed surface, the share of the area that is new, the number of holes left.

    Openings that lie at an opening of the model stay open, and so do those beyond it; they do not count as holes.
    """
    closed = close_openings(weld(surface) if model.topology in ("cone", "closed") else surface)
    openings = [surface.vertices[loop] for loop in boundary_loops(surface.faces)]
    reach = 0.05 * float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    chosen, every = [], boundary_loops(placed.faces)
    for loop in every:
        rim = placed.vertices[loop]
        at_opening = any(float(np.median(cKDTree(o).query(rim)[0])) < reach for o in openings)
        off = float(np.median(np.abs(signed_point_to_mesh(rim, surface))))
        if not at_opening and off < reach:
            chosen.append(loop)
    if not chosen:
        warnings.append("the fragment has no opening that the model would close; filled.ply is the fragment as it is")
        return placed, 0.0, 0
    try:
        filled, _ = fill_towards(placed, chosen, closed)
    except GeometryError as error:
        warnings.append(f"the holes were not filled: {error.fact}; completed.ply holds the whole surface all the same")
        return placed, 0.0, len(chosen)
    n_left = max(0, len(boundary_loops(filled.faces)) - (len(every) - len(chosen)))
    if n_left:
        warnings.append(f"{n_left} of {len(chosen)} holes are left; completed.ply holds the whole surface all the same")
    return filled, float(area(TriMesh(filled.vertices, filled.faces[placed.n_faces :])) / area(filled)), n_left


def _beyond(placed: TriMesh, found: Completion) -> Any:
    """Return which vertices of the fragment lie beyond the completed surface: farther off than it is unsure, by far."""
    reach = float(np.sqrt(((found.points - found.points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    distance = cKDTree(found.points).query(placed.vertices)[0]
    return np.asarray(distance > 0.2 * reach)


def _best_image(
    mesh: TriMesh, fragment: Fragment, model: ShapeModel, remainder: Remainder, warnings: list[str]
) -> tuple[Completion, Floats]:
    """Complete the fragment as the chain would mirror it; both images when that cannot be known."""
    known = _mirrored(fragment)
    if known is not None:
        flip = reflection(0) if known else np.eye(4)
        return complete(move(mesh, flip), model, remainder), flip
    found: list[tuple[float, Completion, Floats]] = []
    for flip in (np.eye(4), reflection(0)):
        try:
            one = complete(move(mesh, flip), model, remainder)
        except GeometryError:
            continue
        surface = TriMesh(one.points, model.faces)
        off = np.abs(signed_point_to_mesh(apply(one.matrix @ flip, mesh.vertices), surface))
        found.append((float(np.median(off)) + one.rms, one, flip))
    if not found:
        raise GeometryError("the fragment cannot be placed on the model", "check units and that it is of this anatomy")
    best = min(found, key=lambda f: f[0])
    taken = f"it was taken {'as it is' if best[2][0, 0] > 0 else 'as the mirror image'}, which fits better"
    by_side = any(step.get("options", {}).get("mirror", "none") != "none" for step in fragment.steps)
    warnings.append(
        f"the side is unknown; {taken}; say --side"
        if by_side
        else f"the model does not go by sides (align.chirality: best-fit); {taken}"
    )
    return best[1], best[2]


def _mirrored(fragment: Fragment) -> bool | None:
    """Return whether the chain of the model would mirror the scan; None when it cannot tell."""
    for step in fragment.steps:
        options = step.get("options", {})
        if step.get("stage") == "orient" and options.get("mirror", "none") != "none":
            if fragment.side is None:
                return None
            return fragment.side == ("L" if options["mirror"] == "left" else "R")
        if step.get("stage") == "align" and options.get("chirality") == "best-fit":
            return None
    return False
