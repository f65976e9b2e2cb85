"""Where closed parameter lines start: turn shapes by whole columns of landmarks until they lie on each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ssmpipe.core.arrays import Floats

LEAST_TURN = 0.05
"""Smaller turns are left to the descent, which finds them [turns]."""
LEAST_GAIN = 0.1
"""A turn must lower the squared distance to the others by this share [-]."""


def starting_turns(points: Floats, n_rounds: int = 10) -> Floats:
    """Return by how much the first parameter of every shape should be turned before the descent, relative to the first shape.

    A descent from a start that is turned by a third of the circumference ends in a wrong place. Here every shape is turned in
    whole steps of the grid to where its points lie nearest to those of the mean, all steps at once by a Fourier transform; the mean
    follows, until nothing turns any more.

    Parameters
    ----------
    points : (n_S, n_u, n_v, d) float64
        In a common pose; periodic in the first parameter, u = 1 left out. ``n_v`` is 1 for curves.
    n_rounds : int

    Returns
    -------
    (n_S,) float64
        In turns, between -0.5 and 0.5: ``u + turn`` on shape i corresponds to ``u`` on the first one. Zero for a shape that does not
        need it, by :data:`LEAST_TURN` or :data:`LEAST_GAIN`.

    Examples
    --------
    >>> angle = 2 * np.pi * np.arange(40) / 40
    >>> ellipse = lambda start: np.stack([3 * np.cos(angle + start), np.sin(angle + start)], axis=-1)[:, None]
    >>> starting_turns(np.array([ellipse(0.0), ellipse(0.6 * np.pi)])).round(12).tolist()
    [0.0, -0.3]
    """
    n_shapes, n_u = points.shape[:2]
    centred = points - points.mean(axis=(0, 1, 2))
    spectra = np.fft.rfft(centred, axis=1)
    # the first shape has the phase that all others are brought to, then they agree among themselves
    steps = np.array([_best_step(spectra[0], one, n_u) for one in spectra])
    for _ in range(n_rounds):
        turned = np.array([np.roll(p, -k, axis=0) for p, k in zip(centred, steps, strict=True)])
        mean = np.fft.rfft(turned.mean(axis=0), axis=0)
        again = np.array([_best_step(mean, one, n_u) for one in spectra])
        again = (again - again[0]) % n_u
        if np.array_equal(again, steps):
            break
        steps = again
    turns = (steps / n_u + 0.5) % 1.0 - 0.5
    for i in range(1, n_shapes):
        apart = ((centred[i] - centred[0]) ** 2).sum()
        left = ((np.roll(centred[i], -steps[i], axis=0) - centred[0]) ** 2).sum()
        if abs(turns[i]) < LEAST_TURN or left > (1.0 - LEAST_GAIN) * apart:
            turns[i] = 0.0
    return np.asarray(turns)


def _best_step(target: NDArray[np.complex128], moving: NDArray[np.complex128], n_u: int) -> int:
    """Return the roll of ``moving`` that brings it nearest to ``target``, both as transforms along the first axis."""
    agreement = np.fft.irfft((moving * np.conj(target)).sum(axis=(1, 2)), n_u)
    return int(np.argmax(agreement))
