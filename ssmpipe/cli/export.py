"""``ssmpipe export``: a model for another program."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from ssmpipe.cli.coefficients import coefficients
from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.parameters import PATH


@click.command()
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
    with guarded(debugging()):
        import numpy as np

        from ssmpipe.use.exporting import export_model, export_shapes
        from ssmpipe.use.model import load_model

        loaded, places = load_model(model), coefficients(at)
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
