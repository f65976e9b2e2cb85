"""The table of patients of the stage ``evaluate``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.evaluation.quality import dense_spline
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import evaluate
from tests.stages.test_group_stages import cohort, context, run

BLOCKS = ("", "back_", "fit_", "fit_back_")


def longer(name: str, mesh: TriMesh) -> TriMesh:
    """Give shape s3 an apron of 20 mm that no other shape has."""
    if name != "s3":
        return mesh
    low = mesh.vertices[:, 0] < 1e-9
    first = np.flatnonzero(low)[np.argsort(mesh.vertices[low, 1])]
    apron = mesh.vertices[first] - [20, 0, 0]
    index = np.concatenate([first, len(mesh.vertices) + np.arange(len(first))]).reshape(2, -1)
    a, b, c, d = index[0, :-1], index[1, :-1], index[1, 1:], index[0, 1:]
    extra = np.concatenate([np.stack([b, a, d], 1), np.stack([b, d, c], 1)])
    return TriMesh(np.concatenate([mesh.vertices, apron]), np.concatenate([mesh.faces, extra]))


def measured(n: int = 5, change=lambda name, mesh: mesh, window=None, **options):
    surfaces, transform = cohort(n)
    correspondence = replace(run(surfaces, transform, max_iterations=3)[0]["correspondence"], window=window)
    # the stages before left the shapes in another frame than that of the correspondence
    turn = np.array([[0, -1.0, 0, 4], [1, 0, 0, -2], [0, 0, 1, 7], [0, 0, 0, 1]])
    before = dict.fromkeys(surfaces, turn)
    meshes = {i: change(i, TriMesh(dense_spline(s).points, dense_spline(s).cells)) for i, s in surfaces.items()}
    meshes = {i: TriMesh(m.vertices @ turn[:3, :3].T + turn[:3, 3], m.faces) for i, m in meshes.items()}
    moved = {
        i: type(s)(s.degree, s.knots_u, s.knots_v, s.control_points @ turn[:3, :3].T + turn[:3, 3])
        for i, s in surfaces.items()
    }
    ctx = context()
    made = evaluate.run(
        correspondence=correspondence,
        landmarks=None,
        transform=before,
        mesh=meshes,
        surface=moved,
        cfg=evaluate.Config(n_specificity_samples=10, n_distance_samples=2000, **options),
        ctx=ctx,
    )
    return made, ctx, correspondence


def test_every_row_starts_with_the_name_and_the_worst_comes_first() -> None:
    made, _, correspondence = measured()
    columns = made["quality"].columns
    assert next(iter(columns)) == "id"
    assert sorted(columns["id"]) == list(correspondence.ids)
    worst = np.maximum(columns["norm_p99"], columns["back_norm_p99"])
    assert (np.diff(worst) <= 0).all()
    assert sum(columns["is_reference"]) == (correspondence.reference >= 0)
    for block in BLOCKS:
        for word in ("mean", "median", "p99", "max"):
            ratio = np.array(columns[f"{block}{word}_dist"]) / columns["bbox_diag"]
            np.testing.assert_allclose(columns[f"{block}norm_{word}"], ratio)
        assert (np.array(columns[f"{block}p99_dist"]) <= columns[f"{block}max_dist"]).all()
    # the meshes are the splines themselves, seen in another frame
    assert max(columns["fit_max_dist"]) < 1e-9
    assert max(columns["fit_back_max_dist"]) < 1e-9


def test_a_part_that_no_reconstruction_reaches_shows_in_the_way_back_alone() -> None:
    made, ctx, _ = measured(change=longer)
    columns = made["quality"].columns
    assert columns["id"][0] == "s3"
    assert columns["back_max_dist"][0] == pytest.approx(20, abs=2)
    assert columns["max_dist"][0] < 8
    assert any(text.startswith("s3: the other shapes reproduce it") for text in ctx.warnings)


def test_a_part_beyond_the_window_is_no_error() -> None:
    kept, free = measured(change=longer), measured(change=longer, window=Window((0.0, 0.0), (1.0, 1.0)))
    before, after = (made["quality"].columns for made in (kept[0], free[0]))
    before, after = (dict(zip(c["id"], c["back_max_dist"], strict=True)) for c in (before, after))
    assert before["s3"] > 18
    assert after["s3"] < 8
    assert not any(text.startswith("s3: the other shapes") for text in free[1].warnings)
    assert "rims: free" in free[0]["quality"].comment
    assert "rims: free" not in kept[0]["quality"].comment


def test_fewer_modes_reproduce_worse_and_the_maps_belong_to_the_table() -> None:
    every, _, correspondence = measured()
    none, _, _ = measured(reconstruction_modes=0)
    assert set(every["quality"].columns["n_modes"]) == {3}
    assert set(none["quality"].columns["n_modes"]) == {0}
    assert np.mean(none["quality"].columns["mean_dist"]) > np.mean(every["quality"].columns["mean_dist"])
    maps = every["reconstructions"]
    assert tuple(maps["ids"]) == correspondence.ids
    assert maps["points"].shape == correspondence.points.shape
    largest = dict(zip(every["quality"].columns["id"], every["quality"].columns["max_dist"], strict=True))
    for name, distance in zip(maps["ids"], maps["distance"], strict=True):
        assert np.abs(distance).max() <= largest[str(name)] + 1e-12
