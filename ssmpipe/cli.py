"""The command line. Importing it loads click only; everything heavy is imported when a command runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ssmpipe import __version__

if TYPE_CHECKING:
    from ssmpipe.runner.project import Project
    from ssmpipe.runner.registry import Registry

PATH = click.Path(path_type=Path)


def _registry() -> Registry:
    from ssmpipe.runner.registry import Registry

    return Registry.default()


class _Commands(click.Group):
    """The fixed commands, and one for every stage: found by file name, imported when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*super().list_commands(ctx), *self._stages()]

    def _stages(self) -> list[str]:
        return [name for name in _registry().files() if name not in self.commands]

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if (
            name == "sample"
        ):  # a stage by its name, too: `sample IN OUT` is the stage, `sample MODEL -o DIR` draws from a model
            return _either(self.commands[name], self._stage_command(ctx, name))
        if name in self.commands:
            return self.commands[name]
        return self._stage_command(ctx, name)

    def _stage_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name in _registry().files():
            from ssmpipe.runner.single import stage_command

            with _errors(ctx.find_root().params.get("debug", False)):
                return stage_command(_registry().load(name), lambda: _errors(_debug()))
        return None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            from ssmpipe.runner.suggest import did_you_mean

            if args and not args[0].startswith("-") and "Did you mean" not in error.message:
                close = did_you_mean(args[0], self.list_commands(ctx))
                raise click.UsageError(f"No such command '{args[0]}'{close if 'mean' in close else ''}.", ctx) from None
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        registry = _registry()
        fixed = [(name, self.commands[name].get_short_help_str(100)) for name in super().list_commands(ctx)]
        stages = [(name, registry.summary(name)) for name in self._stages()]
        for title, rows in (("Commands", fixed), ("One stage on one file (group stages: on a folder)", stages)):
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def _either(of_model: click.Command, of_stage: click.Command | None) -> click.Command:
    """Return one command for both: that for models where an option names the output folder, else that of the stage."""
    stage = of_stage or of_model

    class Either(click.Command):
        def make_context(
            self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
        ) -> click.Context:
            if "--help" in args or "-h" in args:
                return super().make_context(info_name, args, parent, **extra)
            names_folder = any(a.startswith("-o") or a.split("=")[0] == "--output" for a in args)
            return (of_model if names_folder else stage).make_context(info_name, args, parent, **extra)

        def get_help(self, ctx: click.Context) -> str:
            return "\n\n".join(command.get_help(ctx) for command in (of_model, stage))

    return Either("sample", callback=lambda: None, help=of_model.help)


@contextmanager
def _errors(debug: bool, store: Path | None = None) -> Iterator[None]:
    """Turn whatever happens into one line and an exit code."""
    from ssmpipe.core.errors import ConfigError, SsmpipeError

    try:
        yield
    except (click.ClickException, click.exceptions.Exit, click.Abort):
        raise
    except KeyboardInterrupt:
        click.echo("interrupted; what is finished is kept, run the same command again to go on", err=True)
        sys.exit(130)
    except BrokenPipeError:  # `ssmpipe ... | head`: whoever reads has seen enough
        with open(os.devnull, "w") as sink:
            for stream in (sys.stdout, sys.stderr):
                os.dup2(sink.fileno(), stream.fileno())
        sys.exit(141)
    except ConfigError as error:
        if debug:
            raise
        click.echo(f"{error}", err=True)
        sys.exit(2)
    except SsmpipeError as error:
        if debug:
            raise
        from ssmpipe.runner.lock import LockHeldError
        from ssmpipe.runner.patience import ClusterLostError

        click.echo(f"{error}", err=True)
        sys.exit(75 if isinstance(error, LockHeldError) else 74 if isinstance(error, ClusterLostError) else 3)
    except OSError as error:
        if debug:
            raise
        where = f": {error.filename}" if error.filename else ""
        click.echo(
            f"cannot read or write{where}: {error.strerror or error}; try: free space, or check permissions", err=True
        )
        sys.exit(74)
    except Exception as error:
        if debug:
            raise
        click.echo(f"internal error: {type(error).__name__}: {error}; {_store_traceback(store)}", err=True)
        sys.exit(1)


def _store_traceback(folder: Path | None) -> str:
    import tempfile
    import traceback

    text = traceback.format_exc()
    for place in (folder, Path(tempfile.gettempdir())):
        if place is None or not place.is_dir():
            continue
        try:
            path = place / "ssmpipe-traceback.txt"
            path.write_text(text, encoding="utf-8")
            return f"the traceback is in {path}"
        except OSError:
            continue
    return "run again with --debug to see the traceback"


def _debug() -> bool:
    return bool(click.get_current_context().find_root().params.get("debug", False))


def _load(config: Path, overrides: tuple[str, ...] = ()) -> Project:
    from ssmpipe.runner.project import load_project

    return load_project(config, overrides, _registry())


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "auto_envvar_prefix": "SSMPIPE"})
@click.version_option(__version__, prog_name="ssmpipe")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.  [default: off]")
def main(debug: bool) -> None:
    """From a folder of raw anatomical surfaces to a statistical shape model.

    Exit codes: 0 fine, 1 internal error, 2 bad usage or config, 3 finished but some shapes were set aside (or a file was
    refused), 74 disk full or other I/O, 75 another run holds the output folder, 130 interrupted.
    """


def _config_argument(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.argument("config", type=PATH, metavar="CONFIG.yaml")(command)


def _set_option(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="KEY=VALUE",
        help="Override one key of the config, e.g. seed=1 or stages.optimize.n_coefficients=[8,8]; paths are relative to "
        "the working directory.  [repeatable]",
    )(command)


class _Part(click.ParamType):
    name = "i/N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        try:
            number, total = (int(x) for x in str(value).split("/"))
        except ValueError:
            self.fail(f"'{value}' is not of the form i/N, for example 2/8", param, ctx)
        return number, total


@main.command()
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
@_set_option
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
    with _errors(_debug()):
        project = _load(config, overrides)
    with _errors(_debug(), project.out):
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


@main.command()
@_config_argument
@_set_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON.  [default: a table]")
def status(config: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Say what is done, stale and failed, and why; run nothing."""
    with _errors(_debug()):
        from ssmpipe.runner.console import Console
        from ssmpipe.runner.status import print_status, status_of

        project = _load(config, overrides)
        print_status(status_of(project), project, Console(), as_json=as_json)


@main.command()
@_config_argument
@_set_option
@click.option(
    "-j", "--jobs", type=click.IntRange(1), metavar="N", help="Child processes.  [default: processors, at most 8]"
)
def check(config: Path, overrides: tuple[str, ...], jobs: int | None) -> None:
    """Validate the config and every scan before any work."""
    with _errors(_debug()):
        from ssmpipe.runner.check import check_output, check_project, print_checks
        from ssmpipe.runner.console import Console

        project = _load(config, overrides)
        console = Console()
        checks = check_project(project, jobs)
        print_checks(checks, project, console)
        problem = check_output(project)
        if problem:
            console.error(problem)
    sys.exit(2 if problem else 3 if any(c.error for c in checks) else 0)


@main.command()
@_config_argument
@_set_option
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
    with _errors(_debug()):
        from ssmpipe.runner.console import Console

        project, console = _load(config, overrides), Console()
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


@main.command()
@click.argument("anatomy")
@click.argument("scans_dir", type=PATH, metavar="SCANS_DIR")
@click.option("-o", "--output", "target", type=PATH, required=True, metavar="CONFIG.yaml", help="Config file to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.  [default: off]")
def init(anatomy: str, scans_dir: Path, target: Path, overwrite: bool) -> None:
    """Write a commented config for a folder of scans.

    ANATOMY is one of femur-distal, femur-proximal, aorta, tube, closed (spleens, whole bones), disk (one rim), curve (planar outlines,
    photographs). cohort.csv and landmarks.json are found beside the scans.
    """
    with _errors(_debug()):
        from ssmpipe.runner.init import write_config

        for line in write_config(anatomy, scans_dir, target, _registry(), overwrite=overwrite):
            click.echo(line)


@main.command()
@click.argument("model", type=PATH, metavar="MODEL")
@click.option("-o", "--output", "out", type=PATH, required=True, metavar="DIR", help="Folder for the meshes.")
@click.option(
    "--modes", metavar="LIST", help="Modes to walk along, e.g. 1,2; none: no walks.  [default: the first three]"
)
@click.option(
    "--extent", type=click.FloatRange(0, min_open=True), default=3.0, show_default=True,
    help="Ends of a walk [standard deviations].",
)  # fmt: skip
@click.option("--steps", type=click.IntRange(2), default=7, show_default=True, help="Instances per walk.")
@click.option("--n", type=click.IntRange(0), default=0, show_default=True, help="Random instances.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the random instances.")
@click.option(
    "--at", multiple=True, metavar="MODE=VALUE", help="One instance at these coefficients, e.g. 1=-2.  [repeatable]"
)
@click.option(
    "--format", "form", type=click.Choice(["ply", "stl", "vtp", "obj", "off"]), default="ply", show_default=True,
    help="Mesh format.",
)  # fmt: skip
@click.option("--open", "is_open", is_flag=True, help="Leave openings open.  [default: closed by a lid, watertight]")
@click.option("--quads", is_flag=True, help="Also write shells of quadrilaterals for finite elements.  [default: off]")
def sample(
    model: Path,
    out: Path,
    modes: str | None,
    extent: float,
    steps: int,
    n: int,
    seed: int,
    at: tuple[str, ...],
    form: str,
    is_open: bool,
    quads: bool,
) -> None:
    """Write the mean, walks along modes and random instances of a model as meshes."""
    with _errors(_debug()):
        from ssmpipe.use.instances import InstanceOptions, write_instances
        from ssmpipe.use.model import load_model

        named = [] if modes is None or modes.strip().lower() == "none" else modes.split(",")
        chosen = None if modes is None else tuple(_number(x, "--modes") for x in named)
        options = InstanceOptions(
            chosen, extent, steps, n, seed, _coefficients(at), f".{form}", watertight=not is_open, quads=quads
        )
        files = write_instances(load_model(model), out, options)
        click.echo(f"{len(files)} files written to {out}")


@main.command()
@click.argument("model", type=PATH, metavar="MODEL")
@click.option(
    "-o", "--output", "target", type=PATH, required=True, metavar="FILE",
    help="File to write; its suffix says the format: .h5 (statismo), .pc.npz (gias), .swproj (ShapeWorks), .csv (R), .step or .iges "
    "(B-spline surface), .vtp, .ply, .stl, .obj, .off.  [with --shapes: a folder]",
)  # fmt: skip
@click.option(
    "--at", multiple=True, metavar="MODE=VALUE", help="Instance in place of the mean, e.g. 1=-2.  [repeatable]"
)
@click.option(
    "--shapes", type=click.Choice(["ply", "stl", "vtp", "obj", "off"]),
    help="Write the corresponded surface of every shape into a folder, in this format.  [default: off]",
)  # fmt: skip
@click.option("--shape", "ids", multiple=True, metavar="ID", help="With --shapes: just this shape.  [repeatable]")
@click.option(
    "--frame", type=click.Choice(["scan", "model"]), default="scan", show_default=True,
    help="With --shapes: coordinates of the scan files, or those of the model.",
)  # fmt: skip
def export(
    model: Path,
    target: Path,
    at: tuple[str, ...],
    shapes: str | None,
    ids: tuple[str, ...],
    frame: Literal["scan", "model"],
) -> None:
    """Write a model for another program; the suffix says the format."""
    with _errors(_debug()):
        import numpy as np

        from ssmpipe.use.exporting import export_model, export_shapes
        from ssmpipe.use.model import load_model

        loaded, places = load_model(model), _coefficients(at)
        if shapes is not None and places:
            raise click.UsageError("--at and --shapes exclude each other.")
        if ids and shapes is None:
            raise click.UsageError("--shape needs --shapes.")
        if shapes is not None:
            files = export_shapes(loaded, target, f".{shapes}", frame, ids)
            click.echo(f"{len(files)} files written to {target}")
            return
        row = None
        if places:
            row = np.zeros(max(places))
            row[[k - 1 for k in places]] = list(places.values())
        click.echo(f"{target}: {export_model(loaded, target, row)}")


class _Modes(click.ParamType):
    name = "auto|K"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | None:
        if value == "auto":
            return None
        if not str(value).isdigit() or int(value) < 1:
            self.fail(f"'{value}' is neither auto nor a number of modes (1, 2, ...)", param, ctx)
        return int(value)


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


@main.command()
@click.argument("result", type=PATH, metavar="RESULT")
@click.argument("result_b", type=PATH, metavar="[RESULT_B]", required=False)
@click.option("-o", "--output", "out", type=PATH, required=True, metavar="DIR", help="Folder for all that is written.")
@click.option("--by", metavar="COLUMN", help="Column of the cohort table that tells the groups.  [default: group]")
@click.option(
    "--cohort", type=PATH, metavar="FILE",
    help="CSV table with id; its columns come in place of those of the same name that the run knew.  [default: what the run knew]",
)  # fmt: skip
@click.option(
    "--groups", metavar="A,B", help="Groups in the order wanted; second less first is shown.  [default: all, sorted]"
)
@click.option("--modes", type=_Modes(), default="auto", show_default=True, help="Modes that are tested together.")
@click.option(
    "--permutations", type=click.IntRange(19), default=10_000, show_default=True, help="Random rearrangements."
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of everything random.")
@click.option(
    "--covariates", metavar="LIST",
    help="Columns whose effect is removed, e.g. age,sex,size; size needs no column: the logarithm of the centroid size.  [default: none]",
)  # fmt: skip
@click.option(
    "--paired", metavar="COLUMN",
    help="Compare inside of the subjects that this column tells, e.g. left with right.  [default: not paired]",
)  # fmt: skip
@click.option(
    "--subject", metavar="COLUMN", help="Column that tells whose shape it is.  [default: subject, where there is one]"
)
@click.option(
    "--alpha", type=click.FloatRange(0, 1, min_open=True, max_open=True), default=0.05, show_default=True,
    help="Level of the tests and false discovery rate of the maps [probability].",
)  # fmt: skip
def compare(
    result: Path,
    result_b: Path | None,
    out: Path,
    by: str | None,
    cohort: Path | None,
    groups: str | None,
    modes: int | None,
    permutations: int,
    seed: int,
    covariates: str | None,
    paired: str | None,
    subject: str | None,
    alpha: float,
) -> None:
    """Compare groups of one result, or two results: means, maps, tests, effects, a page."""
    with _errors(_debug()):
        if paired and subject and paired != subject:
            raise click.UsageError("--paired and --subject name different columns; --paired tells the subjects already")
        from ssmpipe.core.statistics.comparison import Options
        from ssmpipe.use.comparing import CompareOptions, compare_results
        from ssmpipe.use.groups import GroupOptions

        option = "--paired" if paired else "--subject"
        made_of = GroupOptions(by, _names(groups), paired or subject, _names(covariates), option, cohort)
        tests = Options(n_modes=modes, n_permutations=permutations, paired=paired is not None)
        for line in compare_results(result, result_b, out, CompareOptions(made_of, tests, seed, alpha)):
            click.echo(line)


@main.command()
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
    with _errors(_debug()):
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


def _number(text: str, option: str) -> int:
    if not text.strip().isdigit() or int(text) < 1:
        raise click.BadParameter(f"'{text.strip()}' is not the number of a mode (1, 2, ...)", param_hint=option)
    return int(text)


def _coefficients(at: tuple[str, ...]) -> dict[int, float]:
    found = {}
    for item in at:
        mode, _, value = item.partition("=")
        try:
            found[_number(mode, "--at")] = float(value)
        except ValueError as error:
            raise click.BadParameter(f"'{item}' is not MODE=VALUE, e.g. 1=-2", param_hint="--at") from error
    return found


@main.command()
def schema() -> None:
    """Print the JSON Schema of the config, for editors."""
    with _errors(_debug()):
        import json

        from ssmpipe.runner.schema import config_schema

        click.echo(json.dumps(config_schema(_registry()), indent=2))


class _Synth(click.Group):
    """One command per file in ``ssmpipe/synth`` that defines ``write_cohort``; its ``OPTIONS`` become switches."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        from ssmpipe.runner.registry import synth_files

        return list(synth_files())

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        from ssmpipe.runner.registry import summary_line, synth_files, synth_options

        path = synth_files().get(name)
        if path is None:
            return None

        @click.command(name, help=summary_line(path))
        @click.argument("out_dir", type=PATH, metavar="OUT_DIR")
        @click.option(
            "--n", type=click.IntRange(1), default=None, help="Number of shapes.  [default: the cohort's own]"
        )
        @click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of everything random.")
        def command(out_dir: Path, n: int | None, seed: int, **switches: bool) -> None:
            with _errors(_debug()):
                import importlib

                module = importlib.import_module(f"ssmpipe.synth.{path.stem}")
                module.write_cohort(out_dir, **({} if n is None else {"n": n}), seed=seed, **switches)
                click.echo(f"{len(list((out_dir / 'scans').iterdir()))} shapes written to {out_dir}")

        for option, text in synth_options(path).items():
            command.params.append(click.Option([f"--{option}"], is_flag=True, help=text))
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from ssmpipe.runner.registry import summary_line, synth_files

        rows = [(name, summary_line(path)) for name, path in synth_files().items()]
        if rows:
            with formatter.section("Cohorts"):
                formatter.write_dl(rows)


@main.group(cls=_Synth)
def synth() -> None:
    """Write a synthetic cohort with ground truth."""


if __name__ == "__main__":
    main()
