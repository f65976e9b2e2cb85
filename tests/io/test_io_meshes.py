"""Surface files: every odd one loads, every hostile one is refused with a line that says why."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.mesh_formats.stl import merge_corners
from ssmpipe.io.meshes import MESH_SUFFIXES, read_mesh, write_mesh
from tests.support.mesh_files import HOSTILE, VALID, F, V, obj, off, ply, ply_ascii, stl_ascii, stl_binary, vtk, vtk5


def same_surface(mesh: TriMesh, vertices: np.ndarray = V, faces: np.ndarray = F) -> bool:
    """Same triangles with the same winding, whatever the numbering."""
    found = {tuple(np.roll(t, -int(np.lexsort(t.T)[0]), axis=0).ravel()) for t in mesh.vertices[mesh.faces]}
    wanted = {tuple(np.roll(t, -int(np.lexsort(t.T)[0]), axis=0).ravel()) for t in vertices[faces]}
    return found == wanted


@pytest.mark.parametrize("name", VALID)
def test_valid_file_loads(name: str, tmp_path: Path) -> None:
    file, data, vertices, faces = VALID[name]
    (tmp_path / file).write_bytes(data)
    mesh = read_mesh(tmp_path / file)
    assert mesh.n_vertices == 4
    assert same_surface(mesh, vertices, faces)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    file, data, words = HOSTILE[name]
    (tmp_path / file).write_bytes(data)
    with pytest.raises(ArtifactError, match=words) as caught:
        read_mesh(tmp_path / file)
    assert str(caught.value).isprintable()
    assert "; try: " in str(caught.value)
    assert len(str(caught.value)) < 300


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no such file"):
        read_mesh(tmp_path / "no.stl")
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(ArtifactError, match="not a file"):
        read_mesh(tmp_path / "folder.stl")


SOURCES: list[Callable[[], bytes]] = [
    stl_binary,
    stl_ascii,
    ply,
    ply_ascii,
    obj,
    off,
    vtk,
    lambda: vtk(True),
    lambda: vtk5(True),
]
SUFFIXES = [".stl", ".stl", ".ply", ".ply", ".obj", ".off", ".vtk", ".vtk", ".vtk"]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.integers(0, 8), cut=st.integers(0, 700), at=st.integers(0, 700), patch=st.binary(max_size=8))
def test_damaged_file_loads_or_is_refused(which: int, cut: int, at: int, patch: bytes, tmp_path: Path) -> None:
    """Whatever is done to a file: a mesh or an ArtifactError, nothing else."""
    data = SOURCES[which]()
    at = min(at, len(data))
    damaged = (data[:at] + patch + data[at + len(patch) :])[: max(len(data) - cut, 0) or len(data)]
    path = tmp_path / f"a{SUFFIXES[which]}"
    path.write_bytes(damaged)
    try:
        mesh = read_mesh(path)
    except ArtifactError:
        return
    assert mesh.faces.max() < mesh.n_vertices


def test_ply_is_exact_and_its_bytes_repeat(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mesh = TriMesh(rng.normal(size=(50, 3)) * 1e3, rng.integers(0, 50, (90, 3)))
    for name in "ab":
        write_mesh(tmp_path / f"{name}.ply", mesh)
    again = read_mesh(tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert np.array_equal(again.vertices, mesh.vertices)
    assert np.array_equal(again.faces, mesh.faces)


@pytest.mark.parametrize(("suffix", "atol"), [(".stl", 1e-6), (".obj", 1e-7), (".off", 1e-7)])
def test_other_formats_round_trip(suffix: str, atol: float, tmp_path: Path) -> None:
    write_mesh(tmp_path / f"a{suffix}", TriMesh(V, F))
    mesh = read_mesh(tmp_path / f"a{suffix}")
    assert mesh.n_vertices == 4
    assert np.allclose(mesh.vertices[mesh.faces], V[F], atol=atol)


def test_unknown_suffix_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"'\.xyz'"):
        write_mesh(tmp_path / "a.xyz", TriMesh(V, F))
    assert set(MESH_SUFFIXES) == {".stl", ".ply", ".obj", ".off", ".vtk", ".vtp"}


def test_stl_corners_at_minus_zero_are_merged() -> None:
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[-0.0, 0, -0.0], [0, 1, 0], [0, 0, 1]]])
    vertices, faces = merge_corners(corners)
    assert len(vertices) == 4
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
