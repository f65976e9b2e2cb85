"""Rigid alignment of planar outlines by arc length, all starting points of closed ones tried at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.outline.outline import Outline, resample


@dataclass(frozen=True, eq=False)
class OutlineFit:
    """Rigid motion of one outline onto another.

    Parameters
    ----------
    matrix : (4, 4) float64
        Rotation about the third axis and translation in the plane; never a reflection.
    start : float
        Arc length on the moving outline of the point that falls on the target's first one; 0 when open or kept.
    rms : float
        Root mean square distance of points at equal arc length, after the motion.
    """

    matrix: Floats
    start: float
    rms: float

    @property
    def angle_deg(self) -> float:
        """Rotation, counter-clockwise with x right and y up [degrees]."""
        return float(np.degrees(np.arctan2(self.matrix[1, 0], self.matrix[0, 0])))


def align_outline(moving: Outline, target: Outline, *, n: int = 256, keep_start: bool = False) -> OutlineFit:
    """Find the rotation and translation that best bring equal arc lengths together.

    Parameters
    ----------
    moving, target : Outline
        Both open or both closed, traversed in the same sense.
    n : int, default=256
        Points at equal arc lengths that are compared.
    keep_start : bool, default=False
        Of closed outlines: whether first point belongs to first point; else all ``n`` starting points are tried.

    Returns
    -------
    OutlineFit

    Notes
    -----
    With points as complex numbers the best rotation for shift ``k`` is the phase of ``c_k = sum_l conj(z_(l+k)) w_l`` and the
    residual is ``|z|^2 + |w|^2 - 2 |c_k|``: one FFT gives all shifts. Sizes are not changed.

    Examples
    --------
    >>> square = Outline(np.array([[0, 0], [3, 0], [3, 1], [0, 1.0]]), closed=True)
    >>> turned = Outline(np.array([[0, 3], [-1, 3], [-1, 0], [0, 0.0]]), closed=True)
    >>> round(align_outline(turned, square).rms, 9)
    0.0
    """
    z, w = (_complex(resample(outline, n).points) for outline in (moving, target))
    centre_z, centre_w = z.mean(), w.mean()
    z, w = z - centre_z, w - centre_w
    if moving.closed and not keep_start:
        overlaps = np.conj(np.fft.ifft(np.fft.fft(z) * np.conj(np.fft.fft(w))))
        shift = int(np.argmax(np.abs(overlaps)))
    else:
        overlaps, shift = np.array([np.vdot(z, w)]), 0
    overlap = overlaps[shift]
    turn = overlap / abs(overlap) if abs(overlap) > 0 else 1.0 + 0.0j
    square = float((np.abs(z) ** 2).sum() + (np.abs(w) ** 2).sum() - 2 * abs(overlap)) / n
    move = centre_w - turn * centre_z
    matrix = np.eye(4)
    matrix[:2, :2] = [[turn.real, -turn.imag], [turn.imag, turn.real]]
    matrix[:2, 3] = move.real, move.imag
    return OutlineFit(matrix, shift * moving.length / n, float(np.sqrt(max(square, 0.0))))


def mirror_outline(outline: Outline) -> Outline:
    """Reflect an outline in x; a closed one is run the other way round from the same first point, so that its sense stays.

    Examples
    --------
    >>> mirror_outline(Outline(np.array([[0, 0], [3, 0], [3, 1.0]]), closed=True)).points.tolist()
    [[0.0, 0.0], [-3.0, 1.0], [-3.0, 0.0]]
    """
    points = outline.points * [-1.0, 1.0]
    if outline.closed:
        points = np.concatenate([points[:1], points[:0:-1]])
    return Outline(points + 0.0, outline.closed)


def medoid_outline(outlines: Mapping[str, Outline], *, n: int = 128, keep_start: bool = False) -> str:
    """Return the id of the outline with the smallest sum of RMS distances to all others, each pair aligned; first id wins a tie.

    Parameters
    ----------
    outlines : mapping of id to Outline
    n : int, default=128
    keep_start : bool, default=False
        As in :func:`align_outline`.

    Examples
    --------
    >>> t = 2 * np.pi * np.arange(50) / 50
    >>> circle = np.column_stack([np.cos(t), np.sin(t)])
    >>> medoid_outline({name: Outline(size * circle, True) for name, size in zip("abc", (1, 2, 5))})
    'b'
    """
    ids = sorted(outlines)
    z = np.stack([_complex(resample(outlines[i], n).points) for i in ids])
    z = z - z.mean(axis=1, keepdims=True)
    square = (np.abs(z) ** 2).sum(axis=1)
    shifts = all(outlines[i].closed for i in ids) and not keep_start
    spectra = np.fft.fft(z, axis=1)
    total = np.zeros(len(ids))
    for k in range(len(ids)):
        if shifts:
            overlap = np.abs(np.fft.ifft(spectra * np.conj(spectra[k]), axis=1)).max(axis=1)
        else:
            overlap = np.abs(z.conj() @ z[k])
        total[k] = np.sqrt(np.maximum(square + square[k] - 2 * overlap, 0.0) / n).sum()
    return ids[int(np.argmin(total))]


def move_outline(outline: Outline, matrix: Floats) -> Outline:
    """Move an outline by the upper left block and the last column of a (4, 4) matrix."""
    return Outline(outline.points @ matrix[:2, :2].T + matrix[:2, 3], outline.closed)


def _complex(points: Floats) -> np.ndarray:
    return np.asarray(points[:, 0] + 1j * points[:, 1])
