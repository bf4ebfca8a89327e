"""Units by name, such as ``deg/s`` or ``ms``: their factors to SI units, and the units in labels of columns."""

from __future__ import annotations

import difflib
import math
import re
from typing import Any, NamedTuple

import numpy as np

from .errors import InputError


class Unit(NamedTuple):
    """A unit of measurement: a value in SI units is ``factor * value + offset``.

    Attributes
    ----------
    factor : float
    offset : float
        Zero except for temperatures in degrees Celsius or Fahrenheit.
    dimension : tuple of pairs of a base unit and an exponent
        Such as ``(("rad", 1), ("s", -1))``, sorted by base unit.
    """

    factor: float
    offset: float
    dimension: tuple[tuple[str, int], ...]

    def to_si(self, values: Any) -> np.ndarray:
        """Convert values in this unit to SI units."""
        return self.factor * np.asarray(values, dtype=np.float64) + self.offset


TIME = (("s", 1),)
"""Dimension of a time."""

SI_UNITS: dict[str, dict[str, int]] = {
    "s": {"s": 1},
    "m": {"m": 1},
    "g": {"kg": 1},
    "K": {"K": 1},
    "A": {"A": 1},
    "mol": {"mol": 1},
    "rad": {"rad": 1},
    "Hz": {"s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "T": {"kg": 1, "s": -2, "A": -1},
}
"""Units that take a prefix, with the exponents of their base units."""

PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 0.1, "k": 1e3, "M": 1e6, "G": 1e9}
"""Prefixes of SI units, with their factors."""

OTHER_UNITS: dict[str, tuple[float, dict[str, int]]] = {
    "deg": (math.pi / 180.0, {"rad": 1}),
    "mdeg": (math.pi / 180_000.0, {"rad": 1}),
    "arcmin": (math.pi / 10_800.0, {"rad": 1}),
    "arcsec": (math.pi / 648_000.0, {"rad": 1}),
    "rev": (2.0 * math.pi, {"rad": 1}),
    "rpm": (2.0 * math.pi / 60.0, {"rad": 1, "s": -1}),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "day": (86_400.0, {"s": 1}),
    "inch": (0.0254, {"m": 1}),
    "ft": (0.3048, {"m": 1}),
    "bar": (1e5, SI_UNITS["Pa"]),
    "atm": (101_325.0, SI_UNITS["Pa"]),
    "cal": (4.184, SI_UNITS["J"]),
    "eV": (1.602176634e-19, SI_UNITS["J"]),
    "g0": (9.80665, {"m": 1, "s": -2}),
    "1": (1.0, {}),
    "%": (0.01, {}),
}
"""Units without prefix: their factors to SI units, and the exponents of their base units. The gram is ``g``, the
standard gravity ``g0``."""

TEMPERATURE_OFFSETS = {"degC": (1.0, 273.15), "degF": (5.0 / 9.0, 273.15 - 160.0 / 9.0)}
"""Units of temperature with another zero than the kelvin: factor and offset."""

SYNONYMS = {
    **dict.fromkeys(("second", "seconds", "sec"), "s"),
    **dict.fromkeys(("millisecond", "milliseconds", "msec"), "ms"),
    **dict.fromkeys(("microsecond", "microseconds"), "us"),
    **dict.fromkeys(("minute", "minutes"), "min"),
    **dict.fromkeys(("hour", "hours", "hr"), "h"),
    **dict.fromkeys(("days", "d"), "day"),
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("revolution", "revolutions", "turn", "turns"), "rev"),
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("gram", "grams"), "g"),
    **dict.fromkeys(("kilogram", "kilograms"), "kg"),
    **dict.fromkeys(("kelvin", "kelvins"), "K"),
    **dict.fromkeys(("joule", "joules"), "J"),
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("watt", "watts"), "W"),
    **dict.fromkeys(("hertz",), "Hz"),
    **dict.fromkeys(("°C", "celsius", "Celsius", "degree_Celsius", "degrees_Celsius"), "degC"),
    **dict.fromkeys(("°F", "fahrenheit", "Fahrenheit"), "degF"),
    **dict.fromkeys(("in",), "inch"),
    **dict.fromkeys(("dps",), "deg/s"),
    **dict.fromkeys(("percent",), "%"),
}
"""Other names of units."""

AMBIGUOUS = {"C": "degC", "F": "degF", "M": "mol/m^3", "D": "day", "G": "g0"}
"""Names that several units share, with the unit that a table of measurements probably means."""

MIN_WORD_LENGTH = 3
"""Smallest length of a name whose capital letters do not matter: ``RPM`` is ``rpm``, but ``Mg`` is not ``mg``."""

FACTOR_PATTERN = re.compile(r"([^\d\s*/^.·-][^\s*/^.·\d-]*0?|1)(?:(?:\^|\*\*)?\(?([+-]?\d+)\)?)?")
"""One unit of a product, with an exponent: ``s``, ``s^2``, ``s**-2`` or ``s-2``."""


def parse_unit(name: str) -> Unit:
    """Parse the name of a unit, or of a product or quotient of powers, such as ``rad/s^2``, ``N m`` or ``m s-1``.

    Raises
    ------
    InputError
        If a unit is not known.
    """
    text = re.sub("[µμ]", "u", name.strip()).replace("²", "^2").replace("³", "^3")
    text = SYNONYMS.get(text, text)
    if text in TEMPERATURE_OFFSETS:
        return Unit(*TEMPERATURE_OFFSETS[text], (("K", 1),))
    factor, exponents = 1.0, dict[str, int]()
    for i, product_text in enumerate(text.split("/")):
        position, product_text = 0, re.sub(r"(?<!\*)\*(?!\*)|[·.]", " ", product_text).strip()
        if not product_text and text:
            raise InputError(f"unknown unit {name!r}. {_known_units_text(name)}")
        while position < len(product_text):
            match = FACTOR_PATTERN.match(product_text, position)
            if match is None or (unit := _find_unit_without_exponent(match[1])) is None:
                raise InputError(f"unknown unit {name!r}. {_known_units_text(match[1] if match else name)}")
            power = int(match[2] or 1) * (1 if i == 0 else -1)
            factor *= unit[0] ** power
            for base_unit, exponent in unit[1].items():
                exponents[base_unit] = exponents.get(base_unit, 0) + power * exponent
            position = match.end() + len(product_text[match.end() :]) - len(product_text[match.end() :].lstrip())
    return Unit(factor, 0.0, tuple(sorted((base, exponent) for base, exponent in exponents.items() if exponent)))


QUANTITY_PATTERN = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*)")
"""A number and its unit, such as ``0.5 deg/s``."""


def quantity_in_si(text: str) -> float:
    """Parse a text with a number and a unit, such as ``0.5 deg/s``, and return the number in SI units.

    It is a difference: 1 degC is 1 K.

    Raises
    ------
    InputError
        If it is not a number with a known unit.
    """
    match = QUANTITY_PATTERN.fullmatch(text)
    if match is None:
        raise InputError(f"{text!r} is not a number with a unit, such as '0.5 deg/s'")
    return float(match[1]) * parse_unit(match[2]).factor


def _find_unit_without_exponent(name: str) -> tuple[float, dict[str, int]] | None:
    """Return the SI factor and the dimension exponents of a unit name without exponent; None if it is unknown."""
    name = SYNONYMS.get(name, name)
    if len(name) >= MIN_WORD_LENGTH and name.lower() != name:  # RPM and Kelvin
        lower_case_unit = _find_unit_without_exponent(name.lower())
        if name not in OTHER_UNITS and lower_case_unit is not None and _find_prefixed_unit(name) is None:
            return lower_case_unit
    if name in OTHER_UNITS:
        return OTHER_UNITS[name]
    if "/" in name:
        unit = parse_unit(name)
        return unit.factor, dict(unit.dimension)
    return _find_prefixed_unit(name)


def _find_prefixed_unit(name: str) -> tuple[float, dict[str, int]] | None:
    """Return the SI factor and the dimension exponents of a unit name with an SI prefix; None if it is unknown."""
    for prefix, factor in PREFIXES.items():
        if name.startswith(prefix) and (exponents := SI_UNITS.get(name[len(prefix) :])) is not None:
            return factor * (1e-3 if name.endswith("g") else 1.0), exponents
    return None


def _known_units_text(name: str) -> str:
    """Return a sentence for error messages that names the known unit nearest to an unknown one."""
    names = [*SI_UNITS, *OTHER_UNITS, *TEMPERATURE_OFFSETS, *SYNONYMS, *(p + u for p in PREFIXES for u in SI_UNITS)]
    nearest = [AMBIGUOUS[name]] if name in AMBIGUOUS else difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    hint = f"Did you mean {nearest[0]!r}? " if nearest else ""
    return (
        f"{hint}Known are s, ms, min, h, rad, deg, rev, rpm, m, kg, K, degC, N, J, W and others with SI prefixes, "
        "their products and quotients, such as 'deg/s'"
    )


LABEL_PATTERN = re.compile(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*", re.DOTALL)
"""A label of a column that ends with a unit in brackets or parentheses."""


def split_label(label: str) -> tuple[str, str]:
    """Split the label of a column into name and unit, "" if it has no unit: ``omega_x [deg/s]`` and ``omega_x
    (deg/s)``."""
    match = LABEL_PATTERN.fullmatch(label)
    unit = "" if match is None else (match[2] if match[2] is not None else match[3]).strip()
    if match is None or re.fullmatch(r"[\d, ]*", unit):  # x[0] is a component
        return label.strip(), ""
    return match[1].strip(), unit
