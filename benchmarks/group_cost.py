"""What the group stages cost: measured on planes with a moving bump, then fitted by the terms of ``ssmpipe/runner/estimate.py``.

    python -m benchmarks.group_cost

Every size runs in a process of its own (one thread, default options but for the grid and the coefficients). Prints CPU seconds
and memory beyond an idle process, the fitted constants that ``estimate.py`` holds (but for the products and eigenvalues of
thousands of shapes, which these sizes do not show), and how far single sizes lie from the fit.
"""

from __future__ import annotations

import logging
import multiprocessing
import resource
import time
from typing import Any

import numpy as np
from scipy.optimize import nnls
from threadpoolctl import threadpool_limits

from benchmarks.common import head
from benchmarks.growth import cohort
from ssmpipe.contract import Context, ShapeInfo
from ssmpipe.runner.estimate import evaluate_terms, memory_terms, optimize_terms
from ssmpipe.stages import evaluate, model, optimize

SIZES = [  # shapes, landmarks, coefficients
    (5, 51, 8), (10, 51, 8), (20, 51, 8), (40, 51, 8), (80, 51, 8), (160, 51, 8), (10, 31, 6), (30, 31, 6), (10, 51, 12),
    (20, 51, 12), (10, 101, 8), (20, 101, 8),
]  # fmt: skip


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(n: int, grid: int, coefficients: int) -> dict[str, Any]:
    with threadpool_limits(1):
        surfaces = {f"s{k:04d}": s for k, s in enumerate(cohort(n))}
        transform = {i: np.eye(4) for i in surfaces}
        idle = _peak()
        ctx = Context("cohort", np.random.default_rng(0), logging.getLogger("benchmark"))
        cfg = optimize.Config(n_coefficients=(coefficients, coefficients), landmarks=(grid, grid))
        begin = time.process_time()
        found = optimize.run(surface=surfaces, transform=transform, landmarks=None, cfg=cfg, ctx=ctx)
        optimized = time.process_time() - begin
        begin, memory = time.process_time(), _peak() - idle
        correspondence = found["correspondence"]
        info = {i: ShapeInfo(i, None, {}) for i in correspondence.ids}
        model.run(correspondence=correspondence, info=info, cfg=model.Config(), ctx=ctx)
        evaluate.run(correspondence=correspondence, landmarks={}, transform=transform, cfg=evaluate.Config(), ctx=ctx)
        return {"optimize": optimized, "evaluate": time.process_time() - begin, "memory": memory, "idle": idle}


def fit(name: str, rows: list[list[float]], measured: list[float]) -> None:
    """Fit non-negative constants by relative error and print them with the spread."""
    a, b = np.array(rows), np.array(measured)
    constants, _ = nnls(a / b[:, None], np.ones(len(b)))
    ratio = b / (a @ constants)
    print(
        f"{name}: {', '.join(f'{c:.2e}' for c in constants)}; measured over fitted {ratio.min():.2f} to {ratio.max():.2f}"
    )


def main() -> None:
    head("Cost of the group stages, CPU seconds on one thread")
    print(f"{'n_S':>5} {'grid':>8} {'n_b':>6} {'optimize s':>11} {'rest s':>8} {'memory MB':>10}")
    found = []
    for size in SIZES:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(measure, size)
        found.append(row)
        n, grid, b = size
        cells = f"{row['optimize']:11.2f} {row['evaluate']:8.2f} {row['memory']:10.0f}"
        print(f"{n:>5} {f'{grid}x{grid}':>8} {f'{b}x{b}':>6} {cells}", flush=True)
    print(f"idle process: {np.median([row['idle'] for row in found]):.0f} MB")
    terms = [(n, grid * grid, b * b) for n, grid, b in SIZES]
    fit("OPTIMIZE_S", [list(optimize_terms(*t)) for t in terms], [row["optimize"] for row in found])
    fit("EVALUATE_S", [list(evaluate_terms(t[0], t[1])) for t in terms], [row["evaluate"] for row in found])
    fit("MEMORY_MB", [list(memory_terms(*t)) for t in terms], [row["memory"] for row in found])


if __name__ == "__main__":
    main()
