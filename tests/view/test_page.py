"""The page: its data against what was put in, and itself in a headless browser."""

import base64
import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from jaxreg.judge.evidence import Evidence
from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans.result import Alternative, ScanRegistration
from jaxreg.types import RigidTransform
from jaxreg.view import page, pictures

POSE = Rotation.from_euler("xyz", [20, -30, 70], degrees=True).as_matrix()


def registration(
    source, reference, *, rotation=POSE, translation=(0.0, 0, 0), success=True, alternatives=()
):
    translation = np.asarray(translation, float)
    return ScanRegistration(
        rotation=rotation,
        translation=translation,
        transformation=np.block([[rotation, translation[:, None]], [0, 0, 0, 1]]),
        confidence=np.linspace(0, 1, len(source)),
        correspondences=source @ rotation.T + translation,
        max_correspondence_distance=0.1,
        reason="" if success else "Only 60% of the points lie near the other cloud.",
        alternatives=alternatives,
        converged=True,
        fitness=0.75,
        inlier_rmse=0.01,
        overlap=0.5,
        covariance=np.eye(6) * 1e-6,
        weak_directions=(WeakDirection("rotation", np.array([0.0, 0, 1]), np.zeros(3), 1e-4),),
        success=success,
        probability=0.97 if success else 0.03,
        evidence=Evidence(*np.linspace(0.1, 0.9, len(Evidence._fields))),
        dropped=0,
        notes=(),
    )


def scans(seed, *, count=4000, offset=(0.0, 0, 0)):
    """A flattened ball and its copy under `POSE`, a good two radii to the right of it."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3))
    source *= [1.0, 0.8, 0.3] / np.linalg.norm(source, axis=1, keepdims=True)
    translation = np.array([2.2, 0.5, 0.0]) + offset - POSE @ np.asarray(offset)
    source = source + offset
    return source, source @ POSE.T + translation, translation


def content_of(path) -> dict:
    text = path.read_text(encoding="utf-8")
    data = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    return json.loads(data[1])


def points_of(cloud) -> np.ndarray:
    steps = np.frombuffer(base64.b64decode(cloud["points"]), "<i2").reshape(-1, 3)
    return steps * cloud["step"] + cloud["centre"]


@pytest.mark.parametrize("offset", [(0.0, 0, 0), (4.2e5, 5.1e6, 30.0)])
def test_page_holds_the_clouds_and_ends_at_the_pose(tmp_path, seed, offset):
    source, reference, translation = scans(seed, offset=offset)
    result = registration(source, reference, translation=translation)
    page.write_registration_page(tmp_path / "r.html", source, reference, result)
    content = content_of(tmp_path / "r.html")
    moving, fixed = (points_of(cloud) for cloud in content["clouds"])
    np.testing.assert_allclose(moving - moving[0], source - source[0], atol=2e-4)
    np.testing.assert_allclose(fixed - moving[0], reference - source[0], atol=2e-4)
    motion = content["motions"][0]
    turn = Rotation.from_rotvec(motion["angle"] * np.array(motion["axis"])).as_matrix()
    aligned = (moving - motion["before"]) @ turn.T + motion["after"]
    np.testing.assert_allclose(aligned, fixed, atol=3e-4)
    assert not motion["shortened"]


def test_far_clouds_are_brought_near_and_still_meet(tmp_path, seed):
    source, reference, translation = scans(seed)
    far = np.array([1e7, 0, 0])
    result = registration(source, reference + far, translation=translation + far)
    page.write_registration_page(tmp_path / "r.html", source, reference + far, result)
    content = content_of(tmp_path / "r.html")
    moving, fixed = (points_of(cloud) for cloud in content["clouds"])
    motion = content["motions"][0]
    assert motion["shortened"]
    assert np.linalg.norm(moving.mean(axis=0) - fixed.mean(axis=0)) < 3
    turn = Rotation.from_rotvec(motion["angle"] * np.array(motion["axis"])).as_matrix()
    np.testing.assert_allclose(
        (moving - motion["before"]) @ turn.T + motion["after"], fixed, atol=3e-4
    )


def test_confidence_belongs_to_its_points_when_thinned(tmp_path, seed):
    source, reference, translation = scans(seed, count=50_000)
    source[7] = np.nan
    result = registration(source, reference, translation=translation)
    page.write_registration_page(tmp_path / "r.html", source, reference, result)
    cloud = content_of(tmp_path / "r.html")["clouds"][0]
    rows = page.shown_rows(source)
    assert len(rows) == len(points_of(cloud)) == 20_000
    assert 7 not in rows
    painted = np.frombuffer(base64.b64decode(cloud["confidence"]), np.uint8) / 255
    np.testing.assert_allclose(painted, result.confidence[rows], atol=0.002)
    assert cloud["count"] == 50_000
    assert (tmp_path / "r.html").stat().st_size < 500_000


def test_names_cannot_break_the_page(tmp_path, seed):
    source, _, _ = scans(seed, count=10)
    name = '</script><script>alert("x")</script>&.ply'
    page.write_page(tmp_path / "v.html", {name: source})
    assert content_of(tmp_path / "v.html")["clouds"][0]["name"] == name
    assert "<script>alert" not in (tmp_path / "v.html").read_text()


def test_page_asks_for_nothing_from_elsewhere(tmp_path, seed):
    source, _, _ = scans(seed, count=10)
    page.write_page(tmp_path / "v.html", {"a": source, "b": source + 1})
    text = (tmp_path / "v.html").read_text()
    assert re.findall(r"https?://|<link|<img|<iframe|\bsrc=|@import|url\(|fetch\(", text) == []


def test_one_point_has_a_page(tmp_path):
    page.write_page(tmp_path / "v.html", {"a": np.array([[1.0, 2, 3]])})
    np.testing.assert_array_equal(
        points_of(content_of(tmp_path / "v.html")["clouds"][0]), [[0] * 3]
    )


def test_picture_tells_the_true_motion_where_the_source_is_brought_near(tmp_path, seed):
    source, reference, translation = scans(seed)
    far = np.array([1e7, 0, 0])
    result = registration(source, reference + far, translation=translation + far)
    page.draw_registration(tmp_path / "r.png", source, reference + far, result)
    before, after, _ = np.array_split(imread(tmp_path / "r.png")[150:-100, :-200, :3], 3, axis=1)
    # A panel's rim reaches into its neighbour's third of the picture.
    assert blue(255 * before).sum() > max(1000, 20 * blue(255 * after).sum())
    assert green(255 * after).sum() > max(1000, 20 * green(255 * before).sum())
    told = page._headline(result, source, shortened=True)
    angle = np.degrees(Rotation.from_matrix(POSE).magnitude())
    assert told[1].startswith(f"turned by {angle:.1f} deg, centroid moved by 1e+07; before: ")


def at_another_size(seed, scale):
    """A source that must become `scale` times as large, its reference, and the registration."""
    source, reference, translation = scans(seed, count=400)
    result = registration(source, reference, translation=translation)
    return source / scale, reference, dataclasses.replace(result, scale=scale)


@pytest.mark.parametrize("scale", [0.3, 2.5])
def test_a_source_at_another_size_ends_on_the_reference(tmp_path, seed, scale):
    source, reference, result = at_another_size(seed, scale)
    page.write_registration_page(tmp_path / "r.html", source, reference, result)
    content = content_of(tmp_path / "r.html")
    moving, fixed = (points_of(cloud) for cloud in content["clouds"])
    motion = content["motions"][0]
    turn = Rotation.from_rotvec(motion["angle"] * np.array(motion["axis"])).as_matrix()
    aligned = (moving - motion["before"]) @ turn.T + motion["after"]
    np.testing.assert_allclose(aligned, fixed, atol=3e-4)


@pytest.mark.parametrize("scale", [0.3, 2.5])
def test_so_it_does_in_a_picture(tmp_path, seed, scale, monkeypatch):
    source, reference, result = at_another_size(seed, scale)
    drawn = []
    monkeypatch.setattr(pictures, "plot_pair", lambda *given, **_: drawn.append(given))
    page.draw_registration(tmp_path / "r.png", source, reference, result)
    [(moving, fixed, transform, _)] = drawn
    aligned = moving @ transform.rotation.T + transform.translation
    np.testing.assert_allclose(aligned, fixed, atol=1e-9)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    webdriver = pytest.importorskip(
        "selenium.webdriver", reason="selenium (extra `dev`) is missing"
    )
    names = ("chromium", "chromium-browser", "google-chrome")
    chromium, driver = (
        next(filter(None, map(shutil.which, names)), None),
        shutil.which("chromedriver"),
    )
    if not (chromium and driver):
        pytest.skip("no Chromium with its chromedriver on the PATH")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    flags = "headless=new no-sandbox disable-gpu no-first-run disable-background-networking"
    flags += f" disable-component-update disable-sync user-data-dir={tmp_path_factory.mktemp('u')}"
    for flag in flags.split():
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=driver)
    session = webdriver.Chrome(options=options, service=service)
    yield session
    session.quit()


@pytest.fixture(scope="module")
def page_uri(tmp_path_factory):
    """A registered pair, written as a page."""
    path = tmp_path_factory.mktemp("page") / "r.html"
    source, reference, translation = scans(0)
    result = registration(source, reference, translation=translation)
    page.write_registration_page(path, source, reference, result, names=("a.ply", "b.ply"))
    return path.as_uri()


def opened(browser, page_uri, *, width=1200, dark=False):
    """The page as shown on a screen of this width, without animation."""
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    still = {"name": "prefers-reduced-motion", "value": "reduce"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme, still]})
    metrics = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.get(page_uri)
    return browser


def click(browser, name):
    browser.find_element("id", name).click()


def canvas(browser) -> np.ndarray:
    """The pixels of the 3-D view, (h, w, 3)."""
    width, height, text = browser.execute_script("""
        const c = document.getElementById("view");
        const data = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let text = "";
        for (let i = 0; i < data.length; i += 8192)
            text += String.fromCharCode(...data.slice(i, i + 8192));
        return [c.width, c.height, btoa(text)];""")
    pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)
    return pixels[..., :3].astype(int)


def middle(mask) -> np.ndarray:
    """Centroid (row, column) of the pixels of a mask that holds some."""
    assert mask.sum() > 200, "too few pixels of this colour"
    return np.argwhere(mask).mean(axis=0)


def blue(p):
    return (p[..., 2] > p[..., 0] + 50) & (p[..., 2] > p[..., 1] + 25)


def green(p):
    return (p[..., 1] > p[..., 0] + 40) & (p[..., 1] > p[..., 2] + 25)


def amber(p):
    return (p[..., 0] > p[..., 2] + 60) & (p[..., 0] > p[..., 1])


@pytest.mark.parametrize("dark", [False, True])
def test_toggle_moves_the_source_onto_the_reference(browser, page_uri, dark):
    opened(browser, page_uri, dark=dark)
    after = canvas(browser)
    assert not blue(after).any(), "after: the aligned source is green"
    click(browser, "before")
    before = canvas(browser)
    assert not green(before).any(), "before: the source is blue"
    apart = np.linalg.norm(middle(blue(before)) - middle(amber(before)))
    together = np.linalg.norm(middle(green(after)) - middle(amber(after)))
    assert apart > 100 > 20 > together
    np.testing.assert_allclose(middle(amber(before)), middle(amber(after)), atol=15)
    click(browser, "after")
    np.testing.assert_array_equal(canvas(browser), after)
    told = [entry["message"] for entry in browser.get_log("browser")]
    assert [text for text in told if "getImageData" not in text] == [], "but of this test's reading"


def test_animation_ends_where_the_still_toggle_ends(browser, page_uri):
    opened(browser, page_uri)
    click(browser, "before")
    goal = canvas(browser)
    click(browser, "after")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    click(browser, "before")
    browser.execute_async_script("setTimeout(arguments[0], 700)")
    np.testing.assert_array_equal(canvas(browser), goal)


@pytest.mark.parametrize("dark", [False, True])
def test_confidence_colours_the_source_and_explains_itself(browser, page_uri, dark):
    opened(browser, page_uri, dark=dark)
    scale = browser.find_element("id", "scaleBar")
    assert not scale.is_displayed()
    click(browser, "confidence")
    assert scale.is_displayed()
    pixels = canvas(browser)
    yellow = (pixels[..., :2].min(axis=-1) > pixels[..., 2] + 80).sum()
    assert yellow > 200, "the confident end of the scale"
    assert not amber(pixels).sum() > yellow, "the reference has lost its colour"
    click(browser, "role")
    assert not scale.is_displayed()


def test_one_can_step_through_the_alternatives(browser, tmp_path):
    source, reference, translation = scans(2)
    unmoved = Alternative(RigidTransform(np.eye(3), np.zeros(3)), 0.41)
    result = registration(source, reference, translation=translation, alternatives=(unmoved,))
    page.write_registration_page(tmp_path / "r.html", source, reference, result)
    uri = (tmp_path / "r.html").as_uri()
    opened(browser, uri, width=375)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 375
    opened(browser, uri)
    first, told = canvas(browser), browser.find_element("id", "pose")
    assert told.text == "pose 1 of 2, probability 0.97"
    assert not browser.find_element("id", "previous").is_enabled()
    click(browser, "confidence")
    click(browser, "next")
    assert told.text == "pose 2 of 2, probability 0.41"
    assert not browser.find_element("id", "next").is_enabled()
    assert not browser.find_element("id", "confidence").is_enabled(), "it belongs to the first pose"
    other = canvas(browser)
    apart = np.linalg.norm(middle(green(other)) - middle(amber(other)))
    assert apart > 100, "the other pose leaves the source where it was"
    browser.find_element("id", "view").send_keys("[")
    np.testing.assert_array_equal(canvas(browser), first)
    told = [entry["message"] for entry in browser.get_log("browser")]
    assert [text for text in told if "getImageData" not in text] == []


def test_figures_and_verdict_are_there(browser, page_uri):
    opened(browser, page_uri)
    assert browser.find_element("id", "verdict").text == "success (probability 0.97)"
    text = browser.find_element("id", "figures").text
    for part in (
        "overlap 0.50",
        "fitness 0.75 within 0.1",
        "rotation about axis (0.00, 0.00, 1.00)",
    ):
        assert part in text
    angle = np.degrees(Rotation.from_matrix(POSE).magnitude())
    assert f"rotation {angle:.3f} deg" in text
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0


def test_drag_turns_wheel_zooms_and_boxes_hide(browser, page_uri):
    from selenium.webdriver import ActionChains

    opened(browser, page_uri)
    first = canvas(browser)
    view = browser.find_element("id", "view")
    ActionChains(browser).drag_and_drop_by_offset(view, 120, 0).perform()
    turned = canvas(browser)
    assert (turned != first).any(axis=-1).mean() > 0.02
    click(browser, "reset")
    np.testing.assert_array_equal(canvas(browser), first)
    browser.execute_script(
        "arguments[0].dispatchEvent(new WheelEvent('wheel', {deltaY: -400, cancelable: true}))",
        view,
    )
    assert green(canvas(browser)).sum() != green(first).sum()
    click(browser, "reset")
    browser.find_element("css selector", "#legend input").click()
    assert not green(canvas(browser)).any(), "the hidden source"


def test_phone_width_needs_no_sideways_scrolling(browser, page_uri):
    opened(browser, page_uri, width=375)
    wide = browser.execute_script("return document.documentElement.scrollWidth")
    assert wide <= 375
    buttons = [b for b in browser.find_elements("tag name", "button") if b.is_displayed()]
    assert len(buttons) == 5
    for button in buttons:
        assert button.size["height"] >= 40, "large enough for a finger"
    view = browser.find_element("id", "view")
    assert view.size["width"] > 330
    assert view.size["height"] < 800
    smallest = browser.execute_script("""
        return Math.min(...[...document.querySelectorAll("td, p, label, button")].map(
            (e) => parseFloat(getComputedStyle(e).fontSize)));""")
    assert smallest >= 13


def contrast(one, other) -> float:
    """WCAG 2.1's ratio of the luminances of two CSS colours."""
    light = []
    for colour in (one, other):
        rgb = np.array(re.findall(r"[\d.]+", colour)[:3], float) / 255
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        light.append(linear @ [0.2126, 0.7152, 0.0722] + 0.05)
    return max(light) / min(light)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("success", [False, True])
def test_text_is_readable_in_both_schemes(browser, tmp_path, dark, success):
    source, reference, translation = scans(1, count=50)
    result = registration(source, reference, translation=translation, success=success)
    page.write_registration_page(tmp_path / "r.html", source, reference, result)
    opened(browser, (tmp_path / "r.html").as_uri(), dark=dark)
    paper = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert (contrast(paper, "rgb(0, 0, 0)") > 10) != dark
    for where in ("#verdict", "h1", "td:first-child", "td:last-child", ".hint", "#legend label"):
        colour = browser.execute_script(
            "return getComputedStyle(document.querySelector(arguments[0])).color", where
        )
        assert contrast(colour, paper) >= 4.5, where


def test_view_has_no_toggle_but_its_clouds(browser, tmp_path, seed):
    source, reference, _ = scans(seed)
    page.write_page(tmp_path / "v.html", {"a.ply": source, "b.ply": reference})
    opened(browser, (tmp_path / "v.html").as_uri())
    assert not browser.find_element("id", "before").is_displayed()
    pixels = canvas(browser)
    middle(blue(pixels))
    middle(amber(pixels))
    assert "a.ply (4,000 points)" in browser.find_element("id", "legend").text
