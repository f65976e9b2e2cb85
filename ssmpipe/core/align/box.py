"""The frame of the smallest box around a shape."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from ssmpipe.core.align.frames import Frame, principal_axes
from ssmpipe.core.align.rigid import homogeneous
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.operators import surface_centroid
from ssmpipe.core.mesh.trimesh import TriMesh

TIE = 1e-9
"""Boxes whose volumes differ by no more than this share are equal [-]."""
LARGE, CLOSE, NEAR = 2000, 1.02, np.radians(2.5)
"""Hulls with more vertices are searched in two steps; the second tries the faces within an angle [rad] of those whose box was
nearly the smallest in the first."""


def box_axes(mesh: TriMesh) -> Floats:
    """Return the axes of the oriented bounding box of least volume, rows, longest side first, right-handed.

    One side of the smallest box lies (nearly always) on a face of the convex hull (O'Rourke 1985): every face is tried, and in
    its plane every edge of the outline. Signs follow the principal axes: each axis points the way the surface is skewed.

    Raises
    ------
    scipy.spatial.QhullError
        If all vertices lie in one plane.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> long = sphere(1.0, 2)
    >>> bool(abs(box_axes(TriMesh(long.vertices * [1, 9, 3], long.faces))[0, 1]) > 0.99)
    True
    """
    skew, _ = principal_axes(mesh)
    center = surface_centroid(mesh)
    # about the principal axes, so that the box turns with the shape
    points = (mesh.vertices[np.unique(mesh.faces)] - center) @ skew.T
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    normals = np.unique(np.round(hull.equations[:, :3], 6), axis=0)
    if len(corners) > LARGE:
        # a round shape has most of its vertices on the hull: first with the outermost ones in some directions, then all that is near
        few = _outermost(corners, 600)
        rough = ConvexHull(few).equations[:, :3]
        sizes = _boxes(rough, few)[0]
        good = rough[sizes < CLOSE * sizes.min()]
        normals = normals[(normals @ good.T).max(axis=1) > np.cos(NEAR)]
    sizes, boxes = _small_boxes(normals, corners)
    axes = boxes[int(np.argmax(sizes < sizes.min() * (1 + TIE)))]
    axes = axes[np.argsort(-np.ptp(corners @ axes.T, axis=0), kind="stable")]
    # near a principal axis take its sign
    for k in range(2):
        nearest = int(np.argmax(np.abs(axes[k])))
        if axes[k, nearest] < 0:
            axes[k] = -axes[k]
    axes[2] = np.cross(axes[0], axes[1])
    return np.asarray(axes @ skew)


def _small_boxes(normals: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Do the same as :func:`_boxes` for the smallest box and its equals; what cannot be among them is infinite.

    A box around some of the corners is no larger than the one around all.
    """
    if len(corners) <= LARGE:
        return _boxes(normals, corners)
    bounds = _boxes(normals, _outermost(corners, 3000))[0]
    sizes, boxes = np.full(len(normals), np.inf), np.empty((len(normals), 3, 3))
    for k in np.argsort(bounds, kind="stable"):
        if bounds[k] > sizes.min() * (1 + TIE):
            break
        sizes[k : k + 1], boxes[k : k + 1] = _boxes(normals[k : k + 1], corners)
    return sizes, boxes


def _outermost(corners: Floats, n: int) -> Floats:
    """Return those of the corners, (m, 3), that are the farthest ones in ``n`` directions."""
    blocks = np.array_split(_directions(n), 1 + n // 100)
    return corners[np.unique(np.concatenate([np.argmax(corners @ block.T, axis=0) for block in blocks]))]


def _boxes(normals: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Return volume (n,) and axes (n, 3, 3), as rows, of the smallest box with a side across each of the normals."""
    sizes, boxes = [], []
    for normal in normals / np.linalg.norm(normals, axis=1, keepdims=True):
        basis = np.linalg.svd(normal[None])[2][1:]
        flat = corners @ basis.T
        outline = flat[ConvexHull(flat).vertices]
        sides = np.roll(outline, -1, axis=0) - outline
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        across = np.column_stack([-sides[:, 1], sides[:, 0]])
        area = np.ptp(outline @ sides.T, axis=0) * np.ptp(outline @ across.T, axis=0)
        k = int(np.argmin(area))
        sizes.append(float(area[k] * np.ptp(corners @ normal)))
        boxes.append(np.vstack([sides[k] @ basis, across[k] @ basis, normal]))
    return np.array(sizes), np.array(boxes)


def _directions(n: int) -> Floats:
    """Return directions spread over the sphere, (n, 3): a spiral with the golden angle."""
    height = 1 - 2 * (np.arange(n) + 0.5) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    ring = np.sqrt(1 - height**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])


def box_frame(mesh: TriMesh) -> Frame:
    """Return the frame of the smallest box: x along its longest side, z along its shortest, origin in its middle."""
    axes = box_axes(mesh)
    points = mesh.vertices[np.unique(mesh.faces)] @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    return Frame(homogeneous(axes, -0.5 * (low + high)), float(high[2] - low[2]))
