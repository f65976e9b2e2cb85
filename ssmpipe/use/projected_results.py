"""What a projection of scans gave: exit code, table of scores, a line for each patient, record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ssmpipe import __version__
from ssmpipe.contract import Table
from ssmpipe.runner.batch import Failure
from ssmpipe.runner.exit_codes import INTERNAL, OK, QUARANTINED
from ssmpipe.runner.fingerprint import file_digest
from ssmpipe.runner.sources import Source
from ssmpipe.runner.suggest import count
from ssmpipe.use.completing import PARTIAL
from ssmpipe.use.distance_numbers import rms
from ssmpipe.use.model import Model
from ssmpipe.use.target import Target


@dataclass
class ProjectResult:
    """What came out: exit code, rows of the table by id, failures, and by id what was warned of: stage and sentence."""

    exit_code: int
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    failures: dict[str, Failure] = field(default_factory=dict)
    warnings: dict[str, list[tuple[str, str]]] = field(default_factory=dict)


def exit_code_of(result: ProjectResult) -> int:
    """Return the exit code: 3 where a scan failed, a map is not proved one-to-one, or holes that were to be filled are left.

    Examples
    --------
    >>> exit_code_of(ProjectResult(0, {"a": {"certificate": {"status": "partial"}, "holes_left": 1}}))
    3
    """
    if result.failures and all(f.internal for f in result.failures.values()) and not result.rows:
        return INTERNAL
    unproved = any(row["certificate"]["status"] not in ("proved", PARTIAL) for row in result.rows.values())
    holes = any(row.get("holes_left") for row in result.rows.values())
    return QUARANTINED if result.failures or unproved or holes else OK


def scores_table(rows: Mapping[str, Mapping[str, Any]], n_modes: int, unit: str = "mm") -> Table:
    """Return one row per patient: coefficients as in the ``scores.csv`` of a run, their uncertainty, distances."""
    ids = sorted(rows)
    columns: dict[str, list[Any]] = {"id": list(ids)}
    for m in range(n_modes):
        columns[f"mode_{m + 1:02d}"] = [rows[i]["scores"][m] for i in ids]
    for m in range(n_modes):
        columns[f"mode_{m + 1:02d}_sd"] = [rows[i]["deviations"][m] for i in ids]
    plain = ["side", "mahalanobis", "mahalanobis_p", "residual_rms_mm", "residual_p"]
    plain += [f"{d}_{w}_mm" for d in ("to_scan", "from_scan") for w in ("mean", "median", "p95", "max")]
    for name in plain:
        columns[name] = ["" if rows[i].get(name) is None else rows[i][name] for i in ids]
    if any("seen_share" in rows[i] for i in ids):
        for name in ("seen_share", "expected_error_mm"):
            columns[name] = ["" if rows[i].get(name) is None else rows[i][name] for i in ids]
    columns["certificate"] = [rows[i]["certificate"]["status"] for i in ids]
    note = (
        "modes and their sd in standard deviations of the model; _p: share of the training shapes, each in the model of the others, "
        "that lie as far out; to_scan: from the reconstruction to the scan, from_scan: back"
    )
    if unit != "mm":
        note += f"; columns whose names end in _mm are in {unit}"
    return Table(columns, note)


def line_of(row: Mapping[str, Any], unit: str) -> str:
    """Return what is said of one patient as soon as it is done: a row of :func:`scores_table` in words."""
    text = f"{row['id']}: Mahalanobis {row['mahalanobis']:.2f} (p {row['mahalanobis_p']:.2g}), "
    if row["certificate"]["status"] == PARTIAL:
        text += f"{100 * row['seen_share']:.0f} % seen, {row['from_scan_mean_mm']:.3g} {unit} from the fragment"
        expected = row.get("expected_error_mm")
        text += f", missing part expected within {expected:.2g} {unit}" if expected is not None else ""
        return text + (f", {count(row['holes_left'], 'hole')} left open" if row.get("holes_left") else "")
    text += f"residual {row['residual_rms_mm']:.3g} {unit}"
    if row.get("to_scan_mean_mm") is not None:
        text += (
            f", reconstruction {row['to_scan_mean_mm']:.3g} {unit} from the scan (95 %: {row['to_scan_p95_mm']:.3g})"
        )
    return text + f", {row['certificate']['status']}"


def record_of(model: Model, target: Target, sources: Sequence[Source], result: ProjectResult) -> dict[str, Any]:
    """Return the content of ``project.json``: the model and its training shapes, the scans, which of them went through."""
    others = target.others
    return {
        "ssmpipe_version": __version__,
        "model": {
            "file": model.path.name,
            "sha256": file_digest(model.path),
            "n_shapes": len(model.ids),
            "n_modes": len(model.variances),
        },
        "training": {
            i: {"mahalanobis": d, "residual_rms_mm": rms(r)}
            for i, d, r in zip(model.ids, others.mahalanobis, others.residuals, strict=True)
        },
        "remainder": {
            "variance_mm2": target.remainder.variance,
            "length_mm": target.remainder.length,
            "noise_mm2": target.remainder.noise,
        },
        "scans": {s.id: {"file": s.path.name, "side": s.side} for s in sources},
        "ok": sorted(result.rows),
        "failed": sorted(result.failures),
    }
