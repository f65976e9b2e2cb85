from __future__ import annotations

from pathlib import Path

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.document import parse_value, read_document


def read(tmp_path: Path, text: str):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    return read_document(path)


def test_lines(tmp_path: Path) -> None:
    document = read(tmp_path, "name: x\nstages:\n  - a: {b: 1}\n  - c:\n      d: 2\n")
    assert document.data == {"name": "x", "stages": [{"a": {"b": 1}}, {"c": {"d": 2}}]}
    assert document.where(("stages", 0, "a", "b")).endswith("c.yaml:3")
    assert document.where(("stages", 1, "c", "d")).endswith("c.yaml:5")
    assert document.where(("stages", 1, "c", "unknown", 7)).endswith("c.yaml:4")


def test_yaml_1_2(tmp_path: Path) -> None:
    data = read(tmp_path, "a: no\nb: 1e-6\nc: 010\nd: 2024-01-31\ne: true\nf:\n").data
    assert data == {"a": "no", "b": 1e-6, "c": 10, "d": "2024-01-31", "e": True, "f": None}
    assert [type(v) for v in data.values()] == [str, float, int, str, bool, type(None)]


BOMB = "a: &a [x]\nb: &b [*a, *a]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", r"c\.yaml:3: .*duplicate key"),
        (BOMB, r"c\.yaml:1: anchors and aliases"),
        ("a: !!python/object:os.system x\n", r"c\.yaml:1: tags"),
        ("a: " + "[" * 5000, r"c\.yaml:1: nested deeper than 20"),
        ("a: [1, 2\nb: 3\n", r"c\.yaml:\d: "),
        ("a: b: c\n", r"c\.yaml:1: mapping values are not allowed"),
        ("- a\n- b\n", r"c\.yaml:1: the config must be a mapping"),
        ("", "the config file is empty"),
        ("# nothing\n", "the config file is empty"),
    ],
)
def test_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, text)


def test_unreadable(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the config file: No such file"):
        read_document(tmp_path / "none.yaml")
    (tmp_path / "bin.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not UTF-8"):
        read_document(tmp_path / "bin.yaml")


def test_values() -> None:
    assert parse_value("a.ply") == "a.ply"
    assert parse_value("") is None
    with pytest.raises(ConfigError):
        parse_value("[1, 2")
