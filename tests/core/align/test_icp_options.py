"""Regions, mirror images, and random starts on real shapes."""

from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.icp import Ball, PointSurface, Region, align, align_mirrored, refine
from ssmpipe.core.align.proximal_femur import analyze_proximal_femur
from ssmpipe.core.align.rigid import move, reflection, rotation_angle
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.primitives import star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.core.repair.trimming import trim
from ssmpipe.io.meshes import read_mesh
from ssmpipe.synth.aorta import Wall, truth_grid
from tests.support.femora import DATA, femur, landmark, needs_femora
from tests.support.meshes import random_motion


def with_shaft(length: float) -> TriMesh:
    """Return the lump with one bump drawn out to a shaft along z, cut ``length`` mm above the middle."""
    lump = star_shape(4)
    high = np.clip(lump.vertices[:, 2] - 40.0, 0.0, None)
    drawn = TriMesh(lump.vertices + np.outer(4.0 * high, [0.0, 0.0, 1.0]), lump.faces)
    return trim(drawn, np.array([0, 0, length]), np.array([0, 0, 1.0]))


def test_a_region_makes_the_length_of_the_shaft_indifferent():
    long, short = with_shaft(150.0), with_shaft(70.0)
    motion = random_motion(np.random.default_rng(0), shift=5.0)
    extent = np.ptp(short.vertices[:, 2])
    region = Region(2, 0.0, (extent - 15.0) / extent)
    whole = align(move(long, motion), short).matrix @ motion
    part = align(move(long, motion), short, region=region).matrix @ motion
    assert rotation_angle(part) < 0.1
    assert np.abs(part[:3, 3]).max() < 0.1
    assert np.abs(whole[:3, 3]).max() > 5 * np.abs(part[:3, 3]).max()
    with pytest.raises(
        GeometryError, match=r"the region from 0\.3 to 0\.3 of the reference holds 0\.0 %.*widen align\.region"
    ):
        align(long, short, region=Region(2, 0.3, 0.3))


def test_a_ball_around_a_landmark_makes_the_length_of_the_shaft_indifferent():
    long, short = with_shaft(150.0), with_shaft(70.0)
    motion = random_motion(np.random.default_rng(0), shift=5.0)
    center = np.array([0.0, 0.0, 0.0])
    ball = Ball(center, 60.0).moved(motion)
    assert ball.center == pytest.approx(motion[:3, 3])
    found = align(move(long, motion), short, ball=ball)
    part = found.matrix @ motion
    assert rotation_angle(part) < 0.1
    assert np.abs(part[:3, 3]).max() < 0.1
    with pytest.raises(
        GeometryError,
        match=r"within 5 mm of the landmark at \(300\.0, 0\.0, 0\.0\) mm lies 0\.0 % of the surface, which is .*region_radius_mm",
    ):
        align(long, short, ball=Ball(np.array([300.0, 0, 0]), 5.0))


def test_the_mirror_image_moves_the_shape_as_it_was_given():
    lump, rng = star_shape(3), np.random.default_rng(1)
    given = move(lump, random_motion(rng) @ reflection(1))
    result = align_mirrored(given, lump, align(given, lump))
    assert np.linalg.det(result.matrix[:3, :3]) == pytest.approx(-1.0)
    assert move(given, result.matrix).vertices == pytest.approx(lump.vertices, abs=0.05)
    assert result.cost < 1e-2


def _pair(name: str) -> tuple[TriMesh, TriMesh]:
    """Return two shapes of a cohort in about the same pose."""
    if name == "aorta":
        parameters, faces = truth_grid()
        theta, t = 2 * np.pi * parameters[:, 0], 56.0 * parameters[:, 1]
        rng = np.random.default_rng(0)
        walls = [Wall(rng.normal(size=7), 0.3 * rng.normal(size=(2, 4, 5))) for _ in range(2)]
        a, b = (TriMesh(wall.point(theta, t), faces) for wall in walls)
        return a, b
    if name in ("femur", "proximal femur"):
        found = []
        for shape_id in ("z009_Femur_R", "z035_Femur_R"):
            bone = femur(shape_id)
            if name == "proximal femur":
                axis = analyze_proximal_femur(bone).axis
                bone = trim(bone, landmark(shape_id, "LT") - 20.0 * axis, -axis)
            found.append(decimate(bone, 5000).mesh)
        return found[0], found[1]
    folder, first, second = {
        "teeth": ("teeth_molar", "006.off", "002.off"),
        "spleen": ("spleen", "", ""),
    }[name]
    files = sorted((DATA / folder / "scans").iterdir())
    if first:
        files = [p for p in files if p.name in (first, second)]
    first_mesh, second_mesh = (read_mesh(path) for path in files[:2])
    return first_mesh, second_mesh


@needs_femora
@pytest.mark.slow
@pytest.mark.parametrize("name", ["femur", "proximal femur", "aorta", "teeth", "spleen"])
def test_twenty_of_twenty_random_starts_converge(name):
    source, target = _pair(name)
    size = float(np.linalg.norm(np.ptp(target.vertices, axis=0)))
    source, target = (TriMesh(100.0 / size * m.vertices, m.faces) for m in (source, target))
    # the pose of reference: the best over all starts, refined from there
    best = align(source, target, margin=0.0, n_points=2000)
    points = [PointSurface.of(m, 2000) for m in (source, target)]
    truth = refine(points[0], points[1], best.matrix)[0]
    rng = np.random.default_rng(7)
    off = []
    for _ in range(20):
        motion = random_motion(rng)
        found = align(move(source, motion), target, margin=0.0, n_points=2000).matrix @ motion
        off.append(rotation_angle(found @ np.linalg.inv(truth)))
    assert max(off) < 5.0, [round(x, 1) for x in off]
