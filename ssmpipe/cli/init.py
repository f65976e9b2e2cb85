"""``ssmpipe init``: a commented config for a folder of scans."""

from __future__ import annotations

from pathlib import Path

import click

from ssmpipe.cli.guard import debugging, guarded
from ssmpipe.cli.loading import default_registry
from ssmpipe.cli.parameters import PATH


@click.command()
@click.argument("anatomy")
@click.argument("scans_dir", type=PATH, metavar="SCANS_DIR")
@click.option("-o", "--output", "target", type=PATH, required=True, metavar="CONFIG.yaml", help="Config file to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.  [default: off]")
def init(anatomy: str, scans_dir: Path, target: Path, overwrite: bool) -> None:
    """Write a commented config for a folder of scans.

    ANATOMY is one of femur-distal, femur-proximal, aorta, tube, closed (spleens, whole bones), disk (one rim), curve (planar outlines,
    photographs). cohort.csv and landmarks.json are found beside the scans.
    """
    with guarded(debugging()):
        from ssmpipe.runner.init import write_config

        for line in write_config(anatomy, scans_dir, target, default_registry(), overwrite=overwrite):
            click.echo(line)
