"""Many patients through the per-shape stages of the preset ``femur-distal``, two children: throughput, and memory against their number.

The patients are the six synthetic femora of this repository in new poses and sizes (up to five percent), so that every scan is another
file. Several numbers of patients are run one after the other, each into an empty folder.

    python -m benchmarks.throughput                    500 patients, and 50 to compare
    python -m benchmarks.throughput --n 12 48
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.common import head
from ssmpipe.core.align.rigid import rotation_vector_matrix
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import read_mesh, write_mesh

COHORT = Path(__file__).resolve().parents[1] / "data_synthetic" / "femur_distal"


def write_cohort(folder: Path, n: int) -> Path:
    """Write scans, table and config; return the config."""
    sides = {row["id"]: row["side"] for row in csv.DictReader((COHORT / "cohort.csv").open())}
    names = sorted(sides)
    base = {name: read_mesh(COHORT / "scans" / f"{name}.ply") for name in names}
    (folder / "scans").mkdir(parents=True)
    rng = np.random.default_rng(n)
    with (folder / "cohort.csv").open("w") as table:
        table.write("id,side\n")
        for k in range(n):
            name = names[k % len(names)]
            turn = rotation_vector_matrix(rng.normal(size=3))
            vertices = rng.uniform(0.95, 1.05) * base[name].vertices @ turn.T + rng.uniform(-50, 50, 3)
            write_mesh(folder / "scans" / f"p{k:05d}.ply", TriMesh(vertices, base[name].faces))
            table.write(f"p{k:05d},{sides[name]}\n")
    config = folder / "patients.yaml"
    config.write_text(
        "name: patients\ninput: {scans: scans/*.ply, cohort: cohort.csv, units: mm}\noutput: out\n"
        "anatomy: femur-distal\nstages:\n  - align: {reference: p00000}\n"
    )
    return config


def measure(n: int, jobs: int, executor: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        config = write_cohort(Path(folder), n)
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        command = [sys.executable, "-m", "ssmpipe", "run", str(config), "--to", "fit", "-q", "--jobs", str(jobs)]
        done = subprocess.run([*command, "--executor", executor])
        wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode in (0, 3), done.returncode
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        record = json.loads((Path(folder) / "out/run.json").read_text())
        peaks = [
            json.loads(path.read_text())["peak_rss_mb"] for path in Path(folder).glob("out/shapes/*/*/timing.json")
        ]
        n_failed = len(record.get("failures", {}))
        size = sum(p.stat().st_size for p in Path(folder, "out").rglob("*") if p.is_file()) / n / 1e6
    peak = record["timings"]["peak_rss_mb"]
    values = (n, n_failed, f"{60 * n / wall:.1f}", f"{cpu / n:.2f}", f"{peak:.0f}", f"{max(peaks):.0f}", f"{size:.2f}")
    return "  ".join(f"{v:>{w}}" for v, w in zip(values, (8, 6, 12, 13, 11, 13, 10), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, nargs="+", default=[50, 500])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--executor", choices=["local", "dask"], default="local")
    args = parser.parse_args()
    head(f"Patients through the per-shape stages, {args.jobs} children, executor {args.executor}")
    print(f"load of the machine when this began: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors\n")
    columns = ("patients", "failed", "patients/min", "CPU s/patient", "peak all MB", "peak child MB", "MB/patient")
    print("  ".join(columns))
    for n in args.n:
        print(measure(n, args.jobs, args.executor), flush=True)


if __name__ == "__main__":
    main()
