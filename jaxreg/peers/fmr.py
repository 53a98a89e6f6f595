"""FMR, feature-metric registration (Huang, Mei and Zhang, CVPR 2020): no correspondences at all.

An encoder makes one feature of a whole cloud. The pose is that at which the moved source has the
feature of the reference: a nonlinear least-squares problem, solved as PointNetLK does (Aoki, Goforth,
Srivatsan and Lucey, CVPR 2019), by inverse compositional Gauss-Newton (Lucas and Kanade). A decoder,
which only the training needs, makes points of the feature again, so that it describes the shape.

What it cannot do. Both clouds have to show *all* of the same object: a feature of a part is another
one, so crops and outliers break it, and so do the centroids, about which it turns the clouds. The
reference's feature is linearised once, so the rotation between the clouds has to be moderate (the
authors train with twists up to 0.8). Clouds need about the size of those it was trained on. The
decoder makes a fixed number of points, whatever the number of the cloud's.
"""

from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxreg._xla import on_any_mesh
from jaxreg.config import Config, FMRConfig
from jaxreg.geometry import rigid, se3
from jaxreg.geometry.neighbors import nearest_in, without_padding
from jaxreg.geometry.numerics import leading_max, safe_norm
from jaxreg.geometry.small_linear import pseudo_inverse
from jaxreg.network.features import BatchNorm
from jaxreg.network.model import Variables
from jaxreg.network.run import run_network
from jaxreg.peers import pair, state_dict
from jaxreg.types import PointCloud, Registration, RigidTransform

_FIRST_STEP = 1e-2
_LARGEST_INCREMENT = 2.0
"""Length of a twist (radians, and units of the unit sphere) beyond which no linearisation holds."""


class Iterations(NamedTuple):
    """The pose, and the feature-metric projection error before each iteration and after the last."""

    transform: RigidTransform
    errors: Float[Array, "i"]


class _Encoder(nn.Module):
    """PointNet: the same layers for every point, then the largest value of every channel."""

    channels: tuple[int, ...]
    bn_momentum: float

    @nn.compact
    def __call__(
        self, points: Float[Array, "n 3"], mask: Bool[Array, "n"], *, train: bool
    ) -> Float[Array, "c"]:
        x = points
        for width in self.channels:
            x = nn.relu(BatchNorm(self.bn_momentum)(nn.Dense(width)(x), mask, train=train))
        # What passed a ReLU is not negative: zero leaves the maximum as it is.
        return leading_max(jnp.where(mask[:, None], x, 0))


class _Decoder(nn.Module):
    """Points in the cube from -1 to 1 that have the given feature."""

    hidden: tuple[int, ...]
    points: int

    @nn.compact
    def __call__(self, feature: Float[Array, "c"]) -> Float[Array, "p 3"]:
        x = feature
        for width in self.hidden:
            x = nn.leaky_relu(nn.Dense(width)(x))
        return nn.tanh(nn.Dense(3 * self.points)(x)).reshape(self.points, 3)


@on_any_mesh
def register(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config | FMRConfig,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """Register two clouds with FMR; pure: jit, vmap and differentiate it.

    ``argmin_g |F(g source) - F(reference)|^2`` about the centroids. `confidence` is 1 for every valid
    point, since the method knows no single ones; `correspondences` are the reference points nearest
    to the moved source.

    Clouds should be in the unit sphere and overlap in full. Padding and empty clouds are as in
    `jaxreg.register_pair`.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` of float32 or float64; a mask is not ``(n,)`` of bools;
        `config` is not that of FMR.
    """
    config = pair.settings(config, "fmr", FMRConfig)
    moving, fixed = pair.clouds(source, reference, source_mask, reference_mask)
    variables = pair.in_dtype(variables, moving.points.dtype)
    found = align_features(variables, moving, fixed, config=config)
    every = moving.mask.astype(moving.points.dtype)
    return pair.registration(found.transform, moving, fixed, every)


def init_variables(key: PRNGKeyArray, config: FMRConfig) -> Variables:
    """Random initial `params` and `batch_stats`."""
    encoder, decoder = _networks(config)
    points, mask = jnp.ones((2, 3), jnp.float32), jnp.ones(2, bool)
    feature = jnp.ones(config.channels[-1], jnp.float32)
    first = encoder.init(jax.random.fold_in(key, 0), points, mask, train=False)
    second = decoder.init(jax.random.fold_in(key, 1), feature)
    found = state_dict.joined({"encoder": first})
    found["params"] |= {
        "decoder": second["params"],
        "steps": jnp.full(6, _FIRST_STEP, jnp.float32),
    }
    return found


def _networks(config: FMRConfig) -> tuple[Any, Any]:
    encoder = _Encoder(config.channels, config.bn_momentum)
    return encoder, _Decoder(config.hidden, config.decoded)


def encode(variables: Variables, cloud: PointCloud, *, config: FMRConfig) -> Float[Array, "c"]:
    """F of a whole cloud, whatever the order of its points."""
    inputs = cloud.points, cloud.mask
    return run_network(_networks(config)[0], "encoder", variables, *inputs, train=False)[0]


def decode(
    variables: Variables, feature: Float[Array, "c"], *, config: FMRConfig
) -> Float[Array, "p 3"]:
    """A cloud of the given feature, of `config.decoded` points."""
    return _networks(config)[1].apply({"params": variables["params"]["decoder"]}, feature)


def align_features(
    variables: Variables, source: PointCloud, reference: PointCloud, *, config: FMRConfig
) -> Iterations:
    """Inverse compositional Gauss-Newton on the feature-metric projection error.

    With ``r = F(g source) - F(reference)`` and J the derivative of ``F(exp(-xi) reference)``:
    ``xi = (J^T J)^-1 J^T r`` and ``g <- exp(xi) g``, from the identity about both centroids. J is that
    of the reference alone, so its pseudo-inverse is made once. `errors` are ``|r|^2``.

    The authors stop where an increment is below 1e-7; here the number of iterations is fixed, and such
    increments change nothing. One that is longer than 2 is shortened to that.
    """
    moving, fixed = centred(source), centred(reference)
    target = encode(variables, fixed, config=config)
    inverse = left_inverse(twist_jacobian(variables, fixed, config=config))

    def residual(pose: RigidTransform) -> Float[Array, "c"]:
        moved = moving._replace(points=rigid.apply(pose, moving.points))
        return encode(variables, moved, config=config) - target

    def iteration(pose: RigidTransform, _):
        error = residual(pose)
        increment = jnp.matmul(inverse, error, precision=Precision.HIGHEST)
        increment *= _LARGEST_INCREMENT / jnp.maximum(safe_norm(increment), _LARGEST_INCREMENT)
        return rigid.compose(se3.exp(increment), pose), jnp.sum(error**2)

    # An iteration is computed again in the backward pass: its layers are the most memory by far.
    iteration = jax.checkpoint(iteration, prevent_cse=False)
    start = pair.identity_of(source, reference)
    pose, errors = jax.lax.scan(iteration, start, length=config.iterations)
    errors = jnp.append(errors, jnp.sum(residual(pose) ** 2))
    before, after = (
        RigidTransform(start.rotation, sign * centroid(cloud))
        for sign, cloud in ((-1, source), (1, reference))
    )
    return Iterations(rigid.compose(after, rigid.compose(pose, before)), errors)


def centroid(cloud: PointCloud) -> Float[Array, "3"]:
    """Mean of the valid points, whose padding is zero; zero if there are none."""
    count = jnp.sum(cloud.mask, dtype=cloud.points.dtype)
    return jnp.sum(cloud.points, axis=0) / jnp.maximum(count, 1)


def centred(cloud: PointCloud) -> PointCloud:
    """The cloud about its centroid, its padding at zero."""
    points = cloud.points - centroid(cloud)[None, :]
    return cloud._replace(points=without_padding(points, cloud.mask))


def twist_jacobian(
    variables: Variables, cloud: PointCloud, *, config: FMRConfig
) -> Float[Array, "c 6"]:
    """J by finite differences: column i is ``(F(exp(-s_i e_i) cloud) - F(cloud)) / s_i``.

    e_i are the twists, rotations first (radians). The six steps s_i are learned: a maximum over points
    has a derivative that hangs on one point of each channel, a difference looks further.
    """
    steps = variables["params"]["steps"]

    def feature(twist: Float[Array, "6"]) -> Float[Array, "c"]:
        moved = cloud._replace(points=rigid.apply(se3.exp(twist), cloud.points))
        return encode(variables, moved, config=config)

    apart = jax.vmap(feature)(-jnp.diag(steps)) - encode(variables, cloud, config=config)[None, :]
    return (apart / steps[:, None]).T


def left_inverse(jacobian: Float[Array, "c 6"]) -> Float[Array, "6 c"]:
    """``(J^T J)^+ J^T``, whose product with r is the shortest least-squares solution of ``J xi = r``.

    What moves no feature, as a turn about the axis of a bottle, gets no increment.
    """
    gram = jnp.matmul(jacobian.T, jacobian, precision=Precision.HIGHEST)
    return jnp.matmul(pseudo_inverse(gram), jacobian.T, precision=Precision.HIGHEST)


def chamfer_distance(cloud: PointCloud, others: PointCloud) -> Float[Array, ""]:
    """Mean squared distance of valid points to the nearest valid one of the other cloud, both ways."""

    def one_way(cloud: PointCloud, others: PointCloud) -> Float[Array, ""]:
        nearest = others.points[nearest_in(cloud.points, others.points, others.mask)]
        squared = jnp.sum((cloud.points - nearest) ** 2, axis=1)
        count = jnp.maximum(jnp.sum(cloud.mask, dtype=squared.dtype), 1)
        return jnp.sum(jnp.where(cloud.mask, squared, 0)) / count

    return one_way(cloud, others) + one_way(others, cloud)


def loss(
    variables: Variables,
    source: PointCloud,
    reference: PointCloud,
    truth: RigidTransform,
    *,
    config,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]], Variables]:
    """The loss of a pair, its terms, and the variables with updated statistics.

    * `chamfer`: of each centred cloud and what the decoder makes of its feature, added;
    * `pose`, if `config.supervision` is "semi-supervised": ``|g g_true^-1 - I|^2`` (Frobenius), which
      sees the pose. Without it the method learns from the clouds alone.

    The iterations take the running statistics from before this step, which are constants.
    """
    clouds = pair.clouds(source.points, reference.points, source.mask, reference.mask)
    before, encoder = variables, _networks(config)[0]
    total = jnp.zeros((), source.points.dtype)
    for cloud in map(centred, clouds):
        feature, variables = run_network(encoder, "encoder", variables, *cloud, train=True)
        decoded = decode(variables, feature, config=config)
        decoded = PointCloud(decoded, jnp.ones(decoded.shape[0], bool))
        total += chamfer_distance(decoded, cloud)
    if config.supervision == "unsupervised":
        return total, {"chamfer": total}, variables
    found = align_features(before, *clouds, config=config).transform
    gap = rigid.to_matrix(rigid.compose(found, rigid.inverse(truth)))
    pose = jnp.sum((gap - jnp.eye(4, dtype=gap.dtype)) ** 2)
    return total + pose, {"chamfer": total, "pose": pose}, variables


def load_weights(path: str | Path) -> tuple[Variables, Config]:
    """Load weights of the authors' program, an ``.npz`` of its state dict; PyTorch is not needed.

    The decoder, which only the training needs, is left out: its layers are of another kind. Widths
    are those of the arrays, the rest of the configuration is the default.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array of the network is missing or has
        another shape.
    """
    variables, config = state_dict.load(path, "FMR", _read_state_dict, init_variables)
    return variables, Config(network="fmr", fmr=config)


def _read_state_dict(arrays: state_dict.Arrays) -> tuple[Variables, FMRConfig]:
    names = [("encoder.h1", i) for i in (0, 3)] + [("encoder.h2", i) for i in (0, 3, 6)]
    layers = [(f"{part}.{i}", f"{part}.{i + 1}") for part, i in names]
    variables = state_dict.joined({"encoder": state_dict.dense_and_norm(arrays, layers)})
    variables["params"]["steps"] = jnp.asarray(arrays["dt"]).reshape(-1)
    kernels = (variables["params"]["encoder"][f"Dense_{i}"]["kernel"] for i in range(len(layers)))
    return variables, FMRConfig(channels=tuple(kernel.shape[1] for kernel in kernels))
