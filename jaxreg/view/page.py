"""One interactive HTML file that shows clouds, and a registration before and after; works offline."""

import base64
import html
import json
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxreg.scans import summary
from jaxreg.scans.result import Alternative, ScanRegistration
from jaxreg.types import RigidTransform

_SHOWN = 20_000
"""Largest number of points of a cloud on the page: 120 kB, and a frame in a few milliseconds."""
_COLOURS = ("source", "reference", "aligned", "fourth", "fifth")


def write_registration_page(
    path: str | Path,
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    result: ScanRegistration,
    *,
    names: tuple[str, str] = ("source", "reference"),
) -> None:
    """Write an HTML page: both clouds, a before/after switch, confidence colours, numbers, verdict.

    Where other poses may be right, one can step through them. A source at another size is shown at
    that of the reference from the start. Points that are not finite are left out. Large clouds are
    thinned evenly for display.
    """
    source = source * result.scale
    rows = shown_rows(source)
    origin = middle(reference)
    shift = brought_near(source[rows], reference[shown_rows(reference)])
    clouds = [
        packed_cloud(names[0], source[rows] + shift, origin, len(source), moves=True)
        | {"confidence": _packed(np.round(255 * result.confidence[rows]).astype(np.uint8))},
        packed_cloud(names[1], _shown(reference), origin, len(reference), colour="reference"),
    ]
    content = {
        "clouds": clouds,
        "motions": _motions(result, source[rows], origin, shift),
        "figures": [[name, value] for name, value in summary.figures(result).items()],
        "verdict": {"text": summary.verdict_line(result), "good": result.success},
    }
    write_content(path, f"{names[0]} on {names[1]}", content)


def write_page(path: str | Path, clouds: Mapping[str, Float[np.ndarray, "n 3"]]) -> None:
    """Write an HTML page with clouds as they are, all in one frame."""
    origin = middle(np.concatenate([_shown(points) for points in clouds.values()]))
    shown = [
        packed_cloud(name, _shown(points), origin, len(points), colour=_COLOURS[i % len(_COLOURS)])
        for i, (name, points) in enumerate(clouds.items())
    ]
    sizes = [
        [name, " x ".join(f"{side:.4g}" for side in np.ptp(points, axis=0))]
        for name, points in clouds.items()
    ]
    write_content(path, ", ".join(clouds), {"clouds": shown, "motions": [], "figures": sizes})


def draw_registration(
    path: str | Path,
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    result: ScanRegistration,
) -> None:
    """The same as a picture: before and after from two sides, and the confidence; see `plot_pair`.

    As on the page, large clouds are thinned, and a source that is far away is brought near before
    the registration.
    """
    from jaxreg.view.pictures import plot_pair  # matplotlib, which the page does not need

    source = source * result.scale
    rows = shown_rows(source)
    moving, fixed = source[rows], _shown(reference)
    shift = brought_near(moving, fixed)
    plot_pair(
        moving + shift,
        fixed,
        RigidTransform(result.rotation, result.translation - result.rotation @ shift),
        path,
        confidence=result.confidence[rows],
        title="\n".join(_headline(result, moving, shortened=bool(shift.any()))),
    )


def _headline(result: ScanRegistration, source: np.ndarray, *, shortened: bool) -> list[str]:
    centre = source.mean(axis=0)
    way = np.linalg.norm(result.rotation @ centre + result.translation - centre)
    angle = math.degrees(summary.axis_angle(result.rotation)[1])
    motion = f"turned by {angle:.1f} deg, centroid moved by {way:.3g}"
    note = "; before: the source is shown nearer than it is" if shortened else ""
    return [summary.verdict_line(result), motion + note]


def write_content(path: str | Path, title: str, content: dict[str, Any]) -> None:
    """Write the page of a content: `clouds`, `motion`, `figures`, and what else the viewer knows."""
    template = (resources.files("jaxreg.view") / "viewer.html").read_text("utf-8")
    title = encodable(title)
    # "</script" would end the element that holds the data, "<!--" could swallow its end.
    data = json.dumps(content).replace("<", "\\u003c")
    page = template.replace("{{title}}", html.escape(title)).replace("{{data}}", data)
    Path(path).write_text(page, encoding="utf-8")


def encodable(name: str) -> str:
    """A name as it can be written: bytes of a file's name that are not UTF-8 become question marks."""
    return name.encode("utf-8", "replace").decode("utf-8")


def packed_cloud(
    name: str,
    points: np.ndarray,
    origin: np.ndarray,
    count: int,
    *,
    colour: str = "source",
    moves: bool = False,
) -> dict[str, Any]:
    """Points relative to `origin` as 16-bit steps about their own middle."""
    relative = points - origin
    centre = (relative.min(axis=0) + relative.max(axis=0)) / 2
    step = max(float(np.abs(relative - centre).max()) / 32767, 1e-30)
    steps = np.round((relative - centre) / step).astype("<i2")
    place = {"points": _packed(steps), "centre": centre.tolist(), "step": step}
    return {"name": name, "colour": colour, "moves": moves, "count": count} | place


def brought_near(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "3"]:
    """How to shift the source for a "before" picture that shows both clouds.

    Zero unless the gap between them is wider than the clouds; then they are moved until they touch.
    All points must be finite.
    """
    centres = source.mean(axis=0), reference.mean(axis=0)
    radii = [
        np.linalg.norm(points - centre, axis=1).max()
        for points, centre in zip((source, reference), centres, strict=True)
    ]
    way = centres[0] - centres[1]
    distance, near = np.linalg.norm(way), sum(radii)
    return np.zeros(3) if distance <= 1.5 * near else way * (near / distance - 1)


def _motions(
    result: ScanRegistration, source: np.ndarray, origin: np.ndarray, shift: np.ndarray
) -> list[dict[str, Any]]:
    """The pose found, then its alternatives, each with its probability."""
    poses = [Alternative(result.transform, result.probability), *result.alternatives]
    return [
        {"probability": f"{pose.probability:.2f}"} | _motion(pose.transform, source, origin, shift)
        for pose in poses
    ]


def _motion(
    pose: RigidTransform, source: np.ndarray, origin: np.ndarray, shift: np.ndarray
) -> dict[str, Any]:
    """The motion as a turn about the source's centroid and the path of that centroid.

    The page shows the source shifted before the motion, and ends where the motion ends.
    """
    axis, angle = summary.axis_angle(pose.rotation)
    centre = source.mean(axis=0)
    before, after = centre + shift, pose.rotation @ centre + pose.translation
    ways = {"before": (before - origin).tolist(), "after": (after - origin).tolist()}
    return {"axis": axis.tolist(), "angle": angle, "shortened": bool(shift.any())} | ways


def middle(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """The middle of the box of finite points.

    Coordinates are shown relative to this: UTM offsets do not fit JavaScript's float32 arrays.
    """
    finite = points[np.isfinite(points).all(axis=1)]
    return (finite.min(axis=0) + finite.max(axis=0)) / 2


def _shown(points: np.ndarray) -> np.ndarray:
    return points[shown_rows(points)]


def shown_rows(points: Float[np.ndarray, "n 3"], *, most: int = _SHOWN) -> Int[np.ndarray, "k"]:
    """The finite rows, or an even share of them if a picture needs no more."""
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(rows) <= most:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, most, replace=False))


def _packed(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
