"""``ssmpipe sample MODEL -o DIR``; without ``-o`` it is the command of the stage ``sample``, see :mod:`ssmpipe.cli.root`."""

from __future__ import annotations

from pathlib import Path

import click

from ssmpipe.cli.coefficients import coefficients, mode_number
from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.parameters import PATH


@click.command()
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
    with guarded(debugging()):
        from ssmpipe.use.instances import InstanceOptions, write_instances
        from ssmpipe.use.model import load_model

        named = [] if modes is None or modes.strip().lower() == "none" else modes.split(",")
        chosen = None if modes is None else tuple(mode_number(x, "--modes") for x in named)
        options = InstanceOptions(
            chosen, extent, steps, n, seed, coefficients(at), f".{form}", watertight=not is_open, quads=quads
        )
        files = write_instances(load_model(model), out, options)
        click.echo(f"{len(files)} files written to {out}")
