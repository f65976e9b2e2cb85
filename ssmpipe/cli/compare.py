"""``ssmpipe compare``: groups of shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.parameters import PATH


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


@click.command()
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
    with guarded(debugging()):
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
