"""The outline of one object in a picture: a mask, skin on a plain background, or a silhouette on any plain background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from contourpy import contour_generator
from scipy import ndimage

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.outline.picture import Picture

Method: TypeAlias = Literal["auto", "mask", "skin", "silhouette"]

MIN_SEPARATION = 4.0
"""Least distance of object and background, in standard deviations of both along the direction that separates them best.

Two halves of one normal distribution are 2.7 apart, of an even one 3.5: below 4 nothing says that there are two things.
"""

_ROUNDS = 6
_EDGE = 3  # pixels on both sides of the edge that belong to neither class while classes are learned
_DEEP = 10  # pixels from the edge beyond which no edge is looked for, as in narrow valleys that were taken for object
_LOCAL = 4.0  # pixels over which the two levels beside the edge are averaged
_ROUND = 0.003  # share of the contrast that is taken for noise in all colours, so that faint colours are not overrated
_OTHER_SHARE = 0.05  # of the largest object's area; what is smaller counts as background
_MASK_SHARE = 0.98
_REMEDY = "use a plain background of another colour and even light, or give the outline as CSV"


@dataclass(frozen=True, eq=False)
class Segmentation:
    """An outline found in a picture, and how.

    Parameters
    ----------
    outline : Outline
        In pixels, y down; closed, along the edge of the picture where the object leaves it.
    rim : (n,) bool
        Points of the outline that lie on the edge of the picture.
    method : {"mask", "skin", "silhouette"}
    separation : float
        See ``MIN_SEPARATION``; infinite for a mask.
    other_share : float
        Area of the largest other object, as a share of this one's.
    """

    outline: Outline
    rim: Bools
    method: str
    separation: float
    other_share: float

    @property
    def opened(self) -> Outline:
        """The outline without its longest stretch along the edge of the picture; the closed one when there is none.

        It runs counter-clockwise with x right and y up, like every closed outline that a stage prepares.
        """
        runs = _runs(self.rim)
        if not len(runs):
            return self.outline
        ring, n = self.outline.points, len(self.rim)
        lengths = [np.linalg.norm(np.diff(ring[np.arange(a, b) % n], axis=0), axis=1).sum() for a, b in runs]
        a, b = runs[int(np.argmax(lengths))]
        return Outline(ring[np.arange(b, a + n) % n], False)

    @property
    def n_leaves(self) -> int:
        """How often the object leaves the picture."""
        return len(_runs(self.rim))


def find_outline(picture: Picture, method: Method = "auto", *, longest_side: int = 2000) -> Segmentation:
    """Find the largest object of a picture and return its outline to a part of a pixel.

    Parameters
    ----------
    picture : Picture
    method : {"auto", "mask", "skin", "silhouette"}
        ``mask``: two values, or transparent and opaque pixels; the class that has less of the picture's edge is the object.
        ``skin``: starts from pixels that are redder than they are green and blue. ``silhouette``: starts from pixels that
        differ from the picture's edge. ``auto``: mask if there are two values only, else skin, else silhouette.
    longest_side : int, default=2000
        Larger pictures are averaged over square blocks of pixels before; coordinates stay those of the picture.

    Returns
    -------
    Segmentation

    Raises
    ------
    GeometryError
        If nothing stands out from the background, or what does is too small or fills the picture.

    Notes
    -----
    Object and background are told apart by Fisher's linear discriminant (1936) of their colours, the background being a
    quadratic function of the place so that light may be uneven. Brightness counts little where shadows make it vary.
    Classes and discriminant are improved in turn. The outline is where the colour is halfway between the mean colours on
    both sides of the edge nearby (marching squares), so neither shading nor the width of a blurred edge moves it.

    Examples
    --------
    >>> y, x = np.mgrid[:40, :60]
    >>> disk = Picture((np.hypot(x - 30, y - 20) < 12.2).astype(float)[..., None])
    >>> found = find_outline(disk)
    >>> found.method, bool(abs(found.outline.signed_area - np.pi * 12.2**2) < 5)
    ('mask', True)
    """
    factor = -(-max(picture.size) // longest_side)
    picture = _reduced(picture, factor)
    if min(picture.size) < 16:
        raise GeometryError(
            f"the picture has {picture.size[1]} x {picture.size[0]} pixels", "at least 16 each way are needed"
        )
    is_mask = _two_valued(picture)
    if method == "mask" and not is_mask:
        raise GeometryError("the picture has more than two values, it is no mask", "set contour.method to auto")
    if method == "mask" or (method == "auto" and is_mask):
        level, region, other = _mask(picture)
        return _traced(level[..., None], region, factor, "mask", float("inf"), other)
    smooth = ndimage.gaussian_filter(np.asarray(picture.colors, dtype=np.float64), (1.0, 1.0, 0.0))
    gray = smooth.shape[2] == 1
    if method == "skin" and gray:
        raise GeometryError("the picture is grey, skin is told by its colour", "set contour.method to silhouette")
    ways = {"auto": ("silhouette",) if gray else ("skin", "silhouette")}.get(method, (method,))
    refusals = []
    for way in ways:
        try:
            seeds = [_skin_seed(smooth)] if way == "skin" else _silhouette_seeds(smooth)
            region, separation, other = _best(smooth, seeds)
            return _traced(smooth, region, factor, way, separation, other)
        except GeometryError as error:
            refusals.append(error)
    raise refusals[-1]


def _reduced(picture: Picture, factor: int) -> Picture:
    if factor <= 1:
        return picture
    height, width = (n // factor * factor for n in picture.size)

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = values[:height, :width]
        return np.asarray(cut.reshape(height // factor, factor, width // factor, factor, -1).mean(axis=(1, 3)))

    opaque = None if picture.opaque is None else blocks(picture.opaque)[..., 0] >= 0.5
    return Picture(blocks(picture.colors), opaque)


def _two_valued(picture: Picture) -> bool:
    """Whether pixels are transparent or opaque, or nearly all of one of two grey values (JPEG and blocks blur a few)."""
    if picture.opaque is not None and not picture.opaque.all() and picture.opaque.any():
        return True
    gray = picture.colors.mean(axis=2)
    if np.ptp(picture.colors, axis=2).max() > 0.1:
        return False
    low, high = float(gray.min()), float(gray.max())
    if high == low:
        return False
    between = np.abs((gray - low) / (high - low) - 0.5) < 0.4
    return bool(np.mean(~between) >= _MASK_SHARE)


def _mask(picture: Picture) -> tuple[Floats, Bools, float]:
    if picture.opaque is not None and not picture.opaque.all():
        values = picture.opaque.astype(np.float64)
    else:
        gray = picture.colors.mean(axis=2, dtype=np.float64)
        values = (gray - gray.min()) / np.ptp(gray)
    if (_rim(values) > 0.5).mean() > 0.5:
        values = 1.0 - values
    region, _, other = _largest(values > 0.5)
    return (
        np.asarray(ndimage.gaussian_filter(values, 1.0)),
        region,
        other,
    )  # takes the steps out of a staircase of pixels


def _rim(values: np.ndarray) -> np.ndarray:
    """Return the outermost pixels, (n, ...)."""
    return np.concatenate([values[0], values[-1], values[1:-1, 0], values[1:-1, -1]])


def _otsu(values: Floats) -> float:
    """Return the threshold that leaves the least variance in the two classes (Otsu 1979)."""
    counts, edges = np.histogram(values, bins=512)
    middle = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(counts).astype(np.float64)
    total = np.cumsum(counts * middle)
    above = below[-1] - below
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (total / below - (total[-1] - total) / above) ** 2
    return float(edges[1 + int(np.nanargmax(np.where(np.isfinite(between), between, -1.0)))])


def _skin_seed(colors: Floats) -> Bools:
    """Return pixels whose red stands out: light skin or dark, in the light or in the shade (a shadow is not redder)."""
    redness = colors[..., 0] - 0.5 * (colors[..., 1] + colors[..., 2])
    seed = redness > _otsu(redness.ravel())
    if redness[seed].mean() < 0.05:
        raise GeometryError(
            f"no skin in the picture: its reddest part is {redness[seed].mean():.3f} redder than green and blue, at least 0.05",
            "set contour.method to silhouette",
        )
    return np.asarray(seed)


def _silhouette_seeds(colors: Floats) -> list[Bools]:
    """Return pixels whose colour is far from a plane through the colours at the picture's edge, objects there left out.

    The second guess leaves out the difference in brightness, so that shadows are background; it needs colours.
    """
    y, x = np.mgrid[: colors.shape[0], : colors.shape[1]]
    plane = np.stack([np.ones(colors.shape[:2]), x / colors.shape[1] - 0.5, y / colors.shape[0] - 0.5], axis=-1)
    rim, terms = _rim(colors), _rim(plane)
    distance = np.linalg.norm(rim - np.median(rim, axis=0), axis=1)
    for _ in range(5):
        keep = distance <= np.quantile(distance, 0.65)
        coefficients = np.linalg.lstsq(terms[keep], rim[keep], rcond=None)[0]
        distance = np.linalg.norm(rim - terms @ coefficients, axis=1)
    ground = plane @ coefficients
    rest = colors - ground
    distances = [np.linalg.norm(rest, axis=2)]
    if colors.shape[2] == 3:
        bright = ground / np.maximum(np.linalg.norm(ground, axis=2, keepdims=True), 1e-6)
        distances.append(np.linalg.norm(rest - (rest * bright).sum(axis=2, keepdims=True) * bright, axis=2))
    return [np.asarray(away > _otsu(away.ravel())) for away in distances]


def _best(colors: Floats, seeds: list[Bools]) -> tuple[Bools, float, float]:
    """Improve every guess and return the object that stands out most; refuse like the first one when none does."""
    results, refusals = [], []
    for seed in seeds:
        try:
            results.append(_separate(colors, seed))
        except GeometryError as error:
            refusals.append(error)
    if not results:
        raise refusals[0]
    return max(results, key=lambda result: result[1])


def _separate(colors: Floats, seed: Bools) -> tuple[Bools, float, float]:
    """Improve a first guess of the object; return it, its separation from the background, and the next object's share."""
    region, others, other = _largest(seed)
    y, x = np.mgrid[-1.0 : 1.0 : 1j * colors.shape[0], -1.0 : 1.0 : 1j * colors.shape[1]]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    for _ in range(_ROUNDS):
        near, far = ndimage.binary_erosion(region, iterations=_EDGE, border_value=1), ~_grown(region | others, _EDGE)
        if min(near.sum(), far.sum()) < 100:
            share = 100 * region.mean()
            raise GeometryError(f"the largest object fills {share:.2g} % of the picture", _REMEDY)
        every = max(1, int(far.sum()) // 20000)
        ground = np.linalg.lstsq(terms[far][::every], colors[far][::every], rcond=None)[0]
        rest = colors - terms @ ground
        mean = rest[near].mean(axis=0)
        spread = 0.5 * (_second_moment(rest[near] - mean) + _second_moment(rest[far])) + 1e-6 * np.eye(len(mean))
        direction = np.linalg.solve(spread, mean)
        level = rest @ direction / max(float(mean @ direction), 1e-12)
        sigma_object, sigma_ground = float(level[near].std()), float(np.sqrt((level[far] ** 2).mean()))
        cut = np.clip(sigma_ground / max(sigma_object + sigma_ground, 1e-12), 0.3, 0.7)
        before = region
        region, others, other = _largest(level > cut)
        if np.array_equal(region, before):
            break
    separation = 1.0 / float(np.sqrt(max(0.5 * (sigma_object**2 + sigma_ground**2), 1e-12)))
    if separation < MIN_SEPARATION:
        raise GeometryError(
            f"object and background are {separation:.2g} standard deviations apart, at least {MIN_SEPARATION:g} are needed",
            _REMEDY,
        )
    return region, separation, other


def _second_moment(values: Floats) -> Floats:
    return np.asarray(values.T @ values / len(values))


def _grown(region: Bools, n: int) -> Bools:
    return np.asarray(ndimage.binary_dilation(region, iterations=n))


def _largest(region: Bools) -> tuple[Bools, Bools, float]:
    """Return the largest connected part without holes, other objects of some size, and the largest one's share of its area."""
    opened = ndimage.binary_opening(np.pad(region, 2, mode="edge"), iterations=1)[2:-2, 2:-2]
    labels, n = ndimage.label(opened)
    if n == 0:
        raise GeometryError("nothing stands out from the background", _REMEDY)
    areas = np.bincount(labels.ravel(), minlength=n + 1)[1:]
    order = np.argsort(-areas, kind="stable")
    found = np.asarray(ndimage.binary_fill_holes(labels == order[0] + 1))
    others = np.concatenate([[False], areas >= _OTHER_SHARE * areas.max()])
    others[order[0] + 1] = False
    return found, others[labels], float(areas[order[1]] / areas[order[0]]) if n > 1 else 0.0


def _traced(values: Floats, region: Bools, factor: int, method: str, separation: float, other: float) -> Segmentation:
    """Follow the edge of the region where colours are halfway between those on both sides of it."""
    height, width = region.shape
    halfway = values[..., 0] - 0.5 if method == "mask" else _halfway(values, region)
    halfway = np.where(ndimage.binary_erosion(region, iterations=_DEEP, border_value=1), 1.0, halfway)
    halfway = np.where(_grown(region, _EDGE), halfway, -1.0)
    lines = [np.asarray(line) for line in contour_generator(z=np.pad(halfway, 1, constant_values=-1.0)).lines(0.0)]
    longest = lines[int(np.argmax([len(line) for line in lines]))] if lines else np.zeros((0, 2))
    if len(longest) < 9:
        raise GeometryError("nothing stands out from the background", _REMEDY)
    ring = np.asarray(longest[:-1], dtype=np.float64) - 1.0
    rim = np.any((ring < -1e-6) | (ring > np.array([width, height]) - 1.0 + 1e-6), axis=1)
    ring = (ring + 0.5) * factor - 0.5
    keep = np.any(ring != np.roll(ring, 1, axis=0), axis=1)
    ring, rim = ring[keep], rim[keep]
    outline = Outline(ring, True)
    if outline.signed_area < 0:
        outline, rim = Outline(ring[::-1], True), rim[::-1]
    return Segmentation(outline, rim, method, separation, other)


def _halfway(colors: Floats, region: Bools) -> Floats:
    """Return where every pixel lies between the mean colours of background (-1/2) and object (1/2) beside it.

    Colour differences are weighed by the inverse covariance of the colours around these means: where a shadow makes
    brightness change along the edge, brightness does not decide where the edge is.
    """
    within, beyond = ndimage.binary_erosion(region, iterations=2, border_value=1), ~_grown(region, 2)
    inner, outer = _averaged(colors, within), _averaged(colors, beyond)
    contrast = inner - outer
    band = _grown(region, 6) & ~ndimage.binary_erosion(region, iterations=6, border_value=1)
    spread = sum(_second_moment((colors - mean)[band & side]) for side, mean in ((within, inner), (beyond, outer)))
    spread = spread + _ROUND * float((contrast[band] ** 2).sum(axis=1).mean()) * np.eye(colors.shape[2])
    weighted = contrast @ np.linalg.inv(spread)
    square = np.maximum((weighted * contrast).sum(axis=2), 1e-12)
    return np.asarray(((colors - outer) * weighted).sum(axis=2) / square - 0.5)


def _averaged(colors: Floats, where: Bools) -> Floats:
    """Return the mean colour of the pixels of one class in the neighbourhood of every pixel; of all of them where none is near."""
    weight = ndimage.gaussian_filter(where.astype(np.float64), _LOCAL)[..., None]
    total = ndimage.gaussian_filter(np.where(where[..., None], colors, 0.0), (_LOCAL, _LOCAL, 0.0))
    return np.asarray((total + 1e-6 * colors[where].mean(axis=0)) / (weight + 1e-6))


def _runs(rim: Bools) -> list[tuple[int, int]]:
    """Return cyclic runs of True as (first, one past the last), the last modulo n where it wraps."""
    n = len(rim)
    if not rim.any():
        return []
    starts = np.flatnonzero(rim & ~np.roll(rim, 1))
    if not len(starts):
        return [(0, n)]
    stops = np.flatnonzero(rim & ~np.roll(rim, -1)) + 1
    if stops[0] <= starts[0]:
        stops = np.concatenate([stops[1:], [stops[0] + n]])
    return [(int(a), int(b)) for a, b in zip(starts, stops, strict=True)]
