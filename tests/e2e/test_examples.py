"""The example scripts run as they stand on the synthetic femora."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COHORT = ROOT / "data_synthetic" / "femur_distal"


@pytest.fixture
def env() -> dict[str, str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    if shutil.which("ssmpipe", path=path) is None or shutil.which("bash") is None:
        pytest.skip("needs bash and an installed ssmpipe")
    return {**os.environ, "PATH": path}


@pytest.mark.slow
def test_shell_loop(env: dict[str, str], tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for k in (1, 2, 4):
        shutil.copy(COHORT / "scans" / f"femur_0{k}.ply", scans)
    script = [
        "bash",
        str(ROOT / "examples/single_stages.sh"),
        str(scans),
        str(COHORT / "cohort.csv"),
        str(tmp_path / "out"),
    ]
    subprocess.run(script, env=env, check=True, capture_output=True, timeout=300)
    assert (tmp_path / "out/model/model.npz").is_file()


@pytest.mark.slow
def test_job_array(env: dict[str, str], tmp_path: Path) -> None:
    config = tmp_path / "parts.yaml"
    scans = ", ".join(str(COHORT / "scans" / f"femur_0{k}.ply") for k in (1, 2, 4))
    config.write_text(
        f"name: parts\ninput:\n  scans: [{scans}]\n  cohort: {COHORT / 'cohort.csv'}\noutput: out\nanatomy: femur-distal\n"
    )
    script = ["bash", str(ROOT / "examples/job_array.sbatch"), str(config)]
    for i in (1, 2):
        slurm = {"SLURM_ARRAY_TASK_ID": str(i), "SLURM_ARRAY_TASK_COUNT": "2"}
        subprocess.run(script, env={**env, **slurm}, check=True, capture_output=True, timeout=300)
    assert len(list((tmp_path / "out/shapes").glob("*/*-fit/surface.npz"))) == 3
    finish = subprocess.run(["ssmpipe", "run", str(config)], env=env, capture_output=True, text=True, timeout=300)
    assert finish.returncode == 0, finish.stdout + finish.stderr
    assert (tmp_path / "out/report.html").is_file()
