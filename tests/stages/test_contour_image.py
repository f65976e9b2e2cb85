"""The stage ``contour`` on pictures, and what it does with ends whatever the outline comes from."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.errors import GeometryError, LandmarkError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.outline.picture import Picture
from ssmpipe.stages import _contour_image, contour

SIZE = (150, 120)


def go(module: Any, **inputs: Any) -> tuple[dict[str, Any], Context]:
    options = inputs.pop("options", {})
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    return module.run(**inputs, cfg=module.Config(**options), ctx=ctx), ctx


def spoon(arm: int = SIZE[0], *more: tuple[int, int, int]) -> Picture:
    """A skin-coloured disk on an arm that reaches down to row ``arm``, and other disks (x, y, radius)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    inside = (np.hypot(x - 60, y - 55) < 35) | ((np.abs(x - 60) < 20) & (y > 55) & (y < arm))
    for cx, cy, radius in more:
        inside |= np.hypot(x - cx, y - cy) < radius
    cover = gaussian_filter(inside.astype(float), 0.8)[..., None]
    colors = cover * [0.75, 0.55, 0.45] + (1 - cover) * [0.3, 0.4, 0.6]
    return Picture(np.clip(colors + 0.01 * np.random.default_rng(0).normal(size=colors.shape), 0, 1))


def test_options_are_described() -> None:
    for name, field in _contour_image.Config.model_fields.items():
        assert field.description, name
        assert field.description.endswith("."), name
    assert contour.STAGE.suiting({"image"}) is _contour_image.IMAGE
    assert contour.STAGE.suiting({"contour"}) is contour.STAGE


def test_a_shape_within_the_picture_is_closed_and_one_that_leaves_it_is_open() -> None:
    made, ctx = go(_contour_image, image=spoon(120))
    assert made["contour"].closed
    assert ctx.metrics["method"] == "skin"
    assert made["contour"].signed_area == pytest.approx(ctx.metrics["area_mm2"])
    assert not ctx.warnings
    line = go(_contour_image, image=spoon())[0]["contour"]
    assert not line.closed
    assert line.points[[0, -1], 1].tolist() == [SIZE[0] - 1, SIZE[0] - 1]
    assert line.signed_area > 0
    ring = go(_contour_image, image=spoon(), options={"closed": True})[0]["contour"]
    assert ring.closed
    assert ring.points[:, 1].max() > SIZE[0] - 1
    apart = go(_contour_image, image=spoon(120), options={"closed": False})[0]["contour"]
    assert np.array_equal(apart.points[0], apart.points[-1])


def test_start_and_end_open_and_direct_the_outline() -> None:
    marks = Landmarks({"a": np.array([79.0, 110.0]), "b": np.array([41.0, 110.0])}, {"start": "a", "end": "b"})
    for picture in (spoon(), spoon(130)):
        for start, end in (("a", "b"), ("b", "a")):
            named = Landmarks(marks.points, {"start": start, "end": end})
            made, ctx = go(_contour_image, image=picture, landmarks=named)
            assert ctx.metrics["ends_from"] == "landmarks"
            for place, name in ((0, start), (-1, end)):
                assert np.linalg.norm(made["contour"].points[place] - marks.points[name]) < 1.5
            assert made["contour"].points[:, 1].min() < 21
    table = Outline(go(_contour_image, image=spoon(130))[0]["contour"].points, True)
    made, _ = go(contour, contour=table, landmarks=marks)
    assert not made["contour"].closed
    assert np.linalg.norm(made["contour"].points[0] - marks.points["a"]) < 1.5
    assert go(contour, contour=table, landmarks=marks, options={"closed": True})[0]["contour"].closed


def test_the_stem_is_cut_at_the_same_place_wherever_the_picture_ends() -> None:
    ends = []
    for arm in (130, 140, SIZE[0]):
        made, ctx = go(_contour_image, image=spoon(arm), options={"ends": "stem", "stem_radii": 1.6})
        assert ctx.metrics["ends_from"] == "stem"
        assert not made["contour"].closed
        ends.append(made["contour"].points[[0, -1]])
    np.testing.assert_allclose(ends, np.broadcast_to(ends[-1], (3, 2, 2)), atol=0.5)
    assert ends[0][:, 1] == pytest.approx(55 + np.sqrt((1.6 * 35) ** 2 - 20**2), abs=2)
    made, ctx = go(_contour_image, image=spoon(), options={"ends": "stem", "stem_radii": 3.5})
    assert made["contour"].points[0, 1] == SIZE[0] - 1
    assert "keeps its ends" in ctx.warnings[0]


def test_oddities_are_named() -> None:
    _, ctx = go(_contour_image, image=spoon(96, (92, 124, 24)))
    assert any("another object has" in text for text in ctx.warnings)
    _, ctx = go(_contour_image, image=spoon(SIZE[0], (60, 18, 20)))
    assert any("leaves the picture at 2 places" in text for text in ctx.warnings)
    blank = Picture(np.full((*SIZE, 3), 0.5))
    with pytest.raises(GeometryError, match=r"no skin|nothing stands out|standard deviations|fills"):
        go(_contour_image, image=blank)


def test_landmarks_of_another_picture_are_refused() -> None:
    right = {"top": np.array([60.0, 20.0]), "left": np.array([25.0, 55.0]), "right": np.array([95.0, 55.0])}
    assert not go(_contour_image, image=spoon(), landmarks=Landmarks(right))[1].warnings
    shifted = Landmarks({name: p + [0, 20] if name == "top" else p for name, p in right.items()})
    assert "1 of 3 landmarks" in go(_contour_image, image=spoon(), landmarks=shifted)[1].warnings[0]
    with pytest.raises(LandmarkError, match=r"'top' is .* pixels away"):
        go(_contour_image, image=spoon(), landmarks=Landmarks(shifted.points, {"start": "top"}))
    with pytest.raises(LandmarkError, match="all 3 landmarks"):
        go(_contour_image, image=spoon(), landmarks=Landmarks({n: 0.3 * p for n, p in right.items()}))
