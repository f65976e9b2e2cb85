"""Find the stages by file name; describe them without importing anything heavy.

A stage ``fill-holes`` is the file ``fill_holes.py`` in ``ssmpipe/stages``, or in one of the folders that the environment
variable ``SSMPIPE_STAGES`` lists (a laboratory's own stages). Listing reads only the first docstring line of each file.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.suggest import did_you_mean

if TYPE_CHECKING:
    from ssmpipe.contract import Stage

BUILTIN = Path(__file__).resolve().parents[1] / "stages"
REPORT = "report"  # written by the runner itself: it needs the record of the whole run
RESERVED = ("id", "skip", "from", "after")  # keys of a step in the config that no stage may use as option


def summary_line(path: Path) -> str:
    """Return the first line of a module's docstring, read without importing it."""
    try:
        doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    except (OSError, SyntaxError, UnicodeDecodeError):
        doc = None
    return (doc or "(no description)").strip().splitlines()[0]


@dataclass(frozen=True)
class Registry:
    """The stages that can be named in a config; plain folders, so it can be sent to a child process.

    Examples
    --------
    >>> "report" in Registry().names()
    True
    """

    folders: tuple[Path, ...] = (BUILTIN,)

    @classmethod
    def default(cls) -> Registry:
        """Return the built-in stages and those of the folders in ``SSMPIPE_STAGES``."""
        extra = [Path(p).resolve() for p in os.environ.get("SSMPIPE_STAGES", "").split(os.pathsep) if p]
        return cls((BUILTIN, *extra))

    def files(self) -> dict[str, Path]:
        """Return stage name to file; the first folder that has a name wins."""
        found: dict[str, Path] = {}
        for folder in self.folders:
            for path in sorted(folder.glob("*.py")):
                if not path.stem.startswith("_"):
                    found.setdefault(path.stem.replace("_", "-"), path)
        return dict(sorted(found.items()))

    def names(self) -> tuple[str, ...]:
        """Return all stage names, sorted."""
        return tuple(sorted({*self.files(), REPORT}))

    def summary(self, name: str) -> str:
        """Return one line that says what the stage does."""
        path = self.files().get(name)
        return "Write the report of the whole run." if path is None else summary_line(path)

    def load(self, name: str) -> Stage:
        """Import a stage.

        Raises
        ------
        ConfigError
            If there is no such stage, or its file does not follow the contract.
        """
        path = self.files().get(name)
        if path is None and name == REPORT:
            from ssmpipe.runner.reporting import STAGE

            return STAGE
        if path is None:
            raise ConfigError(f"there is no stage '{name}'{did_you_mean(name, self.names())}")
        module = self._module(path)
        stage = getattr(module, "STAGE", None)
        if stage is None or stage.name != name:
            raise ConfigError(f"{path.name} is not a stage: it must define STAGE with the name '{name}'")
        clash = set(RESERVED) & set(stage.config.model_fields)
        if clash:
            raise ConfigError(f"stage '{name}': the option names {sorted(clash)} are reserved for the config file")
        return stage

    @staticmethod
    def _module(path: Path) -> ModuleType:
        if path.parent == BUILTIN:
            return importlib.import_module(f"ssmpipe.stages.{path.stem}")
        name = f"ssmpipe_extra_stages_{path.stem}"
        known = sys.modules.get(name)
        if known is not None and getattr(known, "__file__", None) == str(path):
            return known
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ConfigError(f"cannot import {path}")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module


def synth_files() -> dict[str, Path]:
    """Return the synthetic cohorts by name: files in ``ssmpipe/synth`` that define ``write_cohort``; nothing is imported."""
    found = {}
    for path in sorted((BUILTIN.parent / "synth").glob("[!_]*.py")):
        try:
            body = ast.parse(path.read_text(encoding="utf-8")).body
        except SyntaxError:
            continue
        if any(isinstance(node, ast.FunctionDef) and node.name == "write_cohort" for node in body):
            found[path.stem.replace("_", "-")] = path
    return found


def synth_options(path: Path) -> dict[str, str]:
    """Return the switches of a synthetic cohort, name to help: the literal ``OPTIONS`` of its file; nothing is imported."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and [t.id for t in node.targets if isinstance(t, ast.Name)] == ["OPTIONS"]:
            return dict(ast.literal_eval(node.value))
    return {}
