"""What the pages of single shapes need from the output folder, and which of them have to be written again."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmpipe.contract import Landmarks
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.core.evaluation.quality import Geometry, dense_spline
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.codecs import load_artifact
from ssmpipe.runner.fingerprint import digest, file_digest
from ssmpipe.runner.plan import SCAN, PlannedStep, Producer
from ssmpipe.runner.workspace import Workspace

if TYPE_CHECKING:
    from ssmpipe.report.patient import StepShape

FOLDER = "report"
PAGES = "pages.json"
_SHAPES = ("mesh", "contour", "surface", "samples")  # the first of them that a stage made is drawn


def page_name(shape: str) -> str:
    """Return the file name of the page of a shape.

    Examples
    --------
    >>> page_name("femur_01")
    'femur_01.html'
    """
    return f"{shape}.html"


def page_digests(workspace: Workspace, step: PlannedStep, shown: Mapping[str, Any]) -> dict[str, str]:
    """Return for every shape the digest of all that its page shows."""
    ids = sorted(shown["shapes"])
    common = {
        slot: workspace.slot_digest(producer, slot, None)
        for slot, producer in step.inputs.items()
        if producer is not None and producer.scope == "cohort"
    }
    given = {slot: p for slot, p in step.inputs.items() if p is not None and p.scope == "shape"}  # landmarks, transform
    rest = [shown.get("name"), shown.get("ssmpipe_version"), shown["config"]["input"]["units"]]
    found = {}
    for place, shape in enumerate(ids):
        made = {}
        for each in workspace.plan.steps:
            if each.scope == "shape":
                manifest = workspace.manifest(workspace.folder(each, shape))
                made[each.id] = {s: out.digest for s, out in manifest.outputs.items()} if manifest else None
        failure = (shown.get("failures") or {}).get(shape)
        scan = [
            _slot_digest(workspace, Producer(SCAN, "shape"), slot, shape) for slot in workspace.sources[shape].kinds
        ]
        beside = {slot: _slot_digest(workspace, producer, slot, shape) for slot, producer in given.items()}
        around = [ids[place - 1] if place else None, ids[place + 1] if place + 1 < len(ids) else None]
        found[shape] = digest([common, rest, shown["shapes"][shape], failure, made, scan, beside, around])
    return found


def _slot_digest(workspace: Workspace, producer: Producer, slot: str, shape: str) -> str | None:
    """Return the digest of one artifact; None when it is not there or cannot be read."""
    with contextlib.suppress(SsmpipeError):
        return workspace.slot_digest(producer, slot, shape)
    return None


@dataclass(frozen=True)
class WrittenPages:
    """What stands in ``pages.json``: per shape the digest of what the page shows, and of the file."""

    requests: Mapping[str, str]
    files: Mapping[str, str]

    @classmethod
    def read(cls, folder: Path) -> WrittenPages:
        """Return what was written last; nothing when that cannot be read."""
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            data = json.loads((folder / PAGES).read_text(encoding="utf-8"))
            return cls(dict(data["requests"]), dict(data["files"]))
        return cls({}, {})

    def text(self) -> str:
        """Return it as JSON."""
        return json.dumps({"requests": dict(self.requests), "files": dict(self.files)}, indent=1, sort_keys=True) + "\n"

    def current(self, shape: str, request: str, path: Path) -> bool:
        """Whether the page of a shape is there as written and shows what it should."""
        return self.requests.get(shape) == request and path.is_file() and self.files.get(shape) == file_digest(path)


def steps_of(
    workspace: Workspace, shape: str, record: Mapping[str, Any], correspondence: Correspondence | None
) -> list[StepShape]:
    """Return the scan and what every stage made of it, as far as it came, and the corresponded surface at the end."""
    from ssmpipe.report.patient import StepShape, checkers, corresponded_state

    transform: Floats = np.eye(4)
    steps = []
    with contextlib.suppress(SsmpipeError, MemoryError):  # a scan that cannot be read has a page that says so
        given = workspace.sources[shape].load()
        transform = np.asarray(given.get("transform", transform))
        shapes = (_geometry(given.get(slot)) for slot in _SHAPES)
        steps.append(StepShape("scan", next((s for s in shapes if s is not None), None), transform))
    done = {str(s.get("folder")) for s in record.get("stages") or () if s.get("status") == "done"}
    for step in workspace.plan.steps:
        folder = workspace.folder(step, shape)
        manifest = workspace.manifest(folder) if step.scope == "shape" and step.folder in done else None
        if manifest is None:
            continue
        made: dict[str, Any] = {}
        for slot in (*_SHAPES, "uv", "transform"):
            if slot in manifest.outputs:
                output = manifest.outputs[slot]
                made[slot] = load_artifact(output.kind, slot, folder, list(output.files))
        transform = np.asarray(made.get("transform", transform))
        shown = next((g for slot in _SHAPES if (g := _geometry(made.get(slot))) is not None), None)
        pattern = None
        if "uv" in made and shown is not None and len(made["uv"]) == len(shown.points):
            pattern = checkers(made["uv"])
        steps.append(StepShape(step.folder, shown, transform, pattern))
    if correspondence is not None and shape in correspondence.ids:
        steps.append(corresponded_state(correspondence, correspondence.ids.index(shape)))
    return steps


def _geometry(made: Any) -> Geometry | None:
    if isinstance(made, TriMesh):
        return Geometry(made.vertices, made.faces)
    if isinstance(made, Outline):
        return Geometry(made.points, made.edges)
    if hasattr(made, "control_points"):
        return dense_spline(made)
    if isinstance(made, np.ndarray) and made.ndim == 3 and made.shape[2] == 3:
        return Geometry(made.reshape(-1, 3), grid_faces(*made.shape[:2]))
    return None


def landmarks_of(
    workspace: Workspace, step: PlannedStep, correspondence: Correspondence, warn: Callable[[str], None] | None = None
) -> dict[str, dict[str, Floats]]:
    """Return the landmarks of every shape of a correspondence in its frame; those that cannot be read are told to ``warn``."""
    marks, frames = step.inputs.get("landmarks"), step.inputs.get("transform")
    found: dict[str, dict[str, Floats]] = {}
    if marks is None or frames is None:
        return found

    def one(slot: str, shape: str) -> Any:
        producer = step.inputs[slot]
        if producer is None:
            return None
        if producer.step == SCAN:
            return workspace.sources[shape].beside().get(slot)  # the scan itself is not read
        folder, manifest = workspace.produced(producer, shape)
        output = manifest.outputs.get(slot) if manifest else None
        return load_artifact(output.kind, slot, folder, list(output.files)) if output else None

    for shape, matrix in zip(correspondence.ids, correspondence.transform, strict=True):
        if shape not in workspace.sources:
            continue
        try:
            given, frame = one("landmarks", shape), one("transform", shape)
        except SsmpipeError as error:
            if warn is not None:
                warn(f"{shape}: shown without landmarks: {error}")
            continue
        if isinstance(given, Landmarks) and frame is not None and given.points:
            found[shape] = dict(given.transformed(matrix @ np.linalg.inv(frame)).points)
    return found
