"""Whatever is given to `register`, it answers with a proper rigid transform or says what to do.

240 examples by default; `make fuzz` (the hypothesis profile "fuzz") runs 10,000.
"""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register

pytestmark = [pytest.mark.slow, pytest.mark.untyped]

EXAMPLES = 10_000 if settings.get_current_profile_name() == "fuzz" else 240
REMEDY = re.compile(r"give|remove|pass|use|need|at least|must be|drop", re.IGNORECASE)

sizes = st.one_of(st.integers(0, 12), st.integers(0, 300))
scales = st.sampled_from([1.0, 1.0, 1.0, 1e-300, 1e-30, 1e-6, 1e6, 1e30, 1e99, 1e160, 1e300])
offsets = st.sampled_from([0.0, 0.0, 1.0, 1e6, -5e6, 1e15])


def surface(rng, n):
    u, v = rng.uniform(size=(2, n))
    return np.stack([2 * u, v, np.sin(3 * u) * v], axis=1)


def lattice(rng, n):
    side = int(np.ceil(n ** (1 / 3))) or 1
    axis = np.arange(float(side))
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)[:n]


SHAPES = {
    "noise": lambda rng, n: rng.normal(size=(n, 3)),
    "surface": surface,
    "line": lambda rng, n: np.outer(rng.normal(size=n), [1.0, -2.0, 0.5]),
    "plane": lambda rng, n: rng.normal(size=(n, 3)) * [1.0, 1.0, 0.0],
    "sphere": lambda rng, n: (lambda x: x / np.linalg.norm(x, axis=1, keepdims=True))(
        rng.normal(size=(n, 3))
    ),
    "lattice": lattice,
    "one place": lambda rng, n: np.ones((n, 3)),
    "duplicates": lambda rng, n: rng.normal(size=(max(n // 4, 1), 3))[
        rng.integers(0, max(n // 4, 1), n)
    ],
    "two clusters": lambda rng, n: 1e-9 * rng.normal(size=(n, 3)) + (np.arange(n) % 2)[:, None],
}


@st.composite
def finite_clouds(draw):
    """Float64 (n, 3), with or without something that is not finite."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = SHAPES[draw(st.sampled_from(sorted(SHAPES)))](rng, draw(sizes))
    return points * draw(scales) + draw(offsets)


@st.composite
def broken_clouds(draw):
    points = draw(finite_clouds())
    if len(points):
        for _ in range(draw(st.integers(1, 3))):
            row, column = draw(st.integers(0, len(points) - 1)), draw(st.integers(0, 2))
            points[row, column] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    return points


DISGUISES = {
    "itself": lambda x: x,
    "float32": lambda x: _quietly(x, np.float32),
    "float16": lambda x: _quietly(x, np.float16),
    "integers": lambda x: np.clip(np.nan_to_num(x), -1e9, 1e9).astype(np.int64),
    "bytes": lambda x: np.clip(np.nan_to_num(x), 0, 255).astype(np.uint8),
    "list": lambda x: x.tolist(),
    "tuple": lambda x: tuple(map(tuple, x)),
    "objects": lambda x: x.astype(object),
    "view": lambda x: np.repeat(x, 2, axis=0)[::2, ::-1],
    "Fortran": np.asfortranarray,
    "read-only": lambda x: _read_only(x),
    "complex": lambda x: x.astype(complex),
    "booleans": lambda x: np.nan_to_num(x) > 0,
    "text": lambda x: x.astype(str),
    "ragged": lambda x: [*x.tolist(), [1.0]],
    "transposed": lambda x: x.T,
    "batch": lambda x: x[None],
    "flat": np.ravel,
    "two columns": lambda x: x[:, :2],
    "four columns": lambda x: np.concatenate([x, x[:, :1]], axis=1),
    "number": lambda x: 3.0,
    "nothing": lambda x: None,
    "dictionary": lambda x: {"points": x},
}


def _quietly(x, dtype):
    with np.errstate(all="ignore"):
        return x.astype(dtype)


def _read_only(x):
    x = x.copy()
    x.flags.writeable = False
    return x


clouds = st.one_of(finite_clouds(), finite_clouds(), broken_clouds())
disguises = st.one_of(st.just("itself"), st.sampled_from(sorted(DISGUISES)))


def assert_answers(source, reference, options):
    try:
        result = register(source, reference, **options)
    except ValueError as error:
        if not REMEDY.search(str(error)):
            pytest.fail(f"says not what to do: {error}")
        return
    assert np.isfinite(result.transformation).all()
    np.testing.assert_allclose(result.rotation @ result.rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(result.rotation) == pytest.approx(1, abs=1e-9)
    np.testing.assert_array_equal(result.transformation[3], [0, 0, 0, 1])
    assert np.isfinite(result.confidence).all()
    assert result.confidence.min() >= 0
    assert result.confidence.max() <= 1
    assert len(result.confidence) == len(result.correspondences) == len(source)
    assert 0 <= result.probability <= 1


# Four tests, so that several processes share the work.
@pytest.mark.parametrize("method", ["gicp", "icp", "point_to_plane", None])
@settings(max_examples=EXAMPLES // 5)
@given(
    source=clouds,
    reference=clouds,
    disguise=disguises,
    largest=st.sampled_from([80.0, None]),
    nonfinite=st.sampled_from(["raise", "drop"]),
)
def test_any_input_gives_a_rigid_transform_or_a_remedy(
    method, source, reference, disguise, largest, nonfinite
):
    refine = method and dataclasses.replace(RegisterConfig().refine, method=method)
    options = {"max_rotation_deg": largest, "nonfinite": nonfinite}
    options["config"] = RegisterConfig(refine=refine)
    assert_answers(DISGUISES[disguise](source), reference, options)


@settings(max_examples=EXAMPLES // 5)
@given(
    cloud=finite_clouds(),
    initial=st.sampled_from(["eye", "zeros", "mirror", "nan", "text", "3x3", "shear", None]),
)
def test_any_initial_pose_gives_a_rigid_transform_or_a_remedy(cloud, initial):
    poses = {
        "eye": np.eye(4),
        "zeros": np.zeros((4, 4)),
        "mirror": np.diag([1.0, 1, -1, 1]),
        "nan": np.full((4, 4), np.nan),
        "text": "identity",
        "3x3": np.eye(3),
        "shear": np.eye(4) + 0.3 * np.eye(4, k=1),
    }
    assert_answers(cloud, cloud[::-1], {"initial": poses.get(initial)})
