"""The page of a patient brought into a finished model: distance maps, coefficients with their uncertainty, how usual the shape is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from ssmpipe.core.arrays import Floats
from ssmpipe.core.evaluation.quality import Geometry
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.report.build import assemble
from ssmpipe.report.figures import AFTER, BEFORE, BONE, SIGNED, SIGNED_STOPS, figure, png_uri, ramp_uri, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.payload import in_space, quantized, quantized_map, viewer_payload
from ssmpipe.report.raster import thinned
from ssmpipe.report.section import Section
from ssmpipe.report.sections.modes import nice_ceiling
from ssmpipe.report.sections.summary import Tile
from ssmpipe.report.sections.viewer import looks_from
from ssmpipe.report.solid import good_view, picture, view_axes
from ssmpipe.report.wording import count, number

_BARS = 20
_CELLS, _ENOUGH = 150, 20_000
INDEX = "index.html"
"""Name of the page that lists all patients, beside theirs."""
WORDS = ("mean", "median", "p95", "max")


@dataclass(frozen=True, eq=False)
class ProjectedPage:
    """What the page of one projected patient shows.

    Parameters
    ----------
    id, file, side, unit, version, model_name : str
        ``side`` may be empty; ``unit`` of the lengths.
    numbers : mapping
        What ``projection.json`` says.
    model : ShapeModel
    points : (n_P, d)
        Corresponded (or completed) points in the frame of the model.
    reconstruction : (n_P, d), optional
        The nearest instance of the model; absent where the scan was completed.
    map_name, map_values : str and (n_P,), optional
        One number per point.
    scan, scan_distance : Geometry and (n,), optional
        The prepared scan in the frame of the model, its signed distance from the reconstruction.
    mahalanobis, residuals : (n_S,)
        Of the training shapes, each in the model of the others.
    matrix : (4, 4)
        From the scan to the frame of the model.
    warnings : sequence of (str, str)
        Stage and sentence.
    """

    id: str
    file: str
    side: str
    unit: str
    version: str
    model_name: str
    numbers: Mapping[str, Any]
    model: ShapeModel
    points: Floats
    mahalanobis: Floats
    residuals: Floats
    matrix: Floats
    reconstruction: Floats | None = None
    map_name: str = ""
    map_values: Floats | None = None
    scan: Geometry | None = None
    scan_distance: Floats | None = None
    warnings: Sequence[tuple[str, str]] = ()

    @property
    def is_part(self) -> bool:
        """Whether the scan was a fragment that the model completed."""
        return self.reconstruction is None


def build_projected(page: ProjectedPage) -> str:
    """Return the page as one HTML document that works offline; the same input gives the same text."""
    sections = [_summary(page), _viewer(page), _scan(page), _coefficients(page), _distances(page), _origin(page)]
    return assemble(
        name=page.id,
        about=f"A {'part of a shape, completed by' if page.is_part else 'shape in'} the model {page.model_name} of "
        f"{count(len(page.model.ids), 'shape')}",
        version=page.version,
        sections=[section for section in sections if section is not None],
        kind="Projected patient",
        links=[(INDEX, "All patients of this call")],
    )


def _summary(page: ProjectedPage) -> Section:
    told, unit = page.numbers, page.unit
    tiles = [
        Tile(
            number(told["mahalanobis"]),
            "Mahalanobis distance",
            f"p {number(told['mahalanobis_p'], 2)}: share of the model's shapes that lie as far out",
            "bad" if told["mahalanobis_p"] <= 1 / (len(page.mahalanobis) + 1) else "",
        )
    ]
    if told.get("residual_rms_mm") is not None:
        remark = f"what no instance reaches, root mean square; p {number(told['residual_p'], 2)}"
        tiles.append(Tile(f"{number(told['residual_rms_mm'])} {unit}", "residual", remark))
    if is_number(told.get("from_scan_mean_mm")):
        remark = f"95 % within {number(told['from_scan_p95_mm'])}, largest {number(told['from_scan_max_mm'])}"
        name = "fragment to the completed surface" if page.is_part else "scan to its reconstruction, mean"
        tiles.append(Tile(f"{number(told['from_scan_mean_mm'])} {unit}", name, remark))
    if page.is_part:
        tiles.append(Tile(f"{100 * told['seen_share']:.0f} %", "of the surface was seen"))
        if is_number(told.get("expected_error_mm")):
            remark = "root mean square, from training shapes with the same part hidden"
            tiles.append(
                Tile(f"{number(told['expected_error_mm'])} {unit}", "expected error of the missing part", remark)
            )
        if told.get("holes_left"):
            tiles.append(Tile(str(told["holes_left"]), "holes left open", "", "bad"))
    else:
        entry = told["certificate"]
        tone = {"proved": "good", "refuted": "bad"}.get(entry["status"], "")
        tiles.append(Tile(entry["status"], "one-to-one", f"area factor at least {number(entry['lower_bound'])}", tone))
    tiles.append(Tile(str(len(page.warnings)), "warning" if len(page.warnings) == 1 else "warnings"))
    html = fill("patient_summary.html.j2", failure=None, tiles=tiles, warnings=page.warnings, file=page.file)
    return Section("summary", "Summary", html)


def is_number(value: Any) -> bool:
    """Whether a value of ``projection.json`` is there and finite."""
    return value is not None and bool(np.isfinite(value))


def _viewer(page: ProjectedPage) -> Section:
    model = page.model
    bare = replace(model, modes=model.modes[:0], variances=model.variances[:0], scores=np.zeros((0, 0)))
    planar, flat = model.mean.shape[1] == 2, len(model.faces) == 0
    look = (-90.0, 89.0 if planar else 0.0) if flat else good_view(in_space(model.mean), model.faces)
    payload = viewer_payload(bare, look=look, unit=page.unit)
    names = [f"{page.id}, completed" if page.is_part else page.id]
    shapes = [quantized(page.points)]
    if page.reconstruction is not None:
        names.append(f"{page.id}, nearest instance of the model")
        shapes.append(quantized(page.reconstruction))
    maps = [] if page.map_values is None else [{**quantized_map("map", page.map_values), "signed": not page.is_part}]
    payload |= {"colours": list(SIGNED_STOPS), "bone": BONE, "shapes": shapes, "maps": maps}
    html = fill(
        "projected_viewer.html.j2",
        payload=payload,
        looks=looks_from(*look),
        flat=flat,
        names=names,
        map_name=page.map_name if maps else "",
        is_part=page.is_part,
    )
    return Section("shape", "The outline" if planar else "The shape in 3-D", html)


def _scan(page: ProjectedPage) -> Section | None:
    scan, distance = page.scan, page.scan_distance
    if scan is None or distance is None or scan.cells.shape[1] != 3 or not len(distance):
        return None
    limit = nice_ceiling(float(np.quantile(np.abs(distance), 0.99)))
    colours = np.asarray(SIGNED(np.clip(0.5 + distance / limit / 2, 0, 1)))[:, :3]
    points, cells = scan.points, scan.cells
    if len(points) > _ENOUGH:
        kept, cells = thinned(points, cells, scan.diagonal / _CELLS)
        points, colours = points[kept], colours[kept]
    first = good_view(points, cells)
    shots = []
    for name, turn in (("one side", 0.0), ("the other side", 180.0)):
        view = (first[0] + turn, first[1])
        axes = view_axes(*view)[:2]
        seen = points @ axes.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        shot = picture(
            points, cells, view=view, centre=(low + high) / 2 @ axes, radius=0.53 * float((high - low).max()),
            colours=colours, inches=3.2, dpi=100,
        )  # fmt: skip
        shots.append((name, png_uri(shot)))
    beyond = float(page.numbers.get("beyond_share") or 0.0)
    html = fill(
        "projected_scan.html.j2", shots=shots, ramp=ramp_uri(), limit=f"{limit:g}", unit=page.unit, is_part=page.is_part,
        beyond=f"{100 * beyond:.0f}" if beyond > 0.005 else "",
    )  # fmt: skip
    return Section("scan", "The scan and what the model makes of it", html)


def _coefficients(page: ProjectedPage) -> Section:
    scores = np.asarray(page.numbers["scores"], dtype=np.float64)
    deviations = np.asarray(page.numbers["deviations"], dtype=np.float64)
    share = page.model.variances / max(float(page.model.variances.sum()), 1e-300)
    n = len(scores)
    usual, far = float(np.sqrt(chi2.median(n))), float(np.sqrt(chi2.ppf(0.95, n)))
    html = fill(
        "projected_coefficients.html.j2",
        plot=_bars(scores[:_BARS], deviations[:_BARS]),
        rows=list(zip(range(1, n + 1), scores.tolist(), deviations.tolist(), share.tolist(), strict=True)),
        n_bars=min(n, _BARS),
        strip=_strip(float(page.numbers["mahalanobis"]), page.mahalanobis, usual, far),
        distance=float(page.numbers["mahalanobis"]),
        p=float(page.numbers["mahalanobis_p"]),
        usual=usual,
        far=far,
        training=(float(np.median(page.mahalanobis)), float(page.mahalanobis.max())),
        n_training=len(page.mahalanobis),
        n_modes=n,
    )
    return Section("coefficients", "Coefficients, and how usual the shape is", html)


def _bars(scores: Floats, deviations: Floats) -> str:
    with style():
        made = figure(5.6, 2.3)
        made.subplots_adjust(left=0.1, right=0.99, bottom=0.22, top=0.96)
        axes = made.subplots()
        at = np.arange(1, len(scores) + 1)
        axes.bar(at, scores, color=AFTER, width=0.6)
        axes.errorbar(at, scores, yerr=deviations, fmt="none", ecolor="#1c2733", elinewidth=1.1, capsize=2.5)
        axes.axhline(0, color="#66727f", linewidth=0.8)
        reach = max(3.0, 1.05 * float((np.abs(scores) + deviations).max(initial=0.0)))
        axes.set(xlabel="mode", ylabel="σ", ylim=(-reach, reach), xticks=at)
        return svg_uri(made)


def _strip(distance: float, training: Floats, usual: float, far: float) -> str:
    with style():
        made = figure(5.6, 1.5)
        made.subplots_adjust(left=0.03, right=0.99, bottom=0.34, top=0.84)
        axes = made.subplots()
        axes.axvspan(0, far, color="#e7ebef", zorder=0)
        axes.axvline(usual, color=BEFORE, linewidth=1.2, linestyle="--")
        heights = np.resize([0.25, 0.5, 0.75], len(training))
        axes.plot(np.sort(training), heights, "o", color=BEFORE, markersize=5)
        axes.axvline(distance, color="#c4421d", linewidth=2.2)
        axes.set(xlabel="Mahalanobis distance [σ]", ylim=(0, 1), yticks=[])
        axes.set_xlim(0, 1.1 * max(distance, far, float(training.max(initial=0.0))))
        return svg_uri(made)


def _distances(page: ProjectedPage) -> Section | None:
    told = page.numbers
    blocks = [
        ("from the scan to the reconstruction", "from_scan"),
        ("from the reconstruction to the scan", "to_scan"),
    ]
    if page.is_part:
        blocks = [
            ("from the fragment to the completed surface", "from_scan"),
            ("from the seen points to the fragment", "to_scan"),
        ]
    rows = [(title, [told.get(f"{key}_{word}_mm") for word in WORDS]) for title, key in blocks]
    rows = [(title, values) for title, values in rows if all(is_number(v) for v in values)]
    usual = float(np.median(page.residuals)) if len(page.residuals) else None
    if not rows:
        return None
    html = fill(
        "projected_distances.html.j2",
        rows=rows, words=WORDS, unit=page.unit, residual=told.get("residual_rms_mm"), usual=usual,
    )  # fmt: skip
    return Section("distances", "Distances", html)


def _origin(page: ProjectedPage) -> Section:
    determinant = float(np.linalg.det(page.matrix[:3, :3]))
    html = fill(
        "patient_origin.html.j2",
        file=page.file,
        info={"side": page.side} if page.side else {},
        matrix=[[f"{x:.6g}".replace("-", "−") for x in line] for line in np.asarray(page.matrix).tolist()],
        mirrored=determinant < 0,
        factor=number(abs(determinant) ** (1 / 3), 6),
        in_model=True,
        unit=page.unit,
    )
    return Section("origin", "Scan and transform", html)
