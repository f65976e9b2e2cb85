"""The real stages give the same bytes however many processes and threads share the work, on whatever engine, in whatever folder."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COHORT = ROOT / "data_synthetic" / "femur_distal"
CONFIG = f"""\
name: bits
input:
  scans: [{", ".join(str(COHORT / "scans" / f"femur_0{k}.ply") for k in (1, 2, 4, 5))}]
  cohort: {COHORT / "cohort.csv"}
  landmarks: {COHORT / "landmarks.json"}
output: out
anatomy: femur-distal
stages:
  - optimize: {{n_coefficients: [6, 6], landmarks: [21, 21], max_iterations: 15, landmark_blocks: 4}}
"""


@pytest.mark.slow
def test_one_process_and_two_give_the_same_bytes(tmp_path: Path) -> None:
    one = run(tmp_path / "first", "1", "--jobs", "1")
    compare(one, run(tmp_path / "second place", "4", "--jobs", "2"))


@pytest.mark.slow
@pytest.mark.skipif(find_spec("distributed") is None, reason="needs ssmpipe[dask]")
def test_a_dask_cluster_gives_the_same_bytes(tmp_path: Path) -> None:
    one = run(tmp_path / "here", "1", "--jobs", "2")
    there = run(tmp_path / "there", "1", "--jobs", "2", "--executor", "dask")
    compare(one, there)
    assert one["report.html"] == there["report.html"]


def run(folder: Path, threads: str, *options: str) -> dict[str, bytes]:
    folder.mkdir()
    (folder / "bits.yaml").write_text(CONFIG)
    command = [sys.executable, "-m", "ssmpipe", "run", str(folder / "bits.yaml"), *options]
    env = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    out = folder / "out"
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}


def compare(one: dict[str, bytes], two: dict[str, bytes]) -> None:
    assert set(one) == set(two)
    same = ["optimize/correspondence.npz", "model/model.npz", "evaluate/measures.csv", "model/scores.csv"]
    wanted = [f"cohort/{name}" for name in same] + [name for name in one if name.endswith(".ply")]
    assert len(wanted) > 4 + 4 * 6
    assert [name for name in wanted if one[name] != two[name]] == []
