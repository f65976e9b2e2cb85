"""Reduce the face count by edge collapse, keeping the topology."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import fast_simplification
import igl
import numpy as np

from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.numbering import canonical
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic, face_components, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.pymeshlab_filter import pymeshlab_filter


@dataclass(frozen=True, eq=False)
class Decimated:
    """A decimated mesh and the method that made it: ``quadric`` (fast-simplification), ``qslim``, ``pymeshlab`` or ``none``."""

    mesh: TriMesh
    method: str


Method = Literal["fast-simplification", "qslim", "pymeshlab"]


def decimate(
    mesh: TriMesh, n_faces: int, *, keep_boundary: bool = False, method: Method = "fast-simplification"
) -> Decimated:
    """Reduce a mesh to about ``n_faces`` faces by quadric error edge collapse (Garland and Heckbert 1997).

    Edges of equal error are collapsed in the order in which they come, so the mesh is numbered canonically before: pose, side and
    order in the file change nothing.

    The fast collapse does not watch topology, so its result is checked; when it differs, the collapse of libigl, which
    refuses moves that break the manifold, takes over.

    Parameters
    ----------
    mesh : TriMesh
        Oriented manifold, one component.
    n_faces : int
        Target; the mesh is returned as it is when it has no more than this.
    keep_boundary : bool
        Keep all boundary vertices, at the cost of the interior; ``qslim`` cannot.
    method : {"fast-simplification", "qslim", "pymeshlab"}
        Who collapses the edges first; ``qslim`` of libigl takes over when the topology changed.

    Raises
    ------
    TopologyError
        If no method reaches the target with the same Euler characteristic and number of loops.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> decimate(sphere(subdivisions=3), 500).mesh.n_faces
    500
    """
    if mesh.n_faces <= n_faces:
        return Decimated(mesh, "none")
    numbered, turned = canonical(mesh)
    found = _decimate(numbered, n_faces, keep_boundary, method)
    return Decimated(TriMesh(found.mesh.vertices, found.mesh.faces[:, [0, 2, 1]]), found.method) if turned else found


def _decimate(mesh: TriMesh, n_faces: int, keep_boundary: bool, method: Method) -> Decimated:
    wanted = _topology(mesh)
    if method != "qslim":
        result = _fast(mesh, n_faces, keep_boundary) if method == "fast-simplification" else _pymeshlab(mesh, n_faces)
        if result.n_faces <= 1.01 * n_faces + 2 and _topology(result) == wanted:
            return Decimated(result, "quadric" if method == "fast-simplification" else method)
    answer = igl.qslim(mesh.vertices, mesh.faces, n_faces)
    if not len(answer[1]):
        raise TopologyError(
            f"decimation to {n_faces} faces failed; edges of the mesh are shared by more than two faces",
            "run repair before",
        )
    result = compact(TriMesh(answer[0], answer[1]))
    if result.n_faces <= 1.01 * n_faces + 2 and _topology(result) == wanted:
        return Decimated(result, "qslim")
    raise TopologyError(
        f"decimation from {mesh.n_faces} to {n_faces} faces gave {result.n_faces} and another topology", "raise n_faces"
    )


def _fast(mesh: TriMesh, n_faces: int, keep_boundary: bool) -> TriMesh:
    vertices, faces = fast_simplification.simplify(
        np.array(mesh.vertices), mesh.faces.astype(np.int32), target_count=n_faces, preserve_border=keep_boundary
    )
    return compact(TriMesh(vertices, faces))


def _pymeshlab(mesh: TriMesh, n_faces: int) -> TriMesh:
    result = pymeshlab_filter(
        mesh,
        "meshing_decimation_quadric_edge_collapse",
        targetfacenum=n_faces,
        targetperc=0.0,
        qualitythr=0.3,
        preserveboundary=True,
        boundaryweight=1.0,
        preservenormal=False,
        preservetopology=True,
        optimalplacement=True,
        planarquadric=False,
        planarweight=0.001,
        qualityweight=False,
        autoclean=True,
        selected=False,
    )
    return compact(result)


def _topology(mesh: TriMesh) -> tuple[bool, int, int, int]:
    manifold = is_manifold(mesh.faces)
    n_loops = len(boundary_loops(mesh.faces)) if manifold else -1
    return manifold, euler_characteristic(mesh.faces), n_loops, int(face_components(mesh.faces).max()) + 1
