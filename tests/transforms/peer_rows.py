"""Rows of the other learned methods: their stages, and each as a whole on one pair."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.peers import cemnet, dcp, fmr, idam, rpmnet
from jaxreg.types import PointCloud
from tests.peers.small import MODULES, SMALL, draw_variables
from tests.transforms.rows import K, N, Row, every, everything, neighbor_graph, points, pose

RNG = np.random.default_rng(7)


def registered(name):
    def run(variables, source, reference):
        found = MODULES[name].register(variables, source, reference, config=SMALL[name])
        # Nearest points jump; what a record of theirs adds to the pose is tested elsewhere.
        return found.transform, found.confidence

    return run


def initial(name):
    return lambda: MODULES[name].init_variables(jax.random.key(3), SMALL[name])


def cloud(x):
    return PointCloud(x, jnp.ones(x.shape[0], bool))


def kept():
    return idam.Kept(np.arange(N, dtype=np.int32), everything(points()), RNG.normal(size=(N, 4)))


def near():
    return rpmnet.Neighborhoods(neighbor_graph(), RNG.normal(size=(N, K, 4)))


def poses():
    return jax.tree.map(lambda *x: np.stack(x), *(pose() for _ in range(3)))


def peer_rows() -> dict[str, Row]:
    source = points()
    moved = source @ Rotation.from_euler("z", 0.2).as_matrix().T + 0.1
    variables = {name: draw_variables(MODULES[name], SMALL[name], RNG) for name in MODULES}
    rows = {}
    for name in MODULES:
        own = variables[name]
        rows[f"peers.{name}.init_variables"] = Row(initial(name), (), smooth=False, loose=True)
        rows[f"peers.{name}.register"] = Row(
            registered(name),
            (own, source, moved),
            every(lambda x, own=own: (own, x, x)),
            # Their paths stop the derivative on purpose, they choose points, or, with random weights,
            # they point to nearly one place, from which a pose is ill-conditioned.
            smooth=False,
            loose=True,
            kinks=True,
        )
    embed = lambda v, x: dcp.embedding(v, cloud(x), config=SMALL["dcp"])  # noqa: E731
    sample = lambda v, x, y: cemnet.sampling_network(  # noqa: E731
        v, cloud(x), cloud(y), config=SMALL["cemnet"]
    )
    score = lambda poses, x, y: cemnet.alignment_error(  # noqa: E731
        poses, (cloud(x), cloud(y)), cloud(x), cloud(y), 1.0
    )
    around = lambda x: rpmnet.neighborhoods(cloud(x), config=SMALL["rpmnet"])  # noqa: E731
    affinity = RNG.normal(size=(N, N - 2))
    return rows | {
        "peers.dcp.embedding": Row(embed, (variables["dcp"], source), loose=True),
        "peers.dcp.soft_pointer": Row(
            lambda a, b, y: dcp.soft_pointer(a, b, cloud(y)),
            (RNG.normal(size=(N, 4)), RNG.normal(size=(N, 4)), source),
            ((np.zeros((N, 4)), np.zeros((N, 4)), source),),
        ),
        "peers.cemnet.sampling_network": Row(
            sample, (variables["cemnet"], source, moved), loose=True, kinks=True
        ),
        "peers.cemnet.numbers_of": Row(
            cemnet.numbers_of,
            (pose(),),
            # Turned by 90 degrees about y, where two of the angles are one.
            ((pose()._replace(rotation=Rotation.from_euler("y", np.pi / 2).as_matrix()),),),
            kinks=True,
        ),
        "peers.cemnet.pose_of": Row(cemnet.pose_of, (RNG.normal(size=6),), ((np.zeros(6),),)),
        "peers.cemnet.sparsemax": Row(
            cemnet.sparsemax, (0.3 * RNG.normal(size=9),), ((np.zeros(9),),)
        ),
        "peers.cemnet.elites": Row(
            cemnet.elites,
            (RNG.normal(size=(9, 6)), RNG.uniform(0, 2, 9)),
            ((np.ones((9, 6)), np.zeros(9)),),
            smooth=False,
        ),
        "peers.cemnet.alignment_error": Row(score, (poses(), source, moved), smooth=False),
        "peers.idam.distance_augmented": Row(
            idam.distance_augmented, (kept(), kept()), ((kept(),) * 2,)
        ),
        "peers.idam.hard_elimination": Row(
            lambda s: idam.hard_elimination(s, jnp.ones(N, bool), one_in=2)[0],
            (RNG.normal(size=N),),
            ((np.zeros(N),),),
            smooth=False,
        ),
        "peers.idam.hybrid_elimination": Row(
            lambda v: idam.hybrid_elimination(v, jnp.ones(N, bool)),
            (RNG.uniform(size=N),),
            ((np.zeros(N),),),
        ),
        "peers.idam.centred_procrustes": Row(
            lambda x, y, w: idam.centred_procrustes(cloud(x), y, w),
            (source, moved, RNG.uniform(size=N)),
            every(lambda x: (x, x, np.ones(N))),
            kinks=True,
        ),
        "peers.rpmnet.neighborhoods": Row(around, (source,), every(lambda x: (x,)), kinks=True),
        "peers.rpmnet.oriented_normals": Row(
            lambda x: rpmnet.oriented_normals(cloud(x), k=K),
            (source,),
            every(lambda x: (x,)),
            kinks=True,
        ),
        "peers.rpmnet.hybrid_features": Row(rpmnet.hybrid_features, (source, near())),
        "peers.rpmnet.sinkhorn": Row(
            lambda a: rpmnet.sinkhorn(a, jnp.ones(a.shape, bool), rounds=3),
            (affinity,),
            ((np.zeros((N, N)),), (1e3 * affinity,)),
        ),
        **fmr_rows(variables["fmr"], source, moved),
    }


def fmr_rows(variables, source, moved) -> dict[str, Row]:
    config = SMALL["fmr"]
    jacobian = RNG.normal(size=(24, 6))
    align = lambda v, x, y: fmr.align_features(v, cloud(x), cloud(y), config=config)  # noqa: E731
    return {
        "peers.fmr.encode": Row(
            lambda v, x: fmr.encode(v, cloud(x), config=config),
            (variables, source),
            every(lambda x: (variables, x)),
            loose=True,
            kinks=True,
        ),
        "peers.fmr.decode": Row(
            lambda v, feature: fmr.decode(v, feature, config=config),
            (variables, RNG.normal(size=24)),
            ((variables, np.zeros(24)),),
            loose=True,
        ),
        "peers.fmr.align_features": Row(
            align,
            (variables, source, moved),
            every(lambda x: (variables, x, x)),
            loose=True,
            kinks=True,
        ),
        "peers.fmr.twist_jacobian": Row(
            lambda v, x: fmr.twist_jacobian(v, cloud(x), config=config),
            (variables, source),
            every(lambda x: (variables, x)),
            loose=True,
            kinks=True,
        ),
        "peers.fmr.left_inverse": Row(
            fmr.left_inverse,
            (jacobian,),
            ((np.zeros((24, 6)),), (jacobian * [1, 1, 1, 1, 1, 0],)),
        ),
        "peers.fmr.centroid": Row(
            lambda x: fmr.centroid(cloud(x)), (source,), every(lambda x: (x,))
        ),
        "peers.fmr.centred": Row(lambda x: fmr.centred(cloud(x)), (source,), every(lambda x: (x,))),
        "peers.fmr.chamfer_distance": Row(
            lambda x, y: fmr.chamfer_distance(cloud(x), cloud(y)),
            (source, moved[:-2]),
            every(lambda x: (x, x)),
            kinks=True,
        ),
    }
