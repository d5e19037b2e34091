"""Units as people write them in headers, such as deg, mV and rad/s: what one is in another."""

import math
import re

from pegasus_jax.math.units import parted

# Units of the same thing: how many of the first each is.
FAMILIES: tuple[dict[str, float], ...] = (
    {"rad": 1, "deg": math.pi / 180, "degrees": math.pi / 180, "°": math.pi / 180, "rev": 2 * math.pi},
    {"s": 1, "sec": 1, "seconds": 1, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60, "h": 3600},
    {"m": 1, "cm": 1e-2, "mm": 1e-3, "km": 1e3},
    {"V": 1, "mV": 1e-3},
    {"A": 1, "mA": 1e-3},
    {"N": 1, "mN": 1e-3, "kN": 1e3},
    {"N m": 1, "mN m": 1e-3},
    {"rad/s": 1, "rpm": 2 * math.pi / 60},
)


def factor(given: str, wanted: str) -> float | None:
    """What makes numbers in one unit numbers in another; 1 where both are written alike, None where it is not known."""
    if (scale := _scale(given, wanted)) is not None:
        return scale
    (over, *under), (own, *below) = given.split("/"), wanted.split("/")
    if not under or len(under) != len(below):
        return None
    # Below a stroke it is the other way round: more of a smaller unit.
    parts = [_scale(over, own), *(_scale(other, one) for one, other in zip(under, below, strict=True))]
    return None if None in parts else math.prod(part for part in parts if part)


def said(name: str) -> str | None:
    """The unit in the square brackets of a name; None where there are none, or a place in an array, as in "q[0]"."""
    unit = parted(name)[1]
    return unit if unit and not unit.isdecimal() else None


def of_header(header: str, wanted: str) -> str | None:
    """The unit of a column, of "rate [deg/s]"; that in round brackets if it can be what is wanted. None: unsaid."""
    unit = said(header)
    found = re.fullmatch(r".*\(([^()]*)\)\s*", header)
    return found[1] if unit is None and found and factor(found[1], wanted) else unit


def _scale(given: str, wanted: str) -> float | None:
    one, other = _letters(given), _letters(wanted)
    if one == other:
        return 1.0
    for family in FAMILIES:
        sizes = {_letters(name): size for name, size in family.items()}
        if one in sizes and other in sizes:
            return sizes[one] / sizes[other]
    return None


def _letters(unit: str) -> str:
    return re.sub(r"[\s*·]", "", unit).casefold().replace("²", "^2")
