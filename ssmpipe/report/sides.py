"""Whether a chain tells left from right, in words for those who read its results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_NONE = ("aorta",)
"""Anatomies that have no side."""


def unchecked_sides(
    stages: Sequence[Mapping[str, Mapping[str, Any]]], sides: Iterable[str | None], anatomy: str | None = None
) -> str:
    """Say what a chain does not do about left and right, and the remedy; empty when it checks, mirrors, or nothing is mixed.

    Parameters
    ----------
    stages : sequence of dict
        Of a resolved config: a stage and its options each.
    sides : iterable of {"L", "R", None}
        Of the shapes, by the cohort table.
    anatomy : str, optional

    Examples
    --------
    >>> align = {"align": {"check_mirror": False, "chirality": "keep"}}
    >>> unchecked_sides([align], [None, None])  # doctest: +ELLIPSIS
    'Left and right are not checked: where they are mixed, ...
    >>> unchecked_sides([align], ["L", "R", "R"])  # doctest: +ELLIPSIS
    'Left and right are mixed (1 L, 2 R) and none is mirrored: ...
    >>> unchecked_sides([{"orient": {"mirror": "left"}}, align], ["L", "R"]) or unchecked_sides([align], ["R", "R"])
    ''
    """
    options = [(name, given or {}) for stage in stages for name, given in stage.items()]
    aligned = [given for name, given in options if name == "align"]
    mirrors = any(name == "orient" and given.get("mirror", "none") != "none" for name, given in options)
    told = any(given.get("check_mirror", True) or given.get("chirality") == "best-fit" for given in aligned)
    counts = Counter(sides)
    if mirrors or told or not aligned or anatomy in _NONE or (len(counts) == 1 and None not in counts):
        return ""
    grows = "their difference becomes a part of the model"
    if counts["L"] and counts["R"]:
        mixed = f"Left and right are mixed ({counts['L']} L, {counts['R']} R) and none is mirrored"
        return f"{mixed}: {grows}; set orient.mirror: left"
    return (
        f"Left and right are not checked: where they are mixed, {grows}; set align.check_mirror: true for a warning of each shape that "
        "fits better mirrored (where shapes are nearly symmetric it warns without reason), or align.chirality: best-fit to have them "
        "mirrored"
    )
