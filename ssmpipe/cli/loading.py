"""What a command begins with: the stages that there are, and the project of a config."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssmpipe.runner.project import Project
    from ssmpipe.runner.registry import Registry


def default_registry() -> Registry:
    """Return the stages that can be named, those of the folders in ``SSMPIPE_STAGES`` among them."""
    from ssmpipe.runner.registry import Registry

    return Registry.default()


def load(config: Path, overrides: tuple[str, ...] = ()) -> Project:
    """Return the checked project of a config; ``overrides`` as ``--set`` gives them.

    Raises
    ------
    ssmpipe.core.errors.ConfigError
        If anything is wrong with it.
    """
    from ssmpipe.runner.project import load_project

    return load_project(config, overrides, default_registry())
