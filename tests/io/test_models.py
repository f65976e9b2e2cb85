from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.shape_model import Chain
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.arrays import read_npz, write_npz
from ssmpipe.io.models import FORMAT, read_model, write_model
from tests.support.models import shape_model


def with_chain():
    mesh = TriMesh(np.eye(3), np.array([[0, 1, 2]]))
    outline = Outline(np.array([[0, 0], [1, 0], [1, 1.0]]), closed=True)
    chain = Chain('{"units":"mm"}', {"align.reference": mesh, "b.c": outline})
    return replace(shape_model(), lambda_cut=0.01, chain=chain)


def test_a_model_comes_back_with_its_chain_and_the_same_bytes(tmp_path: Path) -> None:
    model = with_chain()
    write_model(tmp_path / "a.npz", model)
    write_model(tmp_path / "b.npz", model)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    found = read_model(tmp_path / "a.npz")
    for name in ("mean", "modes", "variances", "scores", "faces"):
        assert np.array_equal(getattr(found, name), getattr(model, name)), name
    assert (found.ids, found.grid, found.topology, found.lambda_cut) == (model.ids, model.grid, "disk", 0.01)
    assert found.chain is not None
    assert found.chain.text == '{"units":"mm"}'
    assert np.array_equal(found.chain.prepared["align.reference"].faces, [[0, 1, 2]])
    assert found.chain.prepared["b.c"].closed
    np.testing.assert_allclose(found.training_points.mean(axis=0), model.mean, atol=1e-12)


def test_a_file_of_the_first_version_is_read(tmp_path: Path) -> None:
    write_model(tmp_path / "a.npz", with_chain())
    new = ("format_version", "lambda_cut", "chain")
    old = {k: v for k, v in read_npz(tmp_path / "a.npz").items() if k not in new and "/" not in k}
    write_npz(tmp_path / "old.npz", old)
    found = read_model(tmp_path / "old.npz")
    assert found.chain is None
    assert np.isnan(found.lambda_cut)
    assert np.array_equal(found.mean, with_chain().mean)


def test_a_file_of_a_later_version_is_refused_in_one_line(tmp_path: Path) -> None:
    write_model(tmp_path / "a.npz", with_chain())
    later = {**read_npz(tmp_path / "a.npz"), "format_version": np.array(FORMAT + 1)}
    write_npz(tmp_path / "later.npz", later)
    with pytest.raises(ArtifactError, match=rf"format version {FORMAT + 1}.*reads up to {FORMAT}; try: update ssmpipe"):
        read_model(tmp_path / "later.npz")


@pytest.mark.parametrize("wrong", [{"modes": np.zeros((2, 3, 3))}, {"grid": np.array([3, 3])}])
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, wrong: dict) -> None:
    write_model(tmp_path / "a.npz", with_chain())
    write_npz(tmp_path / "b.npz", {**read_npz(tmp_path / "a.npz"), **wrong})
    with pytest.raises(ArtifactError, match="do not fit each other"):
        read_model(tmp_path / "b.npz")


def test_a_missing_array_is_named(tmp_path: Path) -> None:
    write_model(tmp_path / "a.npz", with_chain())
    write_npz(tmp_path / "b.npz", {k: v for k, v in read_npz(tmp_path / "a.npz").items() if k != "scores"})
    with pytest.raises(ArtifactError, match="has no array scores"):
        read_model(tmp_path / "b.npz")
