"""``ssmpipe report``: the report written again."""

from __future__ import annotations

from pathlib import Path

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.loading import load
from ssmpipe.cli.parameters import config_argument, set_option


@click.command()
@config_argument
@set_option
@click.option(
    "--format",
    "form",
    type=click.Choice(["html", "pdf"]),
    default="html",
    show_default=True,
    help="html: the page and a page per shape; pdf: what of the page is not interactive, in one file for print (needs ssmpipe[pdf]).",
)
@click.option(
    "--pseudonymize",
    is_flag=True,
    help="Write into report_pseudonymized/ with P001 ... instead of ids, file names and paths; the table of names goes to "
    "pseudonyms.csv, beside that folder and not in it.  [default: off]",
)
@click.option(
    "-j", "--jobs", type=click.IntRange(1), metavar="N", help="Child processes.  [default: processors, at most 8]"
)
def report(config: Path, overrides: tuple[str, ...], form: str, pseudonymize: bool, jobs: int | None) -> None:
    """Write the report again from what is in the output folder."""
    with guarded(debugging()):
        from ssmpipe.runner.console import Console

        project, console = load(config, overrides), Console()
        if form == "html" and not pseudonymize:
            from ssmpipe.runner.status import rewrite_report

            click.echo(f"report: {rewrite_report(project, jobs, console)}")
            return
        from ssmpipe.runner.sharing import share_report

        target, key = share_report(
            project, form="pdf" if form == "pdf" else "html", pseudonymize=pseudonymize, jobs=jobs, console=console
        )
        click.echo(f"report: {target}")
        if key is not None:
            click.echo(f"names: {key} (do not give this file away)")
