"""The group optimization serial, on threads and on every engine: time per iteration, bytes moved, identical result; and what an engine
costs by itself.

51 x 51 landmarks, 8 x 8 coefficients, rows in four blocks. The iterations are those of the solver, the preconditioner (built here, every
tenth iteration) included. Overhead: the messages of one iteration, of the same size, with nothing computed.

    python -m benchmarks.engines                        1000 shapes; overhead at 200
    python -m benchmarks.engines --shapes 100 --iterations 5
"""

from __future__ import annotations

import argparse
import hashlib
import os
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.common import LAMBDA_CUT, head
from benchmarks.growth import cohort
from benchmarks.process_engine import ProcessEngine
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.covariance import SlopeProduct
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.rows import DEFAULT_BLOCKS, RowSums
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.engine import Arrays, Content, Engine
from ssmpipe.core.optim.interior import DescentOptions, minimize_interior
from ssmpipe.core.spline.evaluate import Spline, SplineStack
from ssmpipe.runner.dask_engine import DaskEngine

GRID = (51, 51)


class Counting:
    """An engine that counts the bytes of arguments and results as they are packed."""

    def __init__(self, engine: Any) -> None:
        self.engine, self.bytes = engine, 0

    @property
    def n_workers(self) -> int:
        return int(self.engine.n_workers)

    def share(self, arrays: Arrays) -> Content:
        return self.engine.share(arrays)

    def call(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        answers = self.engine.call(function, arguments)
        self.bytes += sum(len(pickle.dumps(one, protocol=5)) for one in (*arguments, *answers))
        return answers


@contextmanager
def engines(folder: Path) -> Iterator[dict[str, Engine | None]]:
    import distributed

    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, memory_limit=0,
        local_directory=str(folder / "dask"), silence_logs=50,
    )  # fmt: skip
    with ProcessEngine(2, folder / "a") as two, distributed.Client(cluster, direct_to_workers=True) as client:
        client.run(one_thread)
        yield {
            "serial": None,
            "2 threads": None,
            "2 processes": Counting(two),
            "dask, 2 local workers": Counting(DaskEngine(client, folder / "b")),
        }
    cluster.close()


def one_thread() -> None:
    threadpool_limits(1)


def objective(splines: list[Spline], engine: Engine | None, threads: int) -> GroupObjective:
    stack, space = SplineStack(splines, threads=threads), Reparameterization((8, 8), GRID)
    weights = np.full(GRID[0] * GRID[1], 1 / (GRID[0] * GRID[1]))
    return GroupObjective(
        stack,
        space,
        spectral_function("description-length", LAMBDA_CUT),
        base_weights=weights,
        reference=0,
        barrier=10.0,
        sums=RowSums(splines, stack, space, weights, DEFAULT_BLOCKS, engine),
    )


def measure(name: str, splines: list[Spline], engine: Engine | None, iterations: int) -> str:
    f = objective(splines, engine, threads=2 if name == "2 threads" else 1)
    x = f.start()
    f.value_and_gradient(x)  # files, first call
    before = engine.bytes if isinstance(engine, Counting) else 0
    workers = worker_seconds(engine)
    times, here = [time.perf_counter()], time.process_time()
    result = minimize_interior(
        f,
        x,
        DescentOptions(max_iterations=iterations, relative_decrease=0.0),
        callback=lambda *_: times.append(time.perf_counter()),
    )
    cpu = (time.process_time() - here) / result.n_iterations
    there = (worker_seconds(engine) - workers).max() / result.n_iterations
    moved = (engine.bytes - before) / result.n_iterations / 1e6 if isinstance(engine, Counting) else 0.0
    digest = hashlib.sha256(result.value.tobytes()).hexdigest()[:10]
    return f"{name:<24} {np.diff(times).min():>9.2f} {median(np.diff(times)):>9.2f} {cpu:>11.2f} {there:>18.2f} {moved:>6.2f}   {digest}"


def worker_seconds(engine: Engine | None) -> Floats:
    """Return the CPU seconds of the two workers so far."""
    return np.zeros(2) if engine is None else np.array(engine.call(time.process_time, [(), ()]))


def echo_gram(_c: Content, rows: tuple[Any, ...], unknowns: Floats) -> list[Floats]:
    n = len(unknowns)
    return [np.zeros(n * (n + 1) // 2) for _ in rows]


def echo_gradient(_c: Content, rows: tuple[Any, ...], unknowns: Floats, _slope: SlopeProduct) -> list[Floats]:
    return [np.zeros_like(unknowns) for _ in rows]


def overhead(n: int, engine: Counting, repeats: int = 100) -> tuple[float, float, float, float, float]:
    """Return least and median time of an iteration's messages, CPU time here and in the busier worker [ms], and bytes [MB]."""
    content = Content("none", np.zeros)  # type: ignore[arg-type]
    unknowns = np.random.default_rng(0).normal(size=(n, 72))
    slope = SlopeProduct(np.random.default_rng(1).normal(size=(n, n)))
    shares = [((0, 1), (1, 2)), ((2, 3), (3, 4))]
    times = []
    workers, here = np.array(engine.engine.call(time.process_time, [(), ()])), time.process_time()
    for _ in range(repeats):
        begin = time.perf_counter()
        engine.engine.call(echo_gram, [(content, share, unknowns) for share in shares])
        engine.engine.call(echo_gradient, [(content, share, unknowns, slope) for share in shares])
        times.append(1e3 * (time.perf_counter() - begin))
    here = 1e3 * (time.process_time() - here) / repeats
    there = 1e3 * (np.array(engine.engine.call(time.process_time, [(), ()])) - workers).max() / repeats
    before = engine.bytes
    engine.call(echo_gram, [(content, share, unknowns) for share in shares])
    engine.call(echo_gradient, [(content, share, unknowns, slope) for share in shares])
    return min(times), median(times), here, float(there), (engine.bytes - before) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=1000)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--overhead", type=int, default=200, help="shapes whose messages are timed")
    args = parser.parse_args()
    head("Engines of the group optimization, two workers")
    print(f"load of the machine when this began: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors\n")
    with tempfile.TemporaryDirectory() as folder, engines(Path(folder)) as found, threadpool_limits(1):
        print(f"messages of one iteration, {args.overhead} shapes, nothing computed")
        print("engine                    least ms  median ms  CPU ms here  CPU ms in a worker     MB")
        for name, engine in found.items():
            if isinstance(engine, Counting):
                least, middle, here, there, moved = overhead(args.overhead, engine)
                print(
                    f"{name:<24} {least:>9.1f} {middle:>10.1f} {here:>12.1f} {there:>19.1f} {moved:>6.2f}", flush=True
                )
        splines = cohort(args.shapes)
        print(f"\n{args.shapes} shapes, {args.iterations} iterations")
        print("engine                     least s  median s  CPU s here  CPU s in a worker     MB   result")
        for name, engine in found.items():
            print(measure(name, splines, engine, args.iterations), flush=True)


if __name__ == "__main__":
    main()
