"""Shaded still pictures of a surface."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.report.figures import BONE
from ssmpipe.report.raster import rasterize


def vertex_normals(points: Floats, faces: Ints) -> Floats:
    """Return (n_points, 3) area-weighted unit normals; zero where a point has no face.

    Examples
    --------
    >>> vertex_normals(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))[0]
    array([0., 0., 1.])
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.ravel(), np.repeat(face_normals[:, d], 3), len(points)) for d in range(3)],
        axis=1,
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def view_axes(azimuth: float, elevation: float) -> Floats:
    """Return the rows (right, up, towards the viewer) of a view with z upwards; angles in degrees.

    Examples
    --------
    >>> view_axes(-90, 0).round(12) + 0.0
    array([[ 1.,  0.,  0.],
           [ 0.,  0.,  1.],
           [ 0., -1.,  0.]])
    """
    a, e = np.radians([azimuth, elevation])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def good_view(points: Floats, faces: Ints) -> tuple[float, float]:
    """Return azimuth and elevation [degrees] from which much of the outside is seen, a little from the side.

    Examples
    --------
    >>> flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    >>> good_view(flat, np.array([[0, 1, 2]]))[1]
    50.0
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    area_normals = np.cross(b - a, c - a)
    candidates = [
        (azimuth, elevation) for elevation in (50.0, 18.0, -18.0) for azimuth in np.arange(-90.0, 270.0, 45.0)
    ]
    seen = [np.maximum(area_normals @ view_axes(*view)[2], 0).sum() for view in candidates]
    azimuth, elevation = candidates[int(np.argmax(np.round(np.array(seen) / (max(seen) or 1.0), 3)))]
    return float(azimuth + 25.0), elevation


def picture(
    points: Floats,
    faces: Ints,
    *,
    view: tuple[float, float],
    centre: Floats,
    radius: float,
    colours: Floats | None = None,
    inches: float = 2.2,
    dpi: int = 140,
    finer: float = 2.0,
) -> np.ndarray:
    """Return an (h, w, 3) uint8 orthographic picture of a surface.

    Parameters
    ----------
    points : (n_points, 3) float64
    faces : (n_faces, 3) int64
    view : (float, float)
        Azimuth and elevation [degrees].
    centre, radius
        What the picture shows, so that several pictures share one scale.
    colours : (n_points, 3) float64, optional
        In [0, 1]; bone when absent.
    inches, dpi
        Side of the picture: their product, in pixels.
    finer : float, default=2
        Drawn so many times larger and averaged, for smooth rims.
    """
    if colours is None:
        colours = np.tile(to_rgb(BONE), (len(points), 1))
    axes = view_axes(*view)
    local = (points - centre) @ axes.T / radius
    size = round(inches * dpi)
    shot = rasterize(local, vertex_normals(points, faces) @ axes.T, faces, colours, round(finer * size))
    return np.asarray(Image.fromarray(shot).resize((size, size), Image.Resampling.BOX))
