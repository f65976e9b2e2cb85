"""``ssmpipe status``: what is done, stale and failed."""

from __future__ import annotations

from pathlib import Path

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.loading import load
from ssmpipe.cli.parameters import config_argument, set_option


@click.command()
@config_argument
@set_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON.  [default: a table]")
def status(config: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Say what is done, stale and failed, and why; run nothing."""
    with guarded(debugging()):
        from ssmpipe.runner.console import Console
        from ssmpipe.runner.status import print_status, status_of

        project = load(config, overrides)
        print_status(status_of(project), project, Console(), as_json=as_json)
