"""Texts of options as values, with what was expected where they are none."""

from __future__ import annotations

import argparse


def minimum_inliers(text: str) -> int | str:
    """Reads "chance" or a number of closures."""
    if text == "chance":
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}, expected chance or a number of closures"
        ) from None


def at_least_one(text: str) -> int:
    """Reads an integer of at least 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} given, expected at least 1")
    return number


def seconds(text: str) -> float:
    """Reads seconds above 0, perhaps infinitely many."""
    found = float(text)
    if not found > 0.0:
        raise argparse.ArgumentTypeError(f"{text} given, expected seconds above 0")
    return found


def positive(text: str) -> float:
    """Reads a finite number above 0."""
    number = float(text)
    if not 0.0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} given, expected a number above 0")
    return number
