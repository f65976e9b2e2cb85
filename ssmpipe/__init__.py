"""Raw anatomical surfaces in, a statistical shape model with certified dense correspondence out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssmpipe.use.model import Model

__version__ = "0.1.0"
__all__ = ["load_model"]


def load_model(path: Path | str) -> Model:
    """Read a shape model: ``model.npz``, or the output folder of a run; see :class:`ssmpipe.use.model.Model`.

    Raises
    ------
    ssmpipe.core.errors.ConfigError
        If there is none.
    ssmpipe.core.errors.ArtifactError
        If it cannot be read.
    """
    from ssmpipe.use.model import load_model as load

    return load(path)
