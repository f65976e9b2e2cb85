"""Numbers that say how far out a patient lies, the same for whole scans and for fragments."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats


def rank(value: float, training: Floats) -> float:
    """Return the share of shapes, this one among them, that are at least as far out: small for an unusual shape."""
    return float((1 + np.count_nonzero(training >= value)) / (len(training) + 1))


def summary(name: str, signed: Floats) -> dict[str, float]:
    """Return mean, median, 95th percentile and largest size of signed distances, by name; NaN where there is none."""
    if not len(signed):
        return {f"{name}_{what}_mm": float("nan") for what in ("mean", "median", "p95", "max")}
    size = np.abs(signed)
    return {
        f"{name}_mean_mm": float(size.mean()),
        f"{name}_median_mm": float(np.median(size)),
        f"{name}_p95_mm": float(np.percentile(size, 95)),
        f"{name}_max_mm": float(size.max()),
    }


def rms(offsets: Floats) -> float:
    """Return the root mean square length of offsets, (..., d).

    Examples
    --------
    >>> rms(np.array([[3.0, 4.0], [0.0, 5.0]]))
    5.0
    """
    return float(np.sqrt((offsets**2).sum(axis=-1).mean()))
