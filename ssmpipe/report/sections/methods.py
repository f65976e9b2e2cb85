"""A methods paragraph of what was run, with its references."""

from __future__ import annotations

from ssmpipe.report.bibliography import SOFTWARE, numbered, reference
from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section


def render(data: ReportData) -> Section:
    """Return the sentences of the stages in order, each with its numbers, and the bibliography."""
    steps = [step for step in data.record.get("methods") or () if step.get("sentence")]
    numbers = numbered([key for step in steps for key in step.get("cites") or ()] + list(SOFTWARE))
    sentences = [
        (str(step["sentence"]).strip().rstrip("."), [numbers[key] for key in step.get("cites") or ()]) for step in steps
    ]
    html = fill(
        "methods.html.j2",
        sentences=sentences,
        software=[numbers[key] for key in SOFTWARE],
        references=[(n, reference(key)) for key, n in numbers.items()],
        version=data.record.get("ssmpipe_version", ""),
        versions=data.record.get("versions") or {},
    )
    return Section("methods", "Methods", html)
