"""Evidence against a loop over points written from its docstrings, and the laws it obeys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.judge.evidence import Evidence, read_evidence
from jaxreg.judge.surface import Examined
from jaxreg.types import RigidTransform
from tests.judge.clouds import (
    arbitrary,
    assert_same,
    examined,
    inverse,
    partners,
    random_pose,
    read,
)
from tests.scenes import moved, shape

IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def one_way(rotation, shift, cloud, other, partner, step, spacing):
    """What every point says, one after the other; the other cloud stays where it is."""
    rows = []
    for i, j in zip(range(0, len(cloud.points), step), partner, strict=True):
        if not (cloud.mask[i] and other.mask[j]):
            continue
        offset = rotation @ cloud.points[i] + shift - other.points[j]
        far, off = np.linalg.norm(offset) / spacing, abs(offset @ other.normals[j]) / spacing
        cosine = abs((rotation @ cloud.normals[i]) @ other.normals[j])
        near = far < 3
        rows.append(
            {
                "near": near,
                "same": far < 0.02,
                "rough": near and max(cloud.variation[i], other.variation[j]) > 0.02,
                "across": off,
                "cosine": cosine,
                "disagrees": near and (off > 1 or cosine < 0.7),
                "rarity": cloud.rarity[i] * bool(cloud.normals[i].any() and other.normals[j].any()),
                "beside": 3 < far < 6,
                "unseen": other.interior[j] if 2 < far < 6 else 0.0,
                "ends": 1 - other.interior[j],
            }
        )
    return rows, np.sum(cloud.mask[::step])


def resistance(rotation, shift, source, reference, there, step, spacing):
    """The harmonic mean of the eigenvalues of the mean ``J^T n n^T J``, each a millionth larger."""
    points, normals = [], []
    for i, j in zip(range(0, len(source.points), step), there, strict=True):
        point = rotation @ source.points[i] + shift
        near = np.linalg.norm(point - reference.points[j]) < 3 * spacing
        if near and source.mask[i] and reference.mask[j]:
            points.append(point)
            normals.append(reference.normals[j])
    points, normals = np.array(points) - np.mean(points, axis=0), np.array(normals)
    points /= np.sqrt(np.mean(np.sum(points**2, axis=1)))
    rows = np.hstack([np.cross(points, normals), normals])
    return 6 / np.sum(1 / (np.linalg.eigvalsh(rows.T @ rows / len(rows)) + 1e-6)) - 1e-6


def by_loops(pose, source, reference, there, back, step=1) -> Evidence:
    spacing = max(source.spacing, reference.spacing)
    home = inverse(pose)
    forth, count = one_way(*pose, source, reference, there, step, spacing)
    # The reference brought to the source: the same distances and angles.
    return_, count_back = one_way(*home, reference, source, back, step, spacing)
    shares, copied = (
        [sum(row[k] for row in rows) / n for rows, n in ((forth, count), (return_, count_back))]
        for k in ("near", "same")
    )
    rows = forth + return_
    near, rough = ([row for row in rows if row[kind]] for kind in ("near", "rough"))
    total = sum(row["rarity"] for row in near)
    return Evidence(
        smaller=min(shares),
        larger=max(shares),
        distance=(sum(row["across"] for row in near) + 20 * 1.2) / (len(near) + 20),
        rough_distance=(sum(row["across"] for row in rough) + 20 * 1.0) / (len(rough) + 20),
        rough_facing=(sum(row["cosine"] for row in rough) + 20 * 0.5) / (len(rough) + 20),
        disagreement=sum(row["rarity"] for row in near if row["disagrees"]) / (total + 50),
        beside=sum(row["beside"] for row in rows) / (len(near) + 50),
        unseen=sum(row["unseen"] for row in rows) / (len(near) + 50),
        rough=len(rough) / (len(near) + 20),
        ends=sum(row["ends"] for row in near) / (len(near) + 50),
        held=resistance(*pose, source, reference, there, step, spacing),
        same=max(copied),
        sparse=1 - min(source.mask.sum(), reference.mask.sum()) / 4096,
    )


@pytest.mark.parametrize("step", [1, 2, 3])
def test_arbitrary_clouds_against_loops(rng, step):
    """Nothing agrees with anything, so that every term is seen; each cloud is the coarser once."""
    for spacings in ((0.03, 0.04), (0.045, 0.02)):
        source, reference = (
            arbitrary(rng, n, s) for n, s in zip((150, 130), spacings, strict=True)
        )
        pose = random_pose(rng, angle=1.0, shift=0.2)
        reference.points[:13] = moved(source.points[:13], *pose)  # some coincide
        pairs = [index[::step] for index in partners(pose, source, reference)]
        expected = by_loops(pose, source, reference, *pairs, step)
        assert 0 < expected.smaller < expected.larger < 1
        assert min(expected) > 0
        assert_same(read(pose, source, reference, *pairs, step=step), expected, tolerance=1e-6)


def test_without_a_near_point_only_the_priors_are_left(rng):
    source, reference = (arbitrary(rng, 40, 0.03) for _ in range(2))
    far = RigidTransform(np.eye(3), np.full(3, 50.0))
    found = read(far, source, reference, *partners(far, source, reference))
    fewest = min(cloud.mask.sum() for cloud in (source, reference))
    nothing = Evidence(0, 0, 1.2, 1.0, 0.5, 0, 0, 0, 0, 0, 0, same=0, sparse=1 - fewest / 4096)
    assert_same(found, nothing, but=["held"])
    assert abs(found.held) < 1e-9


@pytest.fixture
def scene(rng):
    """Two samplings of a surface under a pose that is a little off, and their partners."""
    source, reference = (examined(shape(rng, 300)) for _ in range(2))
    pose = random_pose(rng, angle=0.05, shift=0.02)
    return pose, source, reference, *partners(pose, source, reference)


def padded(cloud: Examined, count, fill) -> Examined:
    rows = {
        name: np.concatenate([value, np.full((count, *np.shape(value)[1:]), fill)])
        for name, value in cloud._asdict().items()
        if name not in ("mask", "spacing")
    }
    return Examined(**rows, mask=np.arange(len(cloud.mask) + count) < 300, spacing=cloud.spacing)


@pytest.mark.parametrize("fill", [0.0, 0.3, 1e6])
def test_padding_changes_nothing(scene, fill):
    pose, source, reference, there, back = scene
    alone = read(*scene)
    more = [
        np.concatenate([index, np.full(n, 7, np.int32)]) for index, n in ((there, 20), (back, 9))
    ]
    assert_same(read(pose, padded(source, 20, fill), padded(reference, 9, fill), *more), alone)


def test_a_cloud_that_is_all_padding_shows_nothing(scene):
    pose, source, reference, there, back = scene
    found = read(pose, source._replace(mask=np.zeros(300, bool)), reference, there, back)
    assert np.isfinite(found).all()
    assert found.smaller == found.larger == found.rough == 0


def test_swapped_clouds_show_the_same_but_for_what_holds_them(scene):
    """All fields count both directions; `held` asks the normals of the reference alone."""
    pose, source, reference, there, back = scene
    found = read(*scene)
    swapped = read(inverse(pose), reference, source, back, there)
    assert_same(swapped, found, but=["held"])
    assert swapped.held == pytest.approx(float(found.held), rel=0.5)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 500.0])
def test_unit_and_motion_of_the_whole_scene_change_nothing(rng, scale):
    """Read anew from the moved clouds, with the normals that they have."""
    clouds = [shape(rng, 300) for _ in range(2)]
    pose, motion = random_pose(rng, angle=0.05, shift=0.02), random_pose(rng)
    whole = [scale * moved(points, *motion) for points in clouds]
    turn = motion.rotation @ pose.rotation @ motion.rotation.T
    shift = motion.rotation @ pose.translation + motion.translation - turn @ motion.translation
    after = RigidTransform(turn, scale * shift)
    found = []
    for one, (source, reference) in ((pose, clouds), (after, whole)):
        source, reference = examined(source), examined(reference)
        found.append(read(one, source, reference, *partners(one, source, reference)))
    assert_same(*found, tolerance=1e-6)


def test_a_surface_on_itself_agrees_whatever_the_sign_of_its_normals(rng):
    cloud = examined(shape(rng, 300))
    flipped = cloud._replace(normals=cloud.normals * rng.choice([-1.0, 1.0], (300, 1)))
    pairs = partners(IDENTITY, cloud, cloud)
    assert not np.any(cloud.normals[225:], axis=1).all()  # a rod has none
    found = read(IDENTITY, cloud, flipped, *pairs)
    assert_same(found, read(IDENTITY, cloud, cloud, *pairs), tolerance=1e-6)
    assert found.smaller == found.larger == 1
    assert found.disagreement == found.beside == found.unseen == 0


def test_jit_and_vmap_equal_one_after_the_other(rng, scene):
    _, source, reference, *_ = scene
    poses = [random_pose(rng, angle=0.1, shift=0.05) for _ in range(3)]
    pairs = [partners(pose, source, reference) for pose in poses]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *zip(poses, pairs, strict=True))

    @jax.jit
    def all_of(poses, pairs):
        return jax.vmap(lambda pose, two: read_evidence(pose, source, reference, *two))(
            poses, pairs
        )

    together = all_of(*stacked)
    for i, (pose, two) in enumerate(zip(poses, pairs, strict=True)):
        eager = read_evidence(*jax.tree.map(jnp.asarray, (pose, source, reference, *two)))
        assert_same(read(pose, source, reference, *two), eager)
        assert_same(jax.tree.map(lambda x, i=i: x[i], together), eager)


def test_a_step_is_the_thinned_clouds_where_all_partners_are_among_them(rng):
    source, reference = (arbitrary(rng, 200, 0.05) for _ in range(2))
    pose = random_pose(rng, angle=0.5, shift=0.1)
    thin = [
        Examined(*(np.asarray(field)[::2] for field in cloud[:-1]), cloud.spacing)
        for cloud in (source, reference)
    ]
    there, back = partners(pose, *thin)
    found = read(pose, source, reference, 2 * there, 2 * back, step=2)
    assert_same(found, read(pose, *thin, there, back), but=["sparse"])


def lying_on_itself(points, normals):
    n = len(points)
    cloud = Examined(
        points, normals, np.zeros(n), np.ones(n), np.ones(n), np.ones(n, bool), np.float64(0.1)
    )
    return read(IDENTITY, cloud, cloud, *2 * [np.arange(n, dtype=np.int32)])


def test_what_leaves_a_motion_free_is_not_held(rng):
    plane = rng.uniform(-1, 1, (400, 3)) * [1, 1, 0]
    up = np.tile([0.0, 0, 1], (400, 1))
    for points, normals in (
        (plane, up),
        (plane + up * rng.choice([0, 1], (400, 1)), up),  # two shelves
        (np.c_[up[:, :2], rng.normal(size=400)] + up, up[:, [2, 0, 1]]),  # a rod
    ):
        assert 0 <= lying_on_itself(points, normals).held < 5.1e-6
    angle = rng.uniform(0, 2 * np.pi, 400)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    cylinder = around + up * rng.uniform(-1, 1, (400, 1))
    assert lying_on_itself(cylinder, around).held < 1e-5


def test_what_faces_all_directions_everywhere_is_held(rng):
    """The mean of ``n n^T`` is I/3, and that of ``(p x n)(p x n)^T`` for unit radius 2 I/9."""
    points, normals = rng.normal(size=(2, 20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert lying_on_itself(points, normals).held == pytest.approx(6 / (3 * 3 + 3 * 4.5), rel=0.03)


def test_derivatives_are_finite_even_where_points_coincide(rng):
    cloud = jax.tree.map(jnp.asarray, examined(shape(rng, 120)))
    one_place = cloud._replace(points=jnp.ones((120, 3)))
    itself = jnp.arange(120, dtype=jnp.int32)

    @jax.jit
    @jax.grad
    def gradient(inputs, known):
        pose, points, normals = inputs
        moving = known._replace(points=points, normals=normals)
        return sum(map(jnp.sum, read_evidence(pose, moving, known, itself, itself)))

    pose = RigidTransform(*map(jnp.asarray, IDENTITY))
    for known in (cloud, one_place):
        found = gradient((pose, known.points, known.normals), known)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
