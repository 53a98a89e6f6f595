"""Protocols and curves: the same pairs for every method, and known answers for those that know."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import record
from benchmarks.scans import curves, protocols
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.evaluation import methods

pytestmark = pytest.mark.float32


@pytest.fixture(scope="module")
def shapes():
    clouds = np.stack([sample_shape(3, i, points=64) for i in range(4)])
    return protocols.Shapes(clouds, np.array(["chair", "vase", "table", "sofa"]))


@pytest.fixture
def chosen(monkeypatch):
    """The pairs that each method has met; `truth` knows them all."""
    met, real = {}, methods.choose

    def choose(name):
        batch = (lambda pair: pair.transform) if name == "truth" else real(name).batch

        def recorded(pair):
            met.setdefault(name, []).append(jax.tree.map(np.asarray, pair))
            return batch(pair)

        return methods.Method(recorded, None)

    monkeypatch.setattr(methods, "choose", choose)
    return met


def test_methods_meet_the_same_pairs_and_their_recall_is_known(shapes, chosen):
    options = protocols.Options(
        methods=("truth", "identity"), protocols=("resampled", "crops50"), pairs=6, seeds=(3, 4)
    )
    found = protocols.measure(shapes, options)
    once = 2 * (6 + 1)  # Two protocols; the first pair of each compiles.
    assert len(chosen["truth"]) == 2 * once, "the first method meets every seed"
    assert len(chosen["identity"]) == once
    for one, other in zip(chosen["truth"][:once], chosen["identity"], strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)
    for cells in (protocols.cells(x, options) for x in found.values()):
        assert cells["mean_1deg"] == cells["seed3_5deg"] == cells["all_1deg"] == 1
        assert cells["identity_5deg"] == 0
    # Any rotation: the error of the identity is the angle of the truth.
    errors = found["resampled"]["identity", 3].errors.rre_deg
    turns = [pair.transform.rotation[0] for pair in chosen["identity"][1:7]]
    angles = np.degrees(Rotation.from_matrix(np.stack(turns)).magnitude())
    np.testing.assert_allclose(errors, angles, atol=1e-3)
    assert angles.max() > 78, "as no three angles of 45 degrees give"


def test_clouds_share_no_point_and_crops_keep_their_share(shapes):
    config = protocols.pairs_of("crops50")
    drawn = list(protocols.draw_pairs(config, shapes, pairs=5, seed=0, turned=True))
    assert [int(shape) for shape, _ in drawn] == [
        *np.random.default_rng(0).permutation(4),
        drawn[0][0],
    ]
    for _, pair in drawn:
        source, reference = (np.asarray(x.points) for x in pair[:2])
        assert len(source) == round(config.kept / config.points * 32)
        moved = source @ np.asarray(pair.transform.rotation).T + np.asarray(
            pair.transform.translation
        )
        apart = np.linalg.norm(moved[:, None] - reference[None], axis=2)
        assert apart.min() > 1e-4
        # Both are of the shape, whose points are apart by no more than this.
        assert np.median(apart.min(axis=1)) < 0.5


def test_the_mean_is_over_pairs_and_leaves_out_the_symmetric_shapes():
    def found(right, symmetric):
        angle = np.where(right, 0.5, 9.0)
        nothing = np.zeros(len(right))
        errors = protocols.PairErrors(None, angle, None, None, nothing)
        return protocols.Found(errors, np.array(symmetric), np.full(len(right), 20.0), 32)

    first = found([True, True, False, False], [False, True, False, True])
    second = found([True, True, True, True], [False, False, False, True])
    options = protocols.Options(methods=("register_global",), seeds=(1, 2))
    cells = protocols.cells(
        {("register_global", 1): first, ("register_global", 2): second}, options
    )
    assert (cells["seed1_1deg"], cells["all_1deg"], cells["seed2_1deg"]) == (0.5, 0.5, 1)
    assert cells["mean_1deg"] == pytest.approx(4 / 5)
    assert cells["jaxreg_ms"] == 20


def test_the_table_of_the_protocols_fits_the_page(shapes, chosen, records, monkeypatch):
    monkeypatch.setitem(protocols.KEYS, "truth", "jaxreg")
    monkeypatch.setitem(protocols.KEYS, "identity", "learned")
    monkeypatch.setattr(protocols, "read_shapes", lambda *_: shapes)
    protocols.main(protocols.Options(methods=("truth", "identity"), pairs=3))
    entry = records.read("protocols")
    assert records.fits("protocols")
    assert list(entry["rows"]) == list(protocols.PROTOCOLS)
    assert entry["rows"]["crops70"]["mean_5deg"] == 1
    assert entry["rows"]["crops70"]["learned_5deg"] == 0
    kept = sum(
        shapes.categories[i] != "vase"
        for seed in (11, 17, 19)
        for i in np.random.default_rng(seed).permutation(4)[:3]
    )
    assert entry["setting"]["kept"] == kept
    assert entry["setting"]["points"] == 24
    assert entry["setting"]["error_at_50"] == pytest.approx(np.sqrt(0.25 / kept), abs=5e-4)


def test_curves_grow_harder_in_one_way(shapes, chosen, records, tmp_path, monkeypatch):
    for curve, steps in curves.CURVES.items():
        configs = [curves.pairs_of(curve, hardness) for hardness in steps]
        for one, other in zip(configs, configs[1:], strict=False):
            fields = dataclasses.asdict(one).items() ^ dataclasses.asdict(other).items()
            names = {name for name, _ in fields}
            assert (
                names
                == {
                    "overlap": {"kept"},
                    "jitter": {"jitter", "jitter_clip"},
                    "outliers": {"outliers"},
                }[curve]
            )
    half = curves.pairs_of("outliers", 0.5)
    assert half.outliers == half.kept
    monkeypatch.setattr(curves, "CURVES", {k: v[:: len(v) - 1] for k, v in curves.CURVES.items()})
    monkeypatch.setattr(protocols, "read_shapes", lambda *_: shapes)
    options = curves.Options(methods=("truth", "identity"), pairs=3, seed=5, pictures=str(tmp_path))
    curves.main(options)
    entry = records.read("curves")
    expected = ["crops_95", "crops_45", "full_overlap", "jitter_04", "outliers_00", "outliers_50"]
    assert list(entry["rows"]) == expected
    assert all(
        row["truth_1deg"] == 1 and row["identity_5deg"] == 0 for row in entry["rows"].values()
    )
    assert {path.stem for path in tmp_path.glob("*.png")} == set(curves.CURVES)


def test_the_steps_of_the_curves_have_the_names_of_the_page(records):
    found = protocols.Found(
        protocols.PairErrors(*[np.zeros(2)] * 5), np.zeros(2, bool), np.ones(2), 32
    )
    options = curves.Options()
    steps = {
        (name, curve, hardness): found
        for name in options.methods
        for curve, hardnesses in curves.CURVES.items()
        for hardness in hardnesses
    }
    curves.write(steps, options)
    assert records.fits("curves")


@pytest.mark.parametrize("name", ["weights:modelnet40", "open3d_ransac_icp@0.05"])
def test_any_method_has_a_column(name):
    assert protocols.column_key(name) == record.key(name)
    assert record.key(name).isidentifier()
