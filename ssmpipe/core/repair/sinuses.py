"""Find the sinuses of an aortic root, and planes across the tube that lie at the same places in every aorta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.centre_line import centre_line
from ssmpipe.core.mesh.sections import section_segments
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.mesh.tube_profile import (
    TubeProfile,
    places_on_line,
    point_on_line,
    point_on_longer_line,
    tube_profile,
)
from ssmpipe.core.repair.tube_ends import EndPlane, median_radius, plane_across

_BULGE = 0.02
"""Sinuses are wider than the tube on both sides of them by at least this share."""
_LOBES = 0.01
"""The three-lobed wave of their sections is at least this share of the diameter."""
_REACH = 3.0
"""Sinuses lie within so many diameters of an end."""


@dataclass(frozen=True, eq=False)
class Sinuses:
    """Where the three sinuses of an aortic root lie along the centre line.

    Attributes
    ----------
    first : bool
        Whether they lie at the first rim; else at the second.
    lower, upper : float
        Where the three-lobed wave of the sections passes half of its largest amplitude, in arc length from the rim on the side of the
        sinuses [mm]; ``lower`` may be negative, where the scan ends inside the sinuses.
    junction : float
        Narrowest section beyond the sinuses: the sinotubular junction [mm].
    diameter : float
        There [mm].
    lobes : float
        Largest amplitude of the three-lobed wave [mm].
    line : (n, 3) float64
        Centre line from the rim on the side of the sinuses [mm].
    """

    first: bool
    lower: float
    upper: float
    junction: float
    diameter: float
    lobes: float
    line: Floats

    @property
    def height(self) -> float:
        """Distance from ``lower`` to ``upper`` [mm]."""
        return self.upper - self.lower


def find_sinuses(mesh: TriMesh, rims: tuple[Ints, Ints]) -> Sinuses:
    """Find the sinuses of an aortic root from the sections across the centre line.

    Going in from an end the tube widens, narrows (the sinotubular junction), and between the two its sections have three lobes. The
    amplitude of the third wave of the radius rises and falls steeply at both ends of the sinuses; the places where it passes half
    of its largest value do not depend on how wide the tube is, nor how large the sinuses are.

    Parameters
    ----------
    mesh : TriMesh
        A tube with two rims, holes filled, branches removed [mm].
    rims : (n,), (m,) int64

    Raises
    ------
    GeometryError
        If neither end, or both, have a bulge with three lobes.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> from ssmpipe.core.mesh.topology import boundary_loops
    >>> plain = tube(1.0, 66.0, 72, 82)
    >>> x, y, z = plain.vertices.T
    >>> lobes = 1.0 + 0.6 * np.cos(3 * np.arctan2(y, x))  # largest 18 mm from the first end, half as large 7 mm before and behind
    >>> radius = 14.0 + 3.0 * lobes * 2.0 ** -(((z - 18.0) / 7.0) ** 2) + 1.5 / (1.0 + np.exp((38.0 - z) / 4.0))
    >>> root = TriMesh(np.column_stack([radius * x, radius * y, z]), plain.faces)
    >>> found = find_sinuses(root, tuple(boundary_loops(root.faces)))
    >>> abs(found.height - 14.0) < 0.7
    True
    """
    line = centre_line(mesh, *rims)
    radius = median_radius(mesh, rims)
    found, refusals = [], []
    for first in (True, False):
        one = line if first else line[::-1]
        profile = tube_profile(mesh, one, radius / 25.0, 0.8 * radius)
        try:
            found.append(_from_profile(profile, radius, first, one))
        except GeometryError as error:
            refusals.append(error.fact)
    if len(found) != 1:
        both = "both ends look like an aortic root" if found else f"{refusals[0]}; from the other end: {refusals[1]}"
        raise GeometryError(
            f"no sinuses were found: {both}",
            "check that the scan shows the aortic root, or use trim.ends_at: rims or landmarks",
        )
    return found[0]


def sinus_valleys(mesh: TriMesh, sinuses: Sinuses) -> Floats:
    """Return the three places (3, 3) between the sinuses, half way up their lobes, where a section across the centre line is nearest to it.

    The radius of the section is smoothed to six waves; each valley is where it is least within 40 degrees of a trough of the third
    wave. Counter-clockwise seen against the centre line, the deepest first [mm].

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> plain = tube(1.0, 60.0, 90, 61)
    >>> x, y, z = plain.vertices.T
    >>> radius = 14.0 + 2.0 * np.cos(3 * np.arctan2(y, x)) + 0.5 * x
    >>> line = np.column_stack([np.zeros(61), np.zeros(61), np.arange(61.0)])
    >>> found = Sinuses(first=True, lower=11.0, upper=25.0, junction=32.0, diameter=28.0, lobes=2.0, line=line)
    >>> valleys = sinus_valleys(TriMesh(np.column_stack([radius * x, radius * y, z]), plain.faces), found)
    >>> np.degrees(np.arctan2(valleys[:, 1], valleys[:, 0])).round() % 360
    array([180., 300.,  60.])
    """
    middle = 0.5 * (max(sinuses.lower, 0.0) + sinuses.upper)
    point, axis = point_on_line(sinuses.line, middle, 0.5 * sinuses.diameter)
    places = section_segments(mesh, axis, float(point @ axis)).mean(axis=1)
    near = np.linalg.norm(places - point, axis=1) < sinuses.diameter
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(sinuses.line, axis=0), axis=1))]
    beside = length[
        np.linalg.norm(places[:, None] - sinuses.line, axis=2).argmin(axis=1)
    ]  # not the other limb of an arch
    places = places[near & (np.abs(beside - middle) < sinuses.diameter)]
    across = np.linalg.svd(np.eye(3) - np.outer(axis, axis))[0][:, 0]
    offset = places - places.mean(axis=0)
    angle, radius = np.arctan2(offset @ np.cross(axis, across), offset @ across), np.linalg.norm(offset, axis=1)
    orders = np.arange(1, 7)

    def waves(at: Floats) -> Floats:
        return np.column_stack([np.ones(len(at)), np.cos(np.outer(at, orders)), np.sin(np.outer(at, orders))])

    weights = np.linalg.lstsq(waves(angle), radius, rcond=None)[0]
    trough = (np.arctan2(weights[6 + 3], weights[3]) + np.pi) / 3.0
    around = trough + np.radians(np.linspace(-40.0, 40.0, 161)) + 2.0 * np.pi / 3.0 * np.arange(3)[:, None]
    smooth = (waves(around.ravel()) @ weights).reshape(around.shape)
    least = smooth.argmin(axis=1)
    first = int(smooth.min(axis=1).argmin())
    order = (first + np.arange(3)) % 3
    turned = np.abs(np.exp(1j * angle) - np.exp(1j * around[order, least[order]])[:, None])
    return np.asarray(places[turned.argmin(axis=1)])


def planes_at_sinuses(
    mesh: TriMesh, sinuses: Sinuses, below: float, upper: float | Floats | None
) -> tuple[EndPlane, EndPlane | None]:
    """Return the plane below the sinuses and another one farther up, normals out of the tube.

    The first one cuts the tube in the smallest section (:func:`.plane_across`), since one sinus larger than the others bends the
    centre line; the second one lies across the centre line.

    Parameters
    ----------
    mesh : TriMesh
        That of :func:`find_sinuses` [mm].
    sinuses : Sinuses
    below : float
        Distance of the first plane below ``lower``, in heights of the sinuses.
    upper : float, or (3,) float64, optional
        Distance of the second plane from the first one along the centre line, beyond whose end the line goes on straight; or a point
        of it [mm].

    Returns
    -------
    lower, upper : EndPlane
        The second is None without ``upper``.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> line = np.column_stack([np.zeros(61), np.zeros(61), np.arange(61.0)])
    >>> found = Sinuses(first=True, lower=11.0, upper=25.0, junction=32.0, diameter=28.0, lobes=1.8, line=line)
    >>> lower, upper = planes_at_sinuses(tube(14.0, 60.0, 60, 60), found, below=0.5, upper=30.0)
    >>> lower.point.round(6) + 0.0, lower.normal.round(3) + 0.0, upper.point.round(6) + 0.0
    (array([0., 0., 4.]), array([ 0.,  0., -1.]), array([ 0.,  0., 34.]))
    """
    at = sinuses.lower - below * sinuses.height
    point, tangent = point_on_longer_line(sinuses.line, at, sinuses.height)
    lower = plane_across(mesh, point, tangent, sinuses.diameter)
    window = 0.5 * sinuses.diameter
    if upper is None:
        return lower, None
    if isinstance(upper, (float, int)):
        return lower, EndPlane(*point_on_longer_line(sinuses.line, at + upper, window))
    return lower, EndPlane(
        upper, point_on_longer_line(sinuses.line, float(places_on_line(sinuses.line, upper[None])[0]), window)[1]
    )


def _from_profile(profile: TubeProfile, radius: float, first: bool, line: Floats) -> Sinuses:
    whole = np.flatnonzero(np.isfinite(profile.diameter) & (profile.at < 2.0 * _REACH * radius))
    if len(whole) < 10:
        raise GeometryError("the sections near an end do not close")
    at, step = profile.at[whole], profile.at[1] - profile.at[0]
    smooth = 0.08 * radius / step
    wide = gaussian_filter1d(profile.diameter[whole], smooth, mode="nearest")
    lobed = gaussian_filter1d(profile.lobes[1][whole], smooth, mode="nearest")
    peak, valley = _bulge(wide)
    if peak < 0:
        raise GeometryError("the tube does not widen and narrow again near its end")
    top = int(np.argmax(lobed[: valley + 1]))
    if lobed[top] < _LOBES * wide[valley]:
        raise GeometryError(
            f"the wide part has no three lobes (their wave is {lobed[top]:.2f} mm on a diameter of {wide[valley]:.1f} mm)"
        )
    half = 0.5 * lobed[top]
    upper = _crossing(at, lobed, half, top, 1)
    if not np.isfinite(upper) or upper > at[-1]:
        raise GeometryError("the three lobes do not end")
    lower = _crossing(at, lobed, half, top, -1)
    if not np.isfinite(lower):
        # the scan ends inside the sinuses: their wave is about symmetric, so its flanks at 80 % tell its middle
        high = 0.8 * lobed[top]
        flank = _crossing(at, lobed, high, top, -1)
        middle = 0.5 * (flank + _crossing(at, lobed, high, top, 1)) if np.isfinite(flank) else float(at[top])
        lower = 2.0 * middle - upper
    return Sinuses(first, lower, upper, float(at[valley]), float(wide[valley]), float(lobed[top]), line)


def _bulge(wide: Floats) -> tuple[int, int]:
    """Return the widest place of the first bulge from the start and the narrowest place after it, or (-1, -1)."""
    peak = 0
    for k in range(1, len(wide)):
        if wide[k] > wide[peak]:
            peak = k
        elif wide[k] < (1.0 - _BULGE) * wide[peak]:
            break
    else:
        return -1, -1
    if wide[: peak + 1].min() > (1.0 - _BULGE) * wide[peak]:
        return -1, -1
    valley = peak
    for k in range(peak, len(wide)):
        if wide[k] < wide[valley]:
            valley = k
        elif wide[k] > wide[valley] + 0.25 * (wide[peak] - wide[valley]):
            break
    return peak, valley


def _crossing(at: Floats, values: Floats, level: float, start: int, side: int) -> float:
    """Return where ``values`` falls below ``level`` going from ``start``; NaN where it does not."""
    k = start
    while 0 <= k + side < len(values):
        if values[k + side] < level:
            share = (values[k] - level) / (values[k] - values[k + side])
            return float(at[k] + share * (at[k + side] - at[k]))
        k += side
    return float("nan")
