"""One thread against two: evaluation, gradient, preconditioner; the bits must be the same.

    python -m benchmarks.threads

Two idle cores are needed. Before and after every sample a plain hash shows whether two threads really get two cores; samples
taken while they do not are thrown away, and how many were kept is printed. On a busy machine the quickest samples tell more than the
medians.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.common import fresh, group_objective, head, inside, moving_bumps
from ssmpipe.core.blocks import map_blocks
from ssmpipe.core.correspondence import covariance, gauss_newton, objective

_BYTES = bytes(4_000_000)


def clock(function: Callable[[], object]) -> float:
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def idle(pool: ThreadPoolExecutor) -> bool:
    """Return whether two threads hash twice as much in nearly the same time."""
    one = clock(lambda: hashlib.sha256(_BYTES))
    two = clock(lambda: list(pool.map(hashlib.sha256, (_BYTES, _BYTES))))
    return two < 1.15 * one


def shares(n_shapes: int, repeats: int = 9) -> None:
    """Print which share of the CPU time of one thread lies inside the blocks, and the best that two threads can make of it."""
    f = group_objective(moving_bumps(n_shapes))
    x = inside(f)
    spent = [0.0]

    def counted(*arguments: Any) -> list[Any]:
        begin = time.process_time()
        out = map_blocks(*arguments)
        spent[0] += time.process_time() - begin
        return out

    for module in (objective, covariance, gauss_newton):
        module.map_blocks = counted  # type: ignore[attr-defined]
    for name, run in (
        ("gradient", fresh(f, lambda: f.value_and_gradient(x))),
        ("preconditioner", lambda: f.preconditioner(x)),
    ):
        run()
        found = []
        for _ in range(repeats):
            spent[0], begin = 0.0, time.process_time()
            run()
            found.append(spent[0] / (time.process_time() - begin))
        share = median(found)
        print(
            f"{n_shapes:4} shapes, {name:14} {share:4.0%} inside the blocks, two threads at most {1 / (1 - share / 2):.2f}"
        )
    for module in (objective, covariance, gauss_newton):
        module.map_blocks = map_blocks  # type: ignore[attr-defined]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=34)
    parser.add_argument("--samples", type=int, default=21)
    parser.add_argument("--budget", type=float, default=60.0, help="seconds to wait for idle cores")
    parser.add_argument("--shares", action="store_true", help="only the share of the work that threads can have")
    args = parser.parse_args()
    if args.shares:
        head("Share of the work inside the blocks, 51 x 51 landmarks, 8 x 8 coefficients")
        for n in (12, 34, 100, 300):
            shares(n)
        return
    head(f"Threads, {args.shapes} shapes, 51 x 51 landmarks, 8 x 8 coefficients")
    splines = moving_bumps(args.shapes)
    results: dict[int, list[bytes]] = {}
    work: dict[int, dict[str, Callable[[], object]]] = {}
    for threads in (1, 2):
        f = group_objective(splines, threads=threads)
        x = inside(f)
        parameters = f.reparameterization.evaluate(f.coefficients(x))
        jet = f.stack.evaluate(parameters)
        _, gradient = f.value_and_gradient(x)
        results[threads] = [v.tobytes() for v in (gradient, f.hessian(x)(gradient), f.preconditioner(x)(gradient))]
        work[threads] = {
            "evaluation": lambda f=f, p=parameters, j=jet: f.stack.evaluate(p, reuse=j),
            "gradient": fresh(f, lambda f=f, x=x: f.value_and_gradient(x)),
            "preconditioner": lambda f=f, x=x: f.preconditioner(x),
        }
    times: dict[tuple[int, str], list[float]] = {(t, name): [] for t in (1, 2) for name in work[1]}
    begin, tried = time.perf_counter(), 0
    with ThreadPoolExecutor(2) as pool:
        while time.perf_counter() - begin < args.budget and any(len(t) < args.samples for t in times.values()):
            for name in work[1]:
                tried += 1
                if not idle(pool):
                    continue
                one, two = (clock(work[threads][name]) for threads in (1, 2))
                if idle(pool):
                    times[1, name].append(one)
                    times[2, name].append(two)
    kept = sum(len(times[1, name]) for name in work[1])
    print(f"{os.cpu_count()} cores; {kept} of {tried} samples with both cores idle [ms]\n")
    for name in work[1]:
        if times[1, name]:
            for label, take in (("medians", median), ("quickest", min)):
                one, two = take(times[1, name]), take(times[2, name])
                print(f"{name:16} {label:9} one {1e3 * one:8.2f}   two {1e3 * two:8.2f}   ratio {one / two:5.2f}")
    print(f"same bits: {results[1] == results[2]}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
