"""Compare groups of shapes, and write means, maps, tables, plots and a page about it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe import __version__
from ssmpipe.contract import Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.statistics.comparison import Comparison, JointTest, Options, Pair, compare_groups
from ssmpipe.core.statistics.covariates import allometry
from ssmpipe.core.statistics.effect_size import smallest_detectable
from ssmpipe.core.statistics.pointwise import PointTests
from ssmpipe.io.codecs import write_json
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import write_mesh
from ssmpipe.io.outlines import write_outline
from ssmpipe.io.tables import write_table
from ssmpipe.report.comparison import ComparisonPage, build_comparison, scores_png
from ssmpipe.runner.fingerprint import file_digest
from ssmpipe.use.groups import Cohort, GroupOptions, load_cohort

WALK = (-3.0, -1.5, 0.0, 1.5, 3.0)
"""Steps of the walk along the discriminant [standard deviations inside of the groups]."""

FEW_SUBJECTS = 15


@dataclass(frozen=True)
class CompareOptions:
    """What to compare and how.

    Parameters
    ----------
    groups : GroupOptions
    tests : Options
    seed : int
    alpha : float
        Level of the tests, and false discovery rate of the maps.
    """

    groups: GroupOptions = field(default_factory=GroupOptions)
    tests: Options = field(default_factory=Options)
    seed: int = 0
    alpha: float = 0.05


def compare_results(result: Path, other: Path | None, out: Path, options: CompareOptions) -> list[str]:
    """Compare, write everything into ``out``, and return what to tell at once, a line each.

    Raises
    ------
    ArtifactError
        If a result cannot be read.
    ConfigError
        If groups, columns or options do not fit.
    """
    cohort = load_cohort(result, other, options.groups)
    if options.tests.paired and not cohort.has_subjects:
        raise ConfigError("a paired comparison needs a column that tells the subjects", "name it with --paired COLUMN")
    found = compare_groups(cohort.sample, options.tests, options.seed)
    notes = what_to_know(cohort, found, options)
    page = ComparisonPage(
        title=" and ".join(cohort.groups) if len(cohort.groups) == 2 else ", ".join(cohort.groups),
        version=__version__,
        groups=cohort.groups,
        sample=cohort.sample,
        comparison=found,
        model=cohort.model,
        unit=cohort.unit,
        alpha=options.alpha,
        n_permutations=options.tests.n_permutations,
        covariates=cohort.covariates,
        notes=notes,
    )
    out.mkdir(parents=True, exist_ok=True)
    _write_shapes(cohort, found, out)
    _write_maps(cohort, found, out)
    tables = {
        "tests": tests_table(cohort, found),
        "modes": modes_table(cohort, found),
        "pairs": pairs_table(cohort, found, options.alpha),
        "shapes": shapes_table(cohort, found),
    }
    for name, table in tables.items():
        write_table(out / f"{name}.csv", table)
    (out / "scores.png").write_bytes(scores_png(page))
    write_json(out / "compare.json", summary(cohort, found, options, notes))
    (out / "compare.html").write_text(build_comparison(page), encoding="utf-8", newline="\n")
    said = [
        f"{cohort.groups[pair.second]} - {cohort.groups[pair.first]}: modes together p = {pair.joint.p:.4g}, "
        f"anywhere p = {pair.p_anywhere:.4g}, sorted rightly {100 * pair.classification.accuracy:.0f} %"
        for pair in found.pairs
    ]
    if len(found.pairs) > 1:
        said.insert(0, f"all groups: modes together p = {found.joint.p:.4g}, anywhere p = {found.p_anywhere:.4g}")
    return [*said, *(f"note: {note}" for note in notes), f"see {out / 'compare.html'}"]


def what_to_know(cohort: Cohort, found: Comparison, options: CompareOptions) -> list[str]:
    """Return what limits the result, in plain sentences: repeated measures, small samples, how two results were matched."""
    sample, notes = cohort.sample, []
    n, n_subjects = len(sample.labels), len(np.unique(sample.subjects))
    if cohort.matching is not None:
        how = cohort.matching
        notes.append(
            "Two results were matched after the fact: the mean of the second was moved rigidly onto the "
            "mean of the first, and the closest "
            f"places on it carry its shapes. The means are {how.rms:.3g} {cohort.unit} apart (root mean square, at most "
            f"{how.maximum:.3g}); matched places "
            f"lie {how.moved_rms:.3g} mm from the points of the same number. Where points lie along the "
            "surface differs between two runs for "
            "reasons that are no anatomy, so only displacements along the normals are compared. Differences "
            "near a cut rim may come from the "
            "cut. For a publication put all scans into one config and compare by a column."
        )
    if not cohort.has_subjects:
        notes.append(
            f"No column tells the subjects: all {n} shapes were taken as independent. If some come from the same subject, add a column "
            "'subject', or the p values are too small."
        )
    elif n_subjects < n:
        both = sum(len(np.unique(sample.labels[sample.subjects == s])) > 1 for s in np.unique(sample.subjects))
        text = (
            f"{n} shapes of {n_subjects} subjects are not {n} independent samples: subjects were rearranged as a whole."
        )
        if both and not options.tests.paired and len(cohort.groups) == 2:
            text += f" {both} subjects have shapes in both groups; --paired compares these inside of each subject."
        notes.append(text)
    matched = found.pairs[0].pairs
    if matched is not None and len(matched.left_out):
        notes.append(
            f"Paired: {len(matched.subjects)} subjects have shapes in both groups; {len(matched.left_out)} "
            "have not and do not count in the "
            "tests (they do in the means of the groups and in the sorting)."
        )
    counts = [sample.subjects_of(g) for g in range(sample.n_groups)]
    if matched is None and min(counts) < FEW_SUBJECTS:
        a, b = sorted(counts)[:2]
        size = smallest_detectable(a, b, options.alpha)
        notes.append(
            f"Small sample: with {a} and {b} subjects a single measure must differ by {size:.2g} standard "
            "deviations to be found four times "
            "out of five. What is not found may still be there."
        )
    fewest = min(pair.n_rearrangements for pair in found.pairs)
    if fewest < 1 / options.alpha:
        notes.append(
            f"There are only {fewest} different rearrangements, so that no p value can be below "
            f"{1 / fewest:.2g}: no difference, however large, "
            f"can be shown at the level {options.alpha:g}."
        )
    elif fewest < options.tests.n_permutations:
        notes.append(
            f"There are only {fewest} different rearrangements: no p value can be much below "
            f"{1 / fewest:.2g}, and few points of a map may "
            "pass the false discovery rate; the family-wise values do not suffer from it."
        )
    if cohort.left_out:
        notes.append(f"{len(cohort.left_out)} shapes have no group, or one that is not compared, and were left out.")
    if cohort.strangers:
        some = ", ".join(cohort.strangers[:3]) + (" ..." if len(cohort.strangers) > 3 else "")
        rows = (
            "1 row of the given table is"
            if len(cohort.strangers) == 1
            else f"{len(cohort.strangers)} rows of the given table are"
        )
        notes.append(f"{rows} no shape of the result ({some}).")
    return notes


def _write_shapes(cohort: Cohort, found: Comparison, out: Path) -> None:
    for name, points in zip(cohort.groups, found.group_means, strict=True):
        _write_points(cohort, points, out / f"mean_{safe(name)}")
    for pair in found.pairs:
        first, second = (safe(cohort.groups[g]) for g in (pair.first, pair.second))
        for step in WALK:
            label = f"{'minus' if step < 0 else 'plus'}{abs(step):.1f}"
            points = pair.discriminant.centre + step * pair.discriminant.step
            _write_points(cohort, points, out / f"discriminant_{first}_{second}_{label}")


def _write_points(cohort: Cohort, points: Floats, stem: Path) -> None:
    topology = cohort.model.topology
    if points.shape[1] == 2:
        write_outline(stem.with_name(stem.name + ".csv"), Outline(points, topology == "curve-closed"))
    elif len(cohort.model.faces):
        write_mesh(stem.with_name(stem.name + ".ply"), TriMesh(points, cohort.model.faces))
    else:
        columns = dict(zip("xyz", points.T.tolist(), strict=True))
        write_table(stem.with_name(stem.name + ".csv"), Table(columns))


def _write_maps(cohort: Cohort, found: Comparison, out: Path) -> None:
    """Write the mean of all shapes with the maps: ``difference.vtp``, for curves ``difference.csv``."""
    arrays: dict[str, Floats] = {}
    if len(found.pairs) > 1:
        arrays |= _point_arrays(found.along_normal, found.in_space, "")
    for pair in found.pairs:
        end = (
            ""
            if len(found.pairs) == 1
            else f"_{safe(cohort.groups[pair.second])}_minus_{safe(cohort.groups[pair.first])}"
        )
        if pair.distance is not None and pair.effect is not None:
            arrays[f"distance_mm{end}"] = pair.distance
            arrays[f"cohen_d{end}"] = pair.effect
        arrays |= _point_arrays(pair.along_normal, pair.in_space, end)
        arrays[f"displacement_mm{end}"] = pair.displacement
    if len(cohort.model.faces):
        (out / "difference.vtp").write_bytes(vtp.dump(found.mean, cohort.model.faces, arrays))
        return
    columns: dict[str, Sequence[Any]] = {"point": list(range(len(found.mean)))}
    columns |= dict(zip("xyz", found.mean.T.tolist(), strict=False))
    for name, values in arrays.items():
        if values.ndim == 1:
            columns[name] = values.tolist()
        else:
            columns |= {f"{name}_{axis}": column for axis, column in zip("xyz", values.T.tolist(), strict=False)}
    note = "mean of all shapes; distance along its normal, positive outward"
    write_table(out / "difference.csv", Table(columns, note))


def _point_arrays(along: PointTests | None, space: PointTests, end: str) -> dict[str, Floats]:
    arrays: dict[str, Floats] = {}
    if along is not None:
        arrays |= {f"p{end}": along.p, f"q{end}": along.q, f"p_family_wise{end}": along.p_family}
    return arrays | {f"p_t2{end}": space.p, f"q_t2{end}": space.q, f"p_family_wise_t2{end}": space.p_family}


def tests_table(cohort: Cohort, found: Comparison) -> Table:
    """Return a row per test: all groups together first, then two by two."""
    rows: list[tuple[Any, ...]] = []

    def add(groups: str, joint: JointTest, whole: JointTest, anywhere: float, holm: float | None) -> None:
        rows.append(
            (
                "modes together",
                groups,
                joint.n_dimensions,
                joint.trace,
                joint.t_squared,
                joint.p,
                holm,
                joint.p_parametric,
            )
        )
        rows.append(("whole shape", groups, whole.n_dimensions, whole.trace, None, whole.p, None, None))
        rows.append(("anywhere", groups, len(found.mean), None, None, anywhere, None, None))

    if len(found.pairs) > 1:
        add("all", found.joint, found.whole, found.p_anywhere, None)
    for pair, holm in zip(found.pairs, found.p_holm, strict=True):
        add(_named(cohort, pair), pair.joint, pair.whole, pair.p_anywhere, float(holm))
    names = ("test", "groups", "n_dimensions", "pillai_trace", "hotelling_t2", "p", "p_holm", "p_parametric")
    columns = {name: [row[k] for row in rows] for k, name in enumerate(names)}
    return Table(
        columns,
        "p by permutation; p_holm: all pairs of groups together; p_parametric: F distribution, independent shapes",
    )


def modes_table(cohort: Cohort, found: Comparison) -> Table:
    """Return a row per mode: variance, what shuffled data reach, the groups' means, effects and p values of the kept ones."""
    n, kept = len(found.variances), found.count.kept
    tests = found.mode_tests

    def padded(values: Floats) -> list[float | None]:
        return [*(float(x) for x in values), *[None] * (n - kept)]

    columns: dict[str, Sequence[Any]] = {
        "mode": [f"mode_{m + 1:02d}" for m in range(n)],
        "variance_mm2": found.variances.tolist(),
        "share": (found.variances / found.variances.sum()).tolist(),
        "chance_variance_mm2": found.count.thresholds[:n].tolist(),
        "kept": ["yes" if m < kept else "no" for m in range(n)],
    }
    for g, name in enumerate(cohort.groups):
        columns[f"mean_{name}"] = padded(tests.means[g])
    if len(found.pairs) == 1:
        effects = found.pairs[0].effects
        columns |= {"hedges_g": padded(effects.g), "g_low": padded(effects.low), "g_high": padded(effects.high)}
    columns |= {
        "p": padded(tests.p),
        "q": padded(tests.q),
        "p_family_wise": padded(tests.p_family),
        "p_joint_up_to_here": padded(tests.p_joint),
    }
    return Table(
        columns, "means in standard deviations of the mode; chance_variance: reached by 5 % of shuffled cohorts"
    )


def pairs_table(cohort: Cohort, found: Comparison, alpha: float) -> Table:
    """Return a row per pair of groups."""
    rows = []
    for pair, holm in zip(found.pairs, found.p_holm, strict=True):
        counts = [
            (int((cohort.sample.labels == g).sum()), cohort.sample.subjects_of(g)) for g in (pair.first, pair.second)
        ]
        tests = pair.along_normal or pair.in_space
        distance = pair.distance
        rows.append(
            {
                "pair": _named(cohort, pair),
                "n_shapes_first": counts[0][0],
                "n_shapes_second": counts[1][0],
                "n_subjects_first": counts[0][1],
                "n_subjects_second": counts[1][1],
                "n_subject_pairs": None if pair.pairs is None else len(pair.pairs.subjects),
                "mahalanobis": pair.mahalanobis,
                "rms_displacement_mm": float(np.sqrt((pair.displacement**2).sum(axis=1).mean())),
                "lowest_distance_mm": None if distance is None else float(distance.min()),
                "highest_distance_mm": None if distance is None else float(distance.max()),
                "hotelling_t2": pair.joint.t_squared,
                "p": pair.joint.p,
                "p_holm": float(holm),
                "p_whole_shape": pair.whole.p,
                "p_anywhere": pair.p_anywhere,
                "share_of_points_fdr": float((tests.q <= alpha).mean()),
                "share_of_points_family_wise": float((tests.p_family <= alpha).mean()),
                "sorted_rightly": pair.classification.accuracy,
                "sorted_low": pair.classification.low,
                "sorted_high": pair.classification.high,
                "sorted_balanced": pair.classification.balanced,
                "n_rearrangements": pair.n_rearrangements,
            }
        )
    return Table(
        {name: [row[name] for row in rows] for name in rows[0]}, "second group less first; distances along the normals"
    )


def shapes_table(cohort: Cohort, found: Comparison) -> Table:
    """Return a row per shape: group, subject, size, group it was sorted into unseen, discriminant and scores."""
    columns: dict[str, Sequence[Any]] = {
        "id": list(cohort.ids),
        "subject": list(cohort.subjects),
        "group": [cohort.groups[g] for g in cohort.sample.labels],
        "sorted_into": [cohort.groups[g] for g in found.classification.predicted],
        "centroid_size_mm": cohort.size.tolist(),
    }
    if len(found.pairs) == 1:
        columns["discriminant"] = found.pairs[0].discriminant.scores.tolist()
    for m in range(found.scores.shape[1]):
        columns[f"mode_{m + 1:02d}"] = found.scores[:, m].tolist()
    return Table(columns, "scores in standard deviations; discriminant in standard deviations inside of the groups")


def summary(cohort: Cohort, found: Comparison, options: CompareOptions, notes: Sequence[str]) -> dict[str, Any]:
    """Return the whole result but for maps, for programs."""
    sample = cohort.sample
    how = cohort.matching
    return {
        "ssmpipe_version": __version__,
        "by": cohort.by,
        **_table_record(options.groups.cohort),
        "groups": [
            {"name": name, "n_shapes": int((sample.labels == g).sum()), "n_subjects": sample.subjects_of(g)}
            for g, name in enumerate(cohort.groups)
        ],
        "n_shapes": len(sample.labels),
        "n_subjects": len(np.unique(sample.subjects)),
        "left_out": list(cohort.left_out),
        "paired": options.tests.paired,
        "covariates": list(cohort.covariates),
        "share_of_variation_that_goes_with_log_size": allometry(sample.points, sample.labels, cohort.size),
        "seed": options.seed,
        "n_permutations": options.tests.n_permutations,
        "alpha": options.alpha,
        "n_modes": found.count.kept,
        "n_modes_by_parallel_analysis": found.count.by_parallel_analysis,
        "n_modes_by_variance": found.count.by_variance,
        "correspondence": "one model"
        if how is None
        else {
            "matched": "closest points of the means",
            "rms_mm": how.rms,
            "max_mm": how.maximum,
            "moved_rms_mm": how.moved_rms,
        },
        "all_groups": {"p_modes": found.joint.p, "p_whole_shape": found.whole.p, "p_anywhere": found.p_anywhere},
        "pairs": _records(pairs_table(cohort, found, options.alpha)),
        "notes": list(notes),
    }


def _table_record(path: Path | None) -> dict[str, Any]:
    return {} if path is None else {"cohort_table": {"file": path.name, "sha256": file_digest(path)}}


def _records(table: Table) -> list[dict[str, Any]]:
    return [dict(zip(table.columns, row, strict=True)) for row in zip(*table.columns.values(), strict=True)]


def _named(cohort: Cohort, pair: Pair) -> str:
    return f"{cohort.groups[pair.second]} - {cohort.groups[pair.first]}"


def safe(name: str) -> str:
    """Return a name of a group as part of a file name.

    Examples
    --------
    >>> safe("cam (type 2)")
    'cam_type_2'
    """
    return re.sub(r"[^\w.-]+", "_", name).strip("_.") or "group"
