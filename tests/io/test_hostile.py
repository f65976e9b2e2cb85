"""Every hostile file is refused in one line, every odd but valid one loads; none kills, hangs or needs more than 200 MB."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from ssmpipe.io.images import IMAGE_SUFFIXES
from ssmpipe.io.meshes import MESH_SUFFIXES
from ssmpipe.io.outlines import OUTLINE_SUFFIXES

pytest.importorskip("resource", reason="limits per process need a POSIX system")
if not Path("/proc/self/statm").exists():
    pytest.skip("sizes of processes are read from /proc", allow_module_level=True)

from tests.support.hostile import MEMORY_LIMIT, cases

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """One process reads them all, each in a forked child of its own."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.support.hostile", str(tmp_path_factory.mktemp("hostile"))]
    done = subprocess.run(command, env=env, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return {row["name"]: row for row in rows}


def test_the_table_knows_every_readable_suffix() -> None:
    table = cases()
    for hostile in (True, False):
        seen = {Path(case.file).suffix.lower() for case in table if bool(case.words) == hostile}
        assert {*MESH_SUFFIXES, *OUTLINE_SUFFIXES, ".npz", ".fcsv", ".pp", ".json", ".yaml", ".png"} <= seen
    assert {".png", ".webp", ".tif", ".pgm", ".jpg"} <= set(IMAGE_SUFFIXES)
    assert len({case.name for case in table}) == len(table) > 250


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_file(case, verdicts: dict[str, dict]) -> None:
    found = verdicts[case.name]
    if not case.words:
        assert found["verdict"] == "loaded"
    else:
        text = found["verdict"]
        assert text.startswith("refused: ")
        assert re.search(case.words, text)
        assert text.isprintable(), "one line"
        assert len(text) < 400
        assert case.reader == "config" or "; try: " in text
    assert found["mb"] < MEMORY_LIMIT / 2**20
