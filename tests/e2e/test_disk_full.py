"""A full disk ends a run with exit code 74; nothing is half written, what was done stays, and the next run goes on."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import write_mesh
from tests.e2e.test_cli_kill import data
from tests.support.toys import TOY


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of one megabyte, in memory."""
    if shutil.which("mount") is None or not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root and 'mount'")
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("this machine does not let tests mount a tmpfs")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_full_disk(write_config: Callable[..., Path], scans: Path, small_disk: Path) -> None:
    t = np.linspace(0, 1, 60)
    x, y = np.meshgrid(t, t)
    index = np.arange(60 * 60).reshape(60, 60)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    a, b, c, d = (corner.ravel() for corner in corners)
    sheet = TriMesh(np.stack([x, y, x * y], -1).reshape(-1, 3) * 50, np.r_[np.c_[a, b, c], np.c_[a, c, d]])
    for name in "abcd":
        write_mesh(scans / f"{name}.ply", sheet)
    config = write_config(output=str(small_disk / "out"))
    command = [sys.executable, "-m", "ssmpipe.cli", "run", str(config), "-j", "1"]
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}

    full = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert full.returncode == 74, full.stdout + full.stderr
    assert "No space left on device" in full.stdout + full.stderr
    assert "Traceback" not in full.stdout + full.stderr
    before = data(small_disk / "out")
    assert any(name.startswith("shapes/a/") for name in before)
    for folder in (*(small_disk / "out").glob("shapes/*/*"), *(small_disk / "out").glob("cohort/*")):
        assert (folder / "manifest.json").is_file(), folder

    subprocess.run(["mount", "-o", "remount,size=100m", str(small_disk)], check=True)
    again = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    after = data(small_disk / "out")
    assert {name: after[name] for name in before} == before

    clean = write_config(output="clean")
    subprocess.run([*command[:4], str(clean), "-j", "1"], env=env, check=True, capture_output=True)
    assert after == data(clean.parent / "clean")
