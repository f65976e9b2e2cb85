"""Every option of ``ssmpipe report`` as a user types it; nothing that is given away under other names holds an original one."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from ssmpipe.cli import main
from ssmpipe.runner.run import RunResult
from tests.support.toys import TOY

CHAIN = ["grow", "shift", "results", "report"]
IDS = ("Miller_Anna", "Weber-1944", "bone.left.77", "Kowalski_12")
SECRETS = (*IDS, "Anna", "Kowalski", "Weber", "subject-5581", "toys.yaml", "scans/")


@pytest.fixture
def config(
    scans: Path,
    run: Callable[..., RunResult],
    write_config: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """A finished run with names, one of them set aside."""
    for old, new in zip(sorted(scans.iterdir()), IDS, strict=True):
        old.rename(scans / f"{new}.ply")
    (tmp_path / "cohort.csv").write_text(
        "id,side,subject\n" + "".join(f"{i},L,subject-558{k}\n" for k, i in enumerate(IDS))
    )
    given = {"stages": CHAIN, "input": {"cohort": "cohort.csv"}}
    run("stages.grow.refuse=[Weber-1944]", **given)
    monkeypatch.setenv("SSMPIPE_STAGES", str(TOY))
    return write_config(**given)


def report(config: Path, *arguments: str) -> Result:
    done = CliRunner().invoke(main, ["report", str(config), "--set", "stages.grow.refuse=[Weber-1944]", *arguments])
    assert done.exit_code == 0, done.output
    return done


def test_every_option_is_in_this_file(config: Path) -> None:
    shown = set(re.findall(r"--[a-z-]+", CliRunner().invoke(main, ["report", "--help"]).output)) - {"--help"}
    text = Path(__file__).read_text(encoding="utf-8")
    assert shown == {"--set", "--format", "--pseudonymize", "--jobs"}
    assert all(text.count(option) > 1 for option in shown)


def test_html_with_and_without_names(config: Path) -> None:
    out = config.parent / "out"
    shutil.rmtree(out / "report")
    assert f"report: {out / 'report.html'}" in report(config, "--jobs", "2", "--format", "html").output
    assert sorted(path.stem for path in (out / "report").iterdir()) == sorted(IDS)
    assert "Kowalski_12" in (out / "report.html").read_text()
    done = report(config, "--pseudonymize", "--jobs", "1")
    folder = out / "report_pseudonymized"
    assert f"names: {out / 'pseudonyms.csv'}" in done.output
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) == 5
    for path in files:
        content = path.read_bytes()
        assert [s for s in (*SECRETS, str(config.parent)) if s.encode() in content or s in path.name] == []
    assert "Kowalski_12" in (out / "pseudonyms.csv").read_text()
    assert not (folder / "pseudonyms.csv").exists()


def test_pdf_with_and_without_names(config: Path) -> None:
    pytest.importorskip("reportlab", reason="ReportLab is not installed (pip install 'ssmpipe[pdf]')")
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext reads the text of the PDF (apt install poppler-utils)")

    def text_of(path: Path) -> str:
        done = subprocess.run(["pdftotext", str(path), "-"], capture_output=True, check=True, timeout=60)
        told = subprocess.run(["pdfinfo", str(path)], capture_output=True, check=True, timeout=60)
        # words may be broken at the end of a line
        return re.sub(r"\s+", "", (done.stdout + told.stdout).decode("utf-8"))

    out = config.parent / "out"
    report(config, "--format", "pdf")
    assert "Kowalski_12" in text_of(
        out / "report.pdf"
    )  # the text can be read, and so the absence below means something
    report(config, "--format", "pdf", "--pseudonymize")
    hidden = out / "report_pseudonymized/report.pdf"
    text = text_of(hidden)
    assert "P001" in text
    assert [s for s in SECRETS if s in text] == []
    content = hidden.read_bytes()
    assert [s for s in SECRETS if s.encode() in content] == []
