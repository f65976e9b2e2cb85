"""Run the synthetic aortas and proximal femora from raw scans to models, measure against their truth, and write a page.

python docs/make_synthetic_cohorts.py [--work FOLDER] [--only aorta]

What FOLDER holds already is brought up to date; with ``--only`` the part of the page about the other cohort stays as it is.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from make_aorta_synth import draw_modes  # noqa: E402

from ssmpipe.core.evaluation.correspondence_error import correspondence_error  # noqa: E402
from ssmpipe.core.mesh.distance import point_to_mesh  # noqa: E402
from ssmpipe.core.mesh.trimesh import TriMesh  # noqa: E402

COHORTS = {"aorta": ("aorta", ["--n", "12"]), "hips": ("femur-proximal", ["--groups"])}
STAGES = {"aorta": {"trim": {"tube_mm": 55.0}}}
"""How much of an aorta is modelled is the user's choice."""
RIMS = {"trim": {"ends_at": "rims"}}
GUIDES = [f"{kind}_{place}" for kind, places in (("nadir", ("left", "non", "right")),) for place in places]
GUIDES += ["commissure_left_right", "commissure_non_left", "commissure_right_non", "ostium_left", "ostium_right"]
TOP = "trim: opening_top"
"""The landmark on the centre line where the model of an aorta ends, in the role that cuts there."""
ON_SURFACE = 1.5
"""A true point farther from the corresponded surface of any shape was cut away [mm]."""


def make(work: Path, name: str) -> Path:
    """Make a cohort unless it is there, and return its folder."""
    anatomy, options = COHORTS[name]
    data = work / name
    if not (data / "truth.npz").is_file():
        subprocess.run([sys.executable, "-m", "ssmpipe", "synth", anatomy, str(data), *options], check=True)
    return data


def run(
    work: Path, name: str, variant: str = "", stages: dict[str, dict[str, object]] | None = None, roles: str = ""
) -> tuple[Path, float]:
    """Run the preset of a cohort, without landmarks unless they are named; return the output folder and the seconds."""
    data, out = make(work, name), work / f"{name}-out{variant}"
    table = f"\n  cohort: {data / 'cohort.csv'}" if (data / "cohort.csv").is_file() else ""
    config = work / f"{name}{variant}.yaml"
    chosen = json.dumps([{key: value} for key, value in (stages or STAGES.get(name, {})).items()])
    config.write_text(
        f"name: synthetic {name}\ninput:\n  scans: {data / 'scans'}{table}\n  landmarks: {data / 'landmarks.json'}\n"
        f"  units: mm\n  roles: {{{roles}}}\noutput: {out}\nanatomy: {COHORTS[name][0]}\nstages: {chosen}\n"
    )
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "ssmpipe", "run", str(config), "-q"], check=False)
    return out, time.perf_counter() - begin


def against_truth(outs: list[Path], data: Path) -> list[dict[str, np.ndarray]]:
    """Return, for every result, the errors of all ordered pairs before and after [mm], at points that all of them keep."""
    truth = np.load(data / "truth.npz")
    ids = sorted(path.stem for path in (data / "scans").iterdir())
    results = [np.load(out / "cohort" / "optimize" / "correspondence.npz") for out in outs]
    common = sorted(set.intersection(*[set(r["ids"].tolist()) for r in results]))
    chosen = [ids.index(i) for i in common]
    covered = truth["covered"][chosen].all(axis=0)
    sets = []
    for result in results:
        rows = [result["ids"].tolist().index(i) for i in common]
        matrix = result["transform"][rows]
        aligned = np.einsum("sij,snj->sni", matrix[:, :3, :3], truth["points"][chosen]) + matrix[:, None, :3, 3]
        for key in ("initial_points", "points"):
            sets.append((result[key][rows], result["faces"], aligned))
    kept = covered.copy()
    for points, faces, aligned in sets:
        near = [point_to_mesh(t, TriMesh(p, faces))[0] <= ON_SURFACE for p, t in zip(points, aligned, strict=True)]
        kept &= np.all(near, axis=0)
    others = ~np.eye(len(chosen), dtype=bool)
    errors = [correspondence_error(p, f, a[:, kept], max_distance=np.inf)[others] for p, f, a in sets]
    return [{"before": b, "after": a} for b, a in zip(errors[::2], errors[1::2], strict=True)]


def cuts_text(work: Path, data: Path, out: Path) -> str:
    """Return how the place of the cuts and true guides change the error."""
    guides: dict[str, dict[str, object]] = {"optimize": {"guides": GUIDES}}
    variants = {
        "cut just inside the rims": ("-rims", RIMS, ""),
        "cut by the sinuses (the preset)": ("", None, ""),
        "the same, the upper end at a landmark": ("-top", STAGES["aorta"], TOP),
        "cut by the sinuses, eight landmarks as guides": ("-guided", STAGES["aorta"] | guides, ""),
        "the same, the upper end at a landmark, too": ("-top-guided", STAGES["aorta"] | guides, TOP),
    }
    errors = against_truth([run(work, "aorta", *how)[0] for how in variants.values()], data)
    start = errors[0]["before"].mean()
    rows = "\n".join(
        f"| {name} | {e['before'].mean():.2f} | {e['after'].mean():.2f} | {np.median(e['after']):.2f} "
        f"| {100 * e['after'].mean() / e['before'].mean():.0f} % | {100 * e['after'].mean() / start:.0f} % |"
        for name, e in zip(variants, errors, strict=True)
    )
    result = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    per_shape = against_truth_by_shape(out, data)
    worst = int(np.argmax(per_shape))
    rest = [k for k in range(len(per_shape)) if k != worst]
    return f"""### Where the ends are cut

Mean error at the {errors[0]["after"].shape[1]} true points that all of them keep [mm]:

| | before | after | median after | of its own start | of the start of the rims |
|---|---|---|---|---|---|
{rows}

Sinuses show geometry where the lower end lies. Nothing shows it the upper one: along a smooth tube the true points of these aortas move by
their mode `length`, which leaves no trace, and a landmark (`input.roles: {{trim: opening_top}}`) says what no scan does. The better the
ends, the better is the start, too, so that the share of a row's own start grows where its error falls.

By geometry alone `{result["ids"][worst]}` carries most of what is left: {per_shape[worst]:.2f} mm, the others
{per_shape[rest].mean():.2f} mm on average.
"""


def modes_text(data: Path, out: Path) -> str:
    """Return how the scores of the first two modes of aortas go with the true scores, and what both modes together see of two of those."""
    truth, model = np.load(data / "truth.npz"), np.load(out / "cohort" / "model" / "model.npz")
    ids, names = truth["ids"].tolist(), truth["mode_names"].tolist()
    scores = truth["scores"][[ids.index(i) for i in model["ids"].tolist()]]
    first_two = model["scores"][:, :2]
    r = np.corrcoef(scores.T, first_two.T)[: len(names), len(names) :]
    rows = "\n".join(f"| `{name}` | {one:+.2f} | {two:+.2f} |" for name, (one, two) in zip(names, r, strict=True))
    wanted = [names.index(name) for name in ("diameter", "sinus_size")]
    (d_1, d_2), (s_1, s_2) = np.abs(r[wanted])
    # modes of like variance are turned in their plane; a fit by both of them does not depend on that
    design = np.column_stack([np.ones(len(scores)), first_two])
    left = scores[:, wanted] - design @ np.linalg.lstsq(design, scores[:, wanted], rcond=None)[0]
    seen = 100 * (1 - left.var(axis=0) / scores[:, wanted].var(axis=0))
    return f"""### Modes and true scores

Over {len(scores)} aortas, the score of the first mode goes with the true `diameter` with |r| = {d_1:.2f} (the second mode: {d_2:.2f}),
that of the second with the true `sinus_size` with |r| = {s_2:.2f} (the first mode: {s_1:.2f}). Both modes together explain
{seen[0]:.0f} % of the variance of `diameter` and {seen[1]:.0f} % of that of `sinus_size`, by least squares. The
signs of modes are arbitrary.

| true score (r) | mode 1 | mode 2 |
|---|---|---|
{rows}
"""


def against_truth_by_shape(out: Path, data: Path) -> np.ndarray:
    """Return the mean error of what is carried to each shape [mm]."""
    errors = against_truth([out], data)[0]["after"]
    n = len(np.load(out / "cohort" / "optimize" / "correspondence.npz")["ids"])
    square = np.full((n, n), np.nan)
    square[~np.eye(n, dtype=bool)] = errors.mean(axis=1)
    return np.nanmean(square, axis=0)


def section(name: str, title: str, out: Path, data: Path, seconds: float) -> str:
    """Return the part of the page about one cohort."""
    (errors,) = against_truth([out], data)
    n_scans = len(list((data / "scans").iterdir()))
    failed = json.loads((out / "failures.json").read_text()) if (out / "failures.json").is_file() else {}
    lines = [f"- `{i}`, {f['stage']}: {f['error']}" for i, f in failed.items()]
    refused = f"{n_scans - len(failed)} of {n_scans} scans finish" + (
        "; refused:\n\n" + "\n".join(lines) + "\n" if lines else ".\n"
    )
    with (out / "cohort" / "evaluate" / "landmark_transfer.csv").open() as file:
        marks = {
            (row["landmark"], row["correspondence"]): row
            for row in csv.DictReader(line for line in file if not line.startswith("#"))
        }
    names = [key[0] for key in marks if key[1] == "initial"]
    table = "\n".join(
        f"| {n} | {float(marks[n, 'initial']['mean_mm']):.2f} / {float(marks[n, 'initial']['p95_mm']):.1f} "
        f"| {float(marks[n, 'optimized']['mean_mm']):.2f} / {float(marks[n, 'optimized']['p95_mm']):.1f} |"
        for n in names
    )
    model = np.load(out / "cohort" / "model" / "model.npz")
    share = 100 * model["variances"] / model["variances"].sum()
    draw_modes(out, HERE / "figures" / f"synthetic_{name}_modes.png")
    dense = "\n".join(
        f"| {key} | {e.mean():.2f} | {np.median(e):.2f} | {np.percentile(e, 95):.2f} |" for key, e in errors.items()
    )
    return f"""## {title}

{refused}
All stages together took {seconds:.0f} s on two cores. The first three modes hold {share[0]:.0f}, {share[1]:.0f} and
{share[2]:.0f} % of the variance.

True points on the kept parts, {errors["after"].shape[1]} of them, over all ordered pairs [mm]:

| | mean | median | 95 % |
|---|---|---|---|
{dense}

The optimization leaves {100 * errors["after"].mean() / errors["before"].mean():.0f} % of the error at the start.

| landmark (mean / 95th percentile, mm) | before | after |
|---|---|---|
{table}

![Mean and first modes](figures/synthetic_{name}_modes.png)
"""


def main() -> None:
    """Run, measure, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--only", choices=list(COHORTS))
    options = parser.parse_args()
    work = (options.work or Path(tempfile.mkdtemp(prefix="synthetic-"))).resolve()
    work.mkdir(parents=True, exist_ok=True)
    titles = {
        "aorta": "Ascending aortas with sinuses and coronary stumps",
        "hips": "Proximal femora, healthy and with a cam bump",
    }
    page = HERE / "synthetic_cohorts.md"
    parts = []
    for name, title in titles.items():
        if options.only not in (None, name):
            text = page.read_text()
            begin = text.index(f"## {title}")
            end = text.find("\n## ", begin)
            parts.append(text[begin:] if end < 0 else text[begin : end + 1])
            continue
        out, seconds = run(work, name)
        part = section(name, title, out, work / name, seconds)
        if name == "aorta":
            part += "\n" + modes_text(work / name, out) + "\n" + cuts_text(work, work / name, out)
        parts.append(part)
    head = """# Synthetic cohorts, from damaged scans to models

Made by `python docs/make_synthetic_cohorts.py`: `ssmpipe synth` writes the scans ([what is wrong with them](synthetic.md)), the presets
`aorta` (with `trim.tube_mm: 55`, the length to model) and `femur-proximal` run without landmarks, and the truth, which no stage saw,
measures the result. The same runs as configs, with the `synth` command that makes the data: `configs/aorta.yaml`,
`configs/femur_proximal_groups.yaml`.

"""
    page.write_text(head + "\n".join(parts))


if __name__ == "__main__":
    main()
