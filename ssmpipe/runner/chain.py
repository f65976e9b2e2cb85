"""The chain that a model carries: written by a run into ``model.npz``, read back to bring a new scan through the same stages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmpipe.core.errors import ArtifactError, ConfigError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.shape_model import Chain
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.codecs import load_artifact
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.io.outlines import read_outline, write_outline
from ssmpipe.runner.fingerprint import canonical, file_digest
from ssmpipe.runner.plan import Plan, PlannedStep, Producer, Step
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import ID

if TYPE_CHECKING:
    from ssmpipe.runner.workspace import Workspace

OPTIMIZE = "optimize"
FIRST_OUTPUT = "surface"
"""What the per-shape steps of a chain must make, for the group stage that finds the correspondence."""


def chain_steps(plan: Plan) -> list[PlannedStep]:
    """Return the per-shape steps, and the one that finds the correspondence."""
    return [step for step in plan.steps if step.scope == "shape" or step.stage == OPTIMIZE]


def chain_content(workspace: Workspace) -> dict[str, Any]:
    """Return what a model has to know of its chain, as plain data; it names no folder and no file."""
    source = next(iter(workspace.sources.values()))
    return {
        "seed": workspace.seed,
        "kind": source.kind,
        "units": source.units,
        "roles": dict(source.roles),
        "anatomy": source.anatomy,
        "diagonal_mm": list(source.diagonal_mm) if source.diagonal_mm else None,
        "tolerance_mm": source.tolerance_mm,
        "steps": [
            {
                "id": step.id,
                "stage": step.stage,
                "version": step.version,
                "options": dict(step.options),
                "from": {slot: p.step for slot, p in step.inputs.items() if p is not None and not p.prepared},
            }
            for step in chain_steps(workspace.plan)
        ],
    }


def read_chain(workspace: Workspace) -> Chain:
    """Return the chain of a workspace with what its steps prepared; an artifact for the stage ``model``."""
    from ssmpipe.runner.execute import versions

    prepared: dict[str, TriMesh | Outline] = {}
    for step in chain_steps(workspace.plan):
        for port in step.prepared:
            name = f"{step.id}.{port.slot}"
            if port.slot in step.files:
                path = Path(step.files[port.slot][1])
                prepared[name] = read_outline(path) if port.kind == "outline" else read_mesh(path)
                continue
            folder, manifest = workspace.produced(Producer(step.id, "cohort", prepared=True), None)
            if manifest is None:
                raise AssertionError("digests were read from it a moment ago")
            output = manifest.outputs[port.slot]
            prepared[name] = load_artifact(output.kind, port.slot, folder, list(output.files))
    return Chain(canonical({"ssmpipe": versions()["ssmpipe"], **chain_content(workspace)}), prepared)


def read_content(chain: Chain | None, name: str) -> dict[str, Any]:
    """Return the plain data of a chain.

    Raises
    ------
    ConfigError
        If the model ``name`` carries none.
    ArtifactError
        If it is not readable.
    """
    if chain is None:
        raise ConfigError(
            f"{name} does not carry the chain that its shapes went through",
            "build the model again with this version: ssmpipe run CONFIG.yaml --from model",
        )
    try:
        content = json.loads(chain.text)
        if not isinstance(content["steps"], list) or not isinstance(content["units"], str):
            raise TypeError("steps or units")
        for item in content["steps"]:
            kinds = {"id": str, "stage": str, "version": int, "options": dict, "from": dict}
            if not all(isinstance(item[key], kind) for key, kind in kinds.items()) or not ID.fullmatch(item["id"]):
                raise TypeError("a step")  # files are named after it, so it may not lead out of a folder
    except (ValueError, KeyError, TypeError) as error:
        raise ArtifactError(f"{name}: its chain is not readable ({error})", "build the model again") from error
    return content


def chain_as_steps(
    chain: Chain, content: Mapping[str, Any], registry: Registry, folder: Path, available: Sequence[str]
) -> tuple[list[Step], list[str]]:
    """Return the per-shape steps of a chain, ready to be planned, and a warning for every stage that has changed since.

    What the steps had in common is written into ``folder``, which the steps then read.

    Raises
    ------
    ConfigError
        If a stage does not exist any more, or refuses its options.
    """
    from pydantic import ValidationError

    steps, warnings, slots = [], [], set(available)
    for item in content["steps"]:
        if item["stage"] == OPTIMIZE:
            continue
        stage = registry.load(item["stage"]).suiting(slots)
        if stage.scope != "shape":
            continue
        slots |= {port.slot for port in stage.outputs}
        options = dict(item["options"])
        files = {}
        for port in stage.prepared:
            common = chain.prepared.get(f"{item['id']}.{port.slot}")
            if common is None:
                raise ConfigError(
                    f"the model does not hold the {port.slot} of its stage '{item['id']}'", "build it again"
                )
            path = folder / f"{item['id']}-{port.slot}{'.csv' if port.kind == 'outline' else '.ply'}"
            _write_common(path, common)
            sha = file_digest(path)
            files[port.slot] = (sha, str(path))
            options[port.slot] = f"file:{sha}"
        try:
            stage.config.model_validate_json(json.dumps({k: v for k, v in options.items() if k not in files}))
        except ValidationError as error:
            fact = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors(include_url=False))
            raise ConfigError(
                f"stage '{item['id']}' of the model's chain does not accept its options any more ({fact})",
                f"use ssmpipe {content.get('ssmpipe', 'of then')}, or build the model again",
            ) from None
        if stage.version != item["version"]:
            warnings.append(
                f"stage '{item['id']}' is version {stage.version} here, the model was made with version {item['version']}; "
                "results may differ a little; build the model again to be safe"
            )
        steps.append(Step(item["id"], stage, options, dict(item["from"]), files))
    if FIRST_OUTPUT not in slots:
        raise ConfigError("the chain of the model makes no splines", "build the model again")
    return steps, warnings


def optimize_options(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of the stage that found the correspondence."""
    for item in content["steps"]:
        if item["stage"] == OPTIMIZE:
            return dict(item["options"])
    raise ConfigError("the chain of the model has no stage optimize", "build the model again")


def _write_common(path: Path, common: TriMesh | Outline) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(common, Outline):
        write_outline(path, common)
    else:
        write_mesh(path, common)
