from __future__ import annotations

import logging

import numpy as np
import pytest

from ssmpipe.contract import Context, ShapeInfo
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import evaluate, model, optimize
from tests.support.cut_shapes import cut_cohort
from tests.support.surfaces import bump, wrapped

N = 15
PHASES = np.array([0.05, 0.0, -0.12, 0.1])
HEIGHTS = np.array([1.0, 0.7, 1.2, 1.4])


def go(stage, options=None, **inputs):
    ctx = Context("cohort", np.random.default_rng(0), logging.getLogger("test"))
    return stage.run(**inputs, cfg=stage.Config(**(options or {})), ctx=ctx), ctx


def optimized(kind, **options):
    surfaces = {
        f"s{i}": wrapped(kind, n=16, phase=p, bump=b) for i, (p, b) in enumerate(zip(PHASES, HEIGHTS, strict=True))
    }
    chosen = {"n_coefficients": (6, 6), "landmarks": (N, N), "covariance": "II", "pose": "keep", "normalize": "none"}
    transform = {i: np.eye(4) for i in surfaces}
    return go(optimize, chosen | options, surface=surfaces, transform=transform, landmarks=None)


def test_surfaces_weigh_their_normals_unless_told_otherwise():
    made, ctx = optimized("cone", max_iterations=3)
    c = made["correspondence"]
    assert ctx.metrics["normals"] == 0.8
    assert c.normal_scale == pytest.approx(ctx.metrics["normal_scale_mm"])
    assert c.normals.shape == c.points.shape
    assert np.linalg.norm(c.normals, axis=2) == pytest.approx(1.0, abs=0.05)
    outward = np.einsum("ild,ild->il", c.normals, c.points - c.points.mean(axis=1)[:, None])
    assert (outward > 0).mean() > 0.95 or (outward < 0).mean() > 0.95  # one sense on all shapes
    plain, ctx = optimized("cone", max_iterations=3, normals=0)
    assert plain["correspondence"].normals is None
    assert ctx.metrics["normals"] == 0
    assert plain["correspondence"].description_length[0] < c.description_length[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"normals": -1}, "0 or more"),
        ({"normals": float("nan")}, "0 or more"),
        ({"normals": 0.8, "pose": "each-evaluation"}, "use pose: refined, or normals: 0"),
    ],
)
def test_normals_that_cannot_be_are_refused_with_the_options(options, words):
    with pytest.raises(ValueError, match=words):
        optimize.Config(**options)
    optimize.Config(pose="each-evaluation")
    optimize.Config(pose="each-evaluation", normals=0)


@pytest.mark.parametrize(("kind", "n_loops", "n_poles"), [("tube", 2, 0), ("cone", 1, 1), ("closed", 0, 2)])
def test_turned_starts_are_turned_back(kind, n_loops, n_poles):
    made, ctx = optimized(kind)
    assert (ctx.metrics["boundary"], ctx.metrics["topology"]) == ("periodic", kind)
    assert not ctx.warnings
    c = made["correspondence"]
    assert (c.topology, c.grid) == (kind, (N, N))
    field = c.parameters.reshape(len(c.ids), N, N, 2)
    turned = field[..., 0] - (np.arange(N) / N)[None, :, None]
    # around the bump; elsewhere the surface says little about u
    found = turned[:, :, 3:-3].mean(axis=(1, 2))
    assert found == pytest.approx(PHASES[c.reference] - PHASES, abs=1e-3)
    assert c.description_length[1] < c.description_length[0] - 10
    # v of the rims and poles stays
    assert field[:, :, 0, 1] == pytest.approx(0)
    assert field[:, :, -1, 1] == pytest.approx(1)
    used = c.faces
    assert len(used) == N * (2 * (N - 1) - n_poles)
    assert len(boundary_loops(used)) == n_loops
    assert euler_characteristic(used) == {"tube": 0, "cone": 1, "closed": 2}[kind]
    corners = c.points[:, used]
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    assert np.linalg.norm(normals, axis=2).min() > 1e-3
    outward = np.einsum("ifd,ifd->if", normals, corners.mean(axis=2) - c.points.mean(axis=1)[:, None])
    assert (outward > 0).mean() > 0.99
    if kind == "closed":
        assert volume(TriMesh(c.points[0], used)) > 0
    rows = c.points.reshape(len(c.ids), N, N, 3)
    for end in {0: (), 1: (-1,), 2: (0, -1)}[n_poles]:
        assert (rows[:, :, end] == rows[:, :1, end]).all()
    shapes = made["certificate"]["shapes"]
    assert all(len(one.get("poles", ())) == n_poles for one in shapes.values())
    assert all(p["status"] == "proved" and p["winding"] > 0.5 for one in shapes.values() for p in one.get("poles", ()))
    assert made["certificate"]["all_proved"]
    info = {i: ShapeInfo(i) for i in c.ids}
    built, _ = go(model, correspondence=c, info=info)
    assert built["model"].topology == kind
    transform = {i: np.eye(4) for i in c.ids}
    go(evaluate, {"n_specificity_samples": 10}, correspondence=c, landmarks=None, transform=transform)


def test_a_fixed_seam_is_stored_once_and_gains_less():
    free, _ = optimized("tube")
    fixed, ctx = optimized("tube", boundary="fixed")
    c = fixed["correspondence"]
    assert ctx.metrics["boundary"] == "fixed"
    assert (c.topology, c.grid) == ("tube", (N - 1, N))
    assert c.points.shape[1] == c.parameters.shape[1] == (N - 1) * N
    assert len(boundary_loops(c.faces)) == 2
    assert free["correspondence"].description_length[1] < c.description_length[1] - 5


def test_an_edge_at_the_pole_is_told():
    surfaces = {f"s{i}": wrapped("cone", n=16, bump=b, smooth=False) for i, b in enumerate(HEIGHTS)}
    options = {"n_coefficients": (5, 5), "landmarks": (9, 9), "max_iterations": 1}
    made, ctx = go(optimize, options, surface=surfaces, transform={i: np.eye(4) for i in surfaces}, landmarks=None)
    assert any("the tangent plane at a pole of s0" in w for w in ctx.warnings)
    assert made["certificate"]["shapes"]["s0"]["poles"][0]["status"] == "refuted"
    assert "one plane through the pole" in made["certificate"]["pole_condition"]


def test_what_cannot_be_compared_is_refused():
    surfaces = {"a": wrapped("tube", n=12), "b": wrapped("cone", n=12)}
    transform = {i: np.eye(4) for i in surfaces}
    with pytest.raises(ConfigError, match="'a' is a tube and 'b' is a cone; one model needs shapes of one topology"):
        go(optimize, surface=surfaces, transform=transform, landmarks=None)
    disks = {"a": bump((30, 30), 10, n=8), "b": bump((30, 30), 12, n=8)}
    with pytest.raises(ConfigError, match="periodic needs shapes that close, these are disk"):
        go(optimize, {"boundary": "periodic"}, surface=disks, transform=transform, landmarks=None)


def cut_tubes(**options):
    surfaces = {f"t{i}": s for i, s in enumerate(cut_cohort("tube"))}
    chosen = {"n_coefficients": (6, 6), "landmarks": (N, N), "pose": "keep", "normalize": "affine"}
    transform = {i: np.eye(4) for i in surfaces}
    return go(optimize, chosen | options, surface=surfaces, transform=transform, landmarks=None)


def test_free_rims_are_written_with_what_they_cover(tmp_path):
    from ssmpipe.io import codecs

    made, ctx = cut_tubes(rims="free")
    c = made["correspondence"]
    assert c.reference == -1
    assert made["certificate"]["all_proved"]
    assert "rims are free" in made["certificate"]["open_rims"]
    assert ctx.metrics["window"] == [list(c.window.low), list(c.window.high)]
    assert not ctx.warnings
    v = c.parameters.reshape(len(c.ids), N, N, 2)[..., 1]
    assert v.min() > 0
    assert v.max() < 1
    assert np.ptp(v[:, :, 0].mean(axis=1)) > 0.05  # each begins elsewhere
    codecs._save_correspondence("correspondence", c, tmp_path)
    assert codecs._load_correspondence([tmp_path / "correspondence.npz"]).window == c.window
    built, _ = go(model, correspondence=c, info={i: ShapeInfo(i) for i in c.ids})
    assert built["model"].window == c.window


def test_kept_rims_that_lie_apart_get_a_hint(monkeypatch):
    monkeypatch.setattr(optimize, "APART", 0.02)
    _, ctx = cut_tubes()
    assert any("use optimize.rims: free" in w and "t1" in w for w in ctx.warnings)
    monkeypatch.setattr(optimize, "APART", 0.02 * ctx.metrics["mean_rim_shift_percent"])
    assert not cut_tubes()[1].warnings


def test_a_shape_that_is_too_short_is_named():
    _, ctx = cut_tubes(rims="free", max_crop=0.02, max_iterations=3, pose_rounds=0)
    assert any("t1" in w and "end before the part" in w and "max_crop" in w for w in ctx.warnings)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"guides": ("a",)}, "guides are for rims: kept"),
        ({"start": "identity"}, "use start: auto"),
        ({"coarse_to_fine": True}, "coarse_to_fine"),
        ({"n_coefficients": (6,), "landmarks": (9,)}, "curves have none"),
    ],
)
def test_options_that_free_rims_do_not_take(options, says):
    with pytest.raises(ValueError, match=says):
        optimize.Config(rims="free", **options)


def test_free_rims_need_rims():
    with pytest.raises(ConfigError, match="these are closed"):
        optimized("closed", rims="free", normalize="affine")
