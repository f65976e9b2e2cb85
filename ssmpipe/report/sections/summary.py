"""What was run and what came out, in plain words."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmpipe.report.figures import png_uri
from ssmpipe.report.page import fill
from ssmpipe.report.payload import in_space
from ssmpipe.report.section import ReportData, Section, by_correspondence, to_float
from ssmpipe.report.sections.landmarks import OVERALL
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
    tone = "bad" if statuses["refuted"] else "good" if proved == len(shapes) else ""
    tile = Tile(f"{proved} of {len(shapes)}", "proved one-to-one", f"smallest local area factor {number(lowest)}", tone)
    if statuses["refuted"]:
        folded = ", ".join(sorted(key for key, entry in shapes.items() if entry.get("status") == "refuted"))
        return tile, f"The map folds over on {folded}: do not use these shapes, and treat the model with care."
    if proved == len(shapes):
        return tile, (
            "On every shape the map between the surfaces is proved to be one-to-one: no part of a surface is used twice, none is "
            "left out. This is a bound over the whole surface, not a sample of it."
        )
    return tile, f"For {count(len(shapes) - proved, 'shape')} it is not decided whether the map is one-to-one."


def _measure(data: ReportData, name: str, n_modes: int) -> dict[str, float]:
    found = {}
    for group in by_correspondence(data.measures):
        for m, value in zip(group.columns.get("n_modes", ()), group.columns.get(name, ()), strict=False):
            if m == n_modes:
                found[group.name] = value
    return found


def _measure_tile(data: ReportData, name: str, n_modes: int, title: str) -> list[Tile]:
    found = _measure(data, name, n_modes)
    if "optimized" not in found:
        return []
    before, after = found.get("initial", math.nan), found["optimized"]
    tone = "good" if after < before else "bad" if after > before else ""
    remark = f"was {number(before)} before optimization" if math.isfinite(before) else ""
    return [Tile(f"{number(after)} {data.unit}", title, remark, tone)]


def render(data: ReportData) -> Section:
    """Return the summary: failures first, then key numbers and what they mean."""
    c, model = data.correspondence, data.model
    verdict, verdict_text = _verdict(data)
    failed = {key: data.failures[key] for key in sorted(data.failures)}
    n_given = max(len(data.shapes), len(c.ids) + len(failed))
    tiles = [
        Tile(
            f"{len(c.ids)} of {n_given}",
            "shapes in the model",
            "" if failed else "none was set aside",
            "bad" if failed else "good",
        ),
        verdict,
    ]
    before, after = (float(x) for x in c.description_length)
    tiles.append(
        Tile(
            number(after, 4),
            "description length",
            f"{change(before, after)} (was {number(before, 4)})",
            "good" if after < before else "bad",
        )
    )
    few = min(max(modes_for(data, 0.9), 1), max(len(model.variances), 1))
    tiles += _measure_tile(data, "generalization", few, f"error on an unseen shape, {count(few, 'mode')}")
    tiles += _transfer_tile(data)
    sentences = [
        f"{count(len(c.ids), 'shape')} {'were' if len(c.ids) != 1 else 'was'} brought into correspondence at {number(model.mean.shape[0])} "
        "points each: point number k lies at the same anatomical place on all of them."
    ]
    if verdict_text:
        sentences.append(verdict_text)
    if len(model.variances):
        share = float(model.variances[0] / model.variances.sum()) if model.variances.sum() > 0 else math.nan
        sentences.append(
            f"The first mode of variation holds {percent(share)} of all differences in shape, "
            f"90 % are held by {count(modes_for(data, 0.9), 'mode')}, 95 % by {count(modes_for(data, 0.95), 'mode')}."
        )
    found = _measure(data, "generalization", few)
    if "optimized" in found:
        sentences.append(
            f"A shape that the model has never seen is reproduced by {count(few, 'mode')} with a typical error of "
            f"{number(found['optimized'])} {data.unit} per point."
        )
    warned = _warnings(data)
    if warned:
        sentences.append(
            f"{count(warned, 'warning')} {'was' if warned == 1 else 'were'} given on the way, listed with the shapes."
        )
    return Section(
        "summary",
        "Summary",
        fill(
            "summary.html.j2",
            tiles=tiles,
            sentences=sentences,
            failed=failed,
            missing=_missing(data),
            mean=_mean_picture(data),
        ),
    )


def _transfer_tile(data: ReportData) -> list[Tile]:
    table = data.landmark_transfer
    if table is None or "landmark" not in table.columns or "correspondence" not in table.columns:
        return []
    mean = next((key for key in table.columns if key.startswith("mean")), None)
    marks = [str(mark).lower() for mark in table.columns["landmark"]]
    if mean is None or not set(marks) & set(OVERALL):
        return []
    found = {
        str(name): to_float(value)
        for mark, name, value in zip(marks, table.columns["correspondence"], table.columns[mean], strict=True)
        if mark in OVERALL
    }
    if "optimized" not in found:
        return []
    before, after = found.get("initial", math.nan), found["optimized"]
    remark = f"was {number(before)} before optimization" if math.isfinite(before) else ""
    return [
        Tile(f"{number(after)} {data.unit}", "landmark transfer, mean", remark, "good" if after < before else "bad")
    ]


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


def _missing(data: ReportData) -> list[str]:
    known = set(data.correspondence.ids) | set(data.failures)
    return [key for key in data.shapes if key not in known]
