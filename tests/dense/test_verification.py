import jax.numpy as jnp
import numpy as np

from jaxreg import rigid
from jaxreg.dense.surface import Surface
from jaxreg.dense.verification import Evidence, evidence, plausibility


def plane(shift, openness=0.0, n=21):
    line = np.linspace(-1, 1, n)
    points = np.stack([*np.meshgrid(line, line), np.full((n, n), shift)], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (n * n, 1))
    open_ = np.full(n * n, openness)
    return Surface(*map(jnp.asarray, (points, normals, open_)), jnp.ones(n * n, bool))


WIDTHS = {"width": 0.05, "plane_width": 0.02, "rim": 0.25}


def test_a_shifted_plane_by_its_equations():
    identity = rigid.identity(jnp.float64)
    for shift in (0.0, 0.01, 0.04):
        found = evidence(identity, plane(0.0), plane(shift), **WIDTHS)
        near = np.exp(-(shift**2) / (2 * 0.05**2))
        np.testing.assert_allclose(found.near, 2 * near, rtol=1e-6)
        expected = 2 * near * np.exp(-(shift**2) / (2 * 0.02**2))
        np.testing.assert_allclose(found.match, expected, rtol=1e-6)
        assert found.beside == 0


def test_beside_the_inside_speaks_against_and_beside_a_rim_does_not():
    identity = rigid.identity(jnp.float64)
    np.testing.assert_allclose(
        evidence(identity, plane(0.0), plane(0.2), **WIDTHS).beside, 2, rtol=1e-6
    )
    assert evidence(identity, plane(0.0, 0.4), plane(0.2, 0.4), **WIDTHS).beside == 0
    assert evidence(identity, plane(0.0), plane(0.4), **WIDTHS).beside == 0


def test_padding_counts_for_nothing():
    a, b = plane(0.0), plane(0.01)
    half = a._replace(mask=jnp.arange(441) < 441 - 21)
    cut = Surface(*(field[:-21] for field in a))
    identity = rigid.identity(jnp.float64)
    np.testing.assert_allclose(
        np.array(evidence(identity, half, b, **WIDTHS)),
        np.array(evidence(identity, cut, b, **WIDTHS)),
        rtol=1e-9,
    )


def test_plausibility_is_linear_in_the_evidence():
    found = Evidence(jnp.asarray(1.5), jnp.asarray(1.1), jnp.asarray(0.2))
    np.testing.assert_allclose(plausibility(found, contradiction=0.5, beside=2.0), 1.1 - 0.2 - 0.4)
