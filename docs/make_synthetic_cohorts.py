"""Run the synthetic aortas and proximal femora from raw scans to models, measure against their truth, and write a page.

python docs/make_synthetic_cohorts.py [--work FOLDER]
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

COHORTS = {"aorta": ("aorta", ["--n", "12"]), "hips": ("femur-proximal", ["--groups"])}
ON_SURFACE = 1.5
"""A true point farther from the corresponded surface of any shape was cut away [mm]."""


def run(work: Path, name: str) -> tuple[Path, float]:
    """Make a cohort and run its preset without landmarks; return the output folder and the seconds."""
    anatomy, options = COHORTS[name]
    data, out = work / name, work / f"{name}-out"
    subprocess.run([sys.executable, "-m", "ssmpipe", "synth", anatomy, str(data), *options], check=True)
    table = f"\n  cohort: {data / 'cohort.csv'}" if (data / "cohort.csv").is_file() else ""
    config = work / f"{name}.yaml"
    config.write_text(
        f"name: synthetic {name}\ninput:\n  scans: {data / 'scans'}{table}\n  landmarks: {data / 'landmarks.json'}\n"
        f"  units: mm\noutput: {out}\nanatomy: {anatomy}\n"
    )
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "ssmpipe", "run", str(config), "-q"], check=False)
    return out, time.perf_counter() - begin


def against_truth(out: Path, data: Path) -> dict[str, np.ndarray]:
    """Return the errors of all ordered pairs before and after [mm]."""
    result = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    truth = np.load(data / "truth.npz")
    ids = sorted(path.stem for path in (data / "scans").iterdir())
    chosen = [ids.index(i) for i in result["ids"]]
    covered = truth["covered"][chosen].all(axis=0)
    points = truth["points"][chosen][:, covered]
    matrix = result["transform"]
    aligned = np.einsum("sij,snj->sni", matrix[:, :3, :3], points) + matrix[:, None, :3, 3]
    others = ~np.eye(len(chosen), dtype=bool)
    return {
        key: correspondence_error(result[name], result["faces"], aligned, max_distance=ON_SURFACE)[others]
        for key, name in (("before", "initial_points"), ("after", "points"))
    }


def section(name: str, title: str, out: Path, data: Path, seconds: float) -> str:
    """Return the part of the page about one cohort."""
    errors = against_truth(out, data)
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
    work = (parser.parse_args().work or Path(tempfile.mkdtemp(prefix="synthetic-"))).resolve()
    work.mkdir(parents=True, exist_ok=True)
    titles = {
        "aorta": "Ascending aortas with sinuses and coronary stumps",
        "hips": "Proximal femora, healthy and with a cam bump",
    }
    parts = []
    for name, title in titles.items():
        out, seconds = run(work, name)
        parts.append(section(name, title, out, work / name, seconds))
    head = """# Synthetic cohorts, from damaged scans to models

Made by `python docs/make_synthetic_cohorts.py`: `ssmpipe synth` writes the scans ([what is wrong with them](synthetic.md)), the presets
`aorta` and `femur-proximal` run without landmarks, and the truth, which no stage saw, measures the result.

"""
    (HERE / "synthetic_cohorts.md").write_text(head + "\n".join(parts))


if __name__ == "__main__":
    main()
