"""Cohorts of many families with known truth, made from what public packages and the other studies ship; nothing of it is kept."""

from __future__ import annotations

import csv
import io
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ssmpipe.core.align.rigid import apply, homogeneous, reflection, rotation_vector_matrix
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.topology import compact
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.core.repair.trimming import cut_by_plane
from ssmpipe.io.meshes import read_mesh, write_mesh

BONES_PACKAGE = "articulated-ssm==0.2.0"
FACES_PACKAGE = "python-shape-stats==1.0.0"
OUTLINES_PACKAGE = "ktch==0.11.1"
BONES = {  # vertices, faces; from the package's own tables, left side
    "pelvis": (slice(0, 4683), slice(0, 9366)),
    "femur": (slice(9366, 14482), slice(18732, 28960)),
    "fibula": (slice(14482, 16560), slice(28960, 33112)),
    "tibia": (slice(16560, 21206), slice(33112, 42404)),
}


@dataclass(frozen=True)
class Family:
    """A cohort as a new user has it, with the truth the software does not see.

    ``make(folder, seed)`` writes ``scans/`` (and ``cohort.csv`` when sides are known) and ``truth.npz``: ``ids`` and either
    ``points`` (n_S, n_T, d), truly corresponding places in scan coordinates, NaN where a scan does not show them.
    """

    name: str
    anatomy: str
    what: str
    make: Callable[[Path, int], None]
    sets: tuple[str, ...] = ()
    view: tuple[float, float] = (10.0, -60.0)
    unit: str = "mm"
    refused: bool = field(default=False)


def wheel(package: str, folder: Path) -> Path:
    """Fetch a wheel from PyPI once."""
    folder.mkdir(parents=True, exist_ok=True)
    pattern = package.split("==")[0].replace("-", "_") + "-*.whl"
    if not list(folder.glob(pattern)):
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), package],
            check=True,
        )
    return next(folder.glob(pattern))


def bones(name: str, wheels: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return (324, n, 3) vertices [mm] and common faces of left bones of the training set of ``articulated-ssm``."""
    inside = "articulated_ssm_both_sides/coupled_ssm/pel_fem_tib_fib_both_side/shape_model_left_side"
    with zipfile.ZipFile(wheel(BONES_PACKAGE, wheels)) as archive, tempfile.TemporaryDirectory() as scratch:
        model = np.load(io.BytesIO(archive.read(inside + ".pc.npz")), allow_pickle=False)
        shapes = model["mean"] + model["projectedWeights"].T @ model["modes"].T
        mean = Path(scratch) / "mean.ply"
        mean.write_bytes(archive.read(inside + "_mean.ply"))
        faces = read_mesh(mean).faces
    at, triangles = BONES[name]
    return shapes.reshape(len(shapes), -1, 3)[:, at].astype(np.float64), faces[triangles] - at.start


def write_cohort(
    folder: Path,
    shapes: list[np.ndarray],
    faces: np.ndarray,
    rng: np.random.Generator,
    *,
    keep: Callable[[TriMesh, np.random.Generator], TriMesh] | None = None,
    n_faces: int = 5000,
    sides: bool = False,
    labelled: bool = True,
    poses: bool = True,
) -> None:
    """Give every shape its own connectivity, cut and pose, mirror every other one when ``sides``, and keep the truth."""
    (folder / "scans").mkdir(parents=True, exist_ok=True)
    truth, ids, rows = [], [], []
    for k, vertices in enumerate(shapes):
        shape = TriMesh(vertices - vertices.mean(axis=0), faces)
        order = rng.permutation(shape.n_vertices)
        scan = TriMesh(shape.vertices[np.argsort(order)], order[faces][rng.permutation(len(faces))])
        scan = compact(decimate(clean(compact(scan), components="largest").mesh, n_faces).mesh)
        seen = np.ones(len(vertices), dtype=bool)
        if keep is not None:
            scan = keep(scan, rng)
            seen = point_to_mesh(shape.vertices, scan)[0] < 1.5
        turn = rotation_vector_matrix(_random_turn(rng)) if poses else np.eye(3)
        pose = homogeneous(turn, rng.uniform(-300, 300, 3) if poses else np.zeros(3))
        left = not (sides and k % 2)
        if not left:
            pose = pose @ reflection(0)
        moved = TriMesh(apply(pose, scan.vertices), scan.faces if left else scan.faces[:, ::-1])
        name = f"p{k + 1:02d}"
        write_mesh(folder / "scans" / f"{name}.ply", moved)
        ids.append(name)
        rows.append((name, "L" if left else "R"))
        truth.append(np.where(seen[:, None], apply(pose, shape.vertices), np.nan)[:: max(1, len(vertices) // 1000)])
    if labelled:
        with (folder / "cohort.csv").open("w", newline="") as file:
            csv.writer(file).writerows([("id", "side"), *rows])
    np.savez(folder / "truth.npz", ids=np.array(ids), points=np.array(truth))


def _random_turn(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis) * rng.uniform(0, np.pi)


def cut_along(axis: int, low: float, high: float, spread: float) -> Callable[[TriMesh, np.random.Generator], TriMesh]:
    """Keep a part of a bone between two shares of its extent along an axis; the planes scatter and tilt a little."""

    def keep(mesh: TriMesh, rng: np.random.Generator) -> TriMesh:
        start, extent = mesh.vertices[:, axis].min(), np.ptp(mesh.vertices[:, axis])
        for share, sign in ((low, -1.0), (high, 1.0)):
            if not 0 < share < 1:
                continue
            normal = sign * (np.eye(3)[axis] + rng.normal(0, 0.03, 3))
            middle = mesh.vertices.mean(axis=0)
            middle[axis] = start + (share + rng.normal(0, spread)) * extent
            mesh = cut_by_plane(mesh, middle, normal / np.linalg.norm(normal))
        return mesh

    return keep


def bone_family(bone: str, wheels: Path, n: int, part: tuple[int, float, float] | None = None, **options) -> Callable:
    """Return ``make`` of a cohort of whole bones or of parts of them."""

    def make(folder: Path, seed: int) -> None:
        rng = np.random.default_rng(seed)
        shapes, faces = bones(bone, wheels)
        chosen = list(shapes[np.sort(rng.choice(len(shapes), n, replace=False))])
        keep = None if part is None else cut_along(part[0], part[1], part[2], 0.02)
        write_cohort(folder, chosen, faces, rng, keep=keep, **options)

    return make


def face_family(part: str, wheels: Path, n: int, **options) -> Callable:
    """Return ``make`` of a cohort of registered faces (or of a part of them) of ``python-shape-stats``."""

    def make(folder: Path, seed: int) -> None:
        rng = np.random.default_rng(seed)
        inside = f"python_shape_stats/data/sim_faces/{part}/"
        with zipfile.ZipFile(wheel(FACES_PACKAGE, wheels)) as archive, tempfile.TemporaryDirectory() as scratch:
            names = sorted(f for f in archive.namelist() if f.startswith(inside) and f.endswith(".obj"))
            archive.extractall(scratch, names)
            meshes = [read_mesh(Path(scratch) / f) for f in names]
        chosen = np.sort(rng.choice(len(meshes), n, replace=False))
        write_cohort(folder, [meshes[k].vertices for k in chosen], meshes[0].faces, rng, labelled=False, **options)

    return make


def families(wheels: Path, n: int = 8) -> list[Family]:
    """All families that this machine can make."""

    def bone(name: str, **options) -> Callable:
        return bone_family(name, wheels, n, **options)

    both = {"sides": True}
    return [
        Family("tibia", "closed", "whole tibiae, left", bone("tibia", labelled=False)),
        Family("fibula", "closed", "whole fibulae, left", bone("fibula", labelled=False, n_faces=3000)),
        Family("femur", "closed", "whole femora, left", bone("femur", labelled=False)),
        Family("femur-distal", "femur-distal", "whole femora, left and right", bone("femur", **both)),
        Family(
            "femur-distal-piece",
            "femur-distal",
            "distal halves, left and right",
            bone("femur", part=(1, 0, 0.45), **both),
        ),
        Family("femur-proximal", "femur-proximal", "whole femora, left and right", bone("femur", **both)),
        Family(
            "femur-proximal-piece",
            "femur-proximal",
            "upper halves, left and right",
            bone("femur", part=(1, 0.5, 1), **both),
        ),
        Family("tibia-proximal", "disk", "upper 30 % of tibiae", bone("tibia", part=(1, 0.7, 1), labelled=False)),
        Family("tibia-distal", "disk", "lower 25 % of tibiae", bone("tibia", part=(1, 0, 0.25), labelled=False)),
        Family(
            "iliac-wing",
            "disk",
            "iliac wings, cut above the acetabulum",
            bone("pelvis", part=(1, 0.55, 1), labelled=False),
        ),
        Family("faces", "disk", "faces", face_family("faces", wheels, n)),
        Family("noses", "disk", "noses", face_family("nose", wheels, n, n_faces=1300)),
        Family("foreheads", "disk", "foreheads with orbits", face_family("forehead_orbits", wheels, n, n_faces=4000)),
        Family("femur-shaft", "tube", "middle 40 % of femora", bone("femur", part=(1, 0.3, 0.7), labelled=False)),
        Family(
            "tibia-sides",
            "closed",
            "whole tibiae, left and right not told apart",
            bone("tibia", labelled=False, **both),
            ("stages.align.chirality=best-fit",),
        ),
        Family(
            "tibia-proximal-sides",
            "disk",
            "upper 30 % of tibiae, left and right not told apart",
            bone("tibia", part=(1, 0.7, 1), labelled=False, **both),
            ("stages.align.chirality=best-fit",),
        ),
        Family("pelvis", "closed", "half pelves", bone("pelvis", labelled=False), refused=True),
    ]
