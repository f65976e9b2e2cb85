"""Chains that run but hardly give what is meant: one remark each, with the remedy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ssmpipe.runner.plan import Plan, PlannedStep

CUTTING = ("trim", "fill-holes")
"""Stages after which a shape is another piece of surface than before."""
_PLACES = {"cone": ("apex", "seam"), "closed": ("apex", "antapex", "seam")}
_CORNERS = tuple(f"corner_{k}" for k in range(1, 5))


def advise(plan: Plan, sides: Iterable[str | None], roles: Iterable[str]) -> list[tuple[str, str]]:
    """Return (step id, remark) for what the chain leaves out of account.

    Parameters
    ----------
    plan : Plan
    sides : iterable of {"L", "R", None}
        Of the shapes.
    roles : iterable of str
        That landmarks have.
    """
    return [*_uncut_reference(plan, set(roles)), *_sides_as_they_are(plan.steps, set(sides))]


def _uncut_reference(plan: Plan, roles: set[str]) -> list[tuple[str, str]]:
    found = []
    for step in plan.steps:
        maker = step.inputs.get("reference")
        if step.stage != "parameterize" or maker is None or not maker.prepared:
            continue
        aligned = plan.step(maker.step)
        topology = str(step.options.get("topology"))
        if step.options.get("places") != "reference" or "reference" in aligned.files or topology == "tube":
            continue
        if roles.issuperset(_PLACES.get(topology, _CORNERS)):
            continue
        later = [s.id for s in plan.steps[aligned.number : step.number - 1] if s.stage in CUTTING]
        # a tube, told by the seam, has neither poles nor corners
        if later and step.inputs.get("seam") is None:
            them = "it" if len(later) == 1 else "them"
            text = (
                f"places: reference takes poles and corners from the reference as '{aligned.id}' makes it, before "
                f"{' and '.join(repr(s) for s in later)}; put {them} before '{aligned.id}', or set places: own"
            )
            found.append((step.id, text))
    return found


def _sides_as_they_are(steps: Sequence[PlannedStep], sides: set[str | None]) -> list[tuple[str, str]]:
    if not {"L", "R"} <= sides or any(s.options.get("chirality") == "best-fit" for s in steps if s.stage == "align"):
        return []
    orient = [s for s in steps if s.stage == "orient"]
    if not orient or any(s.options.get("mirror") != "none" for s in orient):
        return []
    text = "mirror: none, but the cohort has left and right shapes; set mirror: left (or right), that they become comparable"
    return [(orient[0].id, text)]
