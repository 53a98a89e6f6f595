"""Tuning of a spacing: a spacing that finds nothing leaves the identity, a good one the copies."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.paper import tune_baselines
from jaxreg.config import PairConfig
from jaxreg.data.batches import pair_batches, true_transforms, validation_key
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.evaluation import methods

pytestmark = pytest.mark.float32


@pytest.fixture
def shapes():
    return np.stack([sample_shape(4, i, points=1024) for i in (7, 16)])


def test_a_spacing_without_partners_is_as_wrong_as_the_identity(shapes):
    pytest.importorskip("open3d", reason="the baselines are not installed", exc_type=ImportError)
    nothing = tune_baselines.evaluate("open3d_icp", 1e-6, shapes, 0)
    good = tune_baselines.evaluate("open3d_fgr_gicp", 0.05, shapes, 0)
    pairs = pair_batches(shapes, validation_key(0), config=PairConfig(), batch=8)
    angles = np.degrees(Rotation.from_matrix(true_transforms(pairs).rotation).magnitude())
    assert nothing["mie_r_deg"] == pytest.approx(angles.mean(), rel=1e-3)
    assert good["mie_r_deg"] < 0.1


def test_the_record_has_a_row_a_method_and_two_columns_a_spacing(records, monkeypatch, shapes):
    """Every method and spacing meets the same pairs."""
    met = []

    def choose(name):
        def batch(pair):
            met.append((name, np.asarray(pair.source.points).tobytes()))
            return methods.identity_method(pair)

        return methods.Method(batch, None)

    monkeypatch.setattr(methods, "choose", choose)
    monkeypatch.setattr(tune_baselines, "load_shapes", lambda *a, **k: (shapes, None))
    tune_baselines.main(tune_baselines.Options(pairs=2))
    entry = records.read("tune_baselines")
    assert records.fits("tune_baselines")
    assert len({pair for _, pair in met}) == 1
    assert {name for name, _ in met} == {
        f"{name}@{spacing}"
        for name in tune_baselines.METHODS
        for spacing in ("0.02", "0.035", "0.05", "0.07", "0.1")
    }
    keys = [f"{x}_{y}" for x in ("s02", "s035", "s05", "s07", "s10") for y in ("mae_r", "recall")]
    assert list(entry["columns"]) == keys
    assert entry["columns"]["s05_mae_r"] == "0.05 (default): MAE(R)"
    assert list(entry["rows"]) == ["icp", "icp_coarse_to_fine", "fgr", "fgr_gicp"] + [
        "ransac",
        "ransac_gicp",
    ]
    assert all(row["s07_recall"] == 0 for row in entry["rows"].values())
