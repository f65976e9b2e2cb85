"""The documentation: pages that are generated are up to date, quoted messages exist, links lead somewhere, commands are known."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
if not DOCS.is_dir():
    pytest.skip("docs are not part of this installation", allow_module_level=True)


def test_the_options_page_is_up_to_date() -> None:
    made = runpy.run_path(str(DOCS / "make_options.py"))["page"]()
    assert made == (DOCS / "options.md").read_text(encoding="utf-8"), "run: python docs/make_options.py"


def code_texts() -> str:
    """All text constants of the package, parts of f-strings included; adjacent ones are one already."""
    found = []
    for path in (ROOT / "ssmpipe").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_quoted_messages_exist_in_the_code() -> None:
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = [
        text for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE) for text in re.findall(r"`([^`]+)`", row)
    ]
    assert len(quoted) > 40
    texts = code_texts()
    assert [text for text in quoted if text not in texts] == []


def pages() -> list[Path]:
    return sorted([*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])


@pytest.mark.parametrize("path", pages(), ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files(path: Path) -> None:
    text = re.sub(r"```.*?```|<!--.*?-->", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\((?!https?:|mailto:|#)([^)#\s]+)", text):
        assert (path.parent / target).exists(), target


def test_every_page_is_in_the_navigation_once() -> None:
    hooks = runpy.run_path(str(DOCS / "hooks.py"))
    nav = YAML(typ="safe").load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    pages = hooks["listed"](hooks["complete"](nav, DOCS))
    assert sorted(pages) == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
    assert pages[0] == "index.md"


def test_commands_of_the_tutorials_are_known() -> None:
    from ssmpipe.cli import main
    from ssmpipe.runner.registry import Registry

    known = {*main.commands, *Registry.default().files()}
    blocks = runpy.run_path(str(DOCS / "run_tutorials.py"))["blocks"]
    tutorials = [path for path in (DOCS / "tutorials").glob("*.md") if path.name != "index.md"]
    assert len(tutorials) == 6
    for path in tutorials:
        text = path.read_text(encoding="utf-8")
        commands = re.findall(r"^ssmpipe (\S+)", "\n".join(b for kind, b in blocks(text) if kind == "sh"), re.MULTILINE)
        assert {"init", "check", "run"} <= set(commands) <= known
        assert f"../figures/tutorial_{path.stem}.png" in text


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="pip install 'ssmpipe[docs]'")
    pytest.importorskip("material", reason="pip install 'ssmpipe[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    for page in (tmp_path / "site").rglob("*.html"):
        outside = re.findall(
            r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"https?://[^\"]+", page.read_text(encoding="utf-8")
        )
        assert outside == [], page
