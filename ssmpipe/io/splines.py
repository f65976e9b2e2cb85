"""B-spline surfaces as ``.npz`` files with ``degree, knots_u, knots_v, control_points``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.io.arrays import read_npz, write_npz


def write_surface(path: Path, surface: BSplineSurface) -> None:
    """Write a surface; the same surface gives the same bytes."""
    write_npz(
        path,
        {
            "degree": np.array(surface.degree, dtype=np.int64),
            "knots_u": surface.knots_u,
            "knots_v": surface.knots_v,
            "control_points": surface.control_points,
        },
    )


def read_surface(path: Path) -> BSplineSurface:
    """Read a surface; ``degree`` may be one number or one for each direction.

    Raises
    ------
    ArtifactError
        If an array is missing, not numeric, or the knots do not fit the control points.
    """
    arrays = read_npz(path, ("degree", "knots_u", "knots_v", "control_points"))
    degree = arrays["degree"].reshape(-1)
    if degree.size not in (1, 2) or degree.dtype.kind not in "iu" or degree.min() < 1:
        raise ArtifactError(f"{path.name}: degree must be one or two whole numbers above 0, got {degree.tolist()[:4]}")
    try:
        return BSplineSurface(
            (int(degree[0]), int(degree[-1])), arrays["knots_u"], arrays["knots_v"], arrays["control_points"]
        )
    except (GeometryError, ValueError, TypeError) as error:
        raise ArtifactError(f"{path.name}: {error}") from error
