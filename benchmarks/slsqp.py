"""Against scipy's SLSQP with the same functions, on planes whose bump moves in x and y and changes height.

Both sides start from the identity and see the same description length, gradient and Bernstein coefficients of det dD/du. SLSQP
gets one Kreisselmeier-Steinhauser aggregate per shape (Li 2015, [2.22]), once with K = 15 and once with K = 200, since one row
per coefficient would make its dense subproblem larger by a factor of hundreds. Only points whose coefficients are all positive,
that is certified maps, count for either side. No prior, no pose, one thread;
seconds are CPU time, so that a busy machine does no harm.

    python -m benchmarks.slsqp                                   about three minutes
    python -m benchmarks.slsqp --case 100x8 --solver auto --sharpness 15 --budget 1800        the long one
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from benchmarks.common import LAMBDA_CUT, group_objective, head, moving_bumps
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions, Solver
from ssmpipe.core.spline.evaluate import Spline

BARRIERS = (10.0, 1.0, 0.1, 0.01)
Track = list[tuple[float, float]]


class _OverBudget(Exception):
    pass


def run_slsqp(f: GroupObjective, sharpness: float, budget: float) -> tuple[Track, str]:
    """Return (time, best certified value) and how it ended."""
    aggregate = Barrier("ks", 0.0, sharpness)
    n_shapes = len(f.moving)
    per_shape = f.start().size // n_shapes
    track: Track = []
    begin = time.process_time()

    def value(x: Floats) -> tuple[float, Floats]:
        out = f.spectral_gradient(x)
        elapsed = time.process_time() - begin
        if f.smallest_jacobian(x) > 0 and (not track or out[0] < track[-1][1]):
            track.append((elapsed, out[0]))
        if elapsed > budget:
            raise _OverBudget
        return out

    def constraint(x: Floats) -> Floats:
        return -aggregate.constraint(f.inequalities.jacobian.coefficients(f.coefficients(x)[f.moving]))

    def rows(x: Floats) -> Floats:
        moving = f.coefficients(x)[f.moving]
        jacobians = f.inequalities.jacobian.coefficients(moving)
        excess = aggregate.sharpness * (jacobians.min(axis=1, keepdims=True) - jacobians)
        share = np.exp(excess) / np.exp(excess).sum(axis=1, keepdims=True)
        pulled = f.inequalities.jacobian.pull_back(moving, share)[:, f.reparameterization.free]
        out = np.zeros((n_shapes, n_shapes * per_shape))
        for i in range(n_shapes):
            out[i, i * per_shape : (i + 1) * per_shape] = pulled[i]
        return out

    try:
        result = minimize(
            value,
            f.start(),
            jac=True,
            method="SLSQP",
            constraints=[{"type": "ineq", "fun": constraint, "jac": rows}],
            options={"maxiter": 10_000, "ftol": 1e-8},
        )
    except _OverBudget:
        return track, f"stopped after {budget:g} s"
    return track, f"ended after {time.process_time() - begin:.1f} s: {result.message}"


def run_engine(splines: list[Spline], n_b: int, solver: Solver) -> Track:
    options = EngineOptions(
        n_coefficients=(n_b, n_b),
        lambda_cut=LAMBDA_CUT,
        pose="keep",
        normalize="none",
        prior=0.0,
        barriers=BARRIERS,
        reference=0,
        solver=solver,
    )
    track: Track = []
    begin = time.process_time()

    def record(row: dict[str, float]) -> None:
        if row["min_jacobian"] > 0:
            track.append((time.process_time() - begin, row["description_length"]))

    result = optimize_correspondence(splines, options, record=record)
    assert all(c.verdict == "proved" for c in result.value.certificates)
    return track


def median_run(splines: list[Spline], n_b: int, solver: Solver, repeats: int) -> Track:
    """Return the run of median length; all give the same values."""
    return sorted((run_engine(splines, n_b, solver) for _ in range(repeats)), key=lambda t: t[-1][0])[repeats // 2]


def reached(track: Track, level: float) -> float:
    return next((t for t, v in track if v <= level), float("inf"))


def compare(
    n_shapes: int,
    n_b: int,
    budget: float,
    seed: int,
    solvers: tuple[Solver, ...],
    sharpnesses: list[float],
    repeats: int,
) -> None:
    splines = moving_bumps(n_shapes, seed)
    f = group_objective(splines, (n_b, n_b), barrier=0.0)
    f.value_and_gradient(f.start())
    unknowns = f.start().size
    print(
        f"{n_shapes} shapes, {n_b} x {n_b}, seed {seed}: {unknowns} unknowns, start {f.spectral_value(f.start()):.3f}"
    )
    ours = {solver: median_run(splines, n_b, solver, repeats) for solver in solvers}
    for solver, track in ours.items():
        print(f"  engine, {solver:13} final {track[-1][1]:9.4f}, {track[-1][0]:7.2f} s, {len(track) - 1} iterations")
    for sharpness in sharpnesses:
        track, ending = run_slsqp(f, sharpness, budget)
        seconds, best = track[-1]
        print(f"  SLSQP, K = {sharpness:<9g} best  {best:9.4f}, {seconds:7.2f} s, {ending}")
        for solver, mine in ours.items():
            at = reached(mine, best)
            above = mine[-1][1] / best - 1
            ratio = f"{at:7.2f} s, {seconds / at:6.1f} times sooner" if np.isfinite(at) else "never"
            print(f"    engine, {solver:13} reaches it in {ratio}; final value {above:+.2%} of SLSQP's")
    print(flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", action="append", help="shapes x coefficients, such as 100x8; default 4x12 and 34x8")
    parser.add_argument("--solver", action="append", choices=("auto", "quasi-newton", "newton"), help="default all")
    parser.add_argument(
        "--sharpness", type=float, nargs="+", default=[15.0, 200.0], help="K of the constraints of SLSQP"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[3], help="of the cohort; the problem has many local minima"
    )
    parser.add_argument("--budget", type=float, default=40.0, help="seconds for each run of SLSQP")
    parser.add_argument("--repeats", type=int, default=5, help="runs of the engine; the one of median length counts")
    args = parser.parse_args()
    head("SLSQP against the engine, moving bumps, 51 x 51 landmarks")
    for case in args.case or ["4x12", "34x8"]:
        n_shapes, n_b = map(int, case.split("x"))
        for seed in args.seeds:
            solvers = tuple(args.solver or ("auto", "quasi-newton", "newton"))
            compare(n_shapes, n_b, args.budget, seed, solvers, args.sharpness, args.repeats)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
