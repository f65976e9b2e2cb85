"""``ssmpipe run``: run the whole chain."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.loading import load
from ssmpipe.cli.parameters import PATH, set_option

if TYPE_CHECKING:
    from ssmpipe.runner.project import Project


class _Part(click.ParamType):
    name = "i/N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        try:
            number, total = (int(x) for x in str(value).split("/"))
        except ValueError:
            self.fail(f"'{value}' is not of the form i/N, for example 2/8", param, ctx)
        return number, total


@click.command()
@click.argument("config", type=PATH, metavar="CONFIG.yaml", required=False)
@click.option("-n", "--dry-run", is_flag=True, help="Print what would run and why; touch nothing.  [default: off]")
@click.option("--from", "first", metavar="STAGE", help="First stage to run.  [default: the first of the chain]")
@click.option("--to", "last", metavar="STAGE", help="Last stage to run.  [default: the last of the chain]")
@click.option("--only", multiple=True, metavar="STAGE", help="Run just this stage.  [repeatable; default: all]")
@click.option("--shape", "shapes", multiple=True, metavar="ID", help="Run just this shape.  [repeatable; default: all]")
@click.option(
    "--force",
    multiple=True,
    is_flag=False,
    flag_value="*",
    metavar="[STAGE]",
    help="Run although up to date: one stage, or all.",
)
@click.option(
    "-j",
    "--jobs",
    type=click.IntRange(1),
    metavar="N",
    help="Child processes; in the group optimization, threads.  [default: processors, at most 8]",
)
@click.option(
    "--part",
    type=_Part(),
    metavar="i/N",
    help="Every N-th shape from the i-th on; per-shape stages only.  [default: all]",
)
@click.option(
    "--executor",
    type=click.Choice(["local", "dask"]),
    help="Processes of this machine, or a dask cluster (needs ssmpipe[dask]).  [default: as the config says, else local]",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="With dask: local (--jobs workers on this machine), tcp://127.0.0.1:PORT, tls://HOST:PORT, or slurm.  [default: as the "
    "config says, else local]",
)
@set_option
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.  [default: off]")
@click.option("-v", "--verbose", count=True, help="Print every task (-v), and why it runs (-vv).  [default: 0]")
def run(
    config: Path | None,
    dry_run: bool,
    first: str | None,
    last: str | None,
    only: tuple[str, ...],
    shapes: tuple[str, ...],
    force: tuple[str, ...],
    jobs: int | None,
    part: tuple[int, int] | None,
    executor: str | None,
    scheduler: str | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: int,
) -> None:
    """Run the whole chain; what is up to date is not run again."""
    if config is None and force and Path(force[-1]).is_file():
        config, force = Path(force[-1]), (*force[:-1], "*")  # `--force CONFIG.yaml`
    if config is None:
        raise click.UsageError("Missing argument 'CONFIG.yaml'.")
    with guarded(debugging()):
        project = load(config, overrides)
    with guarded(debugging(), project.out):
        from ssmpipe.runner.console import Console
        from ssmpipe.runner.dry_run import dry_run as forecast_of
        from ssmpipe.runner.run import run_project
        from ssmpipe.runner.run_options import RunOptions

        options = RunOptions(first, last, only, shapes, frozenset(force), jobs, part, executor, scheduler)
        console = Console(-1 if quiet else verbose)
        if dry_run:
            from ssmpipe.runner.status import print_forecast

            print_forecast(forecast_of(project, options), project, console)
            return
        result = run_project(project, options, console)
        _summary(project, result, console)
    sys.exit(result.exit_code)


def _summary(project: Project, result: Any, console: Any) -> None:
    from ssmpipe.runner.suggest import count

    n_failed = sum(1 for i in result.failures if i in project.sources)
    minutes, seconds = divmod(result.seconds, 60)
    wall = f"{int(minutes)} min {seconds:.0f} s" if minutes else f"{seconds:.1f} s"
    if result.n_run == 0 and not n_failed and not result.problem:
        console.say(f"nothing to do: {count(result.n_current, 'task')} up to date")
    if n_failed or result.problem:
        console.error(f"see {project.out / 'failures.json'}" if result.failures else f"stopped: {result.problem}")
    if result.report is not None:
        console.say(f"report: {result.report}")
    shapes, tasks = count(len(result.ok), "shape"), count(result.n_run, "task")
    console.say(f"{shapes} ok, {n_failed} failed, {tasks} run, {wall}")
