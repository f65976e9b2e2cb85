"""One stage on one file (or, for group stages, on a folder), for shell loops.

What the main file cannot hold travels beside it: ``OUT.npz`` (uv, samples, meshes, surfaces) and ``OUT.json``
(transform, landmarks, info), named by the full name of the main file: ``bone.ply.json``. The next stage reads them back.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import click
import numpy as np

from ssmpipe.contract import Context, Landmarks, Port, ShapeInfo, Stage
from ssmpipe.core.errors import ArtifactError, ConfigError, LandmarkError, SsmpipeError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.arrays import read_npz, write_npz
from ssmpipe.io.codecs import load_artifact, read_json, save_artifact, write_json
from ssmpipe.io.images import IMAGE_SUFFIXES, read_image
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import MESH_SUFFIXES, read_mesh, write_mesh
from ssmpipe.io.outlines import OUTLINE_SUFFIXES, read_outline, write_outline
from ssmpipe.runner.config import InputConfig
from ssmpipe.runner.config_problems import explain
from ssmpipe.runner.disk import disk_errors
from ssmpipe.runner.document import parse_value
from ssmpipe.runner.execute import failure_of, make_rng
from ssmpipe.runner.sources import PLAUSIBLE_MM, check_landmarks

COHORT_KINDS = {"correspondence": "correspondence.npz", "model": "model.npz"}
PER_VERTEX = ("uv",)  # not valid any more when the mesh has changed
JSON_KINDS = ("landmarks", "transform", "info", "json")
SHAPES = "shapes.json"


def stage_command(stage: Stage, guard: Callable[[], AbstractContextManager[None]]) -> click.Command:
    """Return the command of a stage: its options are the fields of its config; ``guard`` turns errors into exit codes."""
    group = stage.scope == "cohort"
    params: list[click.Parameter] = [
        click.Argument(["source"], type=click.Path(path_type=Path), metavar="IN_DIR" if group else "IN"),
        click.Argument(["target"], type=click.Path(path_type=Path), metavar="OUT_DIR" if group else "OUT"),
    ]
    common = {port.slot for port in stage.prepared}
    fields = {**stage.config.model_fields}
    for variant in stage.variants:
        fields = {**variant.config.model_fields, **fields}
    params += [_option(name, field, is_file=name in common) for name, field in fields.items()]
    params.append(
        click.Option(
            ["--seed"], type=click.IntRange(0), default=0, show_default=True, help="Seed of everything random."
        )
    )
    slots = {port.slot for port in stage.inputs}
    files = click.Path(path_type=Path)
    if "landmarks" in slots and not group:
        text = "Named points, in the units of IN.  [default: IN.json]"
        params.append(click.Option(["--landmarks", "landmark_file"], type=files, metavar="FILE", help=text))
        text = "Which landmark serves which role.  [repeatable; default: IN.json]"
        params.append(click.Option(["--role", "roles"], multiple=True, metavar="ROLE=NAME", help=text))
    if "info" in slots and not group:
        side = click.Choice(["L", "R"], case_sensitive=False)
        params.append(click.Option(["--side"], type=side, metavar="L|R", help="Side of the body.  [default: IN.json]"))
    for port in stage.prepared:
        if port.slot not in stage.config.model_fields:
            params.append(
                click.Option([f"--{port.slot}"], type=str, metavar="FILE", help=f"The {port.slot}: a mesh file.")
            )

    def callback(source: Path, target: Path, seed: int, **given: Any) -> None:
        with guard():
            if group:
                _run_group(stage, source, target, seed, given)
            else:
                _run_shape(_variant(stage, source), source, target, seed, given)

    module = sys.modules.get(stage.run.__module__)
    doc = (getattr(module, "__doc__", None) or stage.name).strip()
    reads = ", ".join(p.slot + (" (optional)" if p.optional else "") for p in stage.inputs)
    writes = ", ".join(p.slot for p in stage.outputs)
    return click.Command(stage.name, callback=callback, params=params, help=f"{doc}\n\nReads {reads}; writes {writes}.")


def _option(name: str, field: Any, *, is_file: bool = False) -> click.Option:
    flag = name.replace("_", "-")
    if is_file:
        text = f"The {name}: a mesh file, since one file knows nothing of the others.  [default: none, required]"
        return click.Option([f"--{flag}", f"option_{name}"], metavar="FILE", help=text)
    default = field.get_default(call_default_factory=True)
    shown = (
        "required"
        if field.is_required()
        else json.dumps(list(default) if isinstance(default, tuple) else default, default=str)
    )
    text = f"{field.description or ''}  [default: {shown}]"
    if field.annotation is bool:
        return click.Option([f"--{flag}/--no-{flag}", f"option_{name}"], default=None, help=text)
    return click.Option([f"--{flag}", f"option_{name}"], metavar=_metavar(field.annotation), help=text)


def _metavar(annotation: Any) -> str:
    from typing import Literal, get_args, get_origin

    if get_origin(annotation) is Literal:
        return "|".join(str(a) for a in get_args(annotation))
    if isinstance(annotation, type):
        return {int: "INTEGER", float: "NUMBER", str: "TEXT"}.get(annotation, "VALUE")
    if get_origin(annotation) in (tuple, list):
        return "[A,B,...]"
    return "VALUE"


def _config(stage: Stage, given: Mapping[str, Any]) -> Any:
    from pydantic import ValidationError

    options = {}
    for key, value in given.items():
        if key.startswith("option_") and value is not None:
            name = key.removeprefix("option_")
            if name not in stage.config.model_fields:
                raise ConfigError(f"--{name.replace('_', '-')} does not apply to this kind of file")
            field = stage.config.model_fields[name]
            options[name] = value if isinstance(value, bool) or field.annotation is str else parse_value(value)
    try:
        return stage.config.model_validate_json(json.dumps(options))
    except ValidationError as error:
        lines = [
            f"--{str(loc[0]).replace('_', '-')}: {text}" if loc else text
            for loc, text in explain(error, stage.config, options)
        ]
        raise ConfigError("\n".join(lines)) from None


# --- one shape -----------------------------------------------------------------------------------------------------


def _run_shape(stage: Stage, source: Path, target: Path, seed: int, given: Mapping[str, Any]) -> None:
    cfg = _config(stage, given)
    shape_id = _shape_id(source)
    slots, kinds = _read_shape(source, _main_kind(stage.inputs, source))
    raw = "transform" not in slots
    _apply(slots, kinds, shape_id, given)
    ctx = Context(shape_id, make_rng(seed, shape_id, stage.name), _console_logger(stage.name))
    _prepare(stage, slots, given)
    try:
        _check_scan(slots, given, ctx, raw=raw)
        made = stage.run(**_arguments(stage, slots, source), cfg=cfg, ctx=ctx)
    except (SsmpipeError, MemoryError, SystemExit) as error:
        fact, remedy, _ = failure_of(error)
        raise SsmpipeError(f"{shape_id}, {stage.name}, {source}: {fact}", remedy or None) from error
    slots |= {port.slot: made.get(port.slot) for port in stage.outputs}
    kinds |= {port.slot: port.kind for port in stage.outputs}
    if "mesh" in made:
        for slot in set(PER_VERTEX) - set(made):
            slots.pop(slot, None)
    _write_shape(target, _main_port(stage.outputs, target), slots, kinds)
    for name, value in ctx.metrics.items():
        click.echo(f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}")


def _shape_id(path: Path) -> str:
    return path.stem if path.suffix else path.name


def _variant(stage: Stage, source: Path) -> Stage:
    """Return the variant of a stage that reads this kind of file; the stage itself when none does."""
    fitting = (s for s in (stage, *stage.variants) if any(_fits(port.kind, source) for port in s.inputs))
    return next(fitting, stage)


def _fits(kind: str, path: Path) -> bool:
    suffix = path.suffix.lower()
    if kind == "trimesh":
        return suffix in MESH_SUFFIXES
    if kind == "outline":
        return suffix in OUTLINE_SUFFIXES
    if kind == "image":
        return suffix in IMAGE_SUFFIXES
    return suffix == ".npz" and kind in ("samples", "surface", "uv")


def _main_kind(ports: tuple[Port, ...], path: Path) -> Port:
    if not path.is_file():
        raise ArtifactError(f"there is no file {path}")
    return _main_port(ports, path)


def _main_port(ports: tuple[Port, ...], path: Path) -> Port:
    fitting = [port for port in ports if _fits(port.kind, path)]
    if not fitting:
        kinds = [port.kind for port in ports if port.kind in ("trimesh", "outline", "samples", "surface")][:1]
        suffixes = {"trimesh": MESH_SUFFIXES, "outline": OUTLINE_SUFFIXES}
        wanted = " ".join(suffixes.get(kinds[0], (".npz",)) if kinds else (".npz",))
        raise ConfigError(f"{path.name}: this stage needs a file of type {wanted} here")
    return fitting[0]


def _read_shape(path: Path, main: Port) -> tuple[dict[str, Any], dict[str, str]]:
    """Read the main file and what lies beside it: artifacts and kinds by slot."""
    slots: dict[str, Any] = {}
    kinds: dict[str, str] = {}
    arrays = path.with_name(path.name + ".npz")
    texts = path.with_name(path.name + ".json")
    with tempfile.TemporaryDirectory(prefix="ssmpipe-") as name:
        folder = Path(name)
        if arrays.is_file():
            content = read_npz(arrays)
            for key in sorted(content):
                slot, kind, _ = key.split("/", 2) if key.count("/") == 2 else (key, "", "")
                if not kind or slot in slots:
                    continue
                part = {k.split("/", 2)[2]: v for k, v in content.items() if k.startswith(f"{slot}/{kind}/")}
                kinds[slot] = kind
                if kind == "trimesh":
                    slots[slot] = TriMesh(part["vertices"], part["faces"])
                else:
                    write_npz(folder / f"{slot}.npz", part)
                    slots[slot] = load_artifact(kind, slot, folder, [f"{slot}.npz"])
        if texts.is_file():
            for slot, entry in _mapping(texts).items():
                write_json(folder / f"{slot}.json", entry["content"])
                kinds[slot] = str(entry["kind"])
                slots[slot] = load_artifact(kinds[slot], slot, folder, [f"{slot}.json"])
    slots[main.slot] = _read_main(path, main)
    kinds[main.slot] = main.kind
    return slots, kinds


def _read_main(path: Path, main: Port) -> Any:
    if main.kind == "trimesh":
        return read_mesh(path)
    if main.kind not in ("outline", "image"):
        return load_artifact(main.kind, main.slot, path.parent, [path.name])
    remarks: list[str] = []
    content = read_outline(path, remarks) if main.kind == "outline" else read_image(path, remarks)
    for remark in remarks:
        click.echo(f"warning: {remark}", err=True)
    return content


def _mapping(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict) or not all(
        isinstance(e, dict) and {"kind", "content"} <= set(e) for e in content.values()
    ):
        raise ArtifactError(f"{path.name} was not written by ssmpipe", "move it away, or name the scan differently")
    return content


def _apply(slots: dict[str, Any], kinds: dict[str, str], shape_id: str, given: Mapping[str, Any]) -> None:
    """Fill in what no file gave, and what the command line says."""
    if "transform" not in slots:
        slots["transform"], kinds["transform"] = np.eye(4), "transform"
    old: ShapeInfo = slots.get("info", ShapeInfo(shape_id))
    side = given.get("side")
    slots["info"], kinds["info"] = ShapeInfo(old.id, side.upper() if side else old.side, old.columns), "info"
    marks: Landmarks = slots.get("landmarks", Landmarks())
    if given.get("landmark_file") is not None:
        table = read_landmarks(given["landmark_file"])
        points = table.get(shape_id, next(iter(table.values())) if len(table) == 1 else None)
        if points is None:
            raise ArtifactError(
                f"{given['landmark_file']} has no entry '{shape_id}'", f"it has: {', '.join(sorted(table)[:5])}"
            )
        marks = Landmarks(points, marks.roles)
    roles = dict(marks.roles)
    for text in given.get("roles") or ():
        role, sep, name = text.partition("=")
        if not sep:
            raise ConfigError(f"--role {text}: write it as ROLE=NAME")
        roles[role.strip()] = name.strip()
    slots["landmarks"], kinds["landmarks"] = Landmarks(marks.points, roles), "landmarks"


def _check_scan(slots: Mapping[str, Any], given: Mapping[str, Any], ctx: Context, *, raw: bool) -> None:
    """Refuse landmarks of the command line that are far from the shape; warn of a scan whose size can hardly be in mm."""
    mesh, shape = slots.get("mesh"), slots.get("mesh", slots.get("contour"))
    if raw and mesh is not None:
        diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        if not PLAUSIBLE_MM[0] <= diagonal <= PLAUSIBLE_MM[1]:
            ctx.warn(
                f"bounding box diagonal is {diagonal:.3g}; stages take lengths as mm, convert the file if it is not"
            )
    if shape is None or given.get("landmark_file") is None:
        return
    units = "mm" if mesh is not None else "none"  # outlines are often in pixels
    try:
        warnings = check_landmarks(shape, slots["landmarks"].points, InputConfig().landmark_tolerance, units)
    except LandmarkError as error:
        remedy = "give landmarks of this file, in its frame and units" if "away" in error.fact else error.remedy
        raise LandmarkError(error.fact, remedy) from error
    for warning in warnings:
        ctx.warn(warning)


def _prepare(stage: Stage, slots: dict[str, Any], given: Mapping[str, Any]) -> None:
    for port in stage.prepared:
        value = given.get(f"option_{port.slot}") or given.get(port.slot)
        if not value:
            raise ConfigError(f"--{port.slot} FILE is needed: one file knows nothing of the others")
        slots[port.slot] = _read_main(Path(value), port)


def _arguments(stage: Stage, slots: Mapping[str, Any], source: Path) -> dict[str, Any]:
    for port in stage.inputs:
        if slots.get(port.slot) is None and not port.optional:
            raise ArtifactError(
                f"{port.slot} is missing: neither in the file nor in {source.name}.npz or {source.name}.json",
                "run the stage before it with ssmpipe, and keep the files that it writes beside its output",
            )
    return {port.slot: slots.get(port.slot) for port in stage.inputs}


def _write_shape(target: Path, main: Port, slots: Mapping[str, Any], kinds: Mapping[str, str]) -> None:
    arrays: dict[str, Any] = {}
    texts: dict[str, Any] = {}
    with disk_errors():
        target.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".ssmpipe-", dir=target.parent))
    try:
        with disk_errors():
            for slot in sorted(slots):
                artifact, kind = slots[slot], kinds.get(slot, "")
                if artifact is None or slot == main.slot or not kind or kind == "image":
                    continue
                if kind == "trimesh":
                    arrays |= {f"{slot}/{kind}/vertices": artifact.vertices, f"{slot}/{kind}/faces": artifact.faces}
                    continue
                (name, *_) = save_artifact(kind, slot, artifact, folder)
                if kind in JSON_KINDS:
                    texts[slot] = {"kind": kind, "content": read_json(folder / name)}
                elif name.endswith(".npz"):
                    arrays |= {f"{slot}/{kind}/{key}": value for key, value in read_npz(folder / name).items()}
            if main.kind == "trimesh":
                write_mesh(folder / target.name, slots[main.slot])
            elif main.kind == "outline":
                write_outline(folder / target.name, slots[main.slot])
            else:
                (name,) = save_artifact(main.kind, main.slot, slots[main.slot], folder)
                if name != target.name:
                    os.replace(folder / name, folder / target.name)
            beside = []
            if arrays:
                write_npz(folder / f"{target.name}.npz", arrays)
                beside.append(f"{target.name}.npz")
            if texts:
                write_json(folder / f"{target.name}.json", texts)
                beside.append(f"{target.name}.json")
            for old in (f"{target.name}.npz", f"{target.name}.json"):
                if old not in beside:
                    (target.parent / old).unlink(missing_ok=True)
            for name in (*beside, target.name):
                os.replace(folder / name, target.parent / name)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# --- a group -------------------------------------------------------------------------------------------------------


def _run_group(stage: Stage, source: Path, target: Path, seed: int, given: Mapping[str, Any]) -> None:
    cfg = _config(stage, given)
    if not source.is_dir():
        raise ArtifactError(f"there is no folder {source}")
    whole = {p.slot: _read_whole(p, source) for p in stage.inputs if p.kind in COHORT_KINDS}
    shapes = _read_members(stage, source)
    artifacts: dict[str, Any] = dict(whole)
    for port in stage.inputs:
        if port.slot in whole:
            continue
        found = {i: slots[port.slot] for i, (slots, _) in sorted(shapes.items()) if slots.get(port.slot) is not None}
        if not found and not port.optional:
            fact = f"{source}: no file with '{port.slot}' for stage '{stage.name}'"
            raise ArtifactError(fact, "give the folder that the stage before wrote")
        artifacts[port.slot] = found or None
    ctx = Context("", make_rng(seed, None, stage.name), _console_logger(stage.name))
    if sys.stderr.isatty():
        ctx.progress = lambda done, total, text: click.echo(f"\r{done}/{total} {text}\x1b[K", nl=False, err=True)
    made = stage.run(**artifacts, cfg=cfg, ctx=ctx)
    if sys.stderr.isatty():
        click.echo("", err=True)
    carried: tuple[str, ...] = ("info", "landmarks", "transform")
    keep = {i: {s: (kinds[s], slots[s]) for s in carried if s in slots} for i, (slots, kinds) in shapes.items()}
    _write_group(target, stage, made, keep)
    for name, value in ctx.metrics.items():
        click.echo(f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}")
    click.echo(f"{len(shapes)} shapes; results are in {target}")


def _read_whole(port: Port, source: Path) -> Any:
    name = COHORT_KINDS[port.kind]
    if not (source / name).is_file():
        raise ArtifactError(f"{source} has no {name}", "give the folder that the stage before wrote")
    return load_artifact(port.kind, port.slot, source, [name])


def _read_members(stage: Stage, source: Path) -> dict[str, tuple[dict[str, Any], dict[str, str]]]:
    """Read what the folder says of every shape: main files with their sidecars, or the list that a group stage left."""
    shapes: dict[str, tuple[dict[str, Any], dict[str, str]]] = {}
    listed = source / SHAPES
    if listed.is_file():
        with tempfile.TemporaryDirectory(prefix="ssmpipe-") as name:
            folder = Path(name)
            for shape_id, entries in read_json(listed).items():
                slots: dict[str, Any] = {}
                kinds: dict[str, str] = {}
                for slot, entry in entries.items():
                    write_json(folder / f"{slot}.json", entry["content"])
                    kinds[slot] = entry["kind"]
                    slots[slot] = load_artifact(entry["kind"], slot, folder, [f"{slot}.json"])
                _apply(slots, kinds, shape_id, {})
                shapes[shape_id] = (slots, kinds)
        return shapes
    mains = [p for p in stage.inputs if p.kind in ("surface", "samples", "trimesh")]
    if not mains:
        return shapes
    for path in sorted(source.iterdir()):
        is_sidecar = path.suffix == ".npz" and (source / path.stem).is_file()
        if path.is_file() and _fits(mains[0].kind, path) and not is_sidecar:
            slots, kinds = _read_shape(path, mains[0])
            _apply(slots, kinds, _shape_id(path), {})
            shapes[_shape_id(path)] = (slots, kinds)
    if not shapes:
        raise ArtifactError(
            f"no files with '{mains[0].slot}' in {source}", "give the folder that the stage before wrote"
        )
    return shapes


def _write_group(
    target: Path, stage: Stage, made: Mapping[str, Any], keep: Mapping[str, Mapping[str, tuple[str, Any]]]
) -> None:
    with disk_errors():
        target.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".ssmpipe-", dir=target))
    try:
        with disk_errors():
            names = []
            for port in stage.outputs:
                if made.get(port.slot) is not None:
                    names += save_artifact(port.kind, port.slot, made[port.slot], folder)
            listed: dict[str, dict[str, Any]] = {}
            for shape_id, entries in keep.items():
                listed[shape_id] = {}
                for slot, (kind, artifact) in entries.items():
                    (name,) = save_artifact(kind, f"tmp_{slot}", artifact, folder)
                    listed[shape_id][slot] = {"kind": kind, "content": read_json(folder / name)}
            write_json(folder / SHAPES, listed)
            for name in (*names, SHAPES):
                os.replace(folder / name, target / name)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _console_logger(name: str) -> logging.Logger:
    logger = logging.Logger(name)
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("warning: %(message)s"))
    logger.addHandler(handler)
    return logger
