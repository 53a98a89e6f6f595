"""The table of learned methods: which weights meet which pairs, and a record that fits the page."""

import pytest

from benchmarks.paper import columns, peers
from jaxreg.config import Config, DataConfig, PairConfig
from jaxreg.evaluation import methods

pytestmark = pytest.mark.float32


def test_every_method_with_weights_has_a_name_and_every_column_a_configuration():
    known = [name.partition(":")[0] for name in methods.names() if name.endswith(":FILE")]
    for method, (_, weights) in peers.METHODS.items():
        name = peers.name_of(method, "clean", "folder")
        assert bool(name) == (weights == "its authors' weights")
        assert not name or name.partition(":")[0] in known
    name = peers.name_of("cemnet", "jitter", "f")
    assert name == "cemnet:f/cemnet_modelnet40_n768_unseen0_noise1.npz"
    for config, _ in peers.COLUMNS.values():
        assert (columns.CONFIGS / f"{config}.toml").is_file()
    assert peers.PUBLISHED["rienet"] == columns.PAPER_OF_OTHERS["unseen_objects"]["rienet"]


def test_the_record_fits_the_page_and_a_method_without_weights_has_no_figures(records, monkeypatch):
    small = Config(
        data=DataConfig(name="shapes", test_shapes=2), test_pairs=PairConfig(points=48, kept=36)
    )
    monkeypatch.setattr(peers, "load_config", lambda path: small)
    monkeypatch.setattr(peers, "name_of", lambda method, *_: "identity" if method == "dcp" else "")
    peers.main(peers.Options(folder="nowhere", pairs=2))
    assert records.fits("peers")
    rows = records.read("peers")["rows"]
    assert rows["dcp"]["clean_median"] > 1
    assert rows["rpmnet"] == {"label": "RPM-Net", "weights": "not trained here", "paper": 0.0051}
