"""VTK XML surfaces: every way of packing loads, every hostile file is refused with a line that says why."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.meshes import read_mesh
from tests.support.vtp_files import HOSTILE, VALID, F, V, vtp


def read(data: bytes, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    (folder / "a.vtp").write_bytes(data)
    mesh = read_mesh(folder / "a.vtp")
    return mesh.vertices, mesh.faces


@pytest.mark.parametrize("name", VALID)
def test_every_way_of_packing_loads(name: str, tmp_path: Path) -> None:
    vertices, faces = read(VALID[name], tmp_path)
    assert np.array_equal(vertices, V)
    assert np.array_equal(faces, F)


def test_quads_strips_and_pieces(tmp_path: Path) -> None:
    assert read(vtp(faces=np.array([[0, 1, 2, 3]])), tmp_path)[1].tolist() == [[0, 1, 2], [0, 2, 3]]
    strip = vtp("ascii", faces=np.array([[0, 1, 2, 3]]), section="Strips")
    assert read(strip, tmp_path)[1].tolist() == [[0, 1, 2], [1, 3, 2]]
    vertices, faces = read(vtp(compress=True, n_pieces=2), tmp_path)
    assert np.array_equal(vertices, np.r_[V, V])
    assert np.array_equal(faces, np.r_[F, F + 4])


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    data, words = HOSTILE[name]
    tracemalloc.start()
    with pytest.raises(ArtifactError, match=words) as caught:
        read(data, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).isprintable()
    assert "; try: " in str(caught.value)
    assert len(str(caught.value)) < 300
    assert peak < 50e6


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(sorted(VALID)), cut=st.integers(0, 900), at=st.integers(0, 2500), patch=st.binary(max_size=8)
)
def test_damaged_file_loads_or_is_refused(name: str, cut: int, at: int, patch: bytes, tmp_path: Path) -> None:
    """Whatever is done to a file: a mesh or an ArtifactError, nothing else."""
    data = VALID[name]
    at = min(at, len(data))
    damaged = (data[:at] + patch + data[at + len(patch) :])[: max(len(data) - cut, 0) or len(data)]
    try:
        vertices, faces = read(damaged, tmp_path)
    except ArtifactError:
        return
    assert np.isfinite(vertices).all()
    assert faces.max() < len(vertices)
