"""The state of a half-done group stage on disk: one file beside the results, renamed into place, gone when the stage is done."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.checkpoints import LAYOUT, State
from ssmpipe.runner.disk import disk_errors, flush, replacing
from ssmpipe.runner.manifest import Request, changes

FOLDER = ".checkpoints"
_KEY = "key"


@dataclass(frozen=True)
class Found:
    """What is on disk: a state to continue from, or why what is there is of no use; both empty when there is nothing."""

    state: State | None = None
    iteration: int = 0
    discarded: str = ""

    @property
    def line(self) -> str:
        """What to tell the user; empty when there is nothing."""
        if self.state is not None:
            return f"continues from the checkpoint at iteration {self.iteration}"
        return f"checkpoint discarded: {self.discarded}" if self.discarded else ""


class CheckpointFile:
    """The checkpoint of one group stage.

    Parameters
    ----------
    out : Path
        Output folder of the run.
    step : str
    request : Request
        What the stage is run with now; a state that was saved for anything else is discarded.
    versions : mapping of str to str
        Of what computes the numbers: half a result of one version and half of another would be neither's.
    """

    def __init__(self, out: Path, step: str, request: Request, versions: dict[str, str]) -> None:
        self.path = out / FOLDER / f"{step}.npz"
        self.request = request
        self.versions = {name: versions[name] for name in ("numpy", "scipy") if name in versions}

    def find(self, *, force: bool = False) -> Found:
        """Read what there is and say whether it is of use."""
        if not self.path.is_file():
            return Found()
        if force:
            return Found(discarded="forced")
        try:
            with self.path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                key: dict[str, Any] = json.loads(str(file[_KEY]))
                request = Request(**key["request"])
                if key["layout"] != LAYOUT:
                    return Found(discarded=f"its layout is {key['layout']}, this version reads {LAYOUT}")
                if request.fingerprint != self.request.fingerprint:
                    return Found(discarded=changes(request, self.request))
                for name, version in self.versions.items():
                    if key["versions"].get(name) != version:
                        return Found(discarded=f"{name} changed: {key['versions'].get(name)} -> {version}")
                state = {name: file[name] for name in file.files if name != _KEY}
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            return Found(discarded=f"it cannot be read ({type(error).__name__})")
        return Found(state, int(key["iteration"]))

    def save(self, state: State) -> None:
        """Put a state in the place of the one before.

        Raises
        ------
        DiskError
            If it cannot be written.
        """
        iteration = len(state["history/rows"]) - 1 if "history/rows" in state else 0
        key = {
            "layout": LAYOUT,
            "iteration": iteration,
            "request": asdict(self.request),
            "versions": self.versions,
        }
        with replacing(self.path) as file:
            np.savez(file, **{_KEY: np.array(json.dumps(key))}, **state)  # type: ignore[arg-type]
        with disk_errors():
            flush(self.path.parent)

    def remove(self) -> None:
        """Remove the state, and what a killed run left of the next one."""
        if not self.path.parent.is_dir():
            return
        with disk_errors():
            self.path.unlink(missing_ok=True)
            for aside in self.path.parent.glob(f".{self.path.name}.*"):
                aside.unlink(missing_ok=True)
            if not any(self.path.parent.iterdir()):
                self.path.parent.rmdir()
