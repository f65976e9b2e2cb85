"""The real femora beside the repository, when they are there."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from ssmpipe.core.mesh.trimesh import TriMesh

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
FEMORA = DATA / "femur_vsd"
needs_femora = pytest.mark.skipif(not FEMORA.is_dir(), reason="needs the cohort femur_vsd beside the repository")
needs_vertebrae = pytest.mark.skipif(
    not (DATA / "vertebra_l1").is_dir(), reason="needs the cohort vertebra_l1 beside the repository"
)


def read(path: Path) -> TriMesh:
    """Read a PLY file as it is."""
    raw = trimesh.load(path, process=False)
    return TriMesh(np.asarray(raw.vertices), np.asarray(raw.faces))


def femur(shape_id: str) -> TriMesh:
    """Return one raw scan."""
    return read(FEMORA / "scans" / f"{shape_id}.ply")


def femur_ids() -> list[str]:
    """Return the ids, sorted."""
    return sorted(p.stem for p in (FEMORA / "scans").glob("*.ply"))


def sides() -> dict[str, str]:
    """Return L or R by id."""
    with (FEMORA / "cohort.csv").open(newline="", encoding="utf-8") as file:
        return {row["id"]: row["side"] for row in csv.DictReader(file)}


def landmark(shape_id: str, code: str) -> np.ndarray:
    """Return a landmark by the code in brackets, in scanner coordinates."""
    table = json.loads((FEMORA / "landmarks.json").read_text(encoding="utf-8"))[shape_id]
    return np.array(next(point for name, point in table.items() if f"({code})" in name))
