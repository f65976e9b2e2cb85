"""Gradient by the adjoint, by direct differentiation and by finite differences (Li 2015, table 2.2, figures 2.21-2.23).

Finite differences re-evaluate the whole cohort once per unknown with the same precomputed bases. The bound is ``n_D + 1``
evaluations over the cost of one gradient; of the second bound the gradient costs its floor only (see gradient_cost).

    python -m benchmarks.sensitivities --plots docs/figures
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.common import fresh, group_objective, head, inside, median_time
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.sensitivity import direct_gradient, finite_difference_gradient
from ssmpipe.core.spline.evaluate import Spline
from ssmpipe.core.spline.fit_curve import fit_curve
from ssmpipe.synth import box_bump
from ssmpipe.synth import plane_bump as family

THESIS = {4: 12.6, 8: 62.0, 12: 106.0, 16: 153.0}


def planes(n: int) -> list[Spline]:
    return [family.bump(30.0 + 22.5 * (k / (n - 1) - 0.5)) for k in range(n)]


def boxes(n: int) -> list[Spline]:
    u = np.linspace(0.0, 1.0, 1601)
    centres = np.linspace(15.0, 45.0, n)
    outlines = [box_bump.outline(c, u * box_bump.feature_lengths(c)[-1]) for c in centres]
    return [fit_curve(o, degree=2, n_control=box_bump.N_CONTROL, parameters=u) for o in outlines]


def table(repeats: int) -> None:
    names = ("adjoint ms", "direct ms", "differences", "ratio", "thesis", "bound", "share", "floor bound", "share")
    print(f"{'n_b':>8} {'n_D':>5} " + " ".join(f"{name:>11}" for name in names))
    splines = planes(4)
    for n_b, thesis in THESIS.items():
        f = group_objective(splines, (n_b, n_b))
        x = inside(f)
        parameters = f.reparameterization.evaluate(f.coefficients(x))
        jet = f.stack.evaluate(parameters)
        points = jet.points.copy()
        flat = (points - points.mean(axis=0)).reshape(len(points), -1)
        gram = flat @ flat.T
        adjoint = median_time(fresh(f, lambda f=f, x=x: f.spectral_gradient(x)), repeats)
        direct = median_time(fresh(f, lambda f=f, x=x: direct_gradient(f, x)), 5)
        evaluation = median_time(fresh(f, lambda f=f, x=x: f.spectral_value(x)), repeats)
        floor = median_time(
            lambda f=f, p=parameters, a=flat, g=gram, j=jet: (f.stack.evaluate(p, reuse=j), a @ a.T, g @ a), repeats
        )
        begin = time.process_time()
        finite_difference_gradient(f, x)
        differences = time.process_time() - begin
        ratio, bound, strict = (
            differences / adjoint,
            (x.size + 1) * evaluation / adjoint,
            (x.size + 1) * evaluation / floor,
        )
        row = (1e3 * adjoint, 1e3 * direct, 1e3 * differences, ratio, thesis, bound)
        print(
            f"{n_b:>3} x {n_b:<2} {x.size:>5} "
            + " ".join(f"{value:11.1f}" for value in row)
            + f" {ratio / bound:11.0%} {strict:11.0f} {ratio / strict:11.0%}"
        )


def times(objectives: Sequence[GroupObjective]) -> tuple[list[float], list[float]]:
    direct, adjoint = [], []
    for f in objectives:
        x = inside(f)
        adjoint.append(1e3 * median_time(fresh(f, lambda f=f, x=x: f.spectral_gradient(x)), 5))
        direct.append(1e3 * median_time(fresh(f, lambda f=f, x=x: direct_gradient(f, x)), 5))
    return direct, adjoint


def plots(folder: Path) -> None:
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    four_boxes, four_planes = boxes(4), planes(4)
    n_b = ([6, 12, 24, 48], [4, 8, 12, 16])
    n_p = ([26, 51, 101, 201], [26, 51, 76, 101])
    n_s = ([4, 8, 16, 32], [4, 8, 16, 32])
    panels = [
        (
            "2.21",
            "n_b",
            n_b[0],
            [group_objective(four_boxes, (n,), (51,)) for n in n_b[0]],
            n_b[1],
            [group_objective(four_planes, (n, n)) for n in n_b[1]],
        ),
        (
            "2.22",
            "n_P",
            n_p[0],
            [group_objective(four_boxes, (12,), (n,)) for n in n_p[0]],
            n_p[1],
            [group_objective(four_planes, (12, 12), (n, n)) for n in n_p[1]],
        ),
        (
            "2.23",
            "n_S",
            n_s[0],
            [group_objective(boxes(n), (12,), (51,)) for n in n_s[0]],
            n_s[1],
            [group_objective(planes(n), (12, 12)) for n in n_s[1]],
        ),
    ]
    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    for column, (number, name, x0, curves, x1, surfaces) in enumerate(panels):
        for row, (kind, values, objectives) in enumerate((("box-bump", x0, curves), ("plane-bump", x1, surfaces))):
            direct, adjoint = times(objectives)
            axis = axes[row, column]
            axis.plot(values, direct, "s--", color="tab:orange", label="direct")
            axis.plot(values, adjoint, "o-", color="tab:blue", label="adjoint")
            axis.set(
                xlabel=f"{name}{' per direction' if row and name != 'n_S' else ''}",
                ylabel="one gradient [ms]",
                ylim=(0, None),
            )
            axis.set_title(f"{kind}, as figure {number}{'ab'[row]}", fontsize=9)
            axis.legend(frameon=False, fontsize=8)
            print(
                f"{kind:10} {name}: {values}  direct {[round(v, 2) for v in direct]}  adjoint {[round(v, 2) for v in adjoint]} ms"
            )
    figure.savefig(folder / "sensitivities.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--plots", type=Path, help="folder for sensitivities.png")
    args = parser.parse_args()
    head("Gradient of four plane-bumps, 51 x 51 landmarks")
    table(args.repeats)
    if args.plots:
        print()
        plots(args.plots)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
