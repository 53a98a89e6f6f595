"""Pictures: a pair before and after registration, and the curves of a training run.

Figures are made without pyplot, so drawing needs no display and leaves no global state.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxreg._extras import extra
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.io.log import read_metrics
from jaxreg.types import RigidTransform

with extra("view", "a picture"):
    from matplotlib import colormaps
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

SOURCE, REFERENCE, ALIGNED = "#2a78d0", "#f0a818", "#1f9d55"
"""Blue, yellow and green, as in the paper."""

_VIEWS_DEG = ((20.0, -60.0), (20.0, 30.0))
"""Elevation and azimuth of the two views; z is up."""
_VALIDATION = {
    "val_mie_r_deg": "mean angle, MIE(R)",
    "val_mae_r_deg": "Euler angles, MAE(R)",
    "val_median_rre_deg": "median angle",
}
_CURVE_POINTS = 400
_MOST_LABELS = 20


def plot_pair(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    transform: RigidTransform,
    path: str | Path,
    *,
    truth: RigidTransform | None = None,
    confidence: Float[np.ndarray, "n"] | None = None,
    title: str = "",
) -> None:
    """Draw a pair before and after registration, from two sides (PNG, PDF or SVG, by the suffix).

    Source blue, reference yellow, aligned source green; far points are paler. All panels have one
    scale, and the reference stays in place. With `truth` the title gives the errors, without it the
    motion, unless `title` is given. With `confidence` a third column shows the aligned source
    coloured by it.
    """
    source, reference = np.asarray(source, np.float64), np.asarray(reference, np.float64)
    rotation, translation = (np.asarray(x, np.float64) for x in transform)
    aligned = source @ rotation.T + translation
    confident = None if confidence is None else colormaps["viridis"](np.asarray(confidence))[:, :3]
    panels = {
        "before": [(reference, to_rgb(REFERENCE)), (source, to_rgb(SOURCE))],
        "after": [(reference, to_rgb(REFERENCE)), (aligned, to_rgb(ALIGNED))],
    } | ({} if confident is None else {"inlier confidence": [(aligned, confident)]})
    everything = np.concatenate([source, reference, aligned])
    figure = Figure(figsize=(4 * len(panels), 8.4), layout="constrained")
    grid = figure.subplots(len(_VIEWS_DEG), len(panels))
    for column, (name, clouds) in enumerate(panels.items()):
        grid[0, column].set_title(name)
        for axes, view in zip(grid[:, column], _VIEWS_DEG, strict=True):
            draw_clouds(axes, clouds, view, project(everything, view))
    if confident is not None:
        figure.colorbar(ScalarMappable(cmap="viridis"), ax=grid[:, -1], shrink=0.4)
    described = "" if title and truth is None else _describe(transform, truth)
    figure.suptitle("\n".join(filter(None, [title, described])), fontsize=12)
    named = {"source": SOURCE, "reference": REFERENCE, "aligned source": ALIGNED}
    dots = [Line2D([], [], marker="o", ls="", color=c, label=name) for name, c in named.items()]
    figure.legend(handles=dots, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=150, facecolor="white")


def plot_clouds(
    clouds: list[Float[np.ndarray, "_ 3"]],
    colors: list[tuple[float, float, float]],
    path: str | Path,
    *,
    title: str = "",
    labels: list[str] | None = None,
) -> None:
    """Draw clouds in one frame from two sides, each in its colour (PNG, PDF or SVG, by the suffix).

    Up to 20 `labels` are listed below.
    """
    figure = Figure(figsize=(12, 6.6), layout="constrained")
    panels = figure.subplots(1, len(_VIEWS_DEG))
    everything = np.concatenate([*clouds, *([] if clouds else [np.zeros((1, 3))])])
    shades = np.repeat(np.array(colors).reshape(-1, 3), [len(cloud) for cloud in clouds], axis=0)
    shades = shades if clouds else np.zeros((1, 3))
    for axes, view in zip(panels, _VIEWS_DEG, strict=True):
        draw_clouds(axes, [(everything, shades)], view, project(everything, view))
    figure.suptitle(title, fontsize=12)
    if labels and len(labels) <= _MOST_LABELS:
        dots = [
            Line2D([], [], marker="o", ls="", color=color, label=label)
            for color, label in zip(colors, labels, strict=True)
        ]
        figure.legend(handles=dots, loc="outside lower center", ncols=5, frameon=False)
    figure.savefig(path, dpi=150, facecolor="white")


def project(points: np.ndarray, view: tuple[float, float]) -> np.ndarray:
    """Coordinates to the right, upwards and towards the eye, in an orthographic view."""
    elevation, azimuth = np.radians(view)
    (se, ce), (sa, ca) = (np.sin(elevation), np.cos(elevation)), (np.sin(azimuth), np.cos(azimuth))
    return points @ np.array([[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]]).T


def draw_clouds(axes: Axes, clouds: list, view: tuple[float, float], limits: np.ndarray) -> None:
    """Scatter clouds with their colours, far points first; `limits` are projected points."""
    low, high = limits.min(axis=0), limits.max(axis=0)
    extent = np.maximum(high - low, np.finfo(float).tiny)
    points = project(np.concatenate([cloud for cloud, _ in clouds]), view)
    colors = np.concatenate([np.broadcast_to(color, cloud.shape) for cloud, color in clouds])
    near = (points[:, 2] - low[2]) / extent[2]
    # A point of the first cloud shows as a rim behind a coincident point of the second.
    rim = np.arange(len(points)) < len(clouds[0][0]) * (len(clouds) > 1)
    order = np.argsort(near - 0.05 * rim)
    size = np.clip(8000 / len(points), 1, 20) * np.where(rim, 2.6, 1.6)
    pale = (0.6 * (1 - near) * (len(clouds) > 1))[:, None]
    colors = colors * (1 - pale) + pale
    axes.scatter(*points[order, :2].T, s=size[order], c=colors[order], linewidths=0)
    middle, half = (low + high)[:2] / 2, 0.53 * extent[:2].max()
    axes.set(xlim=middle[0] + [-half, half], ylim=middle[1] + [-half, half], aspect="equal")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _describe(transform: RigidTransform, truth: RigidTransform | None) -> str:
    known = RigidTransform(np.eye(3), np.zeros(3)) if truth is None else truth
    (rotation, translation), (r, t) = (
        [np.asarray(x, np.float64) for x in one] for one in (transform, known)
    )
    angle = rotation_angle_deg(rotation[None], r[None])[0]
    length = np.linalg.norm(translation - t)
    if truth is None:
        return f"turned by {angle:.1f} deg, moved by {length:.3g}"
    return f"rotation error {angle:.2g} deg, translation error {length:.2g}"


def plot_curves(metrics: str | Path, path: str | Path) -> None:
    """Draw the losses and the validation errors of a `metrics.jsonl` over the steps, as PNG.

    Raises:
      ValueError: what `read_metrics` raises.
    """
    _curves(read_metrics(metrics)).savefig(path, dpi=150, facecolor="white")


def _curves(columns: dict[str, np.ndarray]) -> Figure:
    columns = dict(columns)
    steps = columns.pop("step")
    validation = {name: columns.pop(name) for name in list(columns) if name.startswith("val_")}
    columns.pop("gradient_norm", None)
    figure = Figure(figsize=(15, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    # A line through one point is invisible.
    marker = "." if len(steps) < 10 else ""
    for name, values in columns.items():
        width = 2 if name == "loss" else 1
        left.plot(*_binned(steps, values), marker=marker, label=name.replace("_", " "), lw=width)
    # A mean surprise below zero (the entries of G can exceed 1) cannot be shown on a logarithmic
    # axis.
    left.set(title="training loss and its terms", xlabel="step")
    left.set_yscale("symlog", linthresh=1e-2)
    for name, label in _VALIDATION.items():
        if name in validation:
            known = np.isfinite(validation[name])
            right.plot(steps[known], validation[name][known], ".-", label=label, lw=1)
    if "val_mie_r_deg" in validation:
        best = int(np.nanargmin(validation["val_mie_r_deg"]))
        error = validation["val_mie_r_deg"][best]
        label = f"best: {error:.3g} deg at step {steps[best]:.0f}"
        right.plot(steps[best], error, "*", ms=14, color="black", mfc="none", label=label)
    right.set(title="validation rotation error (deg)", xlabel="step", yscale="log")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        if axes.lines:
            axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _binned(steps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over bins of steps: single losses of small batches hide the trend."""
    size = -(-len(steps) // _CURVE_POINTS)
    edges = np.arange(0, len(steps), size)
    counts = np.diff(np.append(edges, len(steps)))
    return np.add.reduceat(steps, edges) / counts, np.add.reduceat(values, edges) / counts
