from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context, Landmarks, ShapeInfo
from ssmpipe.core.align.rigid import apply, homogeneous, move, reflection, rotation_angle, rotation_vector_matrix
from ssmpipe.core.errors import ConfigError, LandmarkError, TopologyError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.primitives import sphere, star_shape, torus, tube
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic, face_components
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import align, decimate, fit, orient, parameterize, repair, sample, smooth, trim
from tests.support.femora import DATA, femur, landmark, needs_femora, needs_vertebrae, read, sides
from tests.support.meshes import joined, noisy, random_motion, soup

CHAIN = (repair, orient, trim, smooth, decimate, align, parameterize, sample, fit)


def go(stage, **inputs):
    options = inputs.pop("options", {})
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    outputs = stage.run(**inputs, cfg=stage.Config(**options), ctx=ctx)
    assert set(outputs) == {port.slot for port in stage.STAGE.outputs}
    return outputs, ctx


@pytest.mark.parametrize("stage", CHAIN, ids=lambda s: s.STAGE.name)
def test_options_are_described(stage):
    assert stage.__doc__
    for name, field in stage.Config.model_fields.items():
        assert field.description, name
        assert field.description.endswith("."), name


class TestRepair:
    def test_metrics_tell_what_was_found(self):
        speck = sphere(0.5, 1)
        scan = joined(star_shape(3), TriMesh(speck.vertices + [99.0, 0, 0], speck.faces))
        outputs, ctx = go(repair, mesh=scan)
        assert ctx.metrics["dropped_components"] == 1
        assert ctx.metrics["genus"] == ctx.metrics["n_loops"] == 0
        assert ctx.metrics["n_faces"] == outputs["mesh"].n_faces == star_shape(3).n_faces
        assert not ctx.warnings

    def test_refusals_name_their_options(self):
        two = joined(sphere(10.0), TriMesh(sphere(9.0).vertices + [30.0, 0, 0], sphere().faces))
        with pytest.raises(TopologyError, match=r"2 components of 55\.\d %, 44\.\d %.*components: largest"):
            go(repair, mesh=two)
        kept, ctx = go(repair, mesh=two, options={"components": "largest"})
        assert volume(kept["mesh"]) == pytest.approx(volume(sphere(10.0)))
        assert "44.8 % of the area were dropped" in ctx.warnings[0]
        with pytest.raises(TopologyError, match=r"2 openings.*at most 1 expected.*repair\.max_openings"):
            go(repair, mesh=tube())
        with pytest.raises(TopologyError, match=r"1 opening .*a closed surface is expected"):
            go(
                repair,
                mesh=go(trim, mesh=star_shape(3), options={"distance_mm": 20.0})[0]["mesh"],
                options={"max_openings": 0},
            )
        with pytest.raises(TopologyError, match=r"1 handle"):
            go(repair, mesh=torus())

    def test_faces_that_do_not_quite_meet_are_named_and_merged_when_asked(self):
        raw = soup(star_shape(3))
        size = np.linalg.norm(np.ptp(raw.vertices, axis=0))
        loose = noisy(raw, np.random.default_rng(0), 1e-6 * size)
        with pytest.raises(
            TopologyError, match=r"falls into 1280 pieces, the largest with 0\.\d+ %.*repair\.merge_tolerance"
        ):
            go(repair, mesh=loose)
        outputs, ctx = go(repair, mesh=loose, options={"merge_tolerance": 2e-5})
        assert outputs["mesh"].n_vertices == star_shape(3).n_vertices
        assert ctx.metrics["merged_vertices"] == raw.n_vertices - star_shape(3).n_vertices

    def test_handles_are_cut_when_the_config_allows_it(self):
        ring = torus(6.0, 1.0, 48, 12)
        with pytest.raises(TopologyError, match=r"1 handle .*repair\.max_handle_mm"):
            go(repair, mesh=ring, options={"max_handle_mm": 5.0})
        outputs, ctx = go(repair, mesh=ring, options={"max_handle_mm": 8.0})
        assert euler_characteristic(outputs["mesh"].faces) == 2
        assert ctx.metrics["handles_cut"] == 1
        assert np.hypot(*ctx.metrics["handle_places_mm"][0][:2]) == pytest.approx(6.0, abs=0.2)
        assert "a handle with a loop of 6.2 mm" in ctx.warnings[0]

    def test_spikes_are_removed_and_listed_unless_they_shall_stay(self):
        ball = sphere(20.0, 4)
        vertices = ball.vertices.copy()
        vertices[[100, 900]] *= [[1.4], [1.3]]
        scan = TriMesh(vertices, ball.faces)
        outputs, ctx = go(repair, mesh=scan)
        assert np.linalg.norm(outputs["mesh"].vertices, axis=1).max() < 20.1
        assert ctx.metrics["spikes_removed"] == 2
        assert ctx.metrics["spikes_mm"][0][:3] == pytest.approx(vertices[100], abs=0.01)
        assert "2 spikes were removed: " in ctx.warnings[0]
        kept, ctx = go(repair, mesh=scan, options={"spike_width": 0.0})
        assert np.array_equal(kept["mesh"].vertices, scan.vertices)
        assert not ctx.warnings

    def test_self_intersections_are_replaced_or_named(self):
        ball = sphere(20.0, 4)
        noise = np.random.default_rng(0).normal(size=ball.vertices.shape)
        near = np.linalg.norm(ball.vertices - ball.vertices[100], axis=1) < 2.0
        scan = TriMesh(ball.vertices + near[:, None] * noise, ball.faces)
        _, ctx = go(repair, mesh=scan)
        assert ctx.metrics["self_intersections"] == 1
        assert ctx.metrics["self_intersections_left"] == 0
        assert not ctx.warnings
        outputs, ctx = go(repair, mesh=scan, options={"self_intersections": "report"})
        assert np.array_equal(outputs["mesh"].vertices, scan.vertices)
        assert "passes through itself in 1 places: (" in ctx.warnings[0]
        assert ctx.metrics["self_intersections_mm"][0] == pytest.approx(ball.vertices[100], abs=2.5)
        outputs, ctx = go(repair, mesh=scan, options={"self_intersections": "ignore"})
        assert "self_intersections" not in ctx.metrics
        assert np.array_equal(outputs["mesh"].vertices, scan.vertices)

    @needs_vertebrae
    def test_vertebrae_are_refused(self):
        files = sorted((DATA / "vertebra_l1" / "scans").glob("*.ply"))
        assert len(files) == 3
        for path in files:
            with pytest.raises(TopologyError, match=r"1 handle \(genus 1\), it must have none; a loop of 3\d|4\d"):
                go(repair, mesh=read(path))


class TestOrient:
    def test_mirroring_follows_the_side(self):
        lump = star_shape(3)
        marks = Landmarks({"tip": lump.vertices[5]})
        for side, mirror, expected in (("L", "left", -1), ("R", "left", 1), ("R", "right", -1), ("L", "none", 1)):
            outputs, ctx = go(
                orient,
                mesh=lump,
                landmarks=marks,
                transform=2.0 * np.eye(4) / np.array([1, 1, 1, 2.0]),
                info=ShapeInfo("a", side),
                options={"mirror": mirror, "frame": "principal"},
            )
            matrix = outputs["transform"]
            assert np.linalg.det(matrix[:3, :3]) == pytest.approx(8 * expected)
            assert outputs["landmarks"].points["tip"] == pytest.approx(outputs["mesh"].vertices[5])
            assert apply(matrix, lump.vertices[5:6] / 2)[0] == pytest.approx(outputs["mesh"].vertices[5])
            assert volume(outputs["mesh"]) == pytest.approx(volume(lump))
            assert not ctx.warnings

    def test_unknown_side_warns_and_keeps(self):
        outputs, ctx = go(
            orient,
            mesh=star_shape(2),
            landmarks=None,
            transform=np.eye(4),
            info=ShapeInfo("a"),
            options={"frame": "none"},
        )
        assert "side of 'a' is unknown" in ctx.warnings[0]
        assert "orient.mirror" in ctx.warnings[0]
        assert outputs["transform"] == pytest.approx(np.eye(4))
        ctx = Context("a", np.random.default_rng(0), logging.getLogger("test"), joins=True)
        orient.run(star_shape(2), np.eye(4), ShapeInfo("a"), cfg=orient.Config(frame="none"), ctx=ctx)
        assert "say --side L or --side R" in ctx.warnings[0]
        assert "orient.mirror" not in ctx.warnings[0]

    def test_incomplete_roles_are_refused(self):
        marks = Landmarks({"E": np.zeros(3)}, {"lateral": "E"})
        with pytest.raises(LandmarkError, match=r"missing: medial, proximal"):
            go(orient, mesh=star_shape(2), landmarks=marks, transform=np.eye(4), info=ShapeInfo("a", "R"))

    @needs_femora
    def test_landmarks_refine_the_frame_and_left_equals_mirrored_right(self):
        shape_id = "z009_Femur_R"
        bone = femur(shape_id)
        points = {code: landmark(shape_id, code) for code in ("LEC", "MEC", "SFH")}
        roles = {"lateral": "LEC", "medial": "MEC", "proximal": "SFH"}
        by_landmarks, ctx = go(
            orient, mesh=bone, landmarks=Landmarks(points, roles), transform=np.eye(4), info=ShapeInfo(shape_id, "R")
        )
        assert ctx.metrics["frame_from"] == "landmarks"
        moved = by_landmarks["landmarks"].points
        assert (moved["LEC"] - moved["MEC"])[1] == pytest.approx(0.0, abs=1e-9)
        plain, _ = go(orient, mesh=bone, landmarks=None, transform=np.eye(4), info=ShapeInfo(shape_id, "R"))
        assert rotation_angle(by_landmarks["transform"] @ np.linalg.inv(plain["transform"])) < 12
        pretended, _ = go(
            orient, mesh=move(bone, reflection(2)), landmarks=None, transform=np.eye(4), info=ShapeInfo("other", "L")
        )
        assert pretended["mesh"].vertices == pytest.approx(plain["mesh"].vertices, abs=1e-3)


class TestTrim:
    def test_ways_to_say_where(self):
        lump = star_shape(4)
        low = lump.vertices[:, 2].min()
        for options, marks, height in (
            ({"distance_mm": 20.0}, None, low + 20),
            ({"plane_point": (1.0, 2.0, 3.0)}, None, 3.0),
            ({}, Landmarks({"trim": np.array([0, 0, 7.0])}), 7.0),
            ({"offset_mm": -2.0}, Landmarks({"LT": np.array([0, 0, 7.0])}, {"trim": "LT"}), 5.0),
        ):
            outputs, ctx = go(trim, mesh=lump, landmarks=marks, options=options)
            assert outputs["mesh"].vertices[:, 2].max() == pytest.approx(height)
            assert ctx.metrics["height_mm"] == pytest.approx(height - low)
            assert euler_characteristic(outputs["mesh"].faces) == 1
            assert len(boundary_loops(outputs["mesh"].faces)) == 1

    def test_contradictions_are_refused(self):
        with pytest.raises(ValidationError, match=r"not both"):
            trim.Config(distance_mm=3.0, plane_point=(0.0, 0.0, 1.0))


def test_smooth_and_decimate_report_what_they_did():
    outputs, ctx = go(smooth, mesh=star_shape(4))
    assert abs(ctx.metrics["volume_change_percent"]) < 0.5
    outputs, ctx = go(decimate, mesh=outputs["mesh"], options={"n_faces": 1000})
    assert ctx.metrics["n_faces"] == outputs["mesh"].n_faces == 1000
    assert 0 < ctx.metrics["deviation_rms_mm"] < ctx.metrics["deviation_max_mm"] < 1.5
    _, ctx = go(decimate, mesh=outputs["mesh"])
    assert ctx.metrics["method"] == "none"
    with pytest.raises(ValidationError, match=r"mu must be below"):
        smooth.Config(mu=-0.4)


class TestAlign:
    def prepared(self, **options):
        ctx = Context("", np.random.default_rng(0), logging.getLogger("test"))
        sizes = {"a": 0.9, "b": 1.0, "c": 1.2}
        inputs = {k: {"mesh": TriMesh(s * star_shape(3).vertices, star_shape(3).faces)} for k, s in sizes.items()}
        return align.prepare(inputs, cfg=align.Config(**options), ctx=ctx)["reference"], ctx.metrics["reference"]

    def test_reference_is_the_medoid_or_an_id(self):
        assert self.prepared()[1] == "b"
        assert self.prepared(reference="c")[1] == "c"
        with pytest.raises(ConfigError, match=r"there is no shape 'd'; the cohort has a, b, c"):
            self.prepared(reference="d")

    def test_the_group_itself_can_be_the_reference(self):
        union, name = self.prepared(reference="group")
        assert name == "group"
        assert face_components(union.faces).max() == 2  # three shapes, each of its size
        # the central one gives the poles
        first = compact(union, face_components(union.faces) == 0)
        closed = {"topology": "closed"}
        lump = star_shape(2)
        one, all_ = (go(parameterize, mesh=lump, reference=r, options=closed)[0]["uv"] for r in (first, union))
        assert np.array_equal(one, all_)
        assert np.abs(union.vertices).max() == pytest.approx(1.2 * np.abs(star_shape(3).vertices).max(), rel=0.05)

    def test_a_landmark_restricts_the_fit(self):
        lump = star_shape(3)
        reference = TriMesh(lump.vertices * [1.0, 1.0, 1.1], lump.faces)
        marks = Landmarks({"foot": np.array([0.0, 0.0, -30.0])}, {"trim": "foot"})
        inputs = {"mesh": lump, "landmarks": marks, "transform": np.eye(4), "reference": reference}
        part = {"region_landmark": "trim", "region_radius_mm": 25.0}
        found = [go(align, **inputs, options={"check_mirror": False, **o})[0] for o in ({}, part)]
        foot = [TriMesh(o["mesh"].vertices, lump.faces).vertices[lump.vertices[:, 2] < -25.0] for o in found]
        away = [np.sqrt((point_to_mesh(points, reference)[0] ** 2).mean()) for points in foot]
        assert away[1] < 0.5 * away[0]
        with pytest.raises(
            LandmarkError, match=r"no landmark or role 'head' \(align\.region_landmark\); this shape has 'foot'"
        ):
            go(align, **inputs, options={"region_landmark": "head"})
        with pytest.raises(ValidationError, match="exclude each other"):
            align.Config(region=(0.0, 0.5), region_landmark="trim")

    def test_pose_is_undone_and_reported(self):
        reference, _ = self.prepared()
        motion = random_motion(np.random.default_rng(4))
        marks = Landmarks({"p": apply(motion, np.ones((1, 3)))[0]})
        outputs, ctx = go(align, mesh=move(reference, motion), landmarks=marks, transform=motion, reference=reference)
        assert outputs["transform"] == pytest.approx(np.eye(4), abs=1e-3)
        assert outputs["landmarks"].points["p"] == pytest.approx(np.ones(3), abs=1e-2)
        assert ctx.metrics["rms_mm"] < 1e-3
        assert "pose given by orient was replaced" in ctx.warnings[0]
        assert " mm" not in ctx.warnings[0]  # with units none they are not mm

    def test_a_pose_replaced_is_no_news_where_frames_have_no_ends_or_it_hardly_turns(self, monkeypatch):
        reference, _ = self.prepared()
        far = move(reference, random_motion(np.random.default_rng(4)))
        near = move(reference, homogeneous(rotation_vector_matrix(np.array([0.0, 0.0, 0.2])), np.zeros(3)))
        given = {"landmarks": None, "transform": np.eye(4), "reference": reference}
        outputs, ctx = go(align, mesh=far, **given, options={"check_frame": False})
        assert ctx.metrics["start"] != "identity"
        assert not ctx.warnings
        assert np.abs(outputs["mesh"].vertices - reference.vertices).max() < 1e-2
        found = align.align
        monkeypatch.setattr(align, "align", lambda *a, **k: replace(found(*a, **k), start="screened"))
        assert not go(align, mesh=near, **given)[1].warnings

    def test_the_mirror_image_is_sought_with_as_many_points(self):
        reference, _ = self.prepared()
        given = {"landmarks": None, "transform": np.eye(4), "reference": reference}
        one, two = (go(align, mesh=reference, **given, options={"n_points": n})[1].metrics for n in (1000, 4000))
        assert one["mirrored_cost_mm"] != pytest.approx(two["mirrored_cost_mm"], rel=1e-3)

    def test_wrong_side_warns(self):
        reference, _ = self.prepared()
        _, ctx = go(align, mesh=move(reference, reflection()), landmarks=None, transform=np.eye(4), reference=reference)
        assert any("fits better mirrored" in w and "wrong side label?" in w for w in ctx.warnings)
        assert not any(" mm" in w for w in ctx.warnings)
        wrong = noisy(move(reference, reflection()), np.random.default_rng(0), 0.3)
        given = {"mesh": wrong, "landmarks": None, "transform": np.eye(4), "reference": reference}
        for margin, told in ((0.05, True), (0.999, False)):
            _, ctx = go(align, **given, options={"chirality_margin": margin})
            assert any("better mirrored" in w for w in ctx.warnings) is told


class TestParameterizeAndSample:
    def test_from_angles_and_from_landmarks(self):
        disk = go(trim, mesh=star_shape(4), options={"distance_mm": 60.0})[0]["mesh"]
        outputs, ctx = go(parameterize, mesh=disk, landmarks=None)
        assert ctx.metrics["n_flips"] == 0
        assert ctx.metrics["stretch"] < ctx.metrics["stretch_before"]
        uv = outputs["uv"]
        assert len(uv) == outputs["mesh"].n_vertices
        corners = [int(np.flatnonzero((uv == c).all(axis=1))[0]) for c in ((0, 0), (1, 0), (1, 1), (0, 1))]
        places = outputs["mesh"].vertices[corners]
        marks = Landmarks({f"corner_{k + 1}": p for k, p in enumerate(places)})
        again, ctx = go(parameterize, mesh=disk, landmarks=marks)
        assert ctx.metrics["corners_from"] == "landmarks"
        n = disk.n_vertices
        assert again["uv"][:n] == pytest.approx(uv[:n], abs=1e-8)
        samples, ctx = go(sample, mesh=outputs["mesh"], uv=uv, options={"grid": (30, 20)})
        assert samples["samples"].shape == (30, 20, 3)
        assert samples["samples"][0, 0] == pytest.approx(places[0])
        normals = np.cross(np.diff(samples["samples"], axis=0)[:, :-1], np.diff(samples["samples"], axis=1)[:-1])
        outward = samples["samples"][:-1, :-1] - disk.vertices.mean(axis=0)
        assert (np.einsum("ijk,ijk->ij", normals, outward) > 0).mean() > 0.95

    def test_missing_corner_and_round_rim(self):
        cap = go(trim, mesh=sphere(10.0), options={"distance_mm": 8.0})[0]["mesh"]
        with pytest.raises(LandmarkError, match=r"missing: corner_2, corner_3, corner_4"):
            go(parameterize, mesh=cap, landmarks=Landmarks({"corner_1": np.zeros(3)}))
        _, ctx = go(parameterize, mesh=cap, landmarks=None, options={"corner_axes": "rim"})
        assert "nearly round" in ctx.warnings[0]


@needs_femora
def test_chain_on_two_real_femora_left_and_right():
    made = {}
    for shape_id in ("z013_Femur_L", "z035_Femur_R"):
        slots = go(repair, mesh=femur(shape_id))[0]
        slots |= go(
            orient,
            mesh=slots["mesh"],
            landmarks=Landmarks({"LEC": landmark(shape_id, "LEC")}),
            transform=np.eye(4),
            info=ShapeInfo(shape_id, sides()[shape_id]),
        )[0]
        slots |= go(trim, mesh=slots["mesh"], landmarks=slots["landmarks"])[0]
        slots |= go(smooth, mesh=slots["mesh"])[0]
        made[shape_id] = slots | go(decimate, mesh=slots["mesh"], options={"n_faces": 6000})[0]
    reference = made["z035_Femur_R"]["mesh"]
    for shape_id, slots in made.items():
        outputs, ctx = go(
            align, mesh=slots["mesh"], landmarks=slots["landmarks"], transform=slots["transform"], reference=reference
        )
        assert not ctx.warnings
        assert ctx.metrics["start"] == "identity"
        assert ctx.metrics["rms_mm"] < 2.5
        assert apply(outputs["transform"], landmark(shape_id, "LEC")[None])[0] == pytest.approx(
            outputs["landmarks"].points["LEC"]
        )
        assert outputs["landmarks"].points["LEC"][0] > 25
        mapped, ctx = go(parameterize, mesh=outputs["mesh"], landmarks=outputs["landmarks"])
        assert ctx.metrics["stretch"] < 1.5
        assert ctx.metrics["n_flips"] == 0
        assert go(sample, mesh=mapped["mesh"], uv=mapped["uv"])[0]["samples"].shape == (200, 200, 3)


class TestFit:
    def test_distances_both_ways_and_a_warning_when_they_are_large(self):
        disk = go(trim, mesh=star_shape(4), options={"distance_mm": 60.0})[0]["mesh"]
        uv = go(parameterize, mesh=disk, landmarks=None)[0]
        samples, _ = go(sample, **uv, options={"grid": (60, 60)})
        outputs, ctx = go(fit, **samples, mesh=uv["mesh"], options={"n_control": (20, 20)})
        assert outputs["surface"].control_points.shape == (20, 20, 3)
        rms, largest = ctx.metrics["mesh_to_spline_rms_mm"], ctx.metrics["mesh_to_spline_max_mm"]
        assert 0 < rms < 0.1 < 10 * largest
        assert 0 < ctx.metrics["spline_to_mesh_rms_mm"] < ctx.metrics["spline_to_mesh_max_mm"] < 1
        assert not ctx.warnings
        _, ctx = go(fit, **samples, mesh=uv["mesh"], options={"n_control": (4, 4)})
        assert "raise fit.n_control and sample.grid" in ctx.warnings[0]

    def test_too_few_control_points_are_refused_with_the_config(self):
        with pytest.raises(ValidationError, match=r"at least degree \+ 1 = 4 per direction"):
            fit.Config(degree=3, n_control=(3, 20))
