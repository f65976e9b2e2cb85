"""Shaded still pictures of a surface."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.report.figures import BONE, coarser, figure, pixels, style


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
    """
    if colours is None:
        colours = np.tile(to_rgb(BONE), (len(points), 1))
    axes = view_axes(*view)
    local = (points - centre) @ axes.T
    corners = np.concatenate([local, vertex_normals(points, faces) @ axes.T, colours], axis=1)[faces]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2  # one subdivision rounds the shading off
    fine = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    normal, base = fine[:, :, 3:6].mean(axis=1), fine[:, :, 6:].mean(axis=1)
    back = np.cross(fine[:, 1, :3] - fine[:, 0, :3], fine[:, 2, :3] - fine[:, 0, :3])[:, 2] < 0
    normal = np.where(back[:, None], -normal, normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.array([-0.35, 0.45, 0.82])
    shade = 0.44 + 0.54 * np.clip(normal @ light, 0, 1) + 0.05 * np.clip(normal @ light, 0, 1) ** 12
    shaded = np.clip(base * (shade * np.where(back, 0.62, 1.0))[:, None], 0, 1)
    order = np.argsort(fine[:, :, 2].mean(axis=1), kind="stable")
    with style():
        made = figure(inches, inches)
        panel = made.add_axes((0, 0, 1, 1))
        panel.set_axis_off()
        panel.add_collection(
            PolyCollection(
                list(fine[order, :, :2]), facecolors=shaded[order], edgecolors="none", linewidths=0, antialiased=False
            )
        )
        panel.set(xlim=(-radius, radius), ylim=(-radius, radius))
        return coarser(pixels(made, 3 * dpi), 3)
