"""B-spline curves and surfaces as ``.npz`` files with ``degree, knots_u[, knots_v], control_points``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.io.arrays import read_npz, write_npz


def write_spline(path: Path, spline: BSplineCurve | BSplineSurface) -> None:
    """Write a curve or a surface; the same spline gives the same bytes."""
    knots = dict(zip(("knots_u", "knots_v"), spline.knot_vectors, strict=False))
    degree = np.array(spline.degrees, dtype=np.int64)
    write_npz(path, {"degree": degree, **knots, "control_points": spline.control_points})


def read_spline(path: Path) -> BSplineCurve | BSplineSurface:
    """Read a surface, or a curve when there is no ``knots_v``; ``degree`` may be one number or one for each direction.

    Raises
    ------
    ArtifactError
        If an array is missing, not numeric, or the knots do not fit the control points.
    """
    arrays = read_npz(path, ("degree", "knots_u", "control_points"))
    for name in ("degree", "knots_u", "knots_v", "control_points"):
        if name in arrays and arrays[name].dtype.kind not in "iuf":
            raise ArtifactError(f"{path.name}: '{name}' holds no real numbers ({arrays[name].dtype})", "store floats")
    degree = arrays["degree"].reshape(-1)
    if degree.size not in (1, 2) or degree.dtype.kind not in "iu" or degree.min() < 1:
        raise ArtifactError(
            f"{path.name}: degree must be one or two whole numbers above 0, got {degree.tolist()[:4]}", "check the file"
        )
    if "knots_v" not in arrays and arrays["control_points"].ndim == 3:
        raise ArtifactError(f"{path.name}: a surface needs 'knots_v'", "add the knots of the second direction")
    try:
        if "knots_v" not in arrays:
            return BSplineCurve(int(degree[0]), arrays["knots_u"], arrays["control_points"])
        return BSplineSurface(
            (int(degree[0]), int(degree[-1])), arrays["knots_u"], arrays["knots_v"], arrays["control_points"]
        )
    except (GeometryError, ValueError, TypeError) as error:
        raise ArtifactError(f"{path.name}: {str(error).removesuffix('.')}", "check the file") from error


def read_surface(path: Path) -> BSplineSurface:
    """Read a surface; a curve is refused.

    Raises
    ------
    ArtifactError
        As :func:`read_spline`, or if it is a curve.
    """
    spline = read_spline(path)
    if not isinstance(spline, BSplineSurface):
        raise ArtifactError(f"{path.name} holds a curve, not a surface", "give a file with knots_v")
    return spline
