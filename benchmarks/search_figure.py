"""The picture of *How the search works*: its stages on one pair of procedural crops.

Drawn by `python -m benchmarks.figures --only search`. Nothing in it is chosen by hand: candidates, poses
and scores are those of the stages that `search_poses` runs.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.geometry import frame, rigid
from jaxreg.judge.odds import probabilities
from jaxreg.search import SearchConfig, describe, register_global, search_described
from jaxreg.search.candidates import select_candidates
from jaxreg.search.compatibility import compatibility
from jaxreg.search.description import compare
from jaxreg.search.hypotheses import pose_hypotheses, screen
from jaxreg.search.pipeline import enter
from jaxreg.types import RigidTransform
from jaxreg.view import pictures

POINTS = 1024
VIEW = (18.0, -55.0)
RIGHT, WRONG = "#1f9d55", "#d23c3c"
DRAWN = 4  # Every fourth wrong candidate: all of them would hide the clouds.
RIGHT_WITHIN = (
    0.1  # A candidate whose points lie so near each other is right, in units of the search.
)
SAME_DEG, SAME = 6.0, 0.1  # Poses nearer than this are one, and share no probability.
CONFIG = SearchConfig()


class Stages(NamedTuple):
    """What the stages of the search make of a pair whose pose is known; numpy."""

    source: np.ndarray
    reference: np.ndarray
    truth: RigidTransform
    candidates: np.ndarray
    right: np.ndarray
    angle_deg: np.ndarray
    overlap: np.ndarray
    best_angle_deg: np.ndarray
    score: np.ndarray
    probability: np.ndarray
    found: RigidTransform
    found_angle_deg: np.ndarray


def two_crops() -> tuple[np.ndarray, np.ndarray, RigidTransform]:
    """Two crops of a chair that share no point, and the pose of the first in the frame of the other."""
    chair = sample_shape(1, 16, points=4 * POINTS)
    first, second = chair[::2], chair[1::2]
    first = first[first @ [1.0, 0.4, 0.2] < 0.15][:POINTS]
    second = second[second @ [1.0, -0.3, 0.3] > -0.2][:POINTS]
    turn = Rotation.from_euler("xyz", [25, -40, 110], degrees=True).as_matrix().astype(np.float32)
    return first, second @ turn.T, RigidTransform(turn, np.zeros(3, np.float32))


def run_stages() -> Stages:
    """The stages one by one, then the whole search."""
    source, reference, truth = two_crops()
    where, x, y = enter(jnp.asarray(source), jnp.asarray(reference))
    truth = frame.transform_in(where, jax.tree.map(jnp.asarray, truth))
    described = [describe(points, unit=1.0) for points in (x, y)]
    a, b, similarity = compare(*described)
    proposed = select_candidates(similarity, keep=CONFIG.candidates)
    i, j = proposed.source_index, proposed.reference_index
    apart = jnp.linalg.norm(rigid.apply(truth, x[i]) - y[j], axis=1)
    agree = compatibility(x[i], y[j], a.normals[i], b.normals[j], proposed.mask)
    poses = pose_hypotheses(x[i], y[j], agree, seeds=CONFIG.seeds)
    found = search_described(*described)
    refined = RigidTransform(*register_global(x, y)[:2])
    values = Stages(
        x, y, truth, jnp.stack([i, j], axis=1), apart < RIGHT_WITHIN,
        _angles_deg(poses, truth), screen(poses, a, b, described[1].grid),
        _angles_deg(found.poses, truth), found.score,
        probabilities(found.score, distinct(found.poses)),
        refined, _angles_deg(jax.tree.map(lambda leaf: leaf[None], refined), truth)[0],
    )  # fmt: skip
    return jax.tree.map(np.asarray, values)


def draw_search(path: Path) -> None:
    """Four panels: candidates, poses, what the judge says of the best of them, result."""
    stages = run_stages()
    figure = Figure(figsize=(11.5, 8.6), layout="constrained")
    grid = figure.subplots(2, 2, width_ratios=(1.25, 1), height_ratios=(1.05, 1))
    _draw_candidates(grid[0, 0], stages)
    _draw_poses(grid[0, 1], stages)
    _draw_judged(grid[1, 1], stages)
    _draw_result(grid[1, 0], stages)
    figure.savefig(path, dpi=110, facecolor="white")


def _draw_candidates(axes: Axes, stages: Stages) -> None:
    left, right = (
        pictures.project(cloud, VIEW)[:, :2] for cloud in (stages.source, stages.reference)
    )
    right = right + [np.ptp(left[:, 0]) / 2 + np.ptp(right[:, 0]) / 2 + 0.4, 0]
    ends = np.stack([left[stages.candidates[:, 0]], right[stages.candidates[:, 1]]], axis=1)
    wrong, right_ones = ends[~stages.right][::DRAWN], ends[stages.right]
    axes.add_collection(LineCollection(wrong, colors=WRONG, linewidths=0.4, alpha=0.5, zorder=0))
    axes.add_collection(LineCollection(right_ones, colors=RIGHT, linewidths=1.2, zorder=0))
    axes.scatter(*left.T, s=6, lw=0, color=pictures.SOURCE)
    axes.scatter(*right.T, s=6, lw=0, color=pictures.REFERENCE)
    axes.set(xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_visible(False)
    axes.set_title(f"1, 2   {len(stages.right)} candidates, {stages.right.sum()} right (green)")


def _draw_poses(axes: Axes, stages: Stages) -> None:
    axes.scatter(stages.angle_deg, stages.overlap, s=12, color="0.6", lw=0)
    near = stages.angle_deg < 15
    axes.scatter(stages.angle_deg[near], stages.overlap[near], s=16, color=RIGHT, lw=0)
    axes.set(xlabel="rotation away from the true pose, degrees", ylabel="overlap at a glance")
    axes.set(xlim=(-4, 184), xticks=range(0, 181, 30))
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"3, 4, 5   {len(near)} poses, {near.sum()} within 15 degrees (green)")


def _draw_judged(axes: Axes, stages: Stages) -> None:
    rows, near = np.arange(len(stages.score)), stages.best_angle_deg < 15
    axes.barh(rows, stages.score, color=np.where(near, RIGHT, WRONG), height=0.7)
    for row, score, chance in zip(rows, stages.score, stages.probability, strict=True):
        text = f"{chance:.2f}" if chance else "same as a better one"
        place = (
            {"ha": "left", "xytext": (5, 0)} if score >= 0 else {"ha": "right", "xytext": (-5, 0)}
        )
        axes.annotate(text, (score, row), va="center", textcoords="offset points", **place)
    axes.axvline(0, color="black", lw=0.8)
    axes.margins(x=0.2)
    axes.set_yticks(rows, [f"{angle:.0f}°" for angle in stages.best_angle_deg])
    axes.set(
        ylabel="away from the true pose", xlabel="log odds, and the probability beside the bar"
    )
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"6, 7   the best {len(rows)}, aligned and judged (right: green)")


def _draw_result(axes: Axes, stages: Stages) -> None:
    aligned = stages.source @ stages.found.rotation.T + stages.found.translation
    clouds = [
        (stages.reference, to_rgb(pictures.REFERENCE)),
        (aligned, to_rgb(pictures.ALIGNED)),
    ]
    everything = np.concatenate([stages.reference, aligned])
    pictures.draw_clouds(axes, clouds, VIEW, pictures.project(everything, VIEW))
    axes.set_title(
        f"8   the best one, refined: {stages.found_angle_deg:.1f} degrees from the truth"
    )


def distinct(poses: RigidTransform) -> np.ndarray:
    """Whether no earlier pose is the same but for noise."""
    matrices, shifts = (np.asarray(part) for part in poses)
    counted = np.ones(len(matrices), bool)
    for k in range(1, len(matrices)):
        turned = rigid.rotation_angle_deg(matrices[:k], matrices[k][None])
        moved = np.linalg.norm(shifts[:k] - shifts[k], axis=1)
        counted[k] = not np.any(counted[:k] & (turned < SAME_DEG) & (moved < SAME))
    return counted


def _angles_deg(poses: RigidTransform, truth: RigidTransform) -> jax.Array:
    relative = jnp.einsum("sij,kj->sik", poses.rotation, truth.rotation)
    cosine = (jnp.trace(relative, axis1=1, axis2=2) - 1) / 2
    return jnp.degrees(jnp.arccos(jnp.clip(cosine, -1, 1)))
