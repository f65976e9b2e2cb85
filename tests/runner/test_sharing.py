from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.core.errors import ConfigError, SsmpipeError
from ssmpipe.runner import disk
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.sharing import _names, share_report

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


HEAD = "pseudonym,kind,original\n"


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("name,kind,original\nP001,shape,a\n", "the first line must be pseudonym,kind,original"),
        ("", "the first line must be"),
        (HEAD + "P001,shape\n", "line 2: not a pseudonym"),
        (HEAD + "../P001,shape,a\n", "line 2: not a pseudonym"),
        (HEAD + "P001,shape,a\nP002,patient,b\n", "line 3: not a pseudonym"),
        (HEAD + "P001,shape,a\nP001,shape,b\n", "line 3: 'P001' or its original name is there twice"),
        (HEAD + "P001,shape,a\nP002,shape,a\n", "line 3: 'P002' or its original name is there twice"),
        (HEAD + "P001,shape,\xe9\n", "is not the table that ssmpipe wrote"),
    ],
)
def test_an_edited_table_of_names_is_one_clear_error(tmp_path: Path, text: str, fact: str) -> None:
    key = tmp_path / "pseudonyms.csv"
    key.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=re.escape(fact)) as error:
        _names({"shapes": {"a": {"info": {}}}}, key)
    assert "mend the table, or move it away" in str(error.value)
    assert key.read_bytes() == text.encode("latin-1")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_nobody_else_can_read_the_table_of_names_at_any_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = tmp_path / "pseudonyms.csv"
    modes = []
    flush, old = disk.flush, os.umask(0)

    def looked(path: Path) -> None:
        modes.append(stat.S_IMODE(path.stat().st_mode))
        flush(path)

    monkeypatch.setattr(disk, "flush", looked)
    try:
        for _ in range(2):
            _names({"shapes": {"a": {"info": {}}}}, key)
            modes.append(stat.S_IMODE(key.stat().st_mode))
    finally:
        os.umask(old)
    assert modes == [0o600] * 4
    assert key.read_text() == HEAD + "P001,shape,a\n"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_nor_what_the_children_are_told_of_the_names(
    run: Callable[..., RunResult], project: Callable[..., Project], monkeypatch: pytest.MonkeyPatch
) -> None:
    run(stages=CHAIN)
    modes = {}
    flush, old = disk.flush, os.umask(0)

    def looked(path: Path) -> None:
        modes[path.name.rpartition(".")[0]] = stat.S_IMODE(path.stat().st_mode)
        flush(path)

    monkeypatch.setattr(disk, "flush", looked)
    try:
        share_report(project(stages=CHAIN), pseudonymize=True)
    finally:
        os.umask(old)
    assert modes[".report.json"] == modes[".pseudonyms.csv"] == 0o600
