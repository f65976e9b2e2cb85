"""The certificate of the stage ``optimize``: what is proved of every map, and of every surface at its poles."""

from __future__ import annotations

from typing import Any

from ssmpipe.contract import Context
from ssmpipe.core.correspondence.optimum import Optimum
from ssmpipe.core.spline.evaluate import Spline
from ssmpipe.core.spline.poles import is_pole, surface_topology, tangent_plane
from ssmpipe.core.spline.surface import BSplineSurface

POLE_DEVIATION_DEG = 1e-6  # of control points from one plane through the pole: rounding
_OPEN_RIMS = (
    "rims are free: proved as well that D stays in the domain and is one-to-one, by a positive diagonal of its derivative (disk; Gale "
    "and Nikaido 1965) or rims that are graphs over u and do not meet (tube, cone)"
)


def warn_of_poles(shapes: dict[str, Any], ctx: Context) -> None:
    """Name the shapes that have an edge at a pole, and those that fold there: each needs another remedy.

    Parameters
    ----------
    shapes : dict of dict
        The part ``shapes`` of a certificate.
    ctx : Context
        Is warned.
    """
    refuted = {i: [p for p in one.get("poles", ()) if p["status"] != "proved"] for i, one in shapes.items()}
    edges = [i for i, poles in refuted.items() if any(p["deviation_deg"] > POLE_DEVIATION_DEG for p in poles)]
    folds = [i for i, poles in refuted.items() if poles and i not in edges]
    if edges:
        ctx.warn(f"the tangent plane at a pole of {', '.join(edges)} is not proved unique; use fit.seam: smooth")
    if folds:
        ctx.warn(
            f"the surface of {', '.join(folds)} is not proved to run once around its pole, it may fold there; "
            "use fewer control points (fit.n_control)"
        )


def certificate_of(optimum: Optimum, ids: tuple[str, ...], splines: list[Spline]) -> dict[str, Any]:
    """Return the content of ``certificate.json``.

    Parameters
    ----------
    optimum : Optimum
    ids : tuple of str
        Of the shapes, in the order of the optimum.
    splines : list of Spline
        The fitted shapes, whose poles are looked at.
    """
    method = "smallest Bernstein coefficient of det dD/du over the domain, bisected until proved or refuted, rounding included"
    poles = {i: _poles(spline) for i, spline in zip(ids, splines, strict=True)}
    out: dict[str, Any] = {
        "quantity": "lower bound of det dD/du over the whole parameter domain",
        "method": method,
        **({"open_rims": _OPEN_RIMS} if optimum.window is not None else {}),
        "all_proved": all(c.verdict == "proved" for c in optimum.certificates),
        "shapes": {
            i: {
                "lower_bound": c.lower_bound,
                "smallest_value_seen": c.upper_bound_of_minimum,
                "status": c.verdict,
                "subdivisions": c.n_subdivisions,
                "method": method,
                **({"poles": poles[i]} if poles[i] else {}),
            }
            for i, c in zip(ids, optimum.certificates, strict=True)
        },
    }
    if any(poles.values()):
        out["pole_condition"] = (
            "the second row of control points lies in one plane through the pole (deviation_deg, at most 1e-6) and its curve turns "
            "around the pole in one sense (winding: smallest Bernstein coefficient of its turning speed, 1 for an even circle); so "
            "the fitted surface has one tangent plane there, and D, which keeps the edge of the square, does not change it"
        )
    return out


def _poles(spline: Spline) -> list[dict[str, Any]]:
    """Return the tangent-plane condition at each pole."""
    if not isinstance(spline, BSplineSurface) or surface_topology(spline) == "disk":
        return []
    found = []
    for end in (end for end in (0, -1) if is_pole(spline, end)):
        plane = tangent_plane(spline, end)
        found.append(
            {
                "v": 0 if end == 0 else 1,
                "normal": plane.normal.tolist(),
                "deviation_deg": plane.deviation_deg,
                "winding": plane.winding,
                "status": "proved" if plane.deviation_deg <= POLE_DEVIATION_DEG and plane.winding > 1e-9 else "refuted",
            }
        )
    return found
