"""The model as the viewer reads it: 16-bit points, about a tenth of the size of decimal text."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.model.shape_model import ShapeModel

BUDGET = 6_000_000  # bytes of quantized modes; beyond it the last modes are left out of the viewer (not of the model)


def in_space(points: Floats) -> Floats:
    """Return (..., 3) points: planar ones are put into the plane z = 0.

    Examples
    --------
    >>> in_space(np.ones((2, 2)))
    array([[1., 1., 0.],
           [1., 1., 0.]])
    """
    pad = 3 - points.shape[-1]
    return np.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, pad)]) if pad else points


def _base64(array: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


def viewer_payload(model: ShapeModel, *, look: tuple[float, float], unit: str) -> dict[str, Any]:
    """Return what ``viewer.js`` needs, ready for JSON.

    Points of the mean are rounded to 1/65535 of the longest side of their box, displacements for one standard deviation of a
    mode to 1/32767 of its largest entry.
    """
    mean = in_space(model.mean)
    low = mean.min(axis=0)
    step = float((mean.max(axis=0) - low).max() / 65535) or 1.0
    n_modes = max(1, min(len(model.modes), BUDGET // (mean.size * 2)))
    displacement = in_space(model.modes[:n_modes]) * np.sqrt(model.variances[:n_modes])[:, None, None]
    steps = np.abs(displacement).reshape(len(displacement), -1).max(axis=1, initial=0.0) / 32767
    steps = np.where(steps > 0, steps, 1.0)
    return {
        "n_points": len(mean),
        "grid": [int(n) for n in model.grid],
        "topology": str(model.topology),
        "unit": unit,
        "look": [float(angle) for angle in look],
        "mean": {"offset": [float(x) for x in low], "step": step, "data": _base64(np.rint((mean - low) / step), "<u2")},
        "modes": {
            "step": [float(s) for s in steps],
            "data": _base64(np.rint(displacement / steps[:, None, None]), "<i2"),
        },
        "faces": _base64(model.faces, "<u2" if len(mean) <= 65535 else "<u4"),
        "scores": [[round(float(x), 4) for x in row[:n_modes]] for row in model.scores],
    }
