"""The model in 3-D: sliders, patients, colour map, grid lines."""

from __future__ import annotations

import math

import numpy as np

from ssmpipe.report.figures import BONE, SIGNED_STOPS
from ssmpipe.report.page import fill
from ssmpipe.report.payload import cohort_columns, groups_of, in_space, landmark_places, viewer_payload
from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.solid import good_view
from ssmpipe.report.wording import percent

SHOWN = 8  # sliders before the rest is folded away


def render(data: ReportData) -> Section | None:
    """Return the interactive view, or nothing when the model has no mode."""
    model = data.model
    if len(model.modes) == 0:
        return None
    flat = len(model.faces) == 0
    azimuth, elevation = (-90.0, 0.0) if flat else good_view(in_space(model.mean), model.faces)
    if flat and model.mean.shape[1] == 2:
        azimuth, elevation = -90.0, 89.0
    groups = groups_of(cohort_columns(model.ids, data.shapes))
    marks = [data.landmarks.get(i) or {} for i in data.correspondence.ids]
    landmarks = landmark_places(data.correspondence.points, model.faces, model.topology, marks)
    payload = viewer_payload(model, look=(azimuth, elevation), unit=data.unit, groups=groups, landmarks=landmarks)
    payload |= {"colours": list(SIGNED_STOPS), "bone": BONE}
    n_modes = len(payload["modes"]["step"])
    shares = model.variances / (model.variances.sum() or 1.0)
    reach = max(3.0, math.ceil(10 * float(np.abs(model.scores).max(initial=0.0))) / 10)
    html = fill(
        "viewer.html.j2",
        payload=payload,
        modes=[{"index": k, "share": percent(float(shares[k]), 1)} for k in range(n_modes)],
        shown=SHOWN,
        left_out=len(model.modes) - n_modes,
        reach=f"{reach:g}",
        ids=model.ids,
        looks=looks_from(azimuth, elevation),
        flat=flat,
        unit=data.unit,
        groups=groups,
        columns=list(dict.fromkeys(group.column for group in groups)),
        landmarks=landmarks,
    )
    return Section("model", "The model in 3-D", html)


def looks_from(azimuth: float, elevation: float) -> dict[str, tuple[float, float]]:
    """Return the named directions of view around a first one, in degrees."""
    return {
        "Start": (azimuth, elevation),
        "Left": (azimuth - 90, elevation),
        "Right": (azimuth + 90, elevation),
        "Behind": (azimuth + 180, elevation),
        "Above": (azimuth, 88.0),
        "Below": (azimuth, -88.0),
    }
