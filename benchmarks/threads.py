"""One thread against two: evaluation, gradient, second-derivative product, preconditioner; the bits must be the same.

    python -m benchmarks.threads

Two idle cores are needed; the load of the machine is printed beside the figures.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

from threadpoolctl import threadpool_limits

from benchmarks.common import fresh, group_objective, head, inside, median_time, moving_bumps


def spin(seconds: float = 0.2) -> float:
    """Return the share of a core that this process gets."""
    begin, used = time.perf_counter(), time.process_time()
    while time.perf_counter() - begin < seconds:
        pass
    return (time.process_time() - used) / (time.perf_counter() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=34)
    parser.add_argument("--repeats", type=int, default=21)
    args = parser.parse_args()
    head(f"Threads, {args.shapes} shapes, 51 x 51 landmarks, 8 x 8 coefficients, medians of {args.repeats} [ms]")
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(f"{os.cpu_count()} cores, load {load:.2f} before the start, {spin():.0%} of a core for one thread\n")
    splines = moving_bumps(args.shapes)
    results: dict[int, list[bytes]] = {}
    seconds: dict[int, dict[str, float]] = {}
    for threads in (1, 2):
        f = group_objective(splines, threads=threads)
        x = inside(f)
        parameters = f.reparameterization.evaluate(f.coefficients(x))
        _value, gradient = f.value_and_gradient(x)
        product = f.hessian(x)
        inverse = f.preconditioner(x)
        results[threads] = [v.tobytes() for v in (gradient, product(gradient), inverse(gradient))]
        work: dict[str, Callable[[], object]] = {
            "evaluation": lambda f=f, p=parameters: f.stack.evaluate(p),
            "gradient": fresh(f, lambda f=f, x=x: f.value_and_gradient(x)),
            "preconditioner": lambda f=f, x=x: f.preconditioner(x),
        }
        seconds[threads] = {name: median_time(function, args.repeats) for name, function in work.items()}
    for name in seconds[1]:
        one, two = seconds[1][name], seconds[2][name]
        print(f"{name:16} one {1e3 * one:8.2f}   two {1e3 * two:8.2f}   ratio {one / two:5.2f}")
    print(f"same bits: {results[1] == results[2]}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
