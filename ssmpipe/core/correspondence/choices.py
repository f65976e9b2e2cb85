"""What ``auto`` stands for in the options of the optimization, for a cohort and for one more shape alike."""

from __future__ import annotations

from typing import Literal

from ssmpipe.core.correspondence.normals import DEFAULT_NORMALS
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
    choice: Literal["auto", "identity", "affine"],
    *,
    topology: str,
    dimension: int = 3,
    normalize: str,
    guided: bool,
    reference: int | str,
    rims: str = "kept",
) -> Literal["identity", "affine"]:
    """Return where the maps begin.

    Maps with poles say little of where they lie, and begin at a registration. Rims say more: disks and tubes begin at the identity
    (docs/families.md), unless they are free. A cohort without a reference has nothing to register to.

    Examples
    --------
    >>> start_of("auto", topology="cone", normalize="affine", guided=False, reference="nearest-to-mean")
    'affine'
    >>> start_of("auto", topology="tube", normalize="affine", guided=False, reference="nearest-to-mean")
    'identity'
    >>> start_of("auto", topology="cone", normalize="affine", guided=False, reference="none")
    'identity'
    """
    if rims == "free":  # they are found by a registration
        return "affine"
    if choice != "auto":
        return choice
    poles = topology in ("cone", "closed") and dimension == 3
    return "affine" if poles and normalize == "affine" and not guided and reference != "none" else "identity"


def rims_of(topology: str) -> tuple[tuple[int, int], ...]:
    """Return the edges of the square that are rims, neither seam nor pole: direction and end, 0 or -1.

    Examples
    --------
    >>> rims_of("cone"), rims_of("tube"), rims_of("curve-open")
    (((1, 0),), ((1, 0), (1, -1)), ())
    """
    return {
        "disk": ((0, 0), (0, -1), (1, 0), (1, -1)),
        "tube": ((1, 0), (1, -1)),
        "cone": ((1, 0),),
    }.get(topology, ())


def normals_of(choice: float | Literal["auto"], *, topology: str, dimension: int, pose: str) -> float:
    """Return the weight of the normals; ``auto`` is zero for curves, where they do not help, and where they are not implemented.

    Examples
    --------
    >>> normals_of("auto", topology="cone", dimension=3, pose="refined")
    0.8
    >>> normals_of("auto", topology="curve-closed", dimension=2, pose="refined")
    0.0
    """
    if choice != "auto":
        return choice
    surfaces = not topology.startswith("curve") and dimension == 3
    return DEFAULT_NORMALS if surfaces and pose != "each-evaluation" else 0.0
