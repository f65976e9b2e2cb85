"""What was run and what came out, in plain words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmpipe.report.figures import png_uri
from ssmpipe.report.page import fill
from ssmpipe.report.payload import in_space
from ssmpipe.report.section import ReportData, Section, to_float
from ssmpipe.report.sections.landmarks import OVERALL
from ssmpipe.report.sides import unchecked_sides
from ssmpipe.report.solid import good_view, picture, view_axes
from ssmpipe.report.wording import change, count, number, percent


@dataclass(frozen=True)
class Tile:
    """A key number: value, what it is, and a remark; ``tone`` is "good", "bad" or ""."""

    value: str
    name: str
    remark: str = ""
    tone: str = ""


def modes_for(data: ReportData, fraction: float) -> int:
    """Return how many modes hold ``fraction`` of the variance."""
    total = float(data.model.variances.sum())
    if total <= 0:
        return 0
    return int(np.searchsorted(np.cumsum(data.model.variances) / total, fraction - 1e-12) + 1)


def _verdict(data: ReportData) -> tuple[Tile, str]:
    shapes = data.certificate.get("shapes") or {}
    if not shapes:
        return Tile("–", "correspondence one-to-one", "no certificate in this run"), ""
    statuses = Counter(str(entry.get("status", "undecided")) for entry in shapes.values())
    proved = statuses["proved"]
    lowest = min((to_float(entry.get("lower_bound")) for entry in shapes.values()), default=math.nan)
    at_pole = refuted_poles(shapes)
    tone = "bad" if statuses["refuted"] or at_pole else "good" if proved == len(shapes) else ""
    remark = f"smallest area factor {number(lowest)}"
    if at_pole:
        remark = f"inside of the domain; not at a pole of {count(len(at_pole), 'shape')}, {remark}"
    tile = Tile(f"{proved} of {len(shapes)}", "proved one-to-one", remark, tone)
    if statuses["refuted"]:
        folded = ", ".join(sorted(key for key, entry in shapes.items() if entry.get("status") == "refuted"))
        return tile, f"The map folds over on {folded}: do not use these shapes, and treat the model with care."
    if proved == len(shapes) and at_pole:
        return tile, (
            "On every shape the map between the parameter domains is proved to be one-to-one. At a pole of "
            f"{', '.join(at_pole)} the surface itself is not proved to have one tangent plane and to run once around it: it may fold "
            "there, so look at the region around the pole before using these shapes."
        )
    if proved == len(shapes):
        return tile, (
            "On every shape the map between the surfaces is proved to be one-to-one: no part of a surface is used twice, none is "
            "left out. This is a bound over the whole surface, not a sample of it."
        )
    return tile, f"For {count(len(shapes) - proved, 'shape')} it is not decided whether the map is one-to-one."


def refuted_poles(shapes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the shapes of a certificate whose tangent plane at a pole is refuted.

    Examples
    --------
    >>> refuted_poles({"a": {"poles": [{"status": "proved"}, {"status": "refuted"}]}, "b": {"status": "proved"}})
    ['a']
    """
    return sorted(i for i, one in shapes.items() if any(p.get("status") != "proved" for p in one.get("poles") or ()))


def _before_after(columns: Mapping[str, Sequence[Any]], value: str, **where: Any) -> tuple[float, float] | None:
    """Value before and after optimization in the rows of a table that match ``where``; None when there is none after."""
    found = {
        str(columns["correspondence"][i]): to_float(columns[value][i])
        for i in range(len(columns.get("correspondence", ())))
        if value in columns and all(key in columns and columns[key][i] in wanted for key, wanted in where.items())
    }
    return (found.get("initial", math.nan), found["optimized"]) if "optimized" in found else None


def _length_tile(value: tuple[float, float], name: str, unit: str, remark: str = "") -> Tile:
    before, after = value
    was = f"was {number(before)} before" if math.isfinite(before) else ""
    tone = "good" if after < before else "bad" if after > before else ""
    return Tile(f"{number(after)} {unit}", name, "; ".join(text for text in (remark, was) if text), tone)


def render(data: ReportData) -> Section:
    """Return the summary: failures first, then key numbers and what they mean."""
    failed = {key: data.failures[key] for key in sorted(data.failures)}
    few = min(max(modes_for(data, 0.9), 1), max(len(data.model.variances), 1))
    unseen = _before_after(data.measures.columns, "generalization", n_modes=(few, str(few)))
    transfer = data.landmark_transfer.columns if data.landmark_transfer else {}
    carried = _before_after(transfer, next((key for key in transfer if key.startswith("mean")), ""), landmark=OVERALL)
    verdict, verdict_text = _verdict(data)
    before, after = (float(x) for x in data.correspondence.description_length)
    n_ok, n_given = len(data.correspondence.ids), max(len(data.shapes), len(data.correspondence.ids) + len(failed))
    tiles = [
        Tile(
            f"{n_ok} of {n_given}",
            "shapes in the model",
            "" if failed else "none was set aside",
            "bad" if failed else "good",
        ),
        verdict,
        Tile(
            number(after, 4),
            "description length",
            f"{change(before, after)}; was {number(before, 4)}",
            "good" if after < before else "bad",
        ),
    ]
    if unseen:
        tiles.append(_length_tile(unseen, "error on unseen shapes", data.unit, count(few, "mode")))
    if carried:
        tiles.append(_length_tile(carried, "landmark transfer, mean", data.unit))
    sentences = [
        f"{count(n_ok, 'shape')} {'was' if n_ok == 1 else 'were'} brought into correspondence at "
        f"{number(len(data.model.mean))} points each: a point of one shape and the point of the same number "
        "on any other are meant to lie at the same anatomical place.",
        verdict_text,
        _variation(data),
    ]
    if unseen:
        sentences.append(
            f"A shape that the model has never seen is reproduced by {count(few, 'mode')} with a typical error of "
            f"{number(unseen[1])} {data.unit} per point."
        )
    if carried:
        sentences.append(
            f"Marked landmarks that are carried from shape to shape land {number(carried[1])} {data.unit} from the marked ones on average"
            + (f"; before optimization it was {number(carried[0])} {data.unit}." if math.isfinite(carried[0]) else ".")
        )
    if note := _sides(data):
        sentences.append(f"{note}.")
    if warned := _warnings(data):
        sentences.append(
            f"{count(warned, 'warning')} {'was' if warned == 1 else 'were'} given on the way, listed with the shapes."
        )
    html = fill(
        "summary.html.j2",
        tiles=tiles,
        sentences=[sentence for sentence in sentences if sentence],
        failed=failed,
        missing=_missing(data),
        mean=_mean_picture(data),
    )
    return Section("summary", "Summary", html)


def _variation(data: ReportData) -> str:
    total = float(data.model.variances.sum())
    if not total > 0:
        return ""
    modes = {share: modes_for(data, share) for share in (0.9, 0.95)}
    first = f"The first mode of variation holds {percent(float(data.model.variances[0]) / total)} of all differences in shape"
    if modes[0.9] == modes[0.95]:
        return f"{first}; {percent(0.95)} are held by {count(modes[0.95], 'mode')}."
    return f"{first}; {percent(0.9)} are held by {count(modes[0.9], 'mode')}, {percent(0.95)} by {count(modes[0.95], 'mode')}."


def _mean_picture(data: ReportData) -> str:
    mean, faces = in_space(data.model.mean), data.model.faces
    if len(faces) == 0:
        return ""
    view = good_view(mean, faces)
    axes = view_axes(*view)[:2]
    flat = mean @ axes.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    centre, radius = (low + high) / 2 @ axes, 0.52 * float((high - low).max())
    return png_uri(picture(mean, faces, view=view, centre=centre, radius=radius, inches=2.4))


def _warnings(data: ReportData) -> int:
    stages: list[Any] = [stage for shape in data.shapes.values() for stage in shape.get("stages") or ()]
    stages += data.record.get("cohort_stages") or ()
    return sum(len(stage.get("warnings") or ()) for stage in stages)


def _sides(data: ReportData) -> str:
    config = data.record.get("config") or {}
    sides = [(shape.get("info") or {}).get("side") or None for shape in data.shapes.values()]
    return unchecked_sides(config.get("stages") or (), sides, config.get("anatomy"))


def _missing(data: ReportData) -> list[str]:
    known = set(data.correspondence.ids) | set(data.failures)
    return [key for key in data.shapes if key not in known]
