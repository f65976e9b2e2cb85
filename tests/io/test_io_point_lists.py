"""Numbered points: ``.pts`` and ``.asf``, as outlines and as landmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.outlines import read_outline
from ssmpipe.io.point_lists import read_asf, read_pts

POINTS = np.array([[0.25, 0.5], [0.5, 0.125], [0.75, 0.5], [0.5, 0.75]])


def asf(points: np.ndarray, kind: int = 4, path: int = 0, host: str = "hand.jpg", count: int | None = None) -> str:
    rows = [f"{path} \t{kind} \t{x} \t{y} \t{k} \t{k - 1} \t{k + 1}" for k, (x, y) in enumerate(points)]
    head = ["#" * 30, "#", "#    AAM Shape File  -  written: today", "#", "", "# number of model points", "#"]
    return "\n".join([*head, str(len(points) if count is None else count), "", "# model points", *rows, "", host, ""])


def test_asf_points_are_pixels_of_the_picture_beside_it(tmp_path: Path) -> None:
    Image.new("L", (80, 60)).save(tmp_path / "hand.jpg")
    for name, host in (("a.asf", "hand.jpg"), ("b.ASF", "C:\\pictures\\HAND.JPG"), ("hand.asf", "lost.bmp")):
        (tmp_path / name).write_text(asf(POINTS, host=host))
        remarks: list[str] = []
        outline = read_outline(tmp_path / name, remarks)
        np.testing.assert_allclose(outline.points, POINTS * [80, 60])
        assert not outline.closed
        assert not remarks
    (tmp_path / "closed.asf").write_text(asf(POINTS, kind=0))
    assert read_outline(tmp_path / "closed.asf").closed


def test_asf_without_its_picture_says_that_shapes_are_stretched(tmp_path: Path) -> None:
    (tmp_path / "a.asf").write_text(asf(POINTS))
    remarks: list[str] = []
    found = read_asf(tmp_path / "a.asf", remarks)
    assert not found.scaled
    np.testing.assert_array_equal(found.points, POINTS)
    assert "'hand.jpg' is not beside a.asf" in remarks[0]


def test_pts_with_and_without_a_head(tmp_path: Path) -> None:
    rows = "\n".join(f"{x} {y}" for x, y in POINTS)
    (tmp_path / "a.pts").write_text(f"version: 1\nn_points:  4\n{{\n{rows}\n}}\n")
    (tmp_path / "b.pts").write_text(f"# from a program\n{rows}\n\n")
    for name in ("a.pts", "b.pts"):
        np.testing.assert_array_equal(read_pts(tmp_path / name), POINTS)


def test_numbered_points_are_landmarks(tmp_path: Path) -> None:
    Image.new("L", (80, 60)).save(tmp_path / "hand.jpg")
    (tmp_path / "a.asf").write_text(asf(POINTS))
    (tmp_path / "b.pts").write_text("1 2\n3 4\n")
    table = read_landmarks(tmp_path)
    assert sorted(table) == ["a", "b"]
    assert list(table["a"]) == ["point_01", "point_02", "point_03", "point_04"]
    np.testing.assert_allclose(table["a"]["point_02"], [40, 7.5])
    assert table["b"]["point_02"].tolist() == [3, 4]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.asf", "", "does not begin with a number"),
        ("a.asf", "four\n", "does not begin with a number"),
        ("a.asf", asf(POINTS, count=9), "9 points of 7 numbers each are promised"),
        ("a.asf", asf(POINTS, count=10**9), "promised, not all are there"),
        ("a.asf", asf(POINTS).replace("0.125", "high"), "line 12: 'high' is not a number"),
        ("a.asf", asf(POINTS).replace("0.125", "inf"), "line 12: the coordinate is not finite"),
        ("a.asf", asf(POINTS).replace("0 \t4 \t0.75", "1 \t4 \t0.75"), r"2 paths \(3, 1 points\)"),
        ("a.asf", asf(POINTS[:1]), "has 1 points, an outline needs at least 3"),
        ("a.asf", "0\n", "has 0 points"),
        ("a.pts", "version: 1\nn_points: 5\n{\n1 2\n3 4\n5 7\n}\n", "promises 5 points and has 3"),
        ("a.pts", "version: 1\nn_points: 3\n{\n1 2\n3 4\n5 7\n", "closing brace is missing"),
        ("a.pts", "", "has 0 points"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ArtifactError, match=message):
        read_outline(tmp_path / name)
