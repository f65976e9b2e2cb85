"""``ssmpipe project``: new scans into a finished model."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.parameters import PATH


@click.command()
@click.argument("model", type=PATH, metavar="MODEL")
@click.argument("scans", type=PATH, metavar="SCAN...", nargs=-1, required=True)
@click.option("-o", "--output", "out", type=PATH, required=True, metavar="DIR", help="Folder for all that is written.")
@click.option(
    "--landmarks", type=PATH, metavar="FILE",
    help="Named points of the scans, for steps that a landmark serves; formats as in a run.  [default: none]",
)  # fmt: skip
@click.option(
    "--side", type=click.Choice(["L", "R"], case_sensitive=False), metavar="L|R",
    help="Side of the body of all scans that --cohort does not tell.  [default: unknown]",
)  # fmt: skip
@click.option("--cohort", type=PATH, metavar="FILE", help="CSV table with id and side.  [default: none]")
@click.option(
    "-j", "--jobs", type=click.IntRange(1), metavar="N", help="Child processes.  [default: processors, at most 8]"
)
@click.option(
    "--partial", is_flag=True,
    help="The scans are fragments: complete each by the model, with the uncertainty of what is missing.  [default: off]",
)  # fmt: skip
@click.option("--fill", is_flag=True, help="The same, and write each scan with its holes filled.  [default: off]")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.  [default: off]")
def project(
    model: Path,
    scans: tuple[Path, ...],
    out: Path,
    landmarks: Path | None,
    side: str | None,
    cohort: Path | None,
    jobs: int | None,
    partial: bool,
    fill: bool,
    quiet: bool,
) -> None:
    """Bring new scans into a finished model, which stays as it is: coefficients, reconstruction, distance map."""
    with guarded(debugging()):
        from ssmpipe.runner.console import Console
        from ssmpipe.use.model import load_model
        from ssmpipe.use.projecting import ProjectOptions, project_scans

        options = ProjectOptions(
            landmarks, cohort, side.upper() if side else None, jobs, partial=partial or fill, fill=fill
        )
        result = project_scans(load_model(model), scans, out, options, Console(-1 if quiet else 0))
        if not quiet:
            click.echo(
                f"{len(result.rows)} projected, {len(result.failures)} failed; results are in {out}, see {out / 'index.html'}"
            )
    sys.exit(result.exit_code)
