"""Anatomies as plain data: topology, order of the stages, options that differ from the stages' own defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.suggest import did_you_mean


@dataclass(frozen=True)
class Preset:
    """A chain of stages that suits one anatomy.

    Parameters
    ----------
    name, summary : str
    topology : str
        Of what is modelled: ``disk``, ``tube``, ``curve`` (open or closed) ...
    stages : tuple of (str, dict)
        Stage names in order, with overrides of their defaults.
    diagonal_mm : (float, float), optional
        Plausible range of a scan's bounding-box diagonal [mm]; outside of it the units are wrong.
    needs_side : bool
        Whether left and right occur and must be told apart.
    """

    name: str
    summary: str
    topology: str
    stages: tuple[tuple[str, Mapping[str, Any]], ...]
    diagonal_mm: tuple[float, float] | None = None
    needs_side: bool = False


_GROUP: tuple[tuple[str, Mapping[str, Any]], ...] = (("optimize", {}), ("model", {}), ("evaluate", {}), ("report", {}))

PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset(
            name="femur-distal",
            summary="distal femur, cut from a closed surface of the bone",
            topology="disk",
            stages=(
                ("repair", {}),
                ("orient", {}),
                ("trim", {}),
                ("smooth", {}),
                ("decimate", {}),
                ("align", {}),
                ("parameterize", {"places": "own"}),
                ("sample", {}),
                ("fit", {}),
                *_GROUP,
            ),
            diagonal_mm=(60.0, 700.0),
            needs_side=True,
        ),
        Preset(
            name="disk",
            summary="any surface with one boundary loop, used as it is",
            topology="disk",
            stages=(
                ("repair", {}),
                ("orient", {"mirror": "none", "frame": "principal"}),
                ("smooth", {}),
                ("decimate", {}),
                ("align", {"check_mirror": False, "check_frame": False}),
                ("parameterize", {"corner_axes": "aligned"}),
                ("sample", {}),
                ("fit", {}),
                ("optimize", {"boundary": "sliding"}),
                *_GROUP[1:],
            ),
        ),
        Preset(
            name="femur-proximal",
            summary="proximal femur, cut below the lesser trochanter",
            topology="cone",
            stages=(
                ("repair", {}),
                ("orient", {"frame": "femur-proximal"}),
                ("trim", {"up": (0.0, 0.0, -1.0), "find": "trochanter", "offset_shafts": 0.7}),
                ("smooth", {}),
                ("decimate", {}),
                ("align", {}),
                ("parameterize", {"topology": "cone"}),
                ("sample", {}),
                ("fit", {}),
                ("optimize", {"n_coefficients": [9, 9]}),
                *_GROUP[1:],
            ),
            diagonal_mm=(60.0, 700.0),
            needs_side=True,
        ),
        Preset(
            name="closed",
            summary="any closed surface without handles, mapped between two poles",
            topology="closed",
            stages=(
                ("repair", {"max_openings": 0}),
                ("orient", {"mirror": "none", "frame": "principal"}),
                ("smooth", {}),
                ("decimate", {}),
                ("align", {"check_mirror": False, "check_frame": False}),
                ("parameterize", {"topology": "closed"}),
                ("sample", {}),
                ("fit", {}),
                *_GROUP,
            ),
        ),
        Preset(
            name="tube",
            summary="any surface with two openings, cut open from one to the other",
            topology="tube",
            stages=(
                ("repair", {"max_openings": 20}),
                ("orient", {"mirror": "none", "frame": "principal"}),
                ("fill-holes", {"keep_openings": 2, "opening_share": 0.5}),
                ("trim", {"ends": 2}),
                ("smooth", {}),
                ("decimate", {}),
                ("align", {"check_mirror": False, "check_frame": False}),
                ("cut", {"axis": (1.0, 0.0, 0.0)}),
                ("parameterize", {"topology": "tube"}),
                ("sample", {}),
                ("fit", {}),
                ("optimize", {"covariance": "II"}),
                *_GROUP[1:],
            ),
        ),
        Preset(
            name="aorta",
            summary="aorta, branches removed, cut below the sinuses and at the other end",
            topology="tube",
            stages=(
                ("repair", {"max_openings": 20}),
                ("orient", {"mirror": "none", "frame": "principal"}),
                ("fill-holes", {"keep_openings": 2, "opening_share": 0.5, "stump_reach_mm": 40.0}),
                ("trim", {"ends": 2, "ends_at": "sinuses", "extend_mm": 6.0}),
                ("smooth", {}),
                ("decimate", {}),
                ("align", {"check_mirror": False, "check_frame": False}),
                ("cut", {"axis": (1.0, 0.0, 0.0)}),
                ("parameterize", {"topology": "tube"}),
                ("sample", {}),
                ("fit", {}),
                ("optimize", {"n_coefficients": [12, 12], "landmarks": [51, 51], "covariance": "II", "prior": 0.1}),
                *_GROUP[1:],
            ),
            diagonal_mm=(50.0, 600.0),
        ),
        Preset(
            name="curve",
            summary="planar outlines, open or closed",
            topology="curve",
            stages=(
                ("contour", {}),
                ("align", {}),
                ("fit", {"n_control": 160}),
                ("optimize", {"n_coefficients": [12], "landmarks": [301], "normalize": "none"}),
                *_GROUP[1:],
            ),
        ),
    )
}


def find_preset(name: str) -> Preset:
    """Return a preset by name.

    Raises
    ------
    ConfigError
        If there is none; the message lists those that exist.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown anatomy '{name}'{did_you_mean(name, PRESETS)}")
    return PRESETS[name]
