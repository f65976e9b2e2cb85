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


FOLDERS = ("ssmpipe", "tests", "benchmarks")


def scripts() -> list[Path]:
    return sorted(path for folder in ("docs", "benchmarks", "examples") for path in (ROOT / folder).rglob("*.py"))


def module_file(module: str, beside: Path) -> Path | None:
    """Where a module of this repository lies, or of the scripts beside one; None for those of libraries."""
    folder = ROOT if module.split(".")[0] in FOLDERS else beside
    path = folder.joinpath(*module.split("."))
    found = [file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()]
    if folder == ROOT and not found and not path.is_dir():
        raise AssertionError(f"no module {module}")
    return found[0] if found else path if folder == ROOT else None


def names_in(path: Path) -> set[str]:
    """What a module defines, read and not run: no optional library is needed for it."""
    if path.is_dir():
        return set()
    found: set[str] = set()
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
            continue
        if isinstance(node, ast.Import | ast.ImportFrom):
            found |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        waiting += ast.iter_child_nodes(node)
    return found


def missing_imports(path: Path, text: str) -> list[str]:
    """Names that a script imports from this repository, and that are not there."""
    missing = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                module_file(alias.name, path.parent)
        if not isinstance(node, ast.ImportFrom) or not node.module:
            continue
        file = module_file(node.module, path.parent)
        if file is None:
            continue
        package = file if file.is_dir() else file.parent if file.name == "__init__.py" else None
        inside = {child.stem for child in package.iterdir()} if package else set()
        missing += [f"{node.module}.{alias.name}" for alias in node.names if alias.name not in names_in(file) | inside]
    return missing


def test_scripts_import_what_there_is() -> None:
    paths = scripts()
    assert len([path for path in paths if path.name.startswith("make_")]) > 15
    assert {
        str(path.relative_to(ROOT)): missing
        for path in paths
        if (missing := missing_imports(path, path.read_text(encoding="utf-8")))
    } == {}
    gone = "from ssmpipe.report.comparison import COLOURS, difference_pictures"
    assert missing_imports(DOCS / "make_compare.py", gone) == ["ssmpipe.report.comparison.COLOURS"]
    with pytest.raises(AssertionError, match=r"no module ssmpipe\.nowhere"):
        missing_imports(DOCS / "make_compare.py", "import ssmpipe.nowhere")


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
