"""Groups, subjects and covariates of the shapes of a result, from the columns beside its scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.statistics.comparison import Sample
from ssmpipe.core.statistics.covariates import centroid_size
from ssmpipe.io.codecs import read_json
from ssmpipe.io.tables import read_cohort
from ssmpipe.use.matching import Matching, match_results
from ssmpipe.use.model import Model, load_model

MAX_GROUPS = 8
SIZE = "size"
"""Covariate that needs no column: the logarithm of the centroid size."""


@dataclass(frozen=True)
class GroupOptions:
    """What the groups are made of.

    Parameters
    ----------
    by : str, optional
        Column that tells the groups; ``group`` by default.
    groups : tuple of str
        Values of it (or names of two results), in the order wanted; all, sorted, when empty.
    subject : str, optional
        Column that tells whose shape it is; ``subject`` by default, where there is one.
    covariates : tuple of str
        Columns to take into account; ``size`` stands for the size of the shape itself.
    subject_option : str
        Option that names the column of the subjects, for messages.
    cohort : Path, optional
        Table whose columns come before those that the run knew; of one that both have, the run's is forgotten.
    """

    by: str | None = None
    groups: tuple[str, ...] = ()
    subject: str | None = None
    covariates: tuple[str, ...] = ()
    subject_option: str = "--subject"
    cohort: Path | None = None


@dataclass(frozen=True, eq=False)
class Cohort:
    """Shapes in groups, with their names.

    Parameters
    ----------
    sample : Sample
    ids : tuple of str
    groups : tuple of str
        Names of the groups.
    subjects : tuple of str
        Of every shape.
    by : str
        What tells the groups, in words.
    has_subjects : bool
        Whether a column tells the subjects.
    left_out : tuple of str
        Shapes without a group, or of a group that is not compared.
    size : (n,) float64
        Centroid size per point [mm].
    covariates : tuple of str
        Names of the columns of ``sample.covariates``.
    model : ShapeModel
        Grid, faces and topology.
    matching : Matching, optional
        Of two results.
    unit : str
        Of lengths: mm, or "file units" when the config of the run says ``units: none``.
    strangers : tuple of str
        Rows of the given table that are no shape of the result.
    """

    sample: Sample
    ids: tuple[str, ...]
    groups: tuple[str, ...]
    subjects: tuple[str, ...]
    by: str
    has_subjects: bool
    left_out: tuple[str, ...]
    size: Floats
    covariates: tuple[str, ...]
    model: ShapeModel
    matching: Matching | None = None
    unit: str = "mm"
    strangers: tuple[str, ...] = ()


def load_cohort(result: Path, other: Path | None, options: GroupOptions) -> Cohort:
    """Read one result that a column splits into groups, or two results that are a group each.

    Raises
    ------
    ArtifactError
        If there is no model.
    ConfigError
        If a column or a group does not exist, a covariate is missing for a shape, or two results do not fit.
    """
    model = load_model(result)
    table = None if options.cohort is None else read_cohort(options.cohort)
    columns, known_ids = _columns(model, table), set(model.ids)
    points = shape_points(model.shape_model)
    matching = None
    if other is None:
        by = options.by or "group"
        values = _column(columns, model.ids, by, "--by", model)
        names, keys = _groups(values, by, options.groups), model.ids
    else:
        if options.by is not None:
            raise ConfigError("--by splits one result, but two were given", "give one result, or leave --by out")
        second = load_model(other)
        known_ids |= set(second.ids)
        by = "result"
        names = _result_names(result, other, options.groups)
        matching = match_results(model.shape_model, points, second.shape_model, shape_points(second.shape_model))
        points = matching.points
        values = [names[0]] * len(model.ids) + [names[1]] * len(second.ids)
        twice = set(model.ids) & set(second.ids)
        keys = tuple(
            f"{name}/{key}" if key in twice else key
            for key, name in zip((*model.ids, *second.ids), values, strict=True)
        )
        merged = [*(columns.get(k, {}) for k in model.ids), *(_columns(second, table).get(k, {}) for k in second.ids)]
        columns = dict(zip(keys, merged, strict=True))
    chosen = np.array([value in names for value in values])
    ids = tuple(key for key, use in zip(keys, chosen, strict=True) if use)
    labels = np.array([names.index(value) for value, use in zip(values, chosen, strict=True) if use], dtype=np.int64)
    _enough(labels, names)
    subject_column = options.subject or "subject"
    known = any(subject_column in row for row in columns.values())
    if options.subject is not None and not known:
        _column(columns, keys, subject_column, options.subject_option, model)
    subjects = tuple(columns.get(key, {}).get(subject_column, "") or key for key in ids)
    size = centroid_size(points[chosen])
    named, covariates = _covariates(options.covariates, columns, ids, size, model)
    sample = Sample(
        points[chosen],
        labels,
        np.unique(np.array(subjects), return_inverse=True)[1].astype(np.int64).ravel(),
        model.shape_model.faces,
        model.topology == "curve-closed",
        covariates,
    )
    left_out = tuple(key for key, use in zip(keys, chosen, strict=True) if not use)
    return Cohort(
        sample, ids, names, subjects, by, known, left_out, size, named, model.shape_model, matching, _unit(model),
        tuple(sorted(set(table or {}) - known_ids)),
    )  # fmt: skip


def _columns(model: Model, table: Mapping[str, Mapping[str, str]] | None) -> dict[str, dict[str, str]]:
    """Return the cohort table that a run has put beside the scores, with the columns of ``table`` in place of its own."""
    path = model.path.with_name("scores.csv")
    rows = read_cohort(path) if path.is_file() else {}
    columns = {
        key: {name: cell for name, cell in row.items() if not name.startswith("mode_")} for key, row in rows.items()
    }
    if table is None:
        return columns
    if not any(key in table for key in model.ids):
        raise ConfigError(
            f"no shape of {model.path} has a row in the given table; it has {', '.join(list(table)[:3])}, the model {model.ids[0]}",
            "write the ids of the run, file names without suffix, into its column id",
        )
    named = list(dict.fromkeys(name for row in table.values() for name in row if name != "path"))
    return {
        key: {**columns.get(key, {}), **{name: table.get(key, {}).get(name, "") for name in named}} for key in model.ids
    }


def _unit(model: Model) -> str:
    """Return the unit of lengths that the record of the run tells."""
    record = model.path.parent.parent.parent / "run.json"
    if not record.is_file():
        return "mm"
    found: Any = read_json(record)
    for key in ("config", "input", "units"):
        found = found.get(key) if isinstance(found, dict) else None
    return "file units" if found == "none" else "mm"


def shape_points(model: ShapeModel) -> Floats:
    """Return the points of the shapes of a model, (n_S, n_P, d); the copies of a pole agree to the bit."""
    points = model.mean + np.tensordot(model.scores * np.sqrt(model.variances), model.modes, axes=1)
    if model.topology in ("cone", "closed"):
        grid = points.reshape(len(points), *model.grid, -1)
        for row in (-1, 0) if model.topology == "closed" else (-1,):
            grid[:, :, row] = grid[:, :1, row]
        points = grid.reshape(points.shape)
    return np.asarray(points)


def _column(
    columns: Mapping[str, Mapping[str, str]], ids: Sequence[str], name: str, option: str, model: Model
) -> list[str]:
    there = list(dict.fromkeys(column for row in columns.values() for column in row))
    if name not in there:
        have = f"there are {', '.join(there)}" if there else f"no cohort table is beside {model.path.name}"
        raise ConfigError(
            f"there is no column '{name}' for {option}; {have}",
            f"choose one of them with {option}, give a table that has the column (--cohort FILE), "
            "or add the column to the cohort table and `ssmpipe run` again"
            if there
            else "give one: --cohort FILE, or set input.cohort in the config and run `model` again",
        )
    return [columns.get(key, {}).get(name, "") for key in ids]


def _groups(values: Sequence[str], by: str, wanted: Sequence[str]) -> tuple[str, ...]:
    there = sorted({value for value in values if value})
    if wanted:
        missing = [name for name in wanted if name not in there]
        if missing:
            raise ConfigError(
                f"no shape has '{missing[0]}' in column '{by}'; there are {', '.join(there[:MAX_GROUPS])}",
                "write --groups as the column does",
            )
        if len(set(wanted)) != len(wanted):
            raise ConfigError("--groups names a group twice")
        if len(wanted) < 2:
            raise ConfigError(
                f"--groups names {wanted[0]} only, at least two groups are needed",
                "name two of them, or leave --groups out for all",
            )
        there = list(wanted)
    if len(there) < 2:
        raise ConfigError(
            f"column '{by}' has {len(there)} value, at least two groups are needed", "choose another column with --by"
        )
    if len(there) > MAX_GROUPS:
        raise ConfigError(
            f"column '{by}' has {len(there)} different values, at most {MAX_GROUPS} groups are compared",
            "choose some with --groups A,B, or give the column to --covariates",
        )
    return tuple(there)


def _enough(labels: Ints, names: Sequence[str]) -> None:
    counts = np.bincount(labels, minlength=len(names))
    if counts.min() < 2:
        name = names[int(counts.argmin())]
        raise ConfigError(
            f"group '{name}' has {counts.min()} shape, at least 2 are needed", "leave it out with --groups"
        )


def _result_names(result: Path, other: Path, wanted: Sequence[str]) -> tuple[str, str]:
    if wanted:
        if len(wanted) != 2 or wanted[0] == wanted[1]:
            raise ConfigError(f"two results need two names, --groups gives {len(set(wanted))}")
        return wanted[0], wanted[1]
    a, b = (p.resolve().stem if p.suffix else p.resolve().name for p in (result, other))
    return (a, b) if a != b else (f"{a} A", f"{b} B")


def _covariates(
    names: Sequence[str],
    columns: Mapping[str, Mapping[str, str]],
    ids: Sequence[str],
    size: Floats,
    model: Model,
) -> tuple[tuple[str, ...], Floats | None]:
    if not names:
        return (), None
    said: list[str] = []
    found: list[Floats] = []
    for name in names:
        if name == SIZE and not any(SIZE in row for row in columns.values()):
            said.append("log size")
            found.append(np.log(size))
            continue
        cells = _column(columns, ids, name, "--covariates", model)
        empty = [key for key, cell in zip(ids, cells, strict=True) if not cell]
        if empty:
            raise ConfigError(
                f"'{name}' is empty for {len(empty)} of {len(ids)} shapes ({', '.join(empty[:3])}{' ...' if len(empty) > 3 else ''})",
                "fill it in the cohort table, or leave it out of --covariates",
            )
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            kinds = sorted(set(cells))
            if len(kinds) > MAX_GROUPS:
                raise ConfigError(
                    f"'{name}' is text with {len(kinds)} different values", "give a column of numbers or of few kinds"
                ) from None
            said += [f"{name} = {kind}" for kind in kinds[1:]]
            found += [np.array([float(cell == kind) for cell in cells]) for kind in kinds[1:]]
            continue
        if not np.isfinite(values).all():
            raise ConfigError(f"'{name}' holds values that are not finite", "correct the cohort table")
        said.append(name)
        found.append(values)
    return tuple(said), np.stack(found, axis=1) if found else None
