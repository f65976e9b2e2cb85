"""Which defaults give the best correspondence, judged by truth and experts: runs the study, writes ``docs/defaults.md``.

    python docs/make_defaults_study.py --femora FOLDER --aortas FOLDER --outlines FOLDER [--work FOLDER]

FOLDER: a cohort folder with ``scans`` (or ``contours``), ``cohort.csv`` and ``landmarks``; every one may be left out.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import study_cohorts  # noqa: E402

from ssmpipe.core.correspondence.normals import DEFAULT_NORMALS  # noqa: E402
from ssmpipe.core.correspondence.optimize import optimize_correspondence  # noqa: E402
from ssmpipe.core.correspondence.options import EngineOptions  # noqa: E402
from ssmpipe.core.correspondence.reparameterization import Reparameterization  # noqa: E402
from ssmpipe.core.spline.evaluate import SplineStack  # noqa: E402

DEFAULT = EngineOptions()
FACTORS: dict[str, list[tuple[str, dict]]] = {
    "normals": [(f"{w:g}", {"normals": w}) for w in (0.0, 0.3, 0.8, 1.6)],
    "normalization": [(n, {"normalize": n}) for n in ("none", "size", "affine")],
    "prior": [(f"{p:g}", {"prior": p}) for p in (0.0, 0.001, 0.01, 0.1, 1.0)],
    "last barrier": [
        (f"{b[-1]:g}", {"barriers": b}) for b in ((30.0,), (30.0, 10.0, 3.0), (30.0, 10.0, 3.0, 1.0, 0.1, 0.01))
    ],
    "lambda_cut / auto": [(f"{f:g}", {"factor": f}) for f in (0.01, 1.0, 100.0, 10000.0)],
    "coefficients x": [(f"{s:g}", {"size": s}) for s in (0.75, 1.0, 1.5)],
    "covariance": [("discrete", {}), ("II", {"covariance": "II"})],
    "boundary": [("as given", {}), ("sliding", {"boundary": "sliding"})],
    "pose": [(p, {"pose": p}) for p in ("keep", "procrustes", "refined")],
    "reference": [("nearest to the mean", {}), ("none", {"reference": "none"})],
    "objective": [(o, {"objective": o}) for o in ("description-length", "log-determinant", "trace")],
}

READING = """
## What it says

- [Normals](normals.md) matter most: without them errors on surfaces are 8 to 54 % larger. From 0.8 to 1.6 nothing changes by more
  than 3 %. Outlines are better without.
- Linear maps are worth removing inside the objective on all surfaces (2 to 12 % against nothing, and up to 7 % against sizes
  alone); on the outlines it costs about 3 %, and on four cohorts of 40 drawn hands (`ssmpipe synth hand`, seeds 0 to 3) 1 to 15 %:
  the preset `curve` keeps them.
- Prior and barrier: less of either than the default gains 4 to 8 % on synthetic femora (B, C) and loses 1 to 4 % on D; too much
  forbids the motion that is needed where shapes differ a lot (B, C). On D, whose shared vertices are nearly in correspondence at
  the start, what holds the maps back helps a little.
- lambda_cut: from a hundredth to a hundred times the automatic value surfaces change by less than 1 %. Outlines do change, and not
  alike: a hundredth is 4 % better here, but with linear maps kept it is 2 to 9 % worse on the mice and up to 23 % better on drawn
  hands, which have no noise.
- Formulation II, maps without a reference and the log-determinant are within 5 % of the default. The trace gains on the synthetic
  femora and loses on D and the outlines. Where linear maps are removed, poses make no difference, unless they are refined only
  once, before the optimization (up to 3 %).
- Sliding boundaries gain 2 to 9 % on B, C and D and nothing on A: a candidate for the default where all sides of a patch are cuts.
  Half as many coefficients again gain 10 and 12 % on the synthetic femora, nothing on A and D, for more than twice the unknowns.
- On the splines of ten families with normals (throw-away script, no table) no other prior, number of coefficients, last barrier or
  normalization was better in most of them.
- Outlines, apart from the table: the number of control points matters most. Drawn hands of about a meter (seed 0), linear maps
  kept: 2.96, 2.10, 1.52 and 1.33 mm with 60, 80, 120 and 160; rendered photographs of hands 8.6, 7.5, 6.9 and 6.7 pixels with 80,
  120, 160 and 240; mice 4.32, 3.97 and 3.94 units with 40, 80 and 160. The preset takes 160. From 10 to 16 coefficients and from
  0.003 to 0.03 of prior nothing changes by more than 6 %. The maps do not gain from more than 151 landmarks, but a polygon of 151
  cuts valleys short: read off the polygon, hands miss by 10 % more than with 301.
"""


def options_for(cohort: study_cohorts.Cohort, change: dict) -> EngineOptions:
    change = dict(change)
    closed = len(cohort.n_coefficients) == 1 and cohort.closed
    base = replace(
        DEFAULT,
        n_coefficients=cohort.n_coefficients,
        landmarks=cohort.landmarks,
        boundary="periodic" if closed else DEFAULT.boundary,
        normals=0.0 if len(cohort.n_coefficients) == 1 else DEFAULT_NORMALS,
    )
    size = change.pop("size", None)
    if size:
        base = replace(base, n_coefficients=tuple(round(size * n) for n in cohort.n_coefficients))
    factor = change.pop("factor", None)
    if factor:
        base = replace(base, lambda_cut=factor * cohort.automatic_lambda_cut())
    if closed and change.get("boundary") == "sliding":
        change.pop("boundary")
    return replace(base, **change)


def start_error(cohort: study_cohorts.Cohort) -> float:
    options = options_for(cohort, {})
    maps = Reparameterization(options.n_coefficients, options.landmarks, boundary=options.boundary)
    parameters = np.repeat(maps.evaluate(maps.identity()[None]), len(cohort.splines), axis=0)
    points = SplineStack(cohort.splines, maps.periodic).evaluate(parameters).points
    return cohort.error(points, cohort.landmarks)[0]


def one(cohort: study_cohorts.Cohort, change: dict) -> tuple[float, float]:
    options = options_for(cohort, change)
    start = time.perf_counter()
    optimum = optimize_correspondence(cohort.splines, options).value
    seconds = time.perf_counter() - start
    periodic = (options.boundary == "periodic",) + (False,) * (len(options.n_coefficients) - 1)
    points = SplineStack(cohort.splines, periodic).evaluate(optimum.parameters).points
    return cohort.error(points, cohort.landmarks)[0], seconds


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("femora", "aortas", "outlines", "work"):
        parser.add_argument(f"--{name}", type=Path)
    arguments = parser.parse_args()
    work = arguments.work or Path(tempfile.mkdtemp())
    config = HERE.parent / "configs" / "quickstart.yaml"
    cohorts = [study_cohorts.synthetic_femora(config, work, 12, 1), study_cohorts.synthetic_femora(config, work, 6, 7)]
    if arguments.femora:
        cohorts.insert(0, study_cohorts.real_femora(config, arguments.femora, work))
    if arguments.aortas:
        cohorts.append(study_cohorts.aorta_walls(arguments.aortas))
    if arguments.outlines:
        cohorts.append(
            study_cohorts.mouse_outlines(HERE.parent / "configs" / "mouse_vertebra.yaml", arguments.outlines, work)
        )
    starts = [start_error(c) for c in cohorts]
    cache: dict[tuple[str, str], tuple[float, float]] = {}

    def result(cohort: study_cohorts.Cohort, change: dict) -> tuple[float, float]:
        key = (cohort.name, str(options_for(cohort, change)))
        if key not in cache:
            cache[key] = one(cohort, change)
            print(cohort.name, change, cache[key], flush=True)
        return cache[key]

    lines = [
        "# Where the defaults come from\n",
        "Made by `python docs/make_defaults_study.py`; mean error of the correspondence, one option",
    ]
    lines += [
        "changed at a time, everything else at the default of the engine, with normals on surfaces (A to D) as the stage has them."
    ]
    lines += [
        "Disks and outlines begin at the identity (`start: auto`). The optimizer sees neither landmarks nor truth.\n"
    ]
    for k, c in enumerate(cohorts):
        lines += [
            f"{chr(65 + k)}. {c.name}: {starts[k]:.3f} {c.unit} at the start, {result(c, {})[0]:.3f} with the defaults."
        ]
    lines += [
        "",
        "| option | value | " + " | ".join(chr(65 + k) for k in range(len(cohorts))) + " | against the default |",
        "|---|---|" + "---|" * (len(cohorts) + 1),
    ]
    for factor, variants in FACTORS.items():
        for label, change in variants:
            cells = []
            ratio = np.exp(np.mean([np.log(result(c, change)[0] / result(c, {})[0]) for c in cohorts]))
            for c in cohorts:
                mark = "**" if options_for(c, change) == options_for(c, {}) else ""
                cells.append(f"{mark}{result(c, change)[0]:.3f}{mark}")
            lines.append(f"| {factor} | {label} | " + " | ".join([*cells, f"{ratio:.3f}"]) + " |")
    lines += [
        "",
        "Bold: the default. Last column: geometric mean over the cohorts of error / error with the defaults.",
        READING,
        "![Error against each option](figures/defaults.png)",
        "",
    ]
    (HERE / "defaults.md").write_text("\n".join(lines), encoding="utf-8")
    figure, axes = plt.subplots(2, 6, figsize=(20, 6.4), sharey=True)
    for axis, (factor, variants) in zip(axes.ravel()[: len(FACTORS)], FACTORS.items(), strict=True):
        for k, c in enumerate(cohorts):
            axis.plot(
                [label for label, _ in variants],
                [result(c, change)[0] / starts[k] for _, change in variants],
                "o-",
                label=chr(65 + k),
            )
        axis.set_title(factor)
        axis.tick_params(axis="x", labelrotation=20, labelsize=8)
        axis.set_ylim(0, 1.1)
    for axis in axes.ravel()[len(FACTORS) :]:
        axis.set_axis_off()
    axes[0, 0].set_ylabel("error / error at the start")
    axes[1, 0].set_ylabel("error / error at the start")
    axes[0, 0].legend(frameon=False, loc="lower center", ncol=5, fontsize=8, columnspacing=0.8, handlelength=1.0)
    figure.tight_layout()
    (HERE / "figures").mkdir(exist_ok=True)
    figure.savefig(HERE / "figures" / "defaults.png", dpi=90, metadata={"Software": None})


if __name__ == "__main__":
    main()
