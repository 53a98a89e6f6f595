"""Weights of other people's programs: their networks in PyTorch are the oracle.

The right values are those of the authors' network classes (PyTorch 2.13, float64) on the weights and
inputs drawn here. Names and shapes of the arrays are those of their state dicts.
"""

import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import FMRConfig, IDAMConfig, RPMNetConfig
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.evaluation import methods
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.peers import by_name, fmr, idam, rpmnet
from jaxreg.types import PointCloud
from jaxreg.weights.released import load_pretrained

pytestmark = pytest.mark.loose


def draw(name, shape):
    """Weights, drawn by the CRC of their names; RandomState draws the same for ever."""
    random = np.random.RandomState(zlib.crc32(name.encode()))  # noqa: NPY002
    if name.endswith("running_var"):
        return random.uniform(0.5, 1.5, shape)
    values = random.normal(size=shape)
    if len(shape) > 1:
        return values / np.sqrt(shape[1])
    return 0.3 * values + (1.0 if name.endswith("weight") else 0.0)


def drawn(shapes):
    return {name: draw(name, shape) for name, shape in shapes.items()}


def linear(name, into, out, ones=1, bias=True):
    shapes = {f"{name}.weight": (out, into) + (1,) * ones}
    return shapes | ({f"{name}.bias": (out,)} if bias else {})


def norm(name, width, running=True):
    parts = ("weight", "bias", *(("running_mean", "running_var") if running else ()))
    return {f"{name}.{part}": (width,) for part in parts}


def block(name, widths, ones):
    """IDAM's: a linear map without a bias, BatchNorm and ReLU each, then a linear map."""
    shapes = {}
    for i, (into, out) in enumerate(zip(widths[:-2], widths[1:-1], strict=True)):
        shapes |= linear(f"{name}.conv.{i}.conv", into, out, ones, bias=False)
        shapes |= norm(f"{name}.conv.{i}.bn", out)
    return shapes | linear(f"{name}.conv.{len(widths) - 2}", widths[-2], widths[-1], ones)


def idam_shapes():
    shapes = {"head.reflect": (3, 3)}
    for i, into in enumerate((3, 64, 64, 64, 64)):
        shapes |= block(f"emb_nn.propogate{i + 1}.conv2d", (into, 64, 64), 2)
        shapes |= linear(f"emb_nn.propogate{i + 1}.conv1d.conv.0", 64, 64)
    shapes |= block("significance_fc", (64, 64, 32, 1), 1)
    for i in range(3):
        shapes |= block(f"sim_mat_conv1.{i}", (132, 32, 32), 2)
        shapes |= block(f"sim_mat_conv2.{i}", (32, 32, 1), 2)
        shapes |= block(f"weight_fc.{i}", (32, 32, 1), 1)
    return shapes


def rpmnet_shapes():
    shapes = {}
    for name, widths, last, ones in (
        ("weights_net.prepool", (4, 64, 64, 64, 128, 1024), None, 1),
        ("weights_net.postpool", (1024, 512, 256), 2, 0),
        ("feat_extractor.prepool", (10, 96, 96, 192), None, 2),
        ("feat_extractor.postpool", (192, 192, 96), 96, 1),
    ):
        for i, (into, out) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            shapes |= linear(f"{name}.{3 * i}", into, out, ones)
            shapes |= norm(f"{name}.{3 * i + 1}", out, running=False)
        if last:
            shapes |= linear(f"{name}.{3 * (len(widths) - 1)}", widths[-1], last, ones)
    return shapes


def fmr_shapes():
    shapes = {"dt": (1, 6), "decoder.fc1.weight": (1024, 1024)}
    for part, widths in (("h1", (3, 64, 64)), ("h2", (64, 64, 128, 1024))):
        for i, (into, out) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            shapes |= linear(f"encoder.{part}.{3 * i}", into, out)
            shapes |= norm(f"encoder.{part}.{3 * i + 1}", out)
    return shapes


SHAPES = {"idam": idam_shapes, "rpmnet": rpmnet_shapes, "fmr": fmr_shapes}
MODULES = {"idam": idam, "rpmnet": rpmnet, "fmr": fmr}


@pytest.fixture
def saved(tmp_path):
    def save(method, **others):
        path = tmp_path / f"{method}.npz"
        np.savez(path, **(drawn(SHAPES[method]()) | others))
        return path

    return save


def clouds(seed, *sizes):
    random = np.random.RandomState(seed)  # noqa: NPY002
    return [jnp.asarray(random.normal(size=size)) for size in sizes]


def test_idam_finds_the_pose_that_its_authors_program_finds(saved):
    variables, config = idam.load_weights(saved("idam"))
    assert config.network == "idam"
    assert config.idam == IDAMConfig()
    source, reference = clouds(9, (90, 3), (78, 3))
    cloud = PointCloud(source, jnp.ones(90, bool))
    features, significance, _ = idam._described(variables, cloud, config.idam, train=False)
    np.testing.assert_allclose(
        features[2, :4],
        [-0.6552953409690808, -0.7761038718987545, 0.7460302500468731, -0.8084812216153218],
        atol=1e-9,
    )
    np.testing.assert_allclose(
        significance[:4],
        [0.36345142162396465, 0.35812096148946093, 0.29467300356598947, 0.29095569508428243],
        atol=1e-9,
    )
    found = jax.jit(idam.register, static_argnames="config")(
        variables, source, reference, config=config
    )
    np.testing.assert_allclose(
        found.rotation,
        [
            [-0.045156129026574024, 0.4749448447084106, -0.8788562558781943],
            [0.9982677742402725, -0.011759983515538022, -0.05764680130836655],
            [-0.03771438617699398, -0.8799369848305152, -0.4735910976809784],
        ],
        atol=1e-6,
    )
    np.testing.assert_allclose(
        found.translation,
        [-1.0687763036935962, 0.6459882649001985, -0.02107212266745384],
        atol=1e-6,
    )


def test_rpmnet_describes_points_as_its_authors_program_does(saved):
    variables, config = rpmnet.load_weights(saved("rpmnet"))
    assert config.network == "rpmnet"
    assert config.rpmnet == RPMNetConfig()
    parameters, features = rpmnet._networks(config.rpmnet)
    source, reference, channels = clouds(6, (7, 3), (5, 3), (7, 6, 10))
    both = (PointCloud(x, jnp.ones(len(x), bool)) for x in (source, reference))
    alpha, beta = parameters.apply({"params": variables["params"]["parameters"]}, *both)
    np.testing.assert_allclose([alpha, beta], [0.5730015750954405, 0.9800700274021412], atol=1e-9)
    found = features.apply({"params": variables["params"]["features"]}, channels, jnp.ones(7, bool))
    np.testing.assert_allclose(
        found[2, :5],
        [0.1033811942857534, 0.12480987449717355, -0.06634694103439803, 0.19973716513883194,
         0.07083719936287608],
        atol=1e-9,
    )  # fmt: skip
    np.testing.assert_allclose(
        found[6, -3:],
        [-0.05879299885400801, -0.07678393766376934, -0.04493015350211539],
        atol=1e-9,
    )


def test_fmr_encodes_a_cloud_as_its_authors_program_does(saved):
    variables, config = fmr.load_weights(saved("fmr"))
    assert config.network == "fmr"
    assert config.fmr == FMRConfig()
    (points,) = clouds(6, (7, 3))
    found = fmr.encode(variables, PointCloud(points, jnp.ones(7, bool)), config=config.fmr)
    np.testing.assert_allclose(
        found[:6],
        [0.2102231770851733, 0.0, 0.6069085368839906, 0.5175185191444659, 0.6928695227251018, 0.0],
        atol=1e-9,
    )
    np.testing.assert_allclose(found[-2:], [0.29163914908956484, 0.0], atol=1e-9)
    np.testing.assert_allclose(variables["params"]["steps"][0], -0.17799397026315625, rtol=1e-12)


def test_widths_are_those_of_the_arrays(saved):
    shapes = idam_shapes()
    arrays = drawn({name: shape for name, shape in shapes.items() if "_conv" not in name})
    for i in range(3):
        for part, widths, ones in (
            ("sim_mat_conv1", (132, 16, 16), 2),
            ("sim_mat_conv2", (16, 16, 1), 2),
            ("weight_fc", (16, 16, 1), 1),
        ):
            arrays |= drawn(block(f"{part}.{i}", widths, ones))
    path = saved("idam", **arrays)
    assert idam.load_weights(path)[1].idam == IDAMConfig(hidden=16)


@pytest.mark.parametrize("method", MODULES)
def test_names_of_data_parallel_are_the_same(method, saved, tmp_path):
    plain = MODULES[method].load_weights(saved(method))
    with np.load(tmp_path / f"{method}.npz") as file:
        wrapped = {f"module.{name}": file[name] for name in file.files}
    np.savez(tmp_path / "wrapped.npz", **wrapped)
    found = MODULES[method].load_weights(tmp_path / "wrapped.npz")
    jax.tree.map(np.testing.assert_array_equal, plain[0], found[0])
    assert plain[1] == found[1]


@pytest.mark.parametrize("method", MODULES)
def test_released_weights_find_the_pose_of_a_copy(method):
    """As they are loaded: a network without statistics has none in its file."""
    variables, config = load_pretrained(method)
    source = jnp.asarray(sample_shape(5, 9, points=512))
    turn = jnp.asarray(Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix(), source.dtype)
    found = by_name.register(variables, source, source @ turn.T + 0.1, config=config)
    assert found.valid
    assert rotation_angle_deg(np.asarray(found.rotation), np.asarray(turn)) < 10


@pytest.mark.parametrize("method", MODULES)
def test_they_are_methods_by_their_names(method, saved):
    path = saved(method)
    _, config = methods.load_network_of(f"{method}:{path}")
    assert config.network == method
    assert f"{method}:FILE" in methods.names()


@pytest.mark.parametrize(
    ("method", "name", "whose"),
    [
        ("idam", "emb_nn.propogate3.conv1d.conv.0.bias", "IDAM"),
        ("idam", "emb_nn.propogate3.conv1d.conv.0.weight", "IDAM"),
        ("idam", "sim_mat_conv1.1.conv.0.conv.weight", "IDAM"),
        ("idam", "weight_fc.2.conv.0.bn.running_mean", "IDAM"),
        ("rpmnet", "weights_net.postpool.4.bias", "RPM-Net"),
        ("rpmnet", "feat_extractor.prepool.7.weight", "RPM-Net"),
        ("fmr", "dt", "FMR"),
        ("fmr", "encoder.h2.6.weight", "FMR"),
    ],
)
def test_an_array_that_is_missing_or_of_another_shape_is_named(method, name, whose, tmp_path):
    arrays = drawn(SHAPES[method]())
    np.savez(tmp_path / "odd.npz", **(arrays | {name: np.zeros((5,) * arrays[name].ndim)}))
    with pytest.raises(ValueError, match=rf"odd\.npz.*give {whose}'s whole"):
        MODULES[method].load_weights(tmp_path / "odd.npz")
    arrays.pop(name)
    np.savez(tmp_path / "lacks.npz", **arrays)
    with pytest.raises(ValueError, match=rf"lacks\.npz has no array .*: give {whose}'s whole"):
        MODULES[method].load_weights(tmp_path / "lacks.npz")
    with pytest.raises(ValueError, match=rf"no such file; give the \.npz of {whose}'s state dict"):
        MODULES[method].load_weights(tmp_path / "nowhere.npz")
