"""Write docs/options.md from the schema: every key of the config, every option of every stage, every preset.

python docs/make_options.py [--check]      --check: exit with 1 when the page is not up to date
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.schema import config_schema

PAGE = Path(__file__).resolve().parent / "options.md"
HEAD = """# Options

Every key of a config file, written by `python docs/make_options.py` from the schema that `ssmpipe schema` prints. Units stand in
brackets, `[-]` is a plain number. On the command line: `--set seed=1`, `--set stages.optimize.n_coefficients=[8,8]`; for one stage
on one file: `ssmpipe decimate --n-faces 5000 in.ply out.ply`.

"""


def kind(option: dict[str, Any], schema: dict[str, Any]) -> str:
    """Return the type of an option in words."""
    if "$ref" in option:
        node: Any = schema
        for part in option["$ref"].removeprefix("#/").split("/"):
            node = node[part]
        return kind(node, schema)
    if "anyOf" in option:
        return " or ".join(dict.fromkeys(kind(one, schema) for one in option["anyOf"]))
    if "enum" in option or "const" in option:
        return ", ".join(f"`{value}`" for value in option.get("enum", [option.get("const")]))
    if option.get("type") == "array":
        if "prefixItems" in option:
            return f"list of {len(option['prefixItems'])} {kind(option['prefixItems'][0], schema)}s"
        return f"list of {kind(option.get('items', {}), schema)}s"
    words = {"integer": "whole number", "number": "number", "string": "text", "boolean": "yes or no", "null": "`null`"}
    text = words.get(option.get("type", ""), "mapping")
    limits = [
        f"{sign} {option[key]:g}"
        for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in option
    ]
    return " ".join([text, *limits])


def table(properties: dict[str, Any], schema: dict[str, Any], skip: tuple[str, ...] = ()) -> list[str]:
    """Return a table of options."""
    rows = ["| option | type | default | meaning |", "|---|---|---|---|"]
    for name, option in properties.items():
        if name in skip:
            continue
        default = f"`{json.dumps(option['default'], ensure_ascii=False)}`" if "default" in option else ""
        first = option if "description" in option or "anyOf" not in option else option["anyOf"][0]
        cells = (f"`{name}`", kind(option, schema), default, option.get("description", first.get("description", "")))
        rows.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    return [*rows, ""]


def page() -> str:
    """Return the text of the page."""
    registry = Registry.default()
    schema = config_schema(registry)
    text = [HEAD, "## The config", "", *table(schema["properties"], schema, ("input", "limits", "stages"))]
    for section, name in (("input", "InputConfig"), ("limits", "LimitsConfig")):
        text += [f"### `{section}`", "", *table(schema["$defs"][name]["properties"], schema)]
    text += ["## Presets", "", "| `anatomy` | for | stages, with what differs from their defaults |", "|---|---|---|"]
    for preset in PRESETS.values():
        chain = []
        for name, options in preset.stages:
            given = ", ".join(f"{key}: {json.dumps(value)}" for key, value in options.items())
            chain.append(f"`{name}` ({given})" if given else f"`{name}`")
        text.append(f"| `{preset.name}` | {preset.summary} | {', '.join(chain)} |")
    text += ["", "## Stages", "", "Every stage also takes `id`, `skip`, `after` and `from` (see `ssmpipe schema`).", ""]
    for name in registry.names():
        options = schema["$defs"][name]
        text += [f"### `{name}`", "", options["description"], ""]
        text += table(options["properties"], schema, ("id", "skip", "after", "from"))
    return "\n".join(text).rstrip() + "\n"


def main() -> int:
    wanted = page()
    if "--check" in sys.argv[1:]:
        current = PAGE.read_text(encoding="utf-8") if PAGE.is_file() else ""
        if current != wanted:
            print("docs/options.md is not up to date; run: python docs/make_options.py")
        return int(current != wanted)
    PAGE.write_text(wanted, encoding="utf-8", newline="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
