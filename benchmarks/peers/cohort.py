"""Full femora with known correspondence, drawn from the training scores that the package ``articulated-ssm`` ships.

The package states no licence for its data: it is fetched from PyPI at run time and nothing of it is kept in the repository.
"""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssmpipe.core.align.rigid import apply, homogeneous, rotation_vector_matrix
from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.distance import interpolate, point_to_mesh
from ssmpipe.core.mesh.topology import compact
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.io.meshes import read_mesh, write_mesh

PACKAGE = "articulated-ssm==0.2.0"
FOLDER = "articulated_ssm_both_sides/coupled_ssm/pel_fem_tib_fib_both_side/"
FEMUR_VERTICES, FEMUR_FACES = slice(9366, 14482), slice(18732, 28960)  # from the package's own tables, left side


@dataclass(frozen=True)
class PeerCohort:
    """Shapes as the tools get them, and where the vertices of the template truly lie on each of them.

    Parameters
    ----------
    folder : Path
        Holds ``<id>.ply``: decimated, each with its own connectivity, moved and turned.
    ids : tuple of str
        The first one is the template of tools that need one.
    template_truth : (n_S, n_T, 3) float64
        True places of the template's vertices on every shape [mm].
    """

    folder: Path
    ids: tuple[str, ...]
    template_truth: Floats


def download(folder: Path) -> Path:
    """Fetch the wheel from PyPI."""
    folder.mkdir(parents=True, exist_ok=True)
    found = sorted(folder.glob("articulated_ssm-*.whl"))
    if not found:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), PACKAGE]
        subprocess.run(command, check=True)
        found = sorted(folder.glob("articulated_ssm-*.whl"))
    return found[0]


def training_femora(wheel: Path, scratch: Path) -> tuple[Floats, Ints]:
    """Return the vertices (324, 5116, 3) [mm] and the common faces of the left femora of the training set."""
    with zipfile.ZipFile(wheel) as archive:
        model = np.load(io.BytesIO(archive.read(FOLDER + "shape_model_left_side.pc.npz")), allow_pickle=False)
        mean, modes, scores = model["mean"], model["modes"], model["projectedWeights"]
        path = scratch / "mean.ply"
        path.write_bytes(archive.read(FOLDER + "shape_model_left_side_mean.ply"))
    faces = read_mesh(path).faces[FEMUR_FACES] - FEMUR_VERTICES.start
    shapes = mean.astype(np.float64) + scores.T.astype(np.float64) @ modes.T.astype(np.float64)
    return shapes.reshape(len(shapes), -1, 3)[:, FEMUR_VERTICES], faces


def make_cohort(folder: Path, wheel: Path, *, n_shapes: int, seed: int, normalize: bool) -> PeerCohort:
    """Draw femora, give each its own connectivity and pose, and keep the truth.

    Parameters
    ----------
    folder, wheel : Path
    n_shapes, seed : int
    normalize : bool
        Bring all to the mean centroid size.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    shapes, faces = training_femora(wheel, folder.parent)
    shapes = shapes[np.sort(rng.choice(len(shapes), n_shapes, replace=False))]
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    if normalize:
        size = np.linalg.norm(shapes, axis=(1, 2), keepdims=True)
        shapes = shapes * (size.mean() / size)
    ids = tuple(f"s{i:02d}" for i in range(n_shapes))
    truth: list[Floats] = []
    face, weights = np.empty(0, dtype=np.int64), np.empty((0, 3))
    for k, vertices in enumerate(shapes):
        whole = TriMesh(vertices, faces)
        turn = rotation_vector_matrix(np.radians(rng.uniform(-3, 3, 3)))
        pose = homogeneous(turn, rng.uniform(-3, 3, 3))
        # shuffled vertices give every shape a connectivity of its own
        order = rng.permutation(whole.n_vertices)
        shuffled = TriMesh(whole.vertices[np.argsort(order)], order[whole.faces][rng.permutation(whole.n_faces)])
        scan = compact(decimate(shuffled, 3000).mesh)
        if k == 0:
            _, face, weights = point_to_mesh(scan.vertices, whole)
        truth.append(apply(pose, interpolate(vertices, whole, face, weights)))
        write_mesh(folder / f"{ids[k]}.ply", TriMesh(apply(pose, scan.vertices), scan.faces))
    return PeerCohort(folder, ids, np.stack(truth))
