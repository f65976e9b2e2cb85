"""Hand-like outlines (after Li 2015, section 2.3.4) with landmarks at the tips and valleys and a dense truth.

An open curve from the thumb side of the wrist over five fingers to the other side. Every hand is drawn from the same plan:
the place "halfway up the left side of the ring finger" is the same on all, so the true correspondence is known everywhere
between features. Spread of the fingers, their common length and the width vary together (three modes); each finger's
length and angle, the thumb and a smooth displacement vary on their own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.fit_curve import fit_curve
from ssmpipe.synth._cohort import arc_parameters, shape_ids, write_splines

FINGERS = ("thumb", "index", "middle", "ring", "little")
LANDMARKS = ("thumb root",) + tuple(
    name for k, finger in enumerate(FINGERS) for name in ((f"{finger} tip", f"valley {k + 1}") if k < 4 else (f"{finger} tip",))
) + ("little root",)  # fmt: skip
"""Along the curve: where the thumb begins, five tips with four valleys between them, where the little finger ends."""

MODES = {
    "spread": "angle between neighbouring fingers, 3 degrees per unit",
    "length": "length of all fingers, 7 % per unit",
    "width": "width of palm and fingers, 5 % per unit",
}
N_CONTROL = 150
_BASES = np.array([[-40.0, 6.0], [-25.0, 52.0], [-4.0, 57.0], [17.0, 53.0], [35.0, 42.0]])
_ANGLES = np.array([-46.0, -9.0, -1.0, 6.0, 16.0])  # degrees from straight up, towards the little finger
_LENGTHS = np.array([54.0, 68.0, 76.0, 70.0, 54.0])
_WIDTHS = np.array([20.0, 17.0, 17.0, 16.0, 14.0])
_WRIST = np.array([[-28.0, -55.0], [30.0, -55.0]])
_SIDE, _TIP, _WEB, _PALM = 60, 30, 14, 90  # points per piece of the plan
_SMOOTH = 6.0  # of the plan, in points


def plan_indices() -> tuple[int, ...]:
    """Return where the landmarks lie in the plan: indices of its points, in the order of ``LANDMARKS``."""
    finger = 2 * _SIDE + 2 * _TIP
    starts = _PALM + np.arange(5) * (finger + 2 * _WEB)
    tips, ends = starts + _SIDE + _TIP, starts + finger
    found = [int(starts[0])]
    for k in range(5):
        found.append(int(tips[k]))
        found.append(int(ends[k] + _WEB) if k < 4 else int(ends[k]))
    return tuple(found)


def draw(scores: Floats, lengths: Floats, angles: Floats, widths: Floats, own: Floats) -> Floats:
    """Return the points of the plan on one hand, (n_T, 2) [mm].

    Parameters
    ----------
    scores : (3,)
        Of the modes.
    lengths, angles, widths : (5,)
        Own factors, own turns [degrees], own factors of the fingers.
    own : (4, 2)
        Coefficients of the smooth displacement [mm].
    """
    width = 1.0 + 0.05 * scores[2]
    theta = np.radians(_ANGLES + 3.0 * scores[0] * (np.arange(5) - 2.0) + angles)
    up = np.column_stack([np.sin(theta), np.cos(theta)])
    side = np.column_stack([np.cos(theta), -np.sin(theta)])
    base = _BASES * [width, 1.0]
    half = 0.5 * _WIDTHS * width * widths
    reach = _LENGTHS * lengths * (1.0 + 0.07 * scores[1])
    wrist = _WRIST * [width, 1.0]
    left, right = base - side * half[:, None], base + side * half[:, None]
    pieces = [_line(wrist[0], left[0], _PALM)]
    phi = np.linspace(np.pi, 0.0, 2 * _TIP, endpoint=False)
    for k in range(5):
        round_ = 0.85 * half[k]
        centre = base[k] + up[k] * (reach[k] - round_)
        pieces.append(_line(left[k], centre - side[k] * round_, _SIDE))
        pieces.append(centre + round_ * (np.cos(phi)[:, None] * side[k] + np.sin(phi)[:, None] * up[k]))
        pieces.append(_line(centre + side[k] * round_, right[k], _SIDE))
        if k < 4:
            valley = 0.5 * (right[k] + left[k + 1]) - 3.0 * (up[k] + up[k + 1])
            pieces += [_line(right[k], valley, _WEB), _line(valley, left[k + 1], _WEB)]
    pieces += [_line(right[4], wrist[1], _PALM), wrist[1:]]
    points = gaussian_filter1d(np.concatenate(pieces), _SMOOTH, axis=0, mode="nearest")
    waves = np.sin(np.outer(np.linspace(0.0, 1.0, len(points)), np.pi * np.arange(2, 6)))
    return np.asarray(points + waves @ own)


def random_hand(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the plan's points on a hand of random shape, (n_T, 2) [mm], and the scores of its modes, (3,)."""
    score = np.clip(rng.normal(size=3), -2.5, 2.5)
    hand = draw(
        score,
        1.0 + 0.03 * rng.normal(size=5),
        rng.normal(size=5) * [5.0, 1.5, 1.5, 1.5, 2.5],
        1.0 + 0.03 * rng.normal(size=5),
        0.8 * rng.normal(size=(4, 2)),
    )
    return hand, score


def _line(start: Floats, end: Floats, n: int) -> Floats:
    return np.asarray(start + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (end - start))


def write_cohort(out_dir: Path, n: int = 40, seed: int = 0) -> None:
    """Write the hands and the truth about them; the same seed gives the same bytes.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.npz`` (quadratic, parameter = share of the arc length), ``landmarks.csv`` and ``truth.npz``:
        ``points`` (n, n_T, 2), the same places of the plan on every hand, ``parameters`` (n, n_T), where they lie on its curve,
        ``features`` (n, 11), the parameters of the landmarks, and ``scores`` (n, 3).
    n : int, default=40
    seed : int
    """
    marks = np.array(plan_indices())
    curves, points, parameters, scores = [], [], [], []
    for i in range(n):
        rng = np.random.default_rng([seed, i])
        hand, score = random_hand(rng)
        u = arc_parameters(hand)
        curves.append(fit_curve(hand, degree=2, n_control=N_CONTROL, parameters=u))
        points.append(hand)
        parameters.append(u)
        scores.append(score)
    write_splines(
        Path(out_dir),
        shape_ids("hand", n),
        curves,
        LANDMARKS,
        np.stack(points)[:, marks],
        {
            "points": np.stack(points),
            "parameters": np.stack(parameters),
            "features": np.stack(parameters)[:, marks],
            "scores": np.stack(scores),
            "mode_names": np.array(list(MODES)),
        },
        {
            "source": "after Li 2015, section 2.3.4; photographs are replaced by drawings of our own",
            "seed": seed,
            "units": "mm",
            "modes": MODES,
            "own": {"length": "3 %", "width": "3 %", "angle_deg": [5, 1.5, 1.5, 1.5, 2.5], "displacement_mm": 0.8},
            "ours": {"degree": 2, "n_control": N_CONTROL},
        },
    )
