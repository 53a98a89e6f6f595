"""Pictures are read back: the right colours stand in the right panels."""

import json
import re

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from jaxreg.io.log import read_metrics
from jaxreg.types import RigidTransform
from jaxreg.view import pictures


@pytest.fixture
def pair(seed):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(300, 3))
    transform = RigidTransform(Rotation.random(rng=rng).as_matrix(), np.array([8.0, 0.0, 8.0]))
    return source, source @ transform.rotation.T + transform.translation, transform


def share(image, color) -> float:
    """Share of the pixels within a shade of `color`, paler ones included."""
    pale = np.linspace(0, 0.6, 20)[:, None]
    shades = np.array(to_rgb(color)) * (1 - pale) + pale
    distance = np.abs(image[..., None, :3] - shades).max(axis=-1).min(axis=-1)
    return float(np.mean(distance < 0.02))


def test_before_is_blue_and_yellow_after_is_green(pair, tmp_path):
    source, reference, transform = pair
    pictures.plot_pair(source, reference, transform, tmp_path / "pair.png", truth=transform)
    image = imread(tmp_path / "pair.png")[100:-100]
    before, after = np.array_split(image, 2, axis=1)
    assert share(before, pictures.SOURCE) > 1e-4 > 1e-6 > share(after, pictures.SOURCE)
    assert share(after, pictures.ALIGNED) > 1e-4 > 1e-6 > share(before, pictures.ALIGNED)
    assert share(before, pictures.REFERENCE) > share(after, pictures.REFERENCE), "covered by green"
    assert np.all(imread(tmp_path / "pair.png")[0, 0] == 1), "white background"


def test_a_wrong_transform_leaves_the_reference_in_sight(pair, tmp_path):
    source, reference, transform = pair
    wrong = transform._replace(translation=np.zeros(3))
    shares = []
    for name, estimate in (("right", transform), ("wrong", wrong)):
        pictures.plot_pair(source, reference, estimate, tmp_path / f"{name}.png", truth=transform)
        image = imread(tmp_path / f"{name}.png")[100:-100]
        shares.append(share(image[:, image.shape[1] // 2 :], pictures.REFERENCE))
    assert shares[1] > 1.2 * shares[0]


def test_confidence_adds_a_panel(pair, tmp_path):
    source, reference, transform = pair
    pictures.plot_pair(source, reference, transform, tmp_path / "2.png")
    confidence = np.linspace(0, 1, len(source))
    pictures.plot_pair(source, reference, transform, tmp_path / "3.png", confidence=confidence)
    assert imread(tmp_path / "3.png").shape[1] * 2 == imread(tmp_path / "2.png").shape[1] * 3


def test_title_states_the_errors_or_the_motion(pair):
    _, _, transform = pair
    turned = Rotation.from_euler("y", 2, degrees=True).as_matrix() @ transform.rotation
    estimate = RigidTransform(turned, transform.translation + [0.0, 0.25, 0.0])
    text = pictures._describe(estimate, transform)
    assert text == "rotation error 2 deg, translation error 0.25"
    assert "moved by 11.3" in pictures._describe(transform, None)


@pytest.mark.parametrize("steps", [1, 5, 1001])
def test_every_curve_of_any_run_is_in_sight(tmp_path, steps):
    with (tmp_path / "metrics.jsonl").open("w") as file:
        for step in range(1, steps + 1):
            entry = {"step": step, "loss": 1 / step, "gradient_norm": 1.0, "spatial_consistency": 2}
            if step % 5 == 0:
                entry["val_mie_r_deg"] = 1 / step
            file.write(json.dumps(entry) + "\n")
    pictures.plot_curves(tmp_path / "metrics.jsonl", tmp_path / "curves.png")
    image = imread(tmp_path / "curves.png")

    figure = pictures._curves(read_metrics(tmp_path / "metrics.jsonl"))
    figure.dpi = 150
    figure.draw_without_rendering()
    assert image.shape[1::-1] == tuple(figure.bbox.size)
    curves = {line.get_label(): line for axes in figure.axes for line in axes.lines}
    expected = {"loss", "spatial consistency"}
    if steps >= 5:
        expected |= {"mean angle, MIE(R)", f"best: {1 / (steps // 5 * 5):.3g} deg at step "}
    assert {re.sub(r"(?<=step )\d+$", "", name) for name in curves} == expected
    for line in curves.values():
        assert 1 <= len(line.get_xdata()) <= 400
        assert share(crop(image, line.axes.bbox), line.get_color()) > 0, line.get_label()
    for axes in (axes for axes in figure.axes if axes.lines):
        legend = axes.get_legend()
        assert [text.get_text() for text in legend.get_texts()] == [
            x.get_label() for x in axes.lines
        ]
        box = legend.get_window_extent()
        assert box.x0 >= axes.bbox.x1, "the legend hides no curve"
        assert box.x1 <= figure.bbox.x1, "the legend is not cut off"


def crop(image, box):
    """The part of a picture, first row on top, that a box counted from below encloses."""
    height = len(image)
    return image[round(height - box.y1) : round(height - box.y0), round(box.x0) : round(box.x1)]
