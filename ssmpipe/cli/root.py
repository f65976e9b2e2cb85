"""``ssmpipe`` itself: the group of all commands, and of one for every stage."""

from __future__ import annotations

from typing import Any

import click

from ssmpipe import __version__
from ssmpipe.cli.check import check
from ssmpipe.cli.compare import compare
from ssmpipe.cli.export import export
from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.init import init
from ssmpipe.cli.loading import default_registry
from ssmpipe.cli.project import project
from ssmpipe.cli.report import report
from ssmpipe.cli.run import run
from ssmpipe.cli.sample import sample
from ssmpipe.cli.schema import schema
from ssmpipe.cli.status import status
from ssmpipe.cli.synth import synth


class _Commands(click.Group):
    """The fixed commands, and one for every stage: found by file name, imported when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*super().list_commands(ctx), *self._stages()]

    def _stages(self) -> list[str]:
        return [name for name in default_registry().files() if name not in self.commands]

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if (
            name == "sample"
        ):  # a stage by its name, too: `sample IN OUT` is the stage, `sample MODEL -o DIR` draws from a model
            return _either(self.commands[name], self._stage_command(ctx, name))
        if name in self.commands:
            return self.commands[name]
        return self._stage_command(ctx, name)

    def _stage_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name in default_registry().files():
            from ssmpipe.runner.single import stage_command

            with guarded(ctx.find_root().params.get("debug", False)):
                return stage_command(default_registry().load(name), lambda: guarded(debugging()))
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
        registry = default_registry()
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


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "auto_envvar_prefix": "SSMPIPE"})
@click.version_option(__version__, prog_name="ssmpipe")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.  [default: off]")
def main(debug: bool) -> None:
    """From a folder of raw anatomical surfaces to a statistical shape model.

    Exit codes: 0 fine, 1 internal error, 2 bad usage or config, 3 finished but some shapes were set aside (or a file was
    refused), 74 disk full or other I/O, 75 another run holds the output folder, 130 interrupted.
    """


for command in (check, compare, export, init, project, report, run, sample, schema, status, synth):
    main.add_command(command)
