"""``ssmpipe check``: config and scans before any work."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.loading import load
from ssmpipe.cli.parameters import config_argument, set_option


@click.command()
@config_argument
@set_option
@click.option(
    "-j", "--jobs", type=click.IntRange(1), metavar="N", help="Child processes.  [default: processors, at most 8]"
)
def check(config: Path, overrides: tuple[str, ...], jobs: int | None) -> None:
    """Validate the config and every scan before any work."""
    with guarded(debugging()):
        from ssmpipe.runner.check import check_output, check_project, print_checks
        from ssmpipe.runner.console import Console

        project = load(config, overrides)
        console = Console()
        checks = check_project(project, jobs)
        print_checks(checks, project, console)
        problem = check_output(project)
        if problem:
            console.error(problem)
    sys.exit(2 if problem else 3 if any(c.error for c in checks) else 0)
