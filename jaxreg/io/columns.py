"""Which columns of a table are coordinates, by the names that programs and surveyors give them."""

import re
from collections.abc import Sequence

_UNIT = re.compile(
    r"\s*[\[(][^\d\])][^\])]*[\])]$|[\s_/](m|mm|cm|km|ft|in|metres?|meters?)$", re.IGNORECASE
)
_OF = re.compile(r"(points?|coords?|coordinates?|position|pos|vertex|utm|local|global)[\s:._\[-]*")
_AFTER = re.compile(r"[\s_.-]*(coordinate|coord|position|pos)s?$")
_NUMBERED = {"0": "x", "1": "y", "2": "z"}
_PLAN = {
    "x": {"e", "east", "easting", "eastings", "rechtswert", "rechts", "ostwert"},
    "y": {"n", "north", "northing", "northings", "hochwert", "hoch", "nordwert"},
}
_HEIGHTS = ("elevation", "elev", "height", "altitude", "alt", "hoehe", "höhe", "level", "rl", "h")
_HEIGHTS += ("up", "u")
_ANGLES = ({"lat", "latitude"}, {"lon", "lng", "long", "longitude"})
_NORMALS = re.compile(r"(?:n|normal_?|normals?[:_. ])([xyz012])", re.IGNORECASE)


def coordinates(names: Sequence[str]) -> tuple[int, int, int] | None:
    """Where x, y, z stand among the names of columns; None where they are not named.

    x, y, z in either case, with a unit ("X [m]") or a prefix ("Points:0", "coord_x"); or easting and
    northing; the third may be called elevation, height or H. x, y, z come before all others.
    """
    axes = [_axis(name) for name in names]
    plain = [_bare(name) for name in names]
    east = [next((a for a, words in _PLAN.items() if _last(n) in words), "") for n in plain]
    plan = next((p for p in (axes, east) if {"x", "y"} <= set(p)), None)
    if plan is None:
        return None
    height = _height(axes, plain)
    return None if height is None else (plan.index("x"), plan.index("y"), height)


def plane(names: Sequence[str]) -> tuple[int, int] | None:
    """Where x and y stand among two names, as `coordinates` knows them; None where they do not."""
    found = coordinates([*names, "z"])
    return None if found is None else found[:2]


def normals(names: Sequence[str]) -> tuple[int, int, int] | None:
    """Where the components of a normal stand: nx ny nz, normal_x, Normals:0; None without them."""
    found = [match[1].lower() if (match := _NORMALS.fullmatch(name)) else "" for name in names]
    found = [_NUMBERED.get(axis, axis) for axis in found]
    if not set("xyz") <= set(found):
        return None
    return found.index("x"), found.index("y"), found.index("z")


def geographic(names: Sequence[str]) -> bool:
    """Whether latitude and longitude are named: angles, and no lengths."""
    plain = {_bare(name) for name in names}
    return all(plain & words for words in _ANGLES)


def _height(axes: list[str], plain: list[str]) -> int | None:
    if "z" in axes:
        return axes.index("z")
    ends = [_last(name) for name in plain]
    return next((ends.index(word) for word in _HEIGHTS if word in ends), None)


def _bare(name: str) -> str:
    return _UNIT.sub("", name.strip().strip('"')).strip().lower()


def _last(name: str) -> str:
    """The last word: "grid easting" and "ellipsoidal_height" are an easting and a height."""
    return re.split(r"[\s_]+", name)[-1] if name else ""


def _axis(name: str) -> str:
    bare = _AFTER.sub("", _bare(name))
    stem = _OF.sub("", bare, count=1).rstrip("]") if _OF.match(bare) else bare
    if stem != bare and stem in _NUMBERED:
        return _NUMBERED[stem]
    return stem if stem in ("x", "y", "z") else ""
