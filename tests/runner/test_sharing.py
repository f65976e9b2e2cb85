from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.config import Project
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.sharing import share_report

CHAIN = ["grow", "shift", "results", "report"]
SECRETS = ("Miller_Anna", "Weber-1944", "bone.left.77", "Kowalski_12", "scans/", "toys.yaml")


@pytest.fixture
def named(scans: Path) -> Path:
    for old, new in zip(sorted(scans.iterdir()), SECRETS[:4], strict=True):
        old.rename(scans / f"{new}.ply")
    return scans


def test_no_byte_of_what_is_given_away_names_a_patient_or_a_file(
    named: Path, run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path
) -> None:
    run("stages.grow.refuse=[Weber-1944]", stages=CHAIN)
    target, key = share_report(project("stages.grow.refuse=[Weber-1944]", stages=CHAIN), pseudonymize=True)
    assert target == tmp_path / "out/report_pseudonymized/report.html"
    assert key == tmp_path / "out/pseudonyms.csv"
    files = sorted((path for path in target.parent.rglob("*") if path.is_file()), key=lambda path: len(path.parts))
    assert sorted(path.name for path in files) == ["P001.html", "P002.html", "P003.html", "P004.html", "report.html"]
    for path in files:
        content = path.read_bytes()
        for secret in (*SECRETS, str(tmp_path)):
            assert secret.encode() not in content, (path.name, secret)
    assert (
        "the mesh has 2 components" in (target.parent / "report/P003.html").read_text()
    )  # Kowalski, Miller, Weber, bone
    assert sorted(set(re.findall(r"report/(P\d+)\.html", files[0].read_text()))) == ["P001", "P002", "P003", "P004"]
    rows = key.read_text().splitlines()
    assert rows[0] == "pseudonym,kind,original"
    assert "P001,shape,Kowalski_12" in rows


@pytest.mark.slow
def test_names_stay_when_shapes_come_and_go(
    named: Path, run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path
) -> None:
    run(stages=CHAIN)
    share_report(project(stages=CHAIN), pseudonymize=True)
    (named / "Kowalski_12.ply").rename(named / "Aaron_1.ply")
    run("min_shapes=2", stages=CHAIN)
    target, key = share_report(project("min_shapes=2", stages=CHAIN), pseudonymize=True)
    rows = key.read_text().splitlines() if key else []
    assert "P001,shape,Kowalski_12" in rows
    assert "P005,shape,Aaron_1" in rows
    assert sorted(path.name for path in (target.parent / "report").iterdir()) == [f"P00{k}.html" for k in (2, 3, 4, 5)]


@pytest.mark.slow
def test_pdf_with_and_without_names(
    named: Path, run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path
) -> None:
    pytest.importorskip("reportlab", reason="ReportLab is not installed (pip install 'ssmpipe[pdf]')")
    with pytest.raises(SsmpipeError, match="has not been made yet"):
        share_report(project(stages=CHAIN), form="pdf")
    run(stages=CHAIN)
    plain, nothing = share_report(project(stages=CHAIN), form="pdf")
    assert (plain, nothing) == (tmp_path / "out/report.pdf", None)
    hidden, key = share_report(project(stages=CHAIN), form="pdf", pseudonymize=True)
    assert hidden == tmp_path / "out/report_pseudonymized/report.pdf"
    assert key is not None
    assert plain.read_bytes()[:5] == hidden.read_bytes()[:5] == b"%PDF-"
