"""Rendered photographs of hands, with the exact outline of every one, landmarks, and a dense truth.

The hands of ``synth hand``, each with a forearm that leaves the picture at the bottom, laid on a plain cloth or table of its own
colour: skin tone, scale, pose, uneven light, a soft shadow, blur, noise and JPEG compression differ from picture to picture.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.outline.outline import Outline, resample
from ssmpipe.synth._cohort import arc_parameters, shape_ids, write_truth
from ssmpipe.synth.hand import LANDMARKS, MODES, plan_indices, random_hand

WIDTH, HEIGHT = 600, 800
MARKS = ("thumb wrist", *LANDMARKS, "little wrist")
"""Landmarks along the outline: the two of the wrist, and between them those of ``synth hand``."""

_SKIN = np.array([[0.87, 0.67, 0.57], [0.78, 0.55, 0.44], [0.66, 0.45, 0.34], [0.50, 0.33, 0.25], [0.36, 0.23, 0.17]])
_CLOTH = np.array([[0.88, 0.89, 0.88], [0.30, 0.40, 0.58], [0.20, 0.42, 0.32], [0.10, 0.10, 0.12], [0.62, 0.64, 0.66]])
_PX_PER_MM = 3.1
_ARM_MM, _ARM_HALF_MM = 180.0, 40.0
_QUALITY = 85


def render(
    outline: Floats, skin: Floats, cloth: Floats, rng: np.random.Generator, *, size: tuple[int, int] = (HEIGHT, WIDTH)
) -> Floats:
    """Return the photograph of the region inside a closed polyline, (height, width, 3) in 0 to 1.

    Parameters
    ----------
    outline : (n, 2) float64
        x to the right, y down [pixels]; the centre of the first pixel is the origin.
    skin, cloth : (3,)
        Colours, red, green, blue from 0 to 1.
    rng : numpy.random.Generator
    size : (int, int)
        Height and width [pixels].
    """
    dense = resample(Outline(outline, True), int(4 * Outline(outline, True).length)).points
    inside = _inside(dense, size)
    rows, columns = np.mgrid[: size[0], : size[1]].astype(float)
    near = distance_transform_edt(inside) + distance_transform_edt(~inside) < 4
    coverage = inside.astype(float)
    gap = cKDTree(dense).query(np.column_stack([columns[near], rows[near]]))[0]
    coverage[near] = np.clip(0.5 + np.where(inside[near], gap, -gap), 0.0, 1.0)
    depth = distance_transform_edt(np.pad(inside, ((0, 1), (0, 0)), mode="edge"))[:-1]
    relief = 0.72 + 0.28 * (1.0 - np.exp(-depth / 14.0))
    texture = 1.0 + 0.25 * gaussian_filter(rng.normal(size=size), 6.0, truncate=3)
    hand = skin * (relief * texture)[..., None]
    shift = rng.uniform(4, 14, size=2) * rng.choice([-1.0, 1.0], size=2)
    shade = gaussian_filter(coverage, rng.uniform(5, 14))
    shade = shade[
        np.clip(rows - shift[1], 0, size[0] - 1).astype(int), np.clip(columns - shift[0], 0, size[1] - 1).astype(int)
    ]
    light = _light(rng, rows / size[0] - 0.5, columns / size[1] - 0.5)
    table = cloth * (1.0 - rng.uniform(0.1, 0.4) * shade)[..., None]
    picture = (coverage[..., None] * hand + (1.0 - coverage[..., None]) * table) * light[..., None]
    picture = gaussian_filter(picture, (0.8, 0.8, 0.0)) + 0.015 * rng.normal(size=(*size, 3))
    return np.asarray(np.clip(picture, 0.0, 1.0))


def _light(rng: np.random.Generator, y: Floats, x: Floats) -> Floats:
    """Uneven light: a slope and a bulge of up to 15 % each."""
    slope, bulge = rng.uniform(-0.15, 0.15, size=2), rng.uniform(-0.15, 0.15)
    return np.asarray(1.0 + slope[0] * x + slope[1] * y + bulge * (x**2 + y**2))


def _inside(ring: Floats, size: tuple[int, int]) -> Bools:
    """Whether a pixel's centre lies inside a closed polyline of steps below one pixel: parity of crossings to its left."""
    x, y = ring.T
    after = np.roll(np.arange(len(ring)), -1)
    row = np.floor(np.maximum(y, y[after]))
    crosses = (row > np.minimum(y, y[after])) & (row >= 0) & (row < size[0])
    share = (row - y)[crosses] / (y[after] - y)[crosses]
    at = np.ceil(x[crosses] + share * (x[after] - x)[crosses])
    count = np.zeros((size[0], size[1] + 1), dtype=np.int64)
    np.add.at(count, (row[crosses].astype(int), np.clip(at, 0, size[1]).astype(int)), 1)
    return np.asarray(np.cumsum(count, axis=1)[:, :-1] % 2 == 1)


def _place(hand: Floats, rng: np.random.Generator) -> Floats:
    """Return the (2, 3) map from the plan [mm, y up] to a picture [pixels, y down] that shows the whole hand and its wrist."""
    angle = np.radians(rng.uniform(-9, 9))
    scale = _PX_PER_MM * rng.uniform(0.9, 1.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])
    shown = hand @ turn.T
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 12.0
    scale = min(scale, (WIDTH - 2 * margin) / (high[0] - low[0]), (HEIGHT - 4 * margin) / (high[1] - low[1]))
    room = np.array([WIDTH, HEIGHT]) - margin - scale * (high - low) - [margin, 3 * margin]
    corner = margin + room * rng.uniform(0, 1, size=2) * [1.0, 0.6]
    return np.column_stack([scale * turn, corner - scale * low])


def with_arm(hand: Floats) -> Floats:
    """Return the closed outline of a hand and a forearm that widens away from the wrist, (n, 2) [mm]; first points: the hand's.

    The arm leaves the wrist in the mean direction of the hand's ends; its end is far outside the picture.
    """
    first, last = hand[0], hand[-1]
    down = (hand[0] - hand[25]) + (hand[-1] - hand[-26])
    down /= np.linalg.norm(down)
    across = np.array([-down[1], down[0]])
    half = 0.5 * abs(float((last - first) @ across))
    t = np.linspace(0.0, 1.0, 200)[1:, None]
    middle = 0.5 * (first + last)
    width = half + (_ARM_HALF_MM - half) * (3 * t**2 - 2 * t**3)
    centre = middle + _ARM_MM * t * down
    sides = [centre + sign * width * across for sign in (1.0, -1.0)]
    if np.linalg.norm(sides[0][0] - last) > np.linalg.norm(sides[1][0] - last):
        sides.reverse()
    return np.concatenate([hand, sides[0], sides[1][::-1]])


def visible(ring: Floats, n_hand: int) -> Floats:
    """Return the part of a hand's outline with arm, in pixels, that lies above the lower edge of the picture.

    Parameters
    ----------
    ring : (n, 2) float64
        From :func:`with_arm`.
    n_hand : int
        Points of the hand, which are all visible.
    """
    bottom = HEIGHT - 1.0
    after, before = ring[n_hand - 1 :], np.concatenate([ring[n_hand:], ring[:1]])[::-1]
    ends = []
    for side in (before, after):
        k = int(np.argmax(side[:, 1] > bottom))
        share = (bottom - side[k - 1, 1]) / (side[k, 1] - side[k - 1, 1])
        ends.append(np.concatenate([side[1:k], (side[k - 1] + share * (side[k] - side[k - 1]))[None]]))
    return np.concatenate([ends[0][::-1], ring[:n_hand], ends[1]])


def _leaves_below(ring: Floats, n_hand: int) -> bool:
    """Whether the arm leaves the picture through its lower edge, away from the corners."""
    ends = visible(ring, n_hand)[[0, -1], 0]
    return bool(ends.min() > 10 and ends.max() < WIDTH - 11)


def write_cohort(out_dir: Path, n: int = 40, seed: int = 0) -> None:
    """Write the photographs and the truth about them; the same seed gives the same bytes.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.jpg``, ``outlines/<id>.csv`` (the exact outline, open, from edge to edge of the picture),
        ``landmarks.csv`` and ``truth.npz``: ``points`` (n, n_T, 2), the same places of the plan on every hand [pixels],
        ``landmarks`` (n, 13, 2), ``scores`` (n, 3), ``px_per_mm`` (n,).
    n : int, default=40
    seed : int
    """
    from PIL import Image  # slow to import: only when needed

    out_dir = Path(out_dir)
    for name in ("scans", "outlines"):
        (out_dir / name).mkdir(parents=True, exist_ok=True)
    marks = np.array([0, *plan_indices(), -1])
    points, scores, scales = [], [], []
    for i, shape_id in enumerate(shape_ids("hand", n)):
        rng = np.random.default_rng([seed, i])
        hand, score = random_hand(rng)
        place = _place(hand, rng)
        ring = with_arm(hand) @ place[:, :2].T + place[:, 2]
        while not _leaves_below(ring, len(hand)):
            place = _place(hand, rng)
            ring = with_arm(hand) @ place[:, :2].T + place[:, 2]
        skin = _SKIN[rng.integers(len(_SKIN))] * rng.uniform(0.95, 1.05, size=3)
        cloths = _CLOTH[np.linalg.norm(_CLOTH - skin, axis=1) > 0.25]
        cloth = cloths[rng.integers(len(cloths))] * rng.uniform(0.95, 1.05, size=3)
        pixels = np.round(255 * render(ring, skin, cloth, rng)).astype(np.uint8)
        Image.fromarray(pixels).save(out_dir / "scans" / f"{shape_id}.jpg", quality=_QUALITY)
        rows = ["x,y", *(f"{x!r},{y!r}" for x, y in visible(ring, len(hand)).tolist())]
        text = "\n".join(rows) + "\n"
        (out_dir / "outlines" / f"{shape_id}.csv").write_text(text, encoding="utf-8", newline="\n")
        points.append(ring[: len(hand)])
        scores.append(score)
        scales.append(float(np.sqrt(-np.linalg.det(place[:, :2]))))
    every = np.stack(points)
    write_truth(
        out_dir,
        shape_ids("hand", n),
        MARKS,
        every[:, marks],
        {
            "points": every,
            "parameters": np.stack([arc_parameters(p) for p in every]),
            "scores": np.stack(scores),
            "mode_names": np.array(list(MODES)),
            "px_per_mm": np.array(scales),
        },
        {
            "source": "drawn and rendered by ssmpipe; after Li 2015, section 2.3.4, which has photographs",
            "seed": seed,
            "units": "pixels, x right, y down, origin in the centre of the first pixel",
            "size": [WIDTH, HEIGHT],
            "modes": MODES,
        },
    )
