"""Every default of the library, in one place, and how files and the command line change it.

A TOML file lists only what differs from the defaults::

    weights = "modelnet40"
    [model]
    k = 8

``--model.k 12`` on the command line overrides the file. Each field gives its symbol in the paper.
"""

import dataclasses
import difflib
import math
import re
import sys
import tomllib
import typing
from pathlib import Path
from typing import Any, Literal


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network. Where the paper is ambiguous, a field selects the reading."""

    k: int = 5
    """K: neighbours of a point, itself excluded, in the features and the inlier module."""
    k_matching: int = 5
    """K of the neighbourhood sum in Eq. 4."""
    include_self: bool = False
    """Also count the point itself, first, as RIENet does."""
    channels: tuple[int, ...] = (32, 32, 64, 128)
    """Widths of the DGCNN layers."""
    width: int = 256
    """C, width of the local features."""
    alpha: float = 0.7
    """alpha of Eq. 5."""
    one_nn: Literal["gather", "own", "self", "none"] = "gather"
    """1-NN patch. `gather`: features of the 1-NN cloud are those of the same points in the input
    cloud. `own`: graph and features are computed in the 1-NN cloud itself. `self`: every point is its
    own 1-NN (control). `none`: single neighbourhood (RIENet)."""
    edge: Literal["vector", "length", "coordinates"] = "vector"
    """e of Eq. 7: the edge vector, its length (invariant to rotation), or the raw neighbour
    coordinates (the paper's ablation without geometric invariants)."""
    angles: Literal["all", "next", "none"] = "next"
    """Pairs (r, s) of the angles in Eq. 7: to every other edge, to the next edge, or no angle. The
    paper does not say which; `next` withstood outliers better with every seed (docs/notes/0009)."""
    inlier_network: Literal["paper", "rienet"] = "paper"
    """Eq. 9-11 as written, or RIENet's convolution along the ordered neighbours."""
    inlier_width: int = 8
    """Width of the inlier networks' first layer; the second is twice as wide."""
    n_inliers: int = 256
    """N_c, correspondences kept by confidence (Eq. 12)."""
    svd: Literal["top", "all"] = "top"
    """Points of the weighted Procrustes: the top N_c (paper) or all of them (RIENet)."""
    robust_rounds: int = 0
    """How often each weighted Procrustes is solved again with less weight on pairs that do not fit
    (0 in the paper). For inference."""
    iterations: int = 3
    """N_l, registration steps."""
    bn_momentum: float = 0.9
    """Share of the old running statistics that BatchNorm keeps at a training step."""


@dataclasses.dataclass(frozen=True)
class DCPConfig:
    """DCP v1 (Wang and Solomon, 2019); the sizes are those of its released weights."""

    k: int = 20
    """Neighbours of a point in its graph; the point itself is the first."""
    channels: tuple[int, ...] = (64, 64, 128, 256)
    """Widths of the DGCNN layers."""
    width: int = 512
    """Width of the embedding."""


@dataclasses.dataclass(frozen=True)
class CEMNetConfig:
    """CEMNet (Jiang et al., 2021); the sizes are those of its released weights."""

    k: int = 20
    """Neighbours of a point in its graph; the point itself is the first."""
    channels: tuple[int, ...] = (64, 64, 128, 256)
    """Widths of the DGCNN layers."""
    width: int = 512
    """Width of the embedding."""
    hidden: tuple[int, ...] = (128, 64)
    """Widths of the layers that predict sigma."""
    iterations: int = 10
    """Rounds of the cross-entropy method."""
    candidates: int = 1000
    """Poses drawn in a round."""
    look_ahead: int = 3
    """First rounds, whose errors also count what three steps of ICP make of a pose."""
    future: float = 0.5
    """Share of that in these errors."""
    exploration: float = 0.5
    """How far the predicted distribution is mixed with a wide one about no motion at all."""
    epsilon: float = 0.1
    """Distance at which a point no longer agrees (in the unit of the clouds)."""
    stride: int = 6
    """In the rounds that look ahead every so many points are scored; afterwards all are."""
    reach: int = 16
    """Points of the other cloud that are looked at in the later rounds: those nearest to a point at
    the mean pose."""
    seed: int = 0
    """Seed of the poses that are drawn."""


@dataclasses.dataclass(frozen=True)
class IDAMConfig:
    """IDAM (Li et al., 2020), with the features of its graph network."""

    k: int = 12
    """Neighbours of a point in its graph; the point itself is the first."""
    channels: tuple[int, ...] = (64, 64, 64, 64, 64)
    """Widths of the layers of the graph network; the last is that of the features."""
    significance: tuple[int, ...] = (64, 32)
    """Widths of the layers that tell the significance of a point, before the last."""
    hidden: int = 32
    """Width of the similarity and weight networks."""
    kept_one_in: int = 6
    """Hard elimination keeps one point in so many of the source."""
    iterations: int = 3
    """Registration steps; each has its own similarity and weight networks."""
    match_distance: float = 0.05
    """In training two points closer than this at the true pose correspond."""
    bn_momentum: float = 0.9
    """Share of the old running statistics that BatchNorm keeps at a training step."""


@dataclasses.dataclass(frozen=True)
class RPMNetConfig:
    """RPM-Net (Yew and Lee, 2020)."""

    radius: float = 0.3
    """Radius of a neighbourhood, in the unit of the clouds."""
    neighbors: int = 64
    """Points of a neighbourhood: the first so many of the cloud within the radius."""
    width: int = 96
    """Width of the features; a multiple of 16."""
    hidden: tuple[int, ...] = (64, 64, 64, 128, 1024, 512, 256)
    """Widths of the network that predicts alpha and beta: all but the last two before its pooling."""
    k_normals: int = 16
    """Neighbours of the plane that gives a point its normal."""
    sinkhorn: int = 5
    """Normalisations of rows and columns."""
    iterations: int = 5
    """Registration steps."""
    train_iterations: int = 2
    """Registration steps in training."""
    inliers: float = 0.01
    """Weight of the loss on points without a partner."""


@dataclasses.dataclass(frozen=True)
class FMRConfig:
    """FMR (Huang et al., 2020)."""

    channels: tuple[int, ...] = (64, 64, 64, 128, 1024)
    """Widths of the encoder's layers; the last is that of the feature."""
    hidden: tuple[int, ...] = (1024, 512, 256)
    """Widths of the decoder's layers before the last."""
    decoded: int = 2048
    """Points that the decoder makes."""
    iterations: int = 10
    """Gauss-Newton iterations."""
    supervision: Literal["semi-supervised", "unsupervised"] = "semi-supervised"
    """Whether its loss also sees the true pose."""
    bn_momentum: float = 0.9
    """Share of the old running statistics that BatchNorm keeps at a training step."""


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """The four losses of Eq. 14-18, summed over points, averaged over pairs."""

    global_consistency: float = 1.0
    """Weight of L_gc (1 in the paper; 0 in its ablation)."""
    gamma: float = 1.0
    """Weight of L_in, dual neighbourhood consistency."""
    rho: float = 1.0
    """Weight of L_gs, geometric structure consistency."""
    lambda_: float = 1.0
    """Weight of L_sc, spatial consistency."""
    pose: float = 0.0
    """Weight of the distances to where the true pose takes the source: not part of the
    (unsupervised) method. For pairs that share no point, on which the four losses alone learn
    little."""
    beta: float = 0.01
    """beta of the Huber function in L_gc, applied to squared distances."""
    l_in: Literal["unsquared", "squared"] = "unsquared"
    """L_in with Euclidean norms (paper) or squared: keypoint term + neighbour term / K."""
    l_sc: Literal["G", "F"] = "G"
    """Map whose peak L_sc sharpens: the dual neighbourhood map (paper) or the final map."""


@dataclasses.dataclass(frozen=True)
class PairConfig:
    """How two clouds to register are made from one shape."""

    points: int = 1024
    """Points taken from a shape before the crop."""
    crop: Literal["viewpoint", "half-space", "none"] = "viewpoint"
    """Keep the points nearest to one far viewpoint, or on one side of a plane with a random normal."""
    kept: int = 768
    """Points of each cloud after the crop."""
    independent_crops: bool = False
    """Crop each cloud independently, instead of with one shared viewpoint or plane."""
    sampling: Literal["copy", "disjoint"] = "copy"
    """`copy`: both clouds have the same points. `disjoint`: they share none; each takes one half of
    the shape's points, or its own draw from a dense cloud."""
    rotation: Literal["euler", "axis-angle", "full"] = "euler"
    """Three Euler angles, an axis and an angle, or a uniformly random rotation."""
    rotation_max_deg: float = 45.0
    """Upper end of each angle's range, which starts at 0."""
    translation_max: float = 0.5
    """Half width of the range of each coordinate of the translation."""
    jitter: float = 0.0
    """Standard deviation of the noise on every point."""
    jitter_clip: float = 0.05
    """Largest magnitude of that noise."""
    outliers: int = 0
    """Points appended to each cloud after the crop: random points of it + N(0, 0.5) clipped to 1."""


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Where the shapes come from."""

    name: Literal["modelnet40", "shapes", "folder", "seven_scenes", "icl_nuim"] = "modelnet40"
    """Source: `shapes` is procedural and needs no file, `folder` means your own files."""
    folder: str = ""
    """The folder of your own files: PLY, PCD, XYZ, ... (`jaxreg.io`), with or without train/ and
    test/."""
    test_share: float = 0.2
    """Share of these files, the last ones, to test on if there is no test/."""
    train_categories: Literal["all", "first20", "last20"] = "all"
    """ModelNet40 labels to train on."""
    test_categories: Literal["all", "first20", "last20"] = "all"
    """ModelNet40 labels to test on."""
    validation_share: float = 0.05
    """Share of the training shapes held out to choose the best checkpoint."""
    train_shapes: int = 2048
    """Procedural shapes to train on."""
    test_shapes: int = 256
    """Procedural shapes to test on."""
    train_draws: int = 1
    """Draws of points from every 7Scenes fragment to train on; each draw is a shape."""
    test_draws: int = 1
    """Draws of points from every 7Scenes fragment to test on (one in the published protocol)."""
    test_pairs_from: Literal["shapes", "file"] = "shapes"
    """`shapes`: test pairs are made from single shapes. `file`: the pairs that ICL-NUIM comes with,
    in the poses it gives."""
    label: str = ""
    """Name of the test data in tables; empty: chosen from what is on disk."""
    test_seed: int = 0
    """Seed of the test pairs; separate from the training's, so all runs see the same pairs."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """The optimiser, its schedule and validation."""

    steps: int = 6000
    """Optimiser steps."""
    batch: int = 8
    """Pairs per step."""
    learning_rate: float = 1e-3
    """Peak of the schedule: linear warm-up, then cosine decay to `final_learning_rate`."""
    final_learning_rate: float = 1e-5
    """End of the schedule."""
    warmup: int = 100
    """Steps of warm-up."""
    weight_decay: float = 1e-4
    """L2 term inside Adam (RIENet's)."""
    clip: float = 1000.0
    """Largest global norm of the gradient."""
    ema: float = 0.99
    """Decay of the running average of the weights; the average is what is validated and
    released."""
    validate_every: int = 250
    """Steps between validations (and checkpoints)."""
    validation_pairs: int = 64
    """Pairs per validation."""
    start: str = ""
    """Weights to start from: released ones by their name, or the folder of a run; empty: random
    ones. `jaxreg train ... --weights NAME` sets it."""
    seed: int = 0
    """The one seed; everything random derives from it."""


@dataclasses.dataclass(frozen=True)
class Config:
    """A whole experiment: network, losses, pairs, data and training."""

    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    pairs: PairConfig = PairConfig()
    """Pairs to train on; and to test on, if a file has no `[test_pairs]`."""
    test_pairs: PairConfig = PairConfig()
    """Pairs to test on. A file's `[test_pairs]` starts from its `[pairs]` and lists what
    differs."""
    data: DataConfig = DataConfig()
    train: TrainConfig = TrainConfig()
    network: Literal["paper", "dcp", "cemnet", "idam", "rpmnet", "fmr"] = "paper"
    """The method: the paper's, set up by `model`, or another one, set up by the section of its name."""
    dcp: DCPConfig = DCPConfig()
    cemnet: CEMNetConfig = CEMNetConfig()
    idam: IDAMConfig = IDAMConfig()
    rpmnet: RPMNetConfig = RPMNetConfig()
    fmr: FMRConfig = FMRConfig()
    weights: str = ""
    """Released weights that `jaxreg evaluate` uses when no checkpoint is given; those that training
    starts from are named on its command line."""


PEERS = ("dcp", "cemnet", "idam", "rpmnet", "fmr")
"""Networks other than the paper's; each has a section of its name."""


def available_configs() -> tuple[str, ...]:
    """Names of the configurations that come with jaxreg; `load_config` takes them as paths."""
    return tuple(sorted(path.stem for path in _shipped().glob("*.toml")))


def load_config(path: str | Path) -> Config:
    """Read a configuration from a TOML file that lists what differs from the defaults.

    `path` may also be one of `available_configs`, with or without ``.toml``; a file of that name in
    the working directory takes precedence.

    Raises:
      ValueError: the file is missing (the names are given) or not TOML, or it names an unknown
        section or field (the nearest known name is given), or a value has the wrong type.
    """
    path = Path(path)
    if not path.exists() and path.name == str(path):
        shipped = _shipped() / f"{path.name.removesuffix('.toml')}.toml"
        path = shipped if shipped.exists() else path
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ValueError(
            f"no configuration file at {path}: give the path of a file, or one of the names that come "
            f"with jaxreg ({', '.join(available_configs())})."
        ) from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid TOML: {error}.") from None
    return from_dict(content, where=str(path))


def _shipped() -> Path:
    """The folder of the configurations: in the installed package, or next to it in a checkout."""
    package = Path(__file__).parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def from_dict(content: dict[str, Any], *, where: str = "configuration") -> Config:
    """The configuration from a nested dict of what differs; raises what `load_config` raises."""
    pairs, test_pairs = content.get("pairs", {}), content.get("test_pairs", {})
    if isinstance(pairs, dict) and isinstance(test_pairs, dict):
        content = content | {"test_pairs": pairs | test_pairs}
    return _build(Config, content, where)


def to_dict(config: Config) -> dict[str, Any]:
    """Every field as a nested dict of plain values, which `from_dict` reads back."""
    return dataclasses.asdict(config)


def _build(cls: type, content: dict[str, Any], where: str) -> Any:
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in content.items():
        if key not in hints:
            near = difflib.get_close_matches(key, hints, n=1, cutoff=0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"choose from {', '.join(hints)}."
            raise ValueError(f"{where}: unknown key '{key}'; {hint}")
        values[key] = _convert(hints[key], value, f"{where}: '{key}'")
    return cls(**values)


def _convert(hint: Any, value: Any, where: str) -> Any:
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ValueError(f"{where} is a section: write [{where.split()[-1]}] and its fields.")
        return _build(hint, value, where)
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        if value not in choices:
            raise ValueError(
                f"{where} must be one of {', '.join(map(repr, choices))}, got {value!r}."
            )
        return value
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"{where} must be a list, got {value!r}.")
        return tuple(_convert(typing.get_args(hint)[0], item, where) for item in value)
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint:
        raise ValueError(f"{where} must be {hint.__name__}, got {value!r}.")
    return value


_LEAST = {
    "model": dict.fromkeys(
        ("k", "k_matching", "channels", "width", "inlier_width", "n_inliers", "iterations"), 1
    ),
    "dcp": dict.fromkeys(("k", "channels", "width"), 1),
    "cemnet": dict.fromkeys(
        ("k", "channels", "width", "hidden", "candidates", "iterations", "stride", "reach"), 1
    ),
    "idam": dict.fromkeys(("k", "channels", "hidden", "kept_one_in", "iterations"), 1),
    "rpmnet": dict.fromkeys(
        ("neighbors", "width", "hidden", "k_normals", "iterations", "train_iterations"), 1
    ),
    "fmr": dict.fromkeys(("channels", "hidden", "decoded", "iterations"), 1),
    "pairs": {"points": 1, "kept": 1},
    "data": dict.fromkeys(("train_shapes", "test_shapes", "train_draws", "test_draws"), 1),
    "train": {"steps": 1, "batch": 1, "validate_every": 1, "validation_pairs": 1},
}
"""The smallest allowed value of these settings; other numbers must not be negative."""
_POSITIVE = ("learning_rate", "clip", "beta", "epsilon", "radius", "match_distance")
_SHARES = ("bn_momentum", "ema", "exploration", "future", "test_share", "validation_share")
_LIMITS = {"clip": math.inf, "rotation_max_deg": 360.0} | dict.fromkeys(_SHARES, 1.0)


def model_config(config: Config | ModelConfig) -> ModelConfig:
    """The section of the paper's network.

    Raises:
      ValueError: it is the configuration of another network.
    """
    if not isinstance(config, Config):
        return config
    if config.network != "paper":
        raise ValueError(
            f"config is that of another network: give it to jaxreg.peers.{config.network}.register."
        )
    return config.model


def check_options(section: str, settings: Any) -> None:
    """Refuse numbers that make no sense in one section of a configuration, such as `config.model`.

    Raises:
      ValueError: a number is out of range; the message names it as in `model.k`, and the option.
    """
    for name, value in vars(settings).items():
        least = _LEAST.get("pairs" if section == "test_pairs" else section, {}).get(name, 0)
        most = _LIMITS.get(name, sys.float_info.max)
        values = value if isinstance(value, tuple) else (value,)
        numbers = [x for x in values if isinstance(x, int | float)]
        positive = name in _POSITIVE
        if values and all(least <= x <= most and (x > 0 or not positive) for x in numbers):
            continue
        bound = "positive" if positive else f"at least {least}"
        if most < sys.float_info.max:
            bound += f" and at most {most:g}"
        elif most < math.inf and isinstance(value, float):
            bound += " and finite"
        raise ValueError(
            f"{section}.{name} must be {bound}, got {value}: correct it in the configuration file or "
            f"with --{option_name(f'{section}.{name}')}."
        )


def option_name(name: str) -> str:
    """What a command line calls a field: `train.validate_every` is `train.validate-every` there."""
    section, dot, field = name.rpartition(".")
    return section.replace("_", "-") + dot + re.sub(r"_(?!$)", "-", field)
