"""A refuted certificate: everything is written, the run says so and ends with exit code 3."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from ssmpipe.io.splines import write_spline
from tests.support.surfaces import bump


def test_refuted_map_ends_with_exit_code_three(tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for k, x in enumerate((12.0, 30.0, 48.0)):
        write_spline(scans / f"s{k}.npz", bump((x, 30.0), 30.0))
    config = tmp_path / "config.yaml"
    config.write_text(
        f"""name: folds
input: {{scans: {scans}/*.npz}}
output: {tmp_path / "out"}
stages:
  - optimize: {{form: sampled, landmarks: [5, 5], n_coefficients: [9, 9], barriers: [1.0e-6], prior: 0.0, normalize: none}}
  - model: {{}}
"""
    )
    done = subprocess.run(
        [sys.executable, "-m", "ssmpipe", "run", str(config)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 3, done.stdout + done.stderr
    assert "not proved one-to-one" in done.stdout + done.stderr
    certificate = json.loads((tmp_path / "out/cohort/optimize/certificate.json").read_text())
    assert certificate["all_proved"] is False
    assert np.load(tmp_path / "out/cohort/model/model.npz")["variances"].size > 0
    again = subprocess.run(
        [sys.executable, "-m", "ssmpipe", "run", str(config)], capture_output=True, text=True, timeout=300
    )
    assert again.returncode == 3
