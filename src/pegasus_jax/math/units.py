"""Names with units, such as "trolley [m]"."""

import re


def parted(name: str) -> tuple[str, str | None]:
    """A name and its unit, which is None where it is not known: "theta [rad]" is theta in rad."""
    found = re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", name)
    return (found[1], found[2]) if found else (name, None)


def rate_of(name: str) -> str:
    """What the rate of change of something is called: of "trolley [m]" it is "rate of trolley [m/s]"."""
    plain, unit = parted(name)
    return f"rate of {plain}" + (f" [{unit or '1'}/s]" if unit is not None else "")
