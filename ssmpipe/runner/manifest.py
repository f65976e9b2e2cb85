"""The record of a finished task: written last, compared before a rerun."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ssmpipe.runner.fingerprint import SCHEMA, VOLATILE, file_digest, fingerprint, slot_digest

FILE = "manifest.json"


@dataclass(frozen=True)
class Request:
    """What a task would be run with: the other half of the comparison with a manifest."""

    stage: str
    version: int
    config: Mapping[str, Any]
    inputs: Mapping[str, str | None]
    seed: int
    shape: str | None = None

    @property
    def fingerprint(self) -> str:
        """Digest of the request."""
        return fingerprint(
            stage=self.stage,
            version=self.version,
            config=self.config,
            inputs=self.inputs,
            seed=self.seed,
            shape=self.shape,
        )


@dataclass(frozen=True)
class Output:
    """An artifact on disk: its kind and the digest of every file (names relative to the task's folder)."""

    kind: str
    files: Mapping[str, str]

    @property
    def digest(self) -> str:
        """Digest of the artifact."""
        return slot_digest(self.files)


@dataclass(frozen=True)
class Manifest:
    """Provenance of one task; no clock, no machine, no absolute path in it."""

    step: str
    request: Request
    outputs: Mapping[str, Output]
    reason: str
    metrics: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    origins: Mapping[str, str] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write as JSON."""
        data = {
            "schema": SCHEMA,
            "step": self.step,
            "fingerprint": self.request.fingerprint,
            **asdict(self.request),
            "origins": dict(self.origins),
            "outputs": {
                slot: {"kind": out.kind, "digest": out.digest, "files": dict(out.files)}
                for slot, out in self.outputs.items()
            },
            "reason": self.reason,
            "metrics": dict(self.metrics),
            "warnings": list(self.warnings),
            "versions": dict(self.versions),
        }
        path.write_text(json.dumps(data, indent=1, ensure_ascii=False, sort_keys=True) + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of a task's folder, or None when there is none or it cannot be understood."""
    try:
        data = json.loads((folder / FILE).read_text(encoding="utf-8"))
        if data["schema"] != SCHEMA:
            return None
        request = Request(**{key: data[key] for key in ("stage", "version", "config", "inputs", "seed", "shape")})
        outputs = {slot: Output(out["kind"], out["files"]) for slot, out in data["outputs"].items()}
        return Manifest(
            step=data["step"],
            request=request,
            outputs=outputs,
            reason=data["reason"],
            metrics=data["metrics"],
            warnings=tuple(data["warnings"]),
            versions=data["versions"],
            origins=data["origins"],
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


@dataclass(frozen=True)
class Decision:
    """Whether a task runs, and why."""

    run: bool
    reason: str


UP_TO_DATE = Decision(False, "up to date")


def damaged_outputs(manifest: Manifest, folder: Path) -> str | None:
    """Return ``"output missing: ..."`` or ``"output modified: ..."``, or None when all files are as written."""
    files = {name: sha for out in manifest.outputs.values() for name, sha in out.files.items()}
    missing = sorted(name for name in files if not (folder / name).is_file())
    if missing:
        return f"output missing: {', '.join(missing)}"
    modified = sorted(name for name, sha in files.items() if sha not in (VOLATILE, file_digest(folder / name)))
    return f"output modified: {', '.join(modified)}" if modified else None


def decide(manifest: Manifest | None, request: Request, folder: Path, *, force: bool = False) -> Decision:
    """Compare a request with what is on disk.

    Returns
    -------
    Decision
        With one of the reasons: first run; forced; stage version changed; config changed [keys]; seed changed; input
        changed [slots]; output missing or modified [files]; up to date.
    """
    if manifest is None:
        return Decision(True, "first run")
    if force:
        return Decision(True, "forced")
    difference = changes(manifest.request, request)
    if difference:
        return Decision(True, difference)
    damage = damaged_outputs(manifest, folder)
    return Decision(True, damage) if damage else UP_TO_DATE


def changes(old: Request, new: Request) -> str:
    """Return what is different in the first of version, config, seed and inputs that differ; empty when nothing is."""
    if (old.stage, old.version) != (new.stage, new.version):
        return f"stage version changed: {old.version} -> {new.version}"
    keys = _changed(old.config, new.config)
    if keys:
        return f"config changed: {', '.join(keys)}"
    if old.seed != new.seed:
        return f"seed changed: {old.seed} -> {new.seed}"
    slots = _changed(old.inputs, new.inputs)
    return f"input changed: {', '.join(slots)}" if slots else ""


def _changed(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    missing = object()
    return sorted(key for key in {*old, *new} if old.get(key, missing) != new.get(key, missing))
