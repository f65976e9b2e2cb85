"""The real stages give the same bytes however many processes share the work, and in whatever folder."""

from __future__ import annotations

import subprocess
import sys
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
  - optimize: {{n_coefficients: [6, 6], landmarks: [21, 21], max_iterations: 15}}
"""


@pytest.mark.slow
def test_one_process_and_two_give_the_same_bytes(tmp_path: Path) -> None:
    found = []
    for jobs, name in ((1, "first"), (2, "second place")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "bits.yaml").write_text(CONFIG)
        command = [sys.executable, "-m", "ssmpipe", "run", str(folder / "bits.yaml"), "--jobs", str(jobs)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stdout + done.stderr
        out = folder / "out"
        found.append({str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()})
    one, two = found
    assert set(one) == set(two)
    same = ["optimize/correspondence.npz", "model/model.npz", "evaluate/measures.csv", "model/scores.csv"]
    wanted = [f"cohort/{name}" for name in same] + [name for name in one if name.endswith(".ply")]
    assert len(wanted) > 4 + 4 * 6
    assert [name for name in wanted if one[name] != two[name]] == []
