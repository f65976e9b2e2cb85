"""The group stages on small spline cohorts, called as the runner calls them."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from ssmpipe.contract import Context, Landmarks, ShapeInfo
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.stages import evaluate, model, optimize
from tests.core.correspondence.test_options import closed_curve
from tests.support.surfaces import bump, bumps

SMALL = {"n_coefficients": (6, 6), "landmarks": (15, 15)}


def context() -> Context:
    return Context("cohort", np.random.default_rng(0), logging.getLogger("test"))


def cohort(n: int = 4, mirrored: int | None = None) -> tuple[dict, dict]:
    surfaces = {f"s{k}": s for k, s in enumerate(bumps(n))}
    transform = {i: np.eye(4) for i in surfaces}
    if mirrored is not None:
        transform[f"s{mirrored}"] = np.diag([-1.0, 1.0, 1.0, 1.0])
    return surfaces, transform


def run(surfaces, transform, marks=None, **options):
    ctx = context()
    cfg = optimize.Config(**{**SMALL, **options})
    return optimize.run(surface=surfaces, transform=transform, landmarks=marks, cfg=cfg, ctx=ctx), ctx


def test_scan_points_undo_the_transform_and_mirrored_surfaces_keep_their_outside():
    surfaces, transform = cohort(mirrored=2)
    out, _ = run(surfaces, transform)
    c = out["correspondence"]
    back = np.linalg.inv(c.transform)
    for k in range(4):
        np.testing.assert_allclose(c.points[k] @ back[k, :3, :3].T + back[k, :3, 3], c.points_scan[k], atol=1e-10)
    assert np.linalg.det(c.transform[2, :3, :3]) == pytest.approx(-1.0)
    plain, turned = out["corresponded"]["s1"], out["corresponded"]["s2"]
    np.testing.assert_array_equal(np.sort(plain.faces, axis=1), np.sort(turned.faces, axis=1))
    normal = [
        np.cross(
            m.vertices[m.faces[:, 1]] - m.vertices[m.faces[:, 0]], m.vertices[m.faces[:, 2]] - m.vertices[m.faces[:, 0]]
        )
        for m in (plain, turned)
    ]
    assert (normal[0][:, 2] > 0).all()
    assert (normal[1][:, 2] > 0).all()


def test_an_unproved_map_is_reported_and_the_results_are_kept():
    surfaces = {f"s{k}": bump((x, 30.0), 30.0) for k, x in enumerate((12.0, 30.0, 48.0))}
    transform = {i: np.eye(4) for i in surfaces}
    options = {
        "form": "sampled",
        "landmarks": (5, 5),
        "n_coefficients": (9, 9),
        "barriers": (1e-6,),
        "prior": 0.0,
        "normalize": "none",
    }
    out, ctx = run(surfaces, transform, **options)
    verdicts = [s["status"] for s in out["certificate"]["shapes"].values()]
    assert "refuted" in verdicts
    assert out["certificate"]["all_proved"] is False
    assert ctx.metrics["unproved"]
    assert any("not proved one-to-one" in warning for warning in ctx.warnings)


def test_tubes_close_and_curves_have_no_faces():
    tubes = {}
    for k, radius in enumerate((5.0, 6.0, 7.0)):
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, 1, 30), indexing="ij")
        r = radius + 0.5 * np.cos(2 * u + k) * v
        from ssmpipe.core.spline.fit import fit_surface

        fitted = fit_surface(np.stack([r * np.cos(u), r * np.sin(u), 20 * v], axis=-1), n_control=(20, 10))
        control = fitted.control_points.copy()
        control[-1] = control[0]
        tubes[f"t{k}"] = BSplineSurface(fitted.degree, fitted.knots_u, fitted.knots_v, control)
    out, ctx = run(tubes, {i: np.eye(4) for i in tubes})
    assert ctx.metrics["boundary"] == "periodic"
    assert ctx.metrics["evaluator"] == SplineStack(list(tubes.values())).evaluator
    c = out["correspondence"]
    assert c.topology == "tube"
    assert len(c.faces) == 2 * 15 * 14
    assert volume(TriMesh(c.points[0], c.faces)) > 0
    curves = {f"c{k}": closed_curve(0.5 + 0.1 * k, 0.1 * k) for k in range(3)}
    cfg = {"n_coefficients": (12,), "landmarks": (40,)}
    out, _ = run(curves, {i: np.eye(4) for i in curves}, **cfg)
    c = out["correspondence"]
    assert (c.topology, c.faces.shape, c.points.shape) == ("curve-closed", (0, 3), (3, 40, 2))
    assert out["corresponded"]["c1"].closed
    np.testing.assert_array_equal(out["corresponded"]["c1"].points, c.points_scan[1])


def test_the_optimization_gets_the_threads_of_its_context(monkeypatch):
    def stop(*_, threads, **__):
        raise InterruptedError(threads)

    monkeypatch.setattr(optimize, "optimize_correspondence", stop)
    ctx = context()
    ctx.threads = 3
    surfaces, transform = cohort()
    with pytest.raises(InterruptedError, match="3"):
        optimize.run(surface=surfaces, transform=transform, landmarks=None, cfg=optimize.Config(**SMALL), ctx=ctx)


def test_unknown_names_are_refused():
    surfaces, transform = cohort(3)
    with pytest.raises(ConfigError, match="there is no shape 'x' among s0, s1, s2"):
        run(surfaces, transform, reference="x")
    marks = {"s0": Landmarks({"top": np.zeros(3)})}
    with pytest.raises(ConfigError, match=r"no shape has a landmark 'tip'.*one of: top"):
        run(surfaces, transform, marks, guides=("tip",))


def test_model_and_evaluation_tables():
    surfaces, transform = cohort()
    correspondence = run(surfaces, transform)[0]["correspondence"]
    info = {i: ShapeInfo(i, "L" if i == "s1" else "R", {"age": "40"}) for i in surfaces}
    ctx = context()
    out = model.run(correspondence=correspondence, info=info, cfg=model.Config(n_mode_meshes=2), ctx=ctx)
    assert list(out["scores"].columns)[:4] == ["id", "mode_01", "mode_02", "mode_03"]
    assert out["scores"].columns["side"] == ["R", "L", "R", "R"]
    assert out["scores"].columns["age"] == ["40"] * 4
    assert set(out["model_meshes"]) == {"mean", "mode_01_minus3", "mode_01_plus3", "mode_02_minus3", "mode_02_plus3"}
    half = 0.5 * (out["model_meshes"]["mode_01_minus3"].vertices + out["model_meshes"]["mode_01_plus3"].vertices)
    np.testing.assert_allclose(half, out["model_meshes"]["mean"].vertices, atol=1e-9)
    top = {
        i: Landmarks({"top": s.control_points.reshape(-1, 3)[s.control_points[..., 2].argmax()]})
        for i, s in surfaces.items()
    }
    tables = evaluate.run(
        correspondence=correspondence, landmarks=top, transform=transform, cfg=evaluate.Config(), ctx=ctx
    )
    measures = tables["measures"].columns
    assert measures["correspondence"] == ["initial"] * 2 + ["optimized"] * 2
    transfer = tables["landmark_transfer"].columns
    mean = {
        c: m
        for n, c, m in zip(transfer["landmark"], transfer["correspondence"], transfer["mean_mm"], strict=True)
        if n == "top"
    }
    assert mean["optimized"] < mean["initial"]
