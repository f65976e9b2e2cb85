"""Write a commented config for a folder of scans."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from ssmpipe.core.errors import ConfigError, SsmpipeError
from ssmpipe.runner.config_stages import variant_stages
from ssmpipe.runner.disk import write_atomically
from ssmpipe.runner.presets import Preset, find_preset
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import IMAGE_SUFFIXES, KINDS, OUTLINE_SUFFIXES, SIDES, by_id, scan_files
from ssmpipe.runner.suggest import count

_TABLES = ("cohort.csv", "landmarks.csv")
_LEVELS, _FOLDERS = 3, 200  # that are looked into when a folder holds no scans itself


def write_config(
    anatomy: str, scans_dir: Path, target: Path, registry: Registry, *, overwrite: bool = False
) -> list[str]:
    """Write the config and return lines that say what was found and what to do next.

    Raises
    ------
    ConfigError
        If the anatomy is unknown, the folder holds no scans, or the file exists.
    """
    from ssmpipe.io.meshes import MESH_SUFFIXES

    preset = find_preset(anatomy)
    suffixes_read = (*OUTLINE_SUFFIXES, *IMAGE_SUFFIXES) if preset.topology == "curve" else MESH_SUFFIXES
    if target.exists() and not overwrite:
        raise ConfigError(f"{target} exists already", "choose another name, or --overwrite")
    if not scans_dir.is_dir():
        raise ConfigError(f"there is no folder {scans_dir}")
    found = _scans(scans_dir, suffixes_read)
    if not found:
        inner = _inner(scans_dir, suffixes_read)
        where = "".join(f"; {folder} holds {count(n, 'scan')}" for folder, n in inner[:3])
        command = f"ssmpipe init {anatomy} {shlex.quote(str((inner or [(scans_dir, 0)])[0][0]))} -o {shlex.quote(str(target))}"
        remedy = command if inner else f"give the folder that holds files of type {' '.join(suffixes_read)}"
        raise ConfigError(f"no scans in the folder {scans_dir}{where}", remedy)
    files = by_id(found)
    suffixes = Counter(path.suffix for path in files.values())
    scans = scans_dir / f"*{suffixes.most_common(1)[0][0]}" if len(suffixes) == 1 else scans_dir
    cohort = _beside(scans_dir, ("cohort.csv",))
    landmarks = _beside(scans_dir, ("landmarks.json", "landmarks.csv"))
    base = target.resolve().parent
    named = [None if path is None else _relative(path, base) for path in (cohort, landmarks)]
    mirror = _has_both_sides(cohort, files) and not preset.needs_side
    changes = {"orient": {"mirror": "left"}} if mirror and "orient" in dict(preset.stages) else {}
    text = _text(preset, target.stem, _relative(scans, base), *named) + _stages(preset, registry, changes)
    write_atomically(target, text)
    lines = [f"{len(files)} scans in {scans_dir}; config written to {target}"]
    if cohort is None and preset.needs_side:
        lines.append("no cohort.csv beside the scans: left and right cannot be told apart until input.cohort is given")
    if changes:
        lines.append(
            f"{cohort} has left and right shapes: orient.mirror is set to left, so that they become comparable"
        )
    if landmarks is None:
        lines.append("no landmarks.json beside the scans: geometry decides where a step could use a landmark")
    return [*lines, f"next: ssmpipe check {target}, then ssmpipe run {target}"]


def _scans(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Return the scans of a folder, tables left out."""
    if not any(p.is_file() and p.suffix.lower() in suffixes for p in folder.iterdir()):
        return []
    return [path for path in scan_files([folder], suffixes) if path.name not in _TABLES]


def _inner(folder: Path, suffixes: Sequence[str]) -> list[tuple[Path, int]]:
    """Return the folders inside, at most three levels down, that hold scans, and how many; most first.

    What cannot be read is passed over.
    """
    found, level = [], [folder]
    for _ in range(_LEVELS):
        inside: list[Path] = []
        for parent in level:
            with suppress(OSError):
                inside += [p for p in sorted(parent.iterdir()) if p.is_dir() and not p.name.startswith(".")]
        level = inside[:_FOLDERS]
        for p in level:
            with suppress(OSError, ConfigError):
                found += [(p, n)] if (n := len(_scans(p, suffixes))) else []
    return sorted(found, key=lambda f: -f[1])


def _beside(scans_dir: Path, names: tuple[str, ...]) -> Path | None:
    for folder in (scans_dir, scans_dir.resolve().parent):
        for name in names:
            if (folder / name).is_file():
                return folder / name
    return None


def _has_both_sides(cohort: Path | None, ids: Iterable[str]) -> bool:
    """Say whether a cohort table calls some of these shapes left and some right; what is wrong with it is told by `check`."""
    from ssmpipe.io.tables import read_cohort

    if cohort is None:
        return False
    try:
        table = read_cohort(cohort)
    except SsmpipeError:
        return False
    return {"L", "R"} <= {SIDES.get(table.get(i, {}).get("side", "").strip().lower()) for i in ids}


def _relative(path: Path, base: Path) -> str:
    return Path(os.path.relpath(path.parent.resolve() / path.name, base)).as_posix()


def _quoted(text: str) -> str:
    return text if re.fullmatch(r"[\w./-][\w./* -]*", text) else json.dumps(text, ensure_ascii=False)


def _text(preset: Preset, name: str, scans: str, cohort: str | None, landmarks: str | None) -> str:
    def optional(key: str, value: str | None, example: str, comment: str) -> str:
        line = f"{key}: {_quoted(value)}" if value else f"# {key}: {example}"
        return f"  {line:<44} # {comment}\n"

    planar = preset.topology == "curve"
    units, role = ("none", "start") if planar else ("mm", "trim")
    point = "[x, y]" if planar else "[x, y, z]"
    size = (
        f"; the bounding-box diagonal must be {preset.diagonal_mm[0]:g}-{preset.diagonal_mm[1]:g} mm"
        if preset.diagonal_mm
        else ""
    )
    return (
        f"# {preset.summary}. Paths are relative to this file; every key but name, input and output has a default.\n"
        f"name: {_quoted(name)}\n"
        "input:\n"
        f"  {'scans: ' + _quoted(scans):<44} # folder, glob or list; id = file name without suffix\n"
        + optional("cohort", cohort, "cohort.csv", "table: id, side (L/R), group, subject, age, ...")
        + optional("landmarks", landmarks, "landmarks.json", f"{{id: {{name: {point}}}}}, scan coordinates")
        + f"  {f'units: {units}':<44} # mm, cm, m, um or none{size}\n"
        + f"  {'# roles: {' + role + ': name of a landmark}':<44} # which landmark serves which step\n"
        f"output: {_quoted('out/' + name)}\n"
        f"anatomy: {preset.name}\n"
        f"{'seed: 0':<46} # of everything random\n"
        f"{'min_shapes: 3':<46} # group stages need at least this many shapes\n"
    )


def _stages(preset: Preset, registry: Registry, changes: Mapping[str, Mapping[str, str]]) -> str:
    """Return the chain as comments; only what ``changes`` the preset's options, by stage, counts."""
    lines = [
        "",
        "# The chain of this anatomy with its defaults. Remove the # of a stage and of the options to change.",
        "stages:",
    ]
    known = registry.names()
    names = [name for name, _ in preset.stages if name in known]
    chain = variant_stages(names, KINDS["outline" if preset.topology == "curve" else "mesh"], registry)
    for name, options in preset.stages:
        changed = changes.get(name, {})
        lines.append(
            f"{'' if changed else '#'}  - {name}:"
            + (f"  # {registry.summary(name)}" if name in known else "  # not installed")
        )
        if name not in known:
            continue
        for key, field in chain[name].config.model_fields.items():
            default = changed.get(key, options.get(key, field.get_default(call_default_factory=True)))
            value = json.dumps(
                list(default) if isinstance(default, tuple) else default, default=str, ensure_ascii=False
            )
            lines.append(
                f"{'' if key in changed else '#'}      {f'{key}: {value}':<36} # {field.description or ''}".rstrip()
            )
    return "\n".join(lines) + "\n"
