"""`pcm-jax explain`: why a closure was accepted or rejected, from the report alone."""

from __future__ import annotations

import json
from typing import Any

from pcm_jax.cli._reports import not_ours, read_report
from pcm_jax.errors import FileFormatError

USABLE = 1.0 - 1e-9  # confidence above which a gate lets nearly everything in
UNITS = {"x": "m", "y": "m", "z": "m", "theta": "rad", "rx": "rad", "ry": "rad", "rz": "rad"}


def run(options: Any) -> None:
    """Prints what a report says of one closure."""
    report = read_report(options.report)
    closures = report["closures"]
    if not 0 <= options.closure < len(closures):
        last = len(closures) - 1
        expected = f"expected 0 … {last}" if closures else "but the report has no closure"
        raise FileFormatError(
            options.report, None, f"closure {options.closure} asked for, {expected}"
        )
    row = closures[options.closure]
    try:
        told = json.dumps(row, indent=2) if options.json else explained(report, row)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError):
        raise not_ours(options.report, f"closures[{options.closure}] with other content") from None
    print(told)


def explained(report: dict[str, Any], row: dict[str, Any]) -> str:
    """A report's account of one closure: its sentence, then the numbers."""
    known = [(name, value) for name, value in _rows(report, row) if value is not None]
    width = max(len(name) for name, _ in known)
    lines = [f"  {name.ljust(width)}  {value}" for name, value in known]
    return "\n".join([row["why"], "", *lines])


def _rows(report: dict[str, Any], row: dict[str, Any]) -> Any:
    yield "from", f"{row['a']} to {row['b']}"
    yield "read from", row.get("source") or None
    yield "standing", row.get("standing")
    if row.get("agrees_with") is not None:
        yield "agrees with", f"{row['agrees_with']} of {row['of']} {row['among']} ones"
        yield "of all", f"{row['agreeing']} between these robots"
    if row.get("enters_at") is not None:
        asked = report.get("confidence")
        gate = "" if asked is None else f" (confidence asked for: {asked:g})"
        enters = "no usable confidence" if row["enters_at"] > USABLE else f"{row['enters_at']:.9g}"
        yield "enters at", f"{enters}{gate}"
    worst = row.get("worst_conflict")
    if worst is not None:
        other = report["closures"][worst["with"]]
        yield "worst conflict", f"closure {worst['with']} ({other['a']} to {other['b']})"
        for name, unit in (("translation", "m"), ("rotation", "°")):
            yield f"  {name}", _with_sigma(worst, name, unit)
        yield "  squared distance", _short(worst["squared"])
        yield "  uncertainty", _shares(row, worst["shares"])
    fit = row.get("fit")
    if fit is None:
        return
    yield "in the merged map", f"chi-squared {_short(fit['chi2'])}, {len(fit['residual'])} expected"
    for name, value in fit["residual"].items():
        yield f"  {name}", f"{_short(value)} {UNITS[name]}"


def _with_sigma(worst: dict[str, Any], name: str, unit: str) -> str:
    return f"{_short(worst[name])} {unit}, sigma {_short(worst[f'{name}_sigma'])} {unit}"


def _shares(row: dict[str, Any], shares: dict[str, float | None]) -> str | None:
    parts = (
        ("a", f"the map of {row['a']}"),
        ("b", f"the map of {row['b']}"),
        ("closures", "both closures"),
    )
    if any(shares[key] is None for key, _ in parts):
        return None
    return ", ".join(f"{100.0 * (shares[key] or 0.0):.0f} % in {name}" for key, name in parts)


def _short(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"
