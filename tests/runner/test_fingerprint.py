from __future__ import annotations

from pathlib import Path

from ssmpipe.runner.fingerprint import canonical, file_digest, fingerprint, slot_digest

BASE = {"stage": "grow", "version": 1, "config": {"factor": 2.0}, "inputs": {"mesh": "abc"}, "seed": 0, "shape": "a"}


def test_every_part_changes_the_fingerprint() -> None:
    changes = [
        {"stage": "shrink"},
        {"version": 2},
        {"config": {"factor": 2.5}},
        {"config": {"factor": 2.0, "new": None}},
        {"inputs": {"mesh": "abd"}},
        {"inputs": {"mesh": None}},
        {"seed": 1},
        {"shape": "b"},
    ]
    prints = {fingerprint(**{**BASE, **change}) for change in changes}
    assert len(prints) == len(changes)
    assert fingerprint(**BASE) not in prints


def test_order_of_keys_does_not_matter() -> None:
    assert canonical({"a": 1, "b": {"d": 2, "c": 3}}) == canonical({"b": {"c": 3, "d": 2}, "a": 1})
    assert slot_digest({"x": "1", "y": "2"}) == slot_digest({"y": "2", "x": "1"})
    assert slot_digest({"x": "1", "y": "2"}) != slot_digest({"x": "2", "y": "1"})


def test_file_digest_is_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"same")
    (tmp_path / "b").write_bytes(b"same")
    (tmp_path / "c").write_bytes(b"other")
    assert file_digest(tmp_path / "a") == file_digest(tmp_path / "b") != file_digest(tmp_path / "c")
