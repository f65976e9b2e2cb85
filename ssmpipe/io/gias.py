"""Shape models in the ``.pc.npz`` layout of gias: mean, modes as columns, variances, scores; points as x0 y0 z0 x1 ..."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.io.arrays import write_npz


def write_gias(path: Path, model: ShapeModel) -> None:
    """Write a model for ``gias-pcreg`` and its kin; the same model gives the same bytes.

    ``mean`` (3 n_P,), ``weights`` (n_modes,) variances, ``modes`` (3 n_P, n_modes) orthonormal, ``projectedWeights`` (n_modes, n_S) scores
    in mm (not in standard deviations), ``SD`` a scalar (coordinates are not normalized), ``sizes`` empty.
    """
    n_modes = len(model.variances)
    write_npz(
        path,
        {
            "mean": model.mean.reshape(-1),
            "weights": model.variances,
            "modes": np.ascontiguousarray(model.modes.reshape(n_modes, -1).T),
            "SD": np.array(1.0),  # a scalar: coordinates were not divided by their deviation
            "sizes": np.zeros(0),
            "projectedWeights": np.ascontiguousarray((model.scores * np.sqrt(model.variances)).T),
        },
    )
