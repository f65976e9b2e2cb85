"""Rendered photographs: the same bytes again, and the truth about them is found in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.ends import cut_stem
from ssmpipe.core.outline.segmentation import find_outline
from ssmpipe.io.images import read_image
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.outlines import read_outline
from ssmpipe.synth import hand_photographs
from ssmpipe.synth.hand import random_hand


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("hands")
    hand_photographs.write_cohort(out, n=6)
    return out


def test_files_repeat(tmp_path: Path, folder: Path) -> None:
    hand_photographs.write_cohort(tmp_path, n=2)
    names = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*.*") if p.name.startswith("hand_"))
    assert len(names) == 4
    assert all((tmp_path / name).read_bytes() == (folder / name).read_bytes() for name in names)


def test_landmarks_and_places_lie_on_the_exact_outline(folder: Path) -> None:
    table = read_landmarks(folder / "landmarks.csv")
    with np.load(folder / "truth.npz") as data:
        truth = {name: data[name] for name in data.files}
    assert len(hand_photographs.MARKS) == 13
    for i, shape in enumerate(truth["ids"]):
        outline = read_outline(folder / "outlines" / f"{shape}.csv")
        assert not outline.closed
        np.testing.assert_allclose(outline.points[[0, -1], 1], hand_photographs.HEIGHT - 1)
        assert outline.points[:, 0].min() > 8
        assert outline.points[:, 0].max() < hand_photographs.WIDTH - 9
        for places in (np.array(list(table[shape].values())), truth["points"][i]):
            assert point_to_segments(places, outline.points, outline.edges)[0].max() < 1e-6
        assert truth["landmarks"][i][0, 1] < hand_photographs.HEIGHT - 20, "the wrist is seen"


def test_the_outline_is_found_to_a_fifth_of_a_pixel(folder: Path) -> None:
    squares, worst = [], []
    for path in sorted((folder / "scans").iterdir()):
        truth = read_outline(folder / "outlines" / f"{path.stem}.csv")
        found = find_outline(read_image(path))
        assert (found.n_leaves, found.method) == (1, "skin")
        gaps = np.concatenate(
            [
                point_to_segments(found.opened.points, truth.points, truth.edges)[0],
                point_to_segments(truth.points, found.opened.points, found.opened.edges)[0],
            ]
        )
        squares.append((gaps**2).mean())
        worst.append(gaps.max())
    assert np.sqrt(np.mean(squares)) < 0.25
    assert max(worst) < 3.0, "in the valleys between fingers"


def test_the_cut_at_the_wrist_is_consistent(folder: Path) -> None:
    with np.load(folder / "truth.npz") as data:
        wrists, scale = data["landmarks"][:, [0, -1]], data["px_per_mm"]
    gaps = []
    for k, path in enumerate(sorted((folder / "outlines").iterdir())):
        part = cut_stem(read_outline(path))
        gaps.append(np.linalg.norm(part.points[[0, -1]] - wrists[k], axis=1) / scale[k])
    assert np.max(gaps) < 16
    assert np.ptp(gaps, axis=0).max() < 12


def test_the_arm_leaves_the_wrist_without_a_step() -> None:
    hand, _ = random_hand(np.random.default_rng(0))
    ring = hand_photographs.with_arm(hand)
    assert np.array_equal(ring[: len(hand)], hand)
    steps = np.linalg.norm(np.diff(ring[len(hand) - 2 : len(hand) + 50], axis=0), axis=1)
    assert steps.max() < 3.0
