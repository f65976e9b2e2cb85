from __future__ import annotations

import logging

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.errors import ConfigError, FoldoverError, GeometryError, LandmarkError
from ssmpipe.core.mesh.primitives import sphere, star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.seam import Seam
from ssmpipe.core.repair.trimming import trim
from ssmpipe.stages import fit, parameterize, sample
from tests.support.meshes import noisy

Z = np.array([0, 0, 1.0])


def go(stage, options=None, **inputs):
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    return stage.run(**inputs, cfg=stage.Config(**(options or {})), ctx=ctx), ctx


def cap():
    return trim(star_shape(4), -10.0 * Z, -Z)


def test_a_cap_goes_through_to_a_spline_that_closes():
    made, ctx = go(parameterize, {"topology": "cone"}, mesh=cap())
    assert not ctx.warnings
    assert ctx.metrics["apex_from"] == "geometry"
    assert ctx.metrics["seam_from"] == "direction"
    assert ctx.metrics["stretch"] < 1.1 < ctx.metrics["stretch_before"]
    assert max(ctx.metrics["pole_ring_percent"]) < 3.0
    assert ctx.metrics["euler_characteristic"] == 1
    assert made["seam"].topology == "cone"
    samples, _ = go(sample, {"grid": (80, 80)}, **made)
    fitted, ctx = go(fit, {"n_control": (30, 30)}, samples=samples["samples"], mesh=made["mesh"])
    control = fitted["surface"].control_points
    assert np.array_equal(control[0], control[-1])
    assert (control[:, -1] == control[0, -1]).all()
    assert ctx.metrics["spline_to_mesh_rms_mm"] < 0.2


def test_landmarks_place_poles_and_seam():
    lump = star_shape(4)
    points = {
        "top": lump.vertices[np.argmax(lump.vertices[:, 2])],
        "bottom": lump.vertices[np.argmin(lump.vertices[:, 2])],
    }
    points["side"] = lump.vertices[np.argmin(lump.vertices[:, 0])]
    roles = {"apex": "top", "antapex": "bottom", "seam": "side"}
    made, ctx = go(parameterize, {"topology": "closed"}, mesh=lump, landmarks=Landmarks(points, roles))
    assert (ctx.metrics["apex_from"], ctx.metrics["seam_from"]) == ("landmark", "landmark")
    assert ctx.metrics["pole_distance_max_mm"] == pytest.approx(0.0, abs=1e-9)
    poles = made["mesh"].vertices[list(made["seam"].poles)]
    assert poles == pytest.approx(np.array([points["bottom"], points["top"]]))
    samples, _ = go(sample, {"grid": (60, 200)}, **made)
    assert np.linalg.norm(samples["samples"][0] - points["side"], axis=1).min() < 1.0
    with pytest.raises(LandmarkError, match=r"needs both poles; missing: antapex"):
        go(parameterize, {"topology": "closed"}, mesh=lump, landmarks=Landmarks(points, {"apex": "top"}))


def test_a_traced_cone_goes_through_to_a_spline_that_closes():
    made, ctx = go(parameterize, {"topology": "cone", "cone": "traced"}, mesh=cap())
    plain, _ = go(parameterize, {"topology": "cone"}, mesh=cap())
    assert not ctx.warnings
    assert (ctx.metrics["n_flips"], ctx.metrics["n_iterations"]) == (0, 0)
    assert ctx.metrics["kink"] > 0
    assert ctx.metrics["stretch"] < ctx.metrics["stretch_before"]
    assert made["mesh"].n_vertices > plain["mesh"].n_vertices
    # both lines are in the mesh
    assert min((made["uv"][:, 0] == 0.0).sum(), len(made["seam"].pairs)) > 20
    samples, _ = go(sample, {"grid": (80, 80)}, **made)
    fitted, ctx = go(fit, {"n_control": (30, 30)}, samples=samples["samples"], mesh=made["mesh"])
    control = fitted["surface"].control_points
    assert np.array_equal(control[0], control[-1])
    assert ctx.metrics["spline_to_mesh_rms_mm"] < 0.2
    # triangles that were turned over and mended are told, those that are left stop the shape
    _, ctx = go(parameterize, {"topology": "cone", "cone": "traced"}, mesh=noisy(cap(), np.random.default_rng(1), 0.4))
    assert any("triangles over, so negative weights were raised" in text for text in ctx.warnings)
    with pytest.raises(
        FoldoverError, match=r"triangles are turned over in the square, the first at \(.*cone: periodic"
    ):
        go(parameterize, {"topology": "cone", "cone": "traced"}, mesh=noisy(cap(), np.random.default_rng(0), 1.0))
    with pytest.raises(ValidationError, match=r"cone: traced is for topology: cone, not for closed"):
        parameterize.Config(topology="closed", cone="traced")


def test_options_change_what_they_say():
    mesh = cap()
    plain, ctx = go(parameterize, {"topology": "cone", "max_iterations": 0, "n_remap": 0}, mesh=mesh)
    assert ctx.metrics["stretch"] == ctx.metrics["stretch_before"]
    remapped, _ = go(parameterize, {"topology": "cone", "max_iterations": 0}, mesh=mesh)
    relaxed, _ = go(parameterize, {"topology": "cone", "n_remap": 0}, mesh=mesh)
    turned, _ = go(parameterize, {"topology": "cone", "seam_direction": (1.0, 0.0, 0.0)}, mesh=mesh)
    maps = [m["uv"] for m in (plain, remapped, relaxed, turned)]
    assert all(not np.allclose(maps[i], maps[j]) for i in range(4) for j in range(i))
    lump = star_shape(3)
    up, _ = go(parameterize, {"topology": "closed", "pole_direction": (0.0, 0.0, 1.0)}, mesh=lump)
    down, _ = go(parameterize, {"topology": "closed", "pole_direction": (0.0, 0.0, -1.0)}, mesh=lump)
    ends = [m["mesh"].vertices[list(m["seam"].poles)] for m in (up, down)]
    assert ends[0] == pytest.approx(ends[1][::-1])
    disk = trim(star_shape(3), 35.0 * Z, Z)
    squares = [go(parameterize, {"method": method}, mesh=disk)[0] for method in ("mean-value-stretch", "slim")]
    assert not np.allclose(*(m["uv"] for m in squares))
    assert squares[0]["seam"] is None
    with pytest.raises(ConfigError, match="slim is for a disk, this is a tube"):
        go(parameterize, {"method": "slim"}, mesh=disk, seam=Seam("tube", np.array([[0, 1]])))
    with pytest.raises(ValidationError, match="slim is for topology: disk, not for cone"):
        parameterize.Config(method="slim", topology="cone")
    with pytest.raises(ValidationError, match="must not be zero"):
        parameterize.Config(seam_direction=(0.0, 0.0, 0.0))
    with pytest.raises(ValidationError, match="at least 4"):
        parameterize.Config(n_remap=2)


def test_arbitrary_choices_are_told():
    _, ctx = go(parameterize, {"topology": "closed"}, mesh=sphere(10.0, 3))
    assert "no distinct longest way" in ctx.warnings[0]
    _, ctx = go(parameterize, {"topology": "closed", "pole_direction": (0.0, 1.0, 0.0)}, mesh=star_shape(3))
    assert "lie across parameterize.pole_direction" in ctx.warnings[0]
    rough = noisy(cap(), np.random.default_rng(4), 1.5)
    _, ctx = go(parameterize, {"topology": "cone"}, mesh=rough)
    assert "the harmonic map turned" in ctx.warnings[0]
    assert ctx.metrics["n_flips"] == 0
    _, ctx = go(parameterize, {"topology": "cone", "max_iterations": 1}, mesh=cap())
    assert "stretch still fell after 1 iterations" in ctx.warnings[0]


def test_poles_are_those_of_the_reference():
    lump = star_shape(4)
    linear = np.array([[1.1, 0.05, 0.0], [0.0, 0.9, 0.0], [0.03, 0.0, 1.2]])
    other = TriMesh(lump.vertices @ linear.T + [2.0, 0.0, -1.0], lump.faces)
    made, ctx = go(parameterize, {"topology": "closed", "max_iterations": 5}, mesh=lump, reference=lump)
    own, _ = go(parameterize, {"topology": "closed", "max_iterations": 5, "places": "own"}, mesh=lump, reference=other)
    poles = made["mesh"].vertices[list(made["seam"].poles)]
    assert ctx.metrics["apex_from"] == "reference"
    assert np.allclose(own["mesh"].vertices[list(own["seam"].poles)], poles)
    carried, _ = go(parameterize, {"topology": "closed", "max_iterations": 5}, mesh=other, reference=lump)
    wanted = poles @ linear.T + [2.0, 0.0, -1.0]
    there = carried["mesh"].vertices[list(carried["seam"].poles)]
    assert np.linalg.norm(there - wanted, axis=1).max() < 0.5


@pytest.mark.parametrize(
    ("inputs", "says"),
    [
        ({"reference": True}, r"same boundary vertex; try: .*best-fit.*corner_1"),
        ({"reference": False}, r"same boundary vertex; try: give landmarks"),
        (
            {"landmarks": Landmarks({f"corner_{k}": np.zeros(3) for k in range(1, 5)})},
            "move the corner landmarks apart",
        ),
    ],
)
def test_corners_that_fall_together_are_blamed_on_where_they_come_from(inputs, says, monkeypatch):
    cap_ = cap()
    monkeypatch.setattr(parameterize, "affine_onto", lambda *_: np.diag([0.0, 0, 0, 1]))
    monkeypatch.setattr(
        parameterize, "corners_of_any_rim", lambda mesh, *_: (np.repeat(mesh.vertices[:1], 4, axis=0), False)
    )
    given = inputs | {"reference": cap_ if inputs.get("reference") else None}
    with pytest.raises(GeometryError, match=says):
        go(parameterize, {}, mesh=cap_, **given)


def test_corners_are_those_of_the_reference():
    cap_ = cap()
    turn = np.radians(20.0)
    linear = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    other = TriMesh(cap_.vertices @ linear.T, cap_.faces)

    def corners(made):
        return np.array(
            [made["mesh"].vertices[(made["uv"] == c).all(axis=1)][0] for c in ((0, 0), (1, 0), (1, 1), (0, 1))]
        )

    first, _ = go(parameterize, {"max_iterations": 2}, mesh=cap_, reference=cap_)
    second, ctx = go(parameterize, {"max_iterations": 2}, mesh=other, reference=cap_)
    assert ctx.metrics["corners_from"] == "reference"
    away = np.linalg.norm(corners(second) - corners(first) @ linear.T, axis=1)
    own, _ = go(parameterize, {"max_iterations": 2}, mesh=other)
    assert away.max() < 2.0 < np.linalg.norm(corners(own) - corners(first) @ linear.T, axis=1).min()


def crescent(opening: float = 60.0, thick: float = 6.0) -> TriMesh:
    """A flat C around the origin with a wavy surface: its centroid lies outside of it, and two rays from there meet nothing."""
    from ssmpipe.core.mesh.grid import grid_faces

    n, m = 61, 9
    angle, radius = np.meshgrid(
        np.radians(np.linspace(45 + opening / 2, 405 - opening / 2, n)), np.linspace(20, 20 + thick, m), indexing="ij"
    )
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return TriMesh(np.stack([x, y, np.sin(x / 9.0)], -1).reshape(-1, 3), grid_faces(n, m)[:, ::-1])


def test_corners_of_a_rim_that_its_centroid_does_not_see():
    shape = crescent()
    made, ctx = go(parameterize, {"max_iterations": 5}, mesh=shape, reference=shape)
    assert "quarters of its length" in ctx.warnings[0]
    assert ctx.metrics["corners_from"] == "reference, quarters of the rim"
    assert made["uv"].min() == 0
    assert made["uv"].max() == 1
    other = TriMesh(crescent(50.0, 7.0).vertices * [1.1, 0.95, 1.0], shape.faces)
    second, _ = go(parameterize, {"max_iterations": 5}, mesh=other, reference=shape)

    def corners(found):
        return np.array(
            [found["mesh"].vertices[(found["uv"] == c).all(axis=1)][0] for c in ((0, 0), (1, 0), (1, 1), (0, 1))]
        )

    away = np.linalg.norm(corners(second) - corners(made) * [1.1, 0.95, 1.0], axis=1)
    assert away.max() < 5.0


def test_carried_corners_out_of_order_follow_by_length(monkeypatch):
    """Where nearest places change their order the first one leads."""
    from ssmpipe.stages import parameterize as stage

    shape = crescent()
    monkeypatch.setattr(stage, "affine_onto", lambda a, b: np.diag([0.02, 0.02, 1.0, 1.0]))  # all four near one place
    made, ctx = go(parameterize, {"max_iterations": 2}, mesh=shape, reference=shape)
    assert ctx.metrics["corners_from"] == "reference, by arc length from the first"
    assert made["uv"].max() == 1
