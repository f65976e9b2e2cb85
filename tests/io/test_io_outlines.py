"""Outlines and spline curves in and out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.spline.fit_curve import clamp_periodic
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.outlines import read_outline, write_outline
from ssmpipe.io.splines import read_spline, read_surface, write_spline


@pytest.mark.parametrize("closed", [True, False])
def test_round_trip_is_exact(tmp_path: Path, closed: bool) -> None:
    outline = Outline(np.random.default_rng(0).normal(size=(7, 2)) / 3, closed)
    write_outline(tmp_path / "a.csv", outline)
    again = read_outline(tmp_path / "a.csv")
    assert again.closed == closed
    assert np.array_equal(again.points, outline.points)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "x,y"
    assert (lines[1] == lines[-1]) == closed


def test_an_open_outline_whose_ends_meet_stays_open(tmp_path: Path) -> None:
    outline = Outline(np.array([[0, 0], [1, 0], [1, 1], [0, 0.0]]), False)
    write_outline(tmp_path / "a.csv", outline)
    assert not read_outline(tmp_path / "a.csv").closed


def test_what_other_programs_write(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\ufeffName;X;Y\na;1;2\nb;3;4\nc;5;7\n", encoding="utf-8")
    assert read_outline(tmp_path / "a.csv").points.tolist() == [[1, 2], [3, 4], [5, 7]]
    (tmp_path / "b.pts").write_text("version: 1\nn_points: 4\n{\n1 2\n3 4\n5 7\n1 2\n}\n")
    again = read_outline(tmp_path / "b.pts")
    assert again.closed
    assert len(again.points) == 3


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", "1,2\n3,4\n", "no column 'x'"),
        ("a.csv", "x,z\n1,2\n", "no column 'y'"),
        ("a.csv", "x,y\n1,2\n1,two\n3,4\n", "line 3: 'two' is not a number"),
        ("a.csv", "x,y\n1,2\n1,nan\n3,4\n", "line 3: the coordinate is not finite"),
        ("a.csv", "x,y\n1,2\n3,4\n", "has 2 points"),
        ("a.csv", "id,landmark,x,y\na,b,1,2\n", "table of landmarks"),
        ("a.pts", "version: 1\n{\n1 2 3\n}\n", "3 numbers, need 2"),
        ("a.txt", "1 2\n", "not a format of outlines"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ArtifactError, match=message):
        read_outline(tmp_path / name)


def test_curves_round_trip_and_are_told_from_surfaces(tmp_path: Path) -> None:
    curve = clamp_periodic(np.random.default_rng(1).normal(size=(9, 2)), 3)
    write_spline(tmp_path / "c.npz", curve)
    again = read_spline(tmp_path / "c.npz")
    assert type(again) is type(curve)
    assert again.degrees == (3,)
    assert np.array_equal(again.control_points, curve.control_points)
    assert np.array_equal(again.knot_vectors[0], curve.knots)
    with pytest.raises(ArtifactError, match="holds a curve"):
        read_surface(tmp_path / "c.npz")
    np.savez(tmp_path / "s.npz", degree=2, knots_u=np.array([0, 0, 0, 1, 1, 1.0]), control_points=np.zeros((3, 3, 3)))
    with pytest.raises(ArtifactError, match="needs 'knots_v'"):
        read_spline(tmp_path / "s.npz")


def test_planar_landmarks(tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("id,landmark,x,y\nm1,L1,1.5,2\nm1,L2,3,4\nm2,L1,5,6\n")
    table = read_landmarks(tmp_path / "l.csv")
    assert table["m1"]["L1"].tolist() == [1.5, 2.0]
    assert sorted(table) == ["m1", "m2"]
