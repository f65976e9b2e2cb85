"""What ``auto`` stands for in the options of the optimization, for a cohort and for one more shape alike."""

from __future__ import annotations

from typing import Literal

from ssmpipe.core.correspondence.reparameterization import Boundary


def closes(topology: str) -> bool:
    """Say whether the first parameter direction closes over its ends.

    Examples
    --------
    >>> closes("tube"), closes("disk")
    (True, False)
    """
    return topology not in ("disk", "curve-open")


def boundary_of(choice: Boundary | Literal["auto"], topology: str) -> Boundary:
    """Return the boundary mode of shapes of a topology.

    Examples
    --------
    >>> boundary_of("auto", "cone"), boundary_of("auto", "disk"), boundary_of("sliding", "disk")
    ('periodic', 'fixed', 'sliding')
    """
    if choice != "auto":
        return choice
    return "periodic" if closes(topology) else "fixed"


def start_of(
    choice: Literal["auto", "identity", "affine"], *, surfaces: bool, normalize: str, guided: bool, reference: int | str
) -> Literal["identity", "affine"]:
    """Return where the maps begin; a cohort without a reference has nothing to register to.

    Examples
    --------
    >>> start_of("auto", surfaces=True, normalize="affine", guided=False, reference="nearest-to-mean")
    'affine'
    >>> start_of("auto", surfaces=True, normalize="affine", guided=False, reference="none")
    'identity'
    """
    if choice != "auto":
        return choice
    return "affine" if surfaces and normalize == "affine" and not guided and reference != "none" else "identity"
