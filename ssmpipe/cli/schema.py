"""``ssmpipe schema``: the JSON Schema of the config."""

from __future__ import annotations

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.loading import default_registry


@click.command()
def schema() -> None:
    """Print the JSON Schema of the config, for editors."""
    with guarded(debugging()):
        import json

        from ssmpipe.runner.schema import config_schema

        click.echo(json.dumps(config_schema(default_registry()), indent=2))
