"""Parameters that several commands have: paths, the config, and the keys of it that the command line overrides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)


def config_argument(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument ``config``."""
    return click.argument("config", type=PATH, metavar="CONFIG.yaml")(command)


def set_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command ``--set KEY=VALUE``, which can be repeated, as ``overrides``."""
    return click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="KEY=VALUE",
        help="Override one key of the config, e.g. seed=1 or stages.optimize.n_coefficients=[8,8]; paths are relative to "
        "the working directory.  [repeatable]",
    )(command)
