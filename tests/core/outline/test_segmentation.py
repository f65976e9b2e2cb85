"""Outlines found in rendered pictures: the error in pixels, what is told apart, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.outline.picture import Picture
from ssmpipe.core.outline.segmentation import find_outline

SIZE = (160, 200)
SKIN, BLUE, WHITE = np.array([0.75, 0.55, 0.45]), np.array([0.3, 0.4, 0.6]), np.array([0.9, 0.9, 0.88])
CENTER, AXES = np.array([95.3, 82.6]), np.array([52.0, 40.0])


def ellipse(center: np.ndarray = CENTER, axes: np.ndarray = AXES, n: int = 800) -> Outline:
    t = 2 * np.pi * np.arange(n) / n
    return Outline(center + axes * np.column_stack([np.cos(t), np.sin(t)]), True)


def coverage(center: np.ndarray = CENTER, axes: np.ndarray = AXES, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Share of every pixel inside the ellipse, by 8 x 8 samples."""
    y, x = ((np.arange(8 * n) + 0.5) / 8 - 0.5 for n in size)
    fine = ((x[None] - center[0]) / axes[0]) ** 2 + ((y[:, None] - center[1]) / axes[1]) ** 2 < 1
    return fine.reshape(size[0], 8, size[1], 8).mean(axis=(1, 3))


def photograph(
    cover: np.ndarray,
    front: np.ndarray,
    ground: np.ndarray,
    *,
    noise: float = 0.02,
    shadow: float = 0.0,
    slope: float = 0.0,
) -> Picture:
    rng = np.random.default_rng(3)
    shade = np.roll(gaussian_filter(cover, 6.0), (7, 9), axis=(0, 1))
    light = 1 + slope * np.linspace(-1, 1, cover.shape[1])[None, :, None]
    back = ground * (1 - shadow * shade)[..., None]
    colors = (cover[..., None] * front + (1 - cover[..., None]) * back) * light
    colors = gaussian_filter(colors, (0.8, 0.8, 0)) + noise * rng.normal(size=colors.shape)
    return Picture(np.clip(colors, 0, 1))


def errors(found: Outline, truth: Outline) -> np.ndarray:
    return np.concatenate(
        [
            point_to_segments(found.points, truth.points, truth.edges)[0],
            point_to_segments(truth.points, found.points, found.edges)[0],
        ]
    )


@pytest.mark.parametrize(
    ("front", "ground", "method", "options"),
    [
        (SKIN, BLUE, "skin", {}),
        (SKIN, WHITE, "skin", {"shadow": 0.4, "slope": 0.15}),
        (0.5 * SKIN, 0.2 * WHITE, "skin", {"slope": 0.2}),
        (BLUE, WHITE, "silhouette", {"shadow": 0.3}),
        (0.2 * WHITE, WHITE, "silhouette", {"slope": 0.15}),
        (WHITE, 0.1 * WHITE, "silhouette", {}),
    ],
)
def test_the_outline_is_right_to_a_part_of_a_pixel(
    front: np.ndarray, ground: np.ndarray, method: str, options: dict
) -> None:
    found = find_outline(photograph(coverage(), front, ground, **options), "auto" if method == "skin" else method)
    assert found.method == method
    assert found.outline.signed_area > 0
    assert found.n_leaves == 0
    gaps = errors(found.outline, ellipse())
    assert np.sqrt((gaps**2).mean()) < 0.2
    assert gaps.max() < 0.8


def test_gray_pictures_are_silhouettes() -> None:
    gray = photograph(coverage(), WHITE, 0.3 * WHITE).colors[..., :1]
    assert find_outline(Picture(gray)).method == "silhouette"
    with pytest.raises(GeometryError, match="skin is told by its colour"):
        find_outline(Picture(gray), "skin")


@pytest.mark.parametrize("kind", ["white", "black", "soft", "transparent"])
def test_masks(kind: str) -> None:
    hard = (coverage() > 0.5).astype(float)
    values = {"white": hard, "black": 1 - hard, "soft": coverage(), "transparent": np.ones(SIZE)}[kind]
    picture = Picture(values[..., None], hard > 0 if kind == "transparent" else None)
    found = find_outline(picture)
    assert found.method == "mask"
    assert np.sqrt((errors(found.outline, ellipse()) ** 2).mean()) < 0.15
    with pytest.raises(GeometryError, match="it is no mask"):
        find_outline(photograph(coverage(), SKIN, BLUE), "mask")


def test_holes_are_filled_and_smaller_objects_left_out() -> None:
    cover = coverage() - coverage(axes=np.array([9.0, 9.0])) + coverage(np.array([20.0, 20.0]), np.array([12.0, 12.0]))
    found = find_outline(photograph(cover, SKIN, BLUE))
    assert np.sqrt((errors(found.outline, ellipse()) ** 2).mean()) < 0.2
    assert 0.05 < found.other_share < 0.12


def test_what_leaves_the_picture_is_open_and_its_ends_lie_on_the_edge() -> None:
    center = np.array([95.0, 150.0])
    found = find_outline(photograph(coverage(center), SKIN, BLUE))
    assert found.n_leaves == 1
    line = found.opened
    assert not line.closed
    np.testing.assert_allclose(line.points[[0, -1], 1], SIZE[0] - 1, atol=1e-9)
    assert line.signed_area > 0
    gaps = point_to_segments(line.points, ellipse(center).points, ellipse(center).edges)[0]
    assert gaps.max() < 0.8
    corner = find_outline(photograph(coverage(np.array([95.0, 80.0]), np.array([150.0, 30.0])), SKIN, BLUE))
    assert corner.n_leaves == 2


def test_large_pictures_are_averaged_and_coordinates_stay() -> None:
    picture = photograph(coverage(), SKIN, BLUE)
    whole, small = find_outline(picture), find_outline(picture, longest_side=100)
    assert len(small.outline.points) < 0.6 * len(whole.outline.points)
    assert np.sqrt((errors(small.outline, ellipse()) ** 2).mean()) < 0.4


@pytest.mark.parametrize("method", ["auto", "silhouette"])
def test_what_does_not_stand_out_is_refused(method: str) -> None:
    noise = Picture(np.clip(0.5 + 0.1 * np.random.default_rng(0).normal(size=(*SIZE, 3)), 0, 1))
    slope = Picture(np.broadcast_to(np.linspace(0.2, 0.8, SIZE[1])[None, :, None], (*SIZE, 3)))
    faint = photograph(coverage(), SKIN, SKIN * 0.97, noise=0.06)
    plain = Picture(np.full((*SIZE, 3), 0.4))
    for picture in (noise, slope, faint, plain):
        with pytest.raises(GeometryError) as caught:
            find_outline(picture, method)  # type: ignore[arg-type]
        assert caught.value.remedy
    with pytest.raises(GeometryError, match="12 x 9 pixels"):
        find_outline(Picture(np.zeros((9, 12, 3))))
