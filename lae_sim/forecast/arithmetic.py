"""Arithmetic that is the same to the last bit for one sequence and for many.

Only what IEEE 754 defines exactly: with ``+ - * /`` and :func:`abs` these are enough. A float takes
a tenth of the time of an array of one.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

Number = Any
"""A float, or float64 [n]."""


def root(value: Number) -> Number:
    """The square root."""
    return sqrt(value) if type(value) is float else np.sqrt(value)


def nearest(value: Number) -> Number:
    """The nearest whole number, half to even."""
    return float(round(value)) if type(value) is float else np.rint(value)


def at_least(value: Number, least: float) -> Number:
    """The greater of two."""
    if type(value) is float:
        return value if value > least else least
    return np.maximum(value, least)


def within(value: Number, most: float) -> Number:
    """The value, or the nearest that is not further from 0 than ``most``."""
    if type(value) is float:
        return most if value > most else -most if value < -most else value
    return np.clip(value, -most, most)
