"""``ssmpipe synth``: a command for every synthetic cohort."""

from __future__ import annotations

from pathlib import Path

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.parameters import PATH


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
            with guarded(debugging()):
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


@click.group(cls=_Synth)
def synth() -> None:
    """Write a synthetic cohort with ground truth."""
