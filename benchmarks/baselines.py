"""Time to the same description length: concatenated small warps against the direct spline reparameterization.

Box-bump curves with Cauchy kernels, plane-bump surfaces and distal femora with clamped-plate splines (Li 2015, figures 2.9, 2.15
and 2.32). Both sides see the same splines, landmarks, weights, threshold and reference, no prior and no pose, on one thread. The
spline map runs to its end, the median of five runs counts; the baseline then has to reach the same description length within its
budget. Seconds are CPU time, so that a busy machine does little harm. Run from the repository:

    python -m benchmarks.baselines --budget 120
    python -m ssmpipe run configs/femur_distal.yaml --to fit --set output=FOLDER
    python -m benchmarks.baselines --budget 300 --only femora --femora FOLDER
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from ssmpipe.core.baselines import cauchy, clamped_plate
from ssmpipe.core.baselines.concatenation import Concatenation
from ssmpipe.core.correspondence.description_length import automatic_lambda_cut
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.result import Result
from ssmpipe.core.spline.evaluate import Spline
from ssmpipe.core.spline.fit_curve import fit_curve
from ssmpipe.io.splines import read_spline
from ssmpipe.synth import box_bump, plane_bump

REFERENCE = 1
BARRIERS = (30.0, 10.0, 3.0)
SHARES = (0.5, 0.8, 0.9, 0.95, 0.99, 1.0)


@dataclass(frozen=True)
class Problem:
    """A cohort, the resolution of the spline map, and the baseline to beat."""

    name: str
    splines: Sequence[Spline]
    n_coefficients: tuple[int, ...]
    grid: tuple[int, ...]
    barriers: tuple[float, ...]
    lambda_cut: float
    baseline: Callable[..., Result[Concatenation]]


@dataclass(frozen=True)
class Run:
    """Description length over time."""

    seconds: np.ndarray
    lengths: np.ndarray
    steps: int
    evaluations: int

    def time_to(self, level: float) -> float:
        """Return when ``level`` was reached first; infinity if never."""
        reached = np.flatnonzero(self.lengths <= level + 1e-9)
        return float(self.seconds[reached[0]]) if len(reached) else float("inf")


def boxes() -> list[Spline]:
    u = np.linspace(0.0, 1.0, 4001)
    lengths = [(c, box_bump.feature_lengths(c)[-1]) for c in np.linspace(15.0, 45.0, 4)]
    return [
        fit_curve(box_bump.outline(c, u * whole), degree=2, n_control=box_bump.N_CONTROL, parameters=u)
        for c, whole in lengths
    ]


def planes() -> list[Spline]:
    return [plane_bump.bump(mean) for mean in 30.0 + 7.5 * np.array([-1.5, -0.5, 0.5, 1.5])]


def problem(kind: str, lambda_cut: float, femora: Path | None) -> Problem:
    if kind == "curve":
        barriers = (30.0, 10.0, 3.0, 1.0, 0.3)
        return Problem("box-bump: Cauchy kernels", boxes(), (22,), (51,), barriers, lambda_cut, cauchy.optimize)
    if kind == "surface":
        return Problem(
            "plane-bump: clamped plates", planes(), (12, 12), (51, 51), BARRIERS, lambda_cut, clamped_plate.optimize
        )
    assert femora is not None
    splines = [
        read_spline(next(shape.glob("*-fit")) / "surface.npz") for shape in sorted((femora / "shapes").iterdir())
    ]
    mean = np.mean([s.control_points.reshape(-1, s.dimension) for s in splines], axis=0)
    cut = automatic_lambda_cut(float(np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean())))
    return Problem("femora: clamped plates", splines, (8, 8), (51, 51), BARRIERS, cut, clamped_plate.optimize)


def run_spline(problem: Problem) -> Run:
    options = EngineOptions(
        n_coefficients=problem.n_coefficients,
        landmarks=problem.grid,
        covariance="discrete",
        lambda_cut=problem.lambda_cut,
        pose="keep",
        normalize="none",
        prior=0.0,
        barriers=problem.barriers,
        reference=REFERENCE,
    )
    rows: list[tuple[float, float]] = []
    begin = time.process_time()
    result = optimize_correspondence(
        problem.splines,
        options,
        record=lambda row: rows.append((time.process_time() - begin, row["description_length"])),
    )
    seconds, lengths = np.array(rows).T
    return Run(seconds, lengths, result.n_iterations, result.n_evaluations)


def run_baseline(problem: Problem, target: float, budget: float, seed: int) -> Run:
    result = problem.baseline(
        problem.splines,
        grid=problem.grid,
        lambda_cut=problem.lambda_cut,
        reference=REFERENCE,
        n_warps=10**9,
        rng=np.random.default_rng(seed),
        time_budget_s=budget,
        target=target,
        clock=time.process_time,
    )
    history = result.history
    return Run(history["elapsed"], history["description_length"], result.n_iterations, result.n_evaluations)


def compare(problem: Problem, budget: float, seed: int) -> None:
    spline = sorted((run_spline(problem) for _ in range(5)), key=lambda run: float(run.seconds[-1]))[2]
    start, target = float(spline.lengths[0]), float(spline.lengths.min())
    warps = run_baseline(problem, target, budget, seed)
    n = " x ".join(map(str, problem.n_coefficients))
    print(f"\n{problem.name}, {len(problem.splines)} shapes, lambda_cut {problem.lambda_cut:.3g}, start {start:.2f}")
    print(
        f"  spline map, {n} coefficients: {target:.2f} after {spline.steps} iterations, {spline.evaluations} evaluations"
    )
    print(f"  warps, seed {seed}: {warps.lengths[-1]:.2f} after {warps.steps} warps, {warps.evaluations} evaluations")
    print(f"  {'share of the fall':>18} {'level':>8} {'spline s':>10} {'warps s':>10} {'ratio':>9}")
    for share in SHARES:
        level = start + share * (target - start)
        fast, slow = spline.time_to(level), warps.time_to(level)
        if np.isfinite(slow):
            print(f"  {share:18.2f} {level:8.2f} {fast:10.3f} {slow:10.3f} {slow / fast:9.1f}")
        else:
            spent = float(warps.seconds[-1])
            print(f"  {share:18.2f} {level:8.2f} {fast:10.3f} {f'> {spent:.0f}':>10} {f'> {spent / fast:.0f}':>9}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--budget", type=float, default=120.0, help="seconds for each baseline [120]")
    parser.add_argument("--lambda-cut", type=float, default=3e-5, help="threshold of the description length [3e-5]")
    parser.add_argument("--seed", type=int, default=0, help="of the random warps [0]")
    parser.add_argument("--only", choices=["curve", "surface", "femora"], help="one of the problems")
    parser.add_argument("--femora", type=Path, metavar="FOLDER", help="output of a run of femora up to the stage fit")
    options = parser.parse_args()
    kinds = [options.only] if options.only else ["curve", "surface", *(["femora"] if options.femora else [])]
    if "femora" in kinds and options.femora is None:
        parser.error("--only femora needs --femora FOLDER")
    with threadpool_limits(1):
        for kind in kinds:
            compare(problem(kind, options.lambda_cut, options.femora), options.budget, options.seed)


if __name__ == "__main__":
    main()
