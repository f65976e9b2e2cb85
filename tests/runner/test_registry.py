from __future__ import annotations

from pathlib import Path

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.registry import BUILTIN, Registry, summary_line, synth_files, synth_options


def test_every_stage_follows_the_contract() -> None:
    registry = Registry()
    for name in registry.names():
        stage = registry.load(name)
        assert stage.name == name
        assert all(field.description for field in stage.config.model_fields.values()), name
        assert registry.summary(name).endswith(".")


def test_listing_imports_nothing(tmp_path: Path) -> None:
    (tmp_path / "boom.py").write_text('"""Say boom."""\nraise RuntimeError\n')
    (tmp_path / "broken.py").write_text("def (")
    (tmp_path / "_helper.py").write_text("")
    registry = Registry((tmp_path,))
    assert registry.names() == ("boom", "broken", "report")
    assert registry.summary("boom") == "Say boom."
    assert summary_line(tmp_path / "broken.py") == "(no description)"


def test_unknown_stage_suggests() -> None:
    with pytest.raises(ConfigError, match="did you mean 'decimate'"):
        Registry((BUILTIN,)).load("decimat")


def test_reserved_option_names(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(
        "from ssmpipe.contract import *\n"
        "class Config(StageConfig):\n    skip: bool = False\n"
        "STAGE = Stage('bad', 'shape', 1, Config, print, (), ())\n"
    )
    (tmp_path / "none.py").write_text("")
    with pytest.raises(ConfigError, match="reserved"):
        Registry((tmp_path,)).load("bad")
    with pytest.raises(ConfigError, match="is not a stage"):
        Registry((tmp_path,)).load("none")


def test_environment_adds_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_own.py").write_text('"""Mine."""')
    monkeypatch.setenv("SSMPIPE_STAGES", str(tmp_path))
    assert "my-own" in Registry.default().names()


def test_synthetic_cohorts_are_found() -> None:
    assert all(path.name.replace("_", "-") == f"{name}.py" for name, path in synth_files().items())


def test_switches_of_a_cohort_are_read_without_importing_it(tmp_path: Path) -> None:
    path = tmp_path / "cohort.py"
    path.write_text('raise RuntimeError\nOPTIONS = {"groups": "Two groups."}\n')
    assert synth_options(path) == {"groups": "Two groups."}
    path.write_text("raise RuntimeError\n")
    assert synth_options(path) == {}
