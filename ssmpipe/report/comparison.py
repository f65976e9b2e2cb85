"""The page of a comparison of groups: one HTML file that asks nothing of the network."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.statistics.comparison import Comparison, JointTest, Pair, Sample
from ssmpipe.report.build import assemble
from ssmpipe.report.figures import (
    BONE,
    CATEGORIES,
    MARKS,
    SIGNED,
    SIGNED_STOPS,
    figure,
    png_uri,
    ramp_uri,
    style,
    svg_uri,
)
from ssmpipe.report.page import fill
from ssmpipe.report.payload import viewer_payload
from ssmpipe.report.section import Section
from ssmpipe.report.sections.modes import nice_ceiling
from ssmpipe.report.sections.summary import Tile
from ssmpipe.report.solid import picture, vertex_normals, view_axes
from ssmpipe.report.wording import count, number, percent

REFERENCES = (
    "Anderson MJ. A new method for non-parametric multivariate analysis of variance. Austral Ecol 26:32-46, 2001.",
    "Benjamini Y, Hochberg Y. Controlling the false discovery rate. J R Stat Soc B 57:289-300, 1995.",
    "Freedman D, Lane D. A nonstochastic interpretation of reported significance levels. J Bus Econ Stat 1:292-298, 1983.",
    "Haufe S et al. On the interpretation of weight vectors of linear models in multivariate neuroimaging. NeuroImage 87:96-110, 2014.",
    "Holm S. A simple sequentially rejective multiple test procedure. Scand J Stat 6:65-70, 1979.",
    "Horn JL. A rationale and test for the number of factors in factor analysis. Psychometrika 30:179-185, 1965.",
    "Ledoit O, Wolf M. A well-conditioned estimator for large-dimensional covariance matrices. J Multivar Anal 88:365-411, 2004.",
    "Li K. Direct diffeomorphic reparameterization for correspondence optimization in statistical shape modeling. PhD thesis, Illinois "
    "Institute of Technology, 2015.",
    "Westfall PH, Young SS. Resampling-based multiple testing. Wiley, 1993.",
    "Winkler AM et al. Permutation inference for the general linear model. NeuroImage 92:381-397, 2014.",
    "Winkler AM et al. Multi-level block permutation. NeuroImage 123:253-268, 2015.",
)


@dataclass(frozen=True, eq=False)
class ComparisonPage:
    """What the page shows.

    Parameters
    ----------
    title : str
    version : str
    groups : tuple of str
    sample : Sample
    comparison : Comparison
    model : ShapeModel
        Grid, faces and topology.
    unit : str
        Of lengths.
    alpha : float
        Level of the tests and false discovery rate.
    n_permutations : int
    covariates : tuple of str
    notes : sequence of str
        What a reader must know before the numbers.
    """

    title: str
    version: str
    groups: tuple[str, ...]
    sample: Sample
    comparison: Comparison
    model: ShapeModel
    unit: str
    alpha: float
    n_permutations: int
    covariates: tuple[str, ...]
    notes: Sequence[str]

    def named(self, pair: Pair) -> str:
        """Return "second − first" by name."""
        return f"{self.groups[pair.second]} − {self.groups[pair.first]}"


def build_comparison(page: ComparisonPage) -> str:
    """Return the page as one HTML document; the same input gives the same text."""
    shapes, subjects = len(page.sample.labels), len(np.unique(page.sample.subjects))
    about = f"{count(shapes, 'shape')} of {count(subjects, 'subject')}, {number(len(page.comparison.mean))} points each"
    sections = [_summary(page), _maps(page), _viewer(page), _tests(page), _modes(page), _sorting(page), _methods(page)]
    return assemble(
        name=page.title[:1].upper() + page.title[1:],
        about=about,
        version=page.version,
        sections=[section for section in sections if section is not None],
        kind="Comparison of groups",
    )


def p_value(p: float) -> str:
    """Return a p value as a reader wants it.

    Examples
    --------
    >>> p_value(0.03217), p_value(0.00009999), p_value(1e-12), p_value(float("nan"))
    ('0.032', '0.0001', '< 0.0001', '–')
    """
    if not math.isfinite(p):
        return "–"
    if p < 0.00005:
        return "< 0.0001"
    return f"{p:.3f}" if p >= 0.01 else f"{p:.4f}"


def _equals(p: float) -> str:
    return f"p {p_value(p)}" if p_value(p).startswith("<") else f"p = {p_value(p)}"


def _summary(page: ComparisonPage) -> Section:
    found, alpha = page.comparison, page.alpha
    sizes = np.bincount(page.sample.labels)
    tiles = [
        Tile(str(n), name, f"of {count(page.sample.subjects_of(g), 'subject')}")
        for g, (n, name) in enumerate(zip(sizes.tolist(), page.groups, strict=True))
    ]
    tiles += [
        Tile(_equals(found.joint.p), "all modes together", f"{count(found.joint.n_dimensions, 'mode')}"),
        Tile(_equals(found.p_anywhere), "anywhere on the surface", "largest of all points, family-wise"),
    ]
    sentences = [_in_words(page, found.joint)]
    if page.comparison.p_anywhere <= alpha:
        sentences.append(
            f"Somewhere the groups differ locally (p = {p_value(found.p_anywhere)}, corrected for all points); the maps show where."
        )
    else:
        sentences.append(
            f"No single place is shown to differ (p = {p_value(found.p_anywhere)}, corrected for all points)."
        )
    if len(found.pairs) == 1:
        pair = found.pairs[0]
        if pair.distance is not None:
            low, high = float(pair.distance.min()), float(pair.distance.max())
            sentences.append(
                f"Along the normals of the mean, the mean of {page.groups[1]} lies between {number(low)} and {number(high)} {page.unit} "
                f"from the mean of {page.groups[0]} (positive: outside)."
            )
        tiles.append(
            Tile(f"{number(pair.mahalanobis)} σ", "apart (Mahalanobis)", "means, by the variation inside the groups")
        )
    sorting = found.classification
    tiles.append(
        Tile(
            percent(sorting.accuracy),
            "of unseen subjects sorted rightly",
            f"{percent(sorting.low)} to {percent(sorting.high)}",
        )
    )
    html = fill("compare_summary.html.j2", tiles=tiles, sentences=sentences, notes=list(page.notes))
    return Section("summary", "Summary", html)


def _in_words(page: ComparisonPage, joint: JointTest) -> str:
    held = percent(float(page.comparison.variances[: joint.n_dimensions].sum() / page.comparison.variances.sum()))
    where = f"in the {count(joint.n_dimensions, 'mode')} with {held} of the variation"
    if joint.p <= page.alpha:
        return f"Taken together, {where}, the groups differ (p = {p_value(joint.p)})."
    return (
        f"Taken together, {where}, no difference is shown (p = {p_value(joint.p)}). That is no proof that there is none: a small sample "
        "shows large differences only."
    )


def _maps(page: ComparisonPage) -> Section | None:
    flat = not len(page.model.faces)
    rows = []
    for pair in page.comparison.pairs:
        if pair.distance is None or pair.along_normal is None:
            return None
        significant = pair.along_normal.q <= page.alpha
        limit = nice_ceiling(float(np.quantile(np.abs(pair.distance), 0.995)))
        pictures = _outlines(page, pair, significant) if flat else _surfaces(page, pair, significant, limit)
        rows.append(
            {
                "title": page.named(pair),
                "rms": number(float(np.sqrt((pair.distance**2).mean()))),
                "lowest": number(float(pair.distance.min())),
                "highest": number(float(pair.distance.max())),
                "share": percent(float(significant.mean())),
                "family": percent(float((pair.along_normal.p_family <= page.alpha).mean())),
                "limit": f"{limit:g}",
                "pictures": pictures,
            }
        )
    html = fill("compare_maps.html.j2", rows=rows, unit=page.unit, ramp=ramp_uri(), flat=flat, alpha=f"{page.alpha:g}")
    return Section("maps", "Where the groups differ", html)


def best_view(points: Floats, faces: np.ndarray, weight: Floats) -> tuple[float, float]:
    """Return azimuth and elevation [degrees] from which most of ``weight`` (n_P,) is seen from the front."""
    normals = vertex_normals(points, faces)
    candidates = [(float(a), e) for e in (12.0, 45.0, -25.0) for a in range(-180, 180, 30)]
    seen = [float(weight @ np.maximum(normals @ view_axes(*view)[2], 0)) for view in candidates]
    return candidates[int(np.argmax(np.round(np.array(seen) / (max(seen) or 1.0), 6)))]


def difference_pictures(
    points: Floats, faces: np.ndarray, distance: Floats, significant: Bools, limit: float, inches: float = 2.2
) -> list[tuple[str, np.ndarray]]:
    """Return the map from the side where it is strongest and from the opposite one, whole and where it is significant."""
    azimuth, elevation = best_view(points, faces, distance**2)
    views = {"strongest side": (azimuth, elevation), "opposite side": (azimuth + 180.0, elevation)}
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = 1.02 * float(np.linalg.norm(points - centre, axis=1).max())
    colours = SIGNED(Normalize(-limit, limit)(distance))[:, :3]
    masked = np.where(significant[:, None], colours, to_rgb(BONE))
    return [
        (name if chosen is colours else f"{name}, significant only", picture(
            points, faces, view=view, centre=centre, radius=radius, colours=chosen, inches=inches
        ))
        for chosen in (colours, masked)
        for name, view in views.items()
    ]  # fmt: skip


def _surfaces(page: ComparisonPage, pair: Pair, significant: Bools, limit: float) -> list[tuple[str, str]]:
    base = page.comparison.group_means[pair.first]
    drawn = difference_pictures(base, page.model.faces, np.asarray(pair.distance), significant, limit)
    return [(name, png_uri(pixels)) for name, pixels in drawn]


def outline_figure(page: ComparisonPage, pair: Pair, significant: Bools) -> Figure:
    """Draw the mean outlines of two groups, thick where they differ."""
    closed = page.model.topology == "curve-closed"
    with style():
        made = figure(5.2, 4.6)
        panel = made.add_axes((0.02, 0.1, 0.96, 0.88))
        for group in (pair.first, pair.second):
            points = page.comparison.group_means[group]
            ring = np.concatenate([points, points[:1]]) if closed else points
            panel.plot(ring[:, 0], ring[:, 1], color=CATEGORIES[group], linewidth=1.1, label=page.groups[group])
            strong = np.concatenate([significant, significant[:1]]) if closed else significant
            thick = np.where((strong[:-1] & strong[1:])[:, None], 0.0, np.nan)
            for k in np.flatnonzero(np.isfinite(thick[:, 0])):
                panel.plot(ring[k : k + 2, 0], ring[k : k + 2, 1], color=CATEGORIES[group], linewidth=3.6)
        panel.set_aspect("equal")
        panel.set_axis_off()
        handles, names = panel.get_legend_handles_labels()
        made.legend(handles, names, loc="lower center", ncols=2)
        return made


def _outlines(page: ComparisonPage, pair: Pair, significant: Bools) -> list[tuple[str, str]]:
    return [("thick: significant", svg_uri(outline_figure(page, pair, significant)))]


def _viewer(page: ComparisonPage) -> Section | None:
    if not len(page.model.faces):
        return None
    means, pairs = page.comparison.group_means, page.comparison.pairs
    steps = list(means[1:] - means[0])
    walk = len(pairs) == 1
    if walk:
        steps.append(pairs[0].discriminant.step)
    rows = np.eye(len(means) - 1, len(steps))
    model = replace(
        page.model,
        ids=page.groups[1:],
        mean=means[0],
        modes=np.array(steps),
        variances=np.ones(len(steps)),
        scores=rows,
    )
    weight = np.abs(np.asarray(pairs[0].distance)) ** 2 if pairs[0].distance is not None else np.ones(len(means[0]))
    azimuth, elevation = best_view(means[0], page.model.faces, weight)
    payload = viewer_payload(model, look=(azimuth, elevation), unit=page.unit)
    payload |= {"colours": list(SIGNED_STOPS), "bone": BONE}
    looks = {
        "Start": (azimuth, elevation),
        "Left": (azimuth - 90, elevation),
        "Right": (azimuth + 90, elevation),
        "Behind": (azimuth + 180, elevation),
        "Above": (azimuth, 88.0),
        "Below": (azimuth, -88.0),
    }
    html = fill(
        "compare_viewer.html.j2",
        payload=payload,
        groups=page.groups,
        walk=len(steps) - 1 if walk else None,
        reach="5",
        looks=looks,
    )
    return Section("viewer-section", "The means in 3-D", html)


def _tests(page: ComparisonPage) -> Section:
    found = page.comparison
    header = ["Groups", "modes", "Hotelling T²", "p", "p by F", "whole shape: p", "anywhere: p"]
    rows = []
    if len(found.pairs) > 1:
        header.insert(4, "p, Holm")
        rows.append(["all", *_test_cells(found.joint, found.whole.p, found.p_anywhere, "–")])
    for pair, holm in zip(found.pairs, found.p_holm, strict=True):
        cells = _test_cells(pair.joint, pair.whole.p, pair.p_anywhere, p_value(float(holm)))
        if len(found.pairs) == 1:
            cells.pop(3)
        rows.append([page.named(pair), *cells])
    note = (
        "Three questions. Modes: do the means differ in the kept modes together (Mahalanobis distance, differences of any kind)? Whole "
        "shape: do they differ by plain distance, where large modes count most? Anywhere: does some point differ along the normal "
        "(sees small local differences)? Decide before the study which one is yours; the smallest of three is no p value. "
        "p by F supposes independent, normally distributed shapes and stands here for comparison only."
    )
    tables = [{"title": "Tests of the means", "header": header, "rows": rows, "note": note}]
    return Section("tests", "Tests", fill("compare_tables.html.j2", tables=tables, lead="", plot="", plot_text=""))


def _test_cells(joint: JointTest, whole: float, anywhere: float, holm: str) -> list[str]:
    t2 = number(joint.t_squared) if math.isfinite(joint.t_squared) else "–"
    return [
        str(joint.n_dimensions),
        t2,
        p_value(joint.p),
        holm,
        p_value(joint.p_parametric),
        p_value(whole),
        p_value(anywhere),
    ]


def _modes(page: ComparisonPage) -> Section:
    found = page.comparison
    shares = found.variances / found.variances.sum()
    tests = found.mode_tests
    header = ["Mode", "variance", *(f"mean of {name} [σ]" for name in page.groups)]
    two = len(found.pairs) == 1
    header += ["Hedges' g", "95 % interval"] if two else []
    header += ["p", "q", "p, family-wise", "p of the joint test up to here"]
    rows = []
    for m in range(found.count.kept):
        row = [f"mode {m + 1}", percent(float(shares[m]), 1), *(number(float(x), 2) for x in tests.means[:, m])]
        if two:
            effects = found.pairs[0].effects
            row += [
                number(float(effects.g[m]), 2),
                f"{number(float(effects.low[m]), 2)} to {number(float(effects.high[m]), 2)}",
            ]
        rows.append([*row, *(p_value(float(x[m])) for x in (tests.p, tests.q, tests.p_family, tests.p_joint))])
    kept = found.count
    note = (
        f"{count(kept.kept, 'mode')} kept. {count(kept.by_parallel_analysis, 'mode')} above shuffled data (parallel analysis), "
        f"{kept.by_variance} for 98 % of the variance, {kept.allowed} is a third of the degrees of "
        "freedom, the most that is taken unasked. "
        "The last column tells how much hangs on that number. q: false discovery rate."
    )
    html = fill(
        "compare_tables.html.j2",
        lead="",
        plot=svg_uri(scores_figure(page)),
        plot_text="Scatter of the scores of the first modes by group; the numbers are in shapes.csv.",
        tables=[{"title": "Each mode alone", "header": header, "rows": rows, "note": note}],
    )
    return Section("modes", "Modes and scores", html)


def scores_figure(page: ComparisonPage) -> Figure:
    """Draw the scores of the shapes by group: the first modes, and the discriminant of two groups."""
    found, labels = page.comparison, page.sample.labels
    scores = found.scores
    two = len(found.pairs) == 1
    with style():
        made = figure(9.6, 3.6)
        made.subplots_adjust(left=0.06, right=0.99, bottom=0.25, top=0.9, wspace=0.25)
        panels = made.subplots(1, 3 if two else 2)
        for panel, (a, b) in zip(panels[:2], ((0, 1), (0, 2)), strict=True):
            if scores.shape[1] <= b:
                panel.set_axis_off()
                continue
            for g, name in enumerate(page.groups):
                mine = scores[labels == g]
                panel.scatter(
                    mine[:, a],
                    mine[:, b],
                    s=20,
                    color=CATEGORIES[g],
                    marker=MARKS[g],
                    alpha=0.75,
                    linewidths=0,
                    label=name,
                )
                panel.plot(
                    *mine[:, [a, b]].mean(axis=0), marker="+", markersize=13, markeredgewidth=2.2, color=CATEGORIES[g]
                )
            panel.set(xlabel=f"mode {a + 1} [σ]", ylabel=f"mode {b + 1} [σ]")
        panels[0].set_title("Scores (+: group means)")
        if two:
            values = found.pairs[0].discriminant.scores
            steps = np.linspace(values.min(), values.max(), 17)
            for g in range(2):
                panels[2].hist(values[labels == g], bins=list(steps), color=CATEGORIES[g], alpha=0.6)
            panels[2].set(xlabel="discriminant [σ inside the groups]", ylabel="shapes")
            panels[2].set_title("Discriminant (same shapes)")
        handles, names = panels[0].get_legend_handles_labels()
        made.legend(handles, names, loc="lower center", ncols=min(len(names), 6))
        return made


def scores_png(page: ComparisonPage) -> bytes:
    """Return the scores plot as a PNG file."""
    buffer = io.BytesIO()
    with style():
        scores_figure(page).savefig(buffer, format="png", dpi=150, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def _sorting(page: ComparisonPage) -> Section:
    found = page.comparison
    header = ["Groups", "sorted rightly", "95 % interval", "balanced", "by chance", "Mahalanobis", "shrinkage"]
    rows: list[list[Any]] = []
    for pair in found.pairs:
        one = pair.classification
        rows.append(
            [
                page.named(pair),
                percent(one.accuracy),
                f"{percent(one.low)} to {percent(one.high)}",
                percent(one.balanced),
                percent(0.5),
                f"{number(pair.mahalanobis)} σ",
                number(pair.discriminant.shrinkage, 2),
            ]
        )
    if len(found.pairs) > 1:
        one = found.classification
        chance = percent(1 / len(page.groups))
        rows.append(
            [
                "all",
                percent(one.accuracy),
                f"{percent(one.low)} to {percent(one.high)}",
                percent(one.balanced),
                chance,
                "–",
                "–",
            ]
        )
    note = (
        "Each subject was sorted by a linear discriminant made without any shape of that subject; every "
        "subject counts once. Balanced is the "
        "mean of the groups' shares; chance refers to it. The plot above shows the shapes that the discriminant was made from: they look "
        "better separated than new ones are."
    )
    tables = [{"title": "Sorting of subjects that were not seen", "header": header, "rows": rows, "note": note}]
    return Section(
        "sorting",
        "Can the groups be told apart?",
        fill("compare_tables.html.j2", tables=tables, lead="", plot="", plot_text=""),
    )


def _many(n: int) -> str:
    return number(n) if n < 10**9 else "more than 10⁹"


def _methods(page: ComparisonPage) -> Section:
    found = page.comparison
    paired = found.pairs[0].pairs is not None
    moved = (
        "the signs of the differences of every subject were flipped at random"
        if paired
        else "group labels were rearranged at random; shapes of one subject stayed together, and only subjects with equally many shapes "
        "changed places"
    )
    sentences = [
        f"For all p values {moved} ({number(page.n_permutations)} times, seeded); there are "
        f"{_many(found.n_rearrangements)} different rearrangements. "
        "The observed one counts among them, so that no p value is zero.",
        "The joint test is Hotelling's T² (Pillai's trace for more than two groups) of the scores in "
        "the kept modes; the test of whole shapes "
        "compares sums of squared distances (Anderson 2001); point tests use the displacement along the "
        "normals of the mean of all shapes, "
        "and T² of the displacement in space. Points are corrected by Benjamini and Hochberg (q) and by the largest statistic of every "
        "rearrangement (family-wise; Westfall and Young 1993), pairs of groups by Holm.",
    ]
    if page.covariates:
        sentences.append(
            f"The effects of {', '.join(page.covariates)} were removed with one slope for all groups; "
            "residuals were rearranged (Freedman and "
            "Lane 1983), which keeps the level approximately, not exactly. Means are those at the average covariates."
        )
    sentences.append(
        "The walk along the discriminant shows the change of shape that goes with its score (Haufe et "
        "al. 2014), its covariance is shrunk "
        "(Ledoit and Wolf 2004). In cross-validation modes, covariates and covariance come from the other subjects only."
    )
    html = fill("compare_methods.html.j2", sentences=sentences, references=REFERENCES)
    return Section("methods", "Methods", html)
