"""The configs of the repository: nothing but data that is not there is missing in them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.project import load_project

CONFIGS = Path(__file__).parents[2] / "configs"
NO_DATA = re.compile(r"[^ ]*\.yaml:\d+: input\.(scans|cohort|landmarks): .*(no scans match|no scans in|cannot be read)")

if not CONFIGS.is_dir():
    pytest.skip("configs are not part of this installation", allow_module_level=True)


def others(path: Path, *overrides: str) -> list[str]:
    """Return what is wrong with a config apart from missing data."""
    try:
        load_project(path, overrides)
    except ConfigError as error:
        return [line for line in str(error).splitlines() if not NO_DATA.match(line)]
    return []


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.yaml")), ids=lambda p: p.stem)
def test_a_config_is_valid(path: Path) -> None:
    assert others(path) == []


def test_a_wrong_option_would_be_seen() -> None:
    assert others(CONFIGS / "aorta.yaml", "stages.trim.tube_m=55") != []
