"""Breaks each kernel on purpose, in a copy: a named test must notice. Run by `make mutants`.

A mutant that survives is a hole in the tests; one whose text is gone must be written anew. Words after
the command choose the mutants of these modules: `python tests/mutants.py matching losses`.
"""

import concurrent.futures
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Mutant(NamedTuple):
    """Where `text` of `module` becomes `mutated`, `test` of that module's tests must fail."""

    module: str
    text: str
    mutated: str
    test: str


MUTANTS = [
    Mutant(
        "numerics",
        "jnp.sqrt(jnp.where(zero, 1, x))",
        "jnp.sqrt(x)",
        "test_derivative_of_the_square_root",
    ),
    Mutant("numerics", "zero = x <= 0", "zero = ~(x > 0)", "test_nan_stays_nan"),
    Mutant(
        "numerics",
        "jnp.arctan2(cross, jnp.where(degenerate, 1, dot))",
        "jnp.arctan2(cross, dot)",
        "test_derivatives_of_the_angle_are_finite_where_it_has_none",
    ),
    Mutant(
        "numerics",
        "jnp.arctan2(cross, jnp.where(degenerate, 1, dot))",
        "jnp.arccos(dot / jnp.where(degenerate, 1, safe_norm(u) * safe_norm(v)))",
        "test_small_and_flat_angles_keep_their_digits",
    ),
    Mutant(
        "numerics",
        "x[:half], x[x.shape[0] - half :]",
        "x[:half], x[:half]",
        "test_leading_max_is_numpy_s_and_hands_its_derivative_to_the_largest",
    ),
    Mutant(
        "rigid",
        "points, transform.rotation.T,",
        "points, transform.rotation,",
        "test_apply_maps_source_to_reference",
    ),
    Mutant(
        "rigid",
        "RigidTransform(rotation, -translation)",
        "RigidTransform(rotation, translation)",
        "test_compose_and_inverse_are_those_of_matrices",
    ),
    Mutant(
        "rigid",
        "jnp.matmul(second.rotation, first.rotation",
        "jnp.matmul(first.rotation, second.rotation",
        "test_compose_and_inverse_are_those_of_matrices",
    ),
    Mutant(
        "neighbors",
        "excluded = order[None, :] == row[:, None]",
        "excluded = jnp.zeros((len(row), n), bool)",
        "test_knn_gives_the_k_nearest_other_points",
    ),
    Mutant(
        "neighbors",
        "order = jnp.lexsort(points.T)",
        "order = jnp.arange(n)",
        "test_permuting_the_points_permutes_the_graph",
    ),
    Mutant(
        "neighbors",
        "excluded | ~mask[order][None, :]",
        "excluded",
        "test_padding_is_nobody_s_neighbour",
    ),
    Mutant(
        "neighbors",
        "jnp.where(mask[None, :], distance, jnp.inf)",
        "distance",
        "test_nearest_in_another_cloud",
    ),
    Mutant(
        "procrustes",
        "(share * (source - source_centroid)).T",
        "(share * share * (source - source_centroid)).T",
        "test_equals_scipy_with_noise",
    ),
    Mutant(
        "procrustes",
        "jnp.sign(sign)]",
        "jnp.ones_like(sign)]",
        "test_mirrored_reference_gives_the_best_rotation_not_a_mirror",
    ),
    Mutant(
        "procrustes",
        "weights = jnp.maximum(weights, 0)",
        "weights = jnp.abs(weights)",
        "test_negative_weights_count_as_zero",
    ),
    Mutant(
        "procrustes",
        "skew = skew.T - skew",
        "skew = skew - skew.T",
        "test_derivative_equals_finite_differences",
    ),
    Mutant(
        "procrustes",
        "jnp.linalg.pinv(system, rtol=tolerance, hermitian=True)",
        "jnp.linalg.inv(system)",
        "test_derivative_is_zero_along_motions_that_change_nothing",
    ),
    Mutant(
        "features",
        "points[neighbors] - points[:, None]",
        "points[:, None] - points[neighbors]",
        "test_relative_coordinates_point_from_the_centre_to_the_neighbour",
    ),
    Mutant("features", "leading_max(x)", "jnp.mean(x, axis=0)", "test_features_edge_by_edge"),
    Mutant(
        "features",
        "count = jnp.maximum(jax.lax.psum(jnp.sum(weight), BATCH_AXIS), 1)",
        "count = jax.lax.psum(1, BATCH_AXIS) * jnp.maximum(jnp.sum(weight), 1)",
        "test_batch_statistics_run_over_all_valid_points_of_all_clouds",
    ),
    Mutant(
        "matching",
        "weight / jnp.sum(weight, axis=1, keepdims=True)",
        "weight / jnp.sum(weight, axis=0, keepdims=True)",
        "test_scores_are_a_softmax_over_the_reference",
    ),
    Mutant(
        "matching",
        "jnp.where(valid[None, :], distance, _FAR)",
        "distance",
        "test_padded_columns_score_exactly_zero",
    ),
    Mutant(
        "matching", "jnp.exp(alpha - dual)", "jnp.exp(dual - alpha)", "test_maps_entry_by_entry"
    ),
    Mutant(
        "matching",
        "neighborhood_sum(scores + nearest, *graphs) / k",
        "neighborhood_sum(scores + nearest, *graphs)",
        "test_maps_entry_by_entry",
    ),
    Mutant(
        "matching",
        "_two_passes(collect_rows, x",
        "_two_passes(gather_rows, x",
        "test_derivative_of_the_neighborhood_sum_is_its_transpose",
    ),
    Mutant(
        "invariants",
        "vectors = points[:, None] - points[neighbors]",
        "vectors = points[neighbors] - points[:, None]",
        "test_structure_neighbour_by_neighbour",
    ),
    Mutant(
        "invariants",
        "jnp.roll(vectors, -1, axis=1)",
        "jnp.roll(vectors, 1, axis=1)",
        "test_structure_neighbour_by_neighbour",
    ),
    Mutant(
        "inliers",
        "2 * jax.nn.sigmoid(-2 * jnp.abs(consistency))",
        "2 * jax.nn.sigmoid(-2 * consistency)",
        "test_confidence_point_by_point",
    ),
    Mutant(
        "inliers",
        "jax.nn.softmax(attention, axis=1) * difference",
        "jax.nn.softmax(attention, axis=2) * difference",
        "test_confidence_point_by_point",
    ),
    Mutant(
        "inliers",
        "jnp.where(mask, confidence, -1)",
        "confidence",
        "test_padded_points_come_last",
    ),
    Mutant(
        "losses",
        "one_way(moved, reference) + one_way(reference, moved)",
        "2 * one_way(moved, reference)",
        "test_global_consistency_point_by_point",
    ),
    Mutant(
        "losses",
        "beta * x - beta * beta / 2",
        "beta * x - beta * beta",
        "test_huber_of_the_squared_distance_bends_at_beta",
    ),
    Mutant(
        "losses",
        "reference = PointCloud(without_padding(*reference), reference.mask)",
        "pass",
        "test_padding_changes_neither_value_nor_derivative",
    ),
    Mutant(
        "losses",
        "of_neighbors = error[neighbors[inliers]]",
        "of_neighbors = error[neighbors][: inliers.shape[0]]",
        "test_neighborhood_consistency_neighbour_by_neighbour",
    ),
    Mutant(
        "model",
        "rigid.compose(motion, total)",
        "rigid.compose(total, motion)",
        "test_steps_compose_and_move_the_source",
    ),
    Mutant(
        "model",
        "weights = jnp.where(mask, confidence, 0)",
        "weights = confidence",
        "test_no_valid_point_gives_the_identity_and_says_so",
    ),
    Mutant(
        "metrics",
        "chord / np.sqrt(8)",
        "chord / np.sqrt(2)",
        "test_equals_loops_over_scipy",
    ),
    Mutant("metrics", "errors.rte < 0.01)", "errors.rte < 0.1)", "test_equals_loops_over_scipy"),
]


def killer(mutant: Mutant, cache: str) -> str | None:
    """Name of the test that fails for a mutant; None when it survives.

    What a mutant does not change was compiled for another one, and is found in `cache`.

    Raises:
      ValueError: the module does not hold the text exactly once, or the test did not run.
    """
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory)
        ignored = shutil.ignore_patterns("__pycache__", "weights")
        for name in ("jaxreg", "tests"):
            shutil.copytree(ROOT / name, copy / name, ignore=ignored)
        shutil.copy(ROOT / "pyproject.toml", copy)
        path = copy / "jaxreg" / f"{mutant.module}.py"
        source = path.read_text(encoding="utf-8")
        if source.count(mutant.text) != 1:
            count = source.count(mutant.text)
            raise ValueError(f"{mutant.module}.py holds {mutant.text!r} {count} times, not once")
        path.write_text(source.replace(mutant.text, mutant.mutated), encoding="utf-8")
        test = f"tests/test_{mutant.module}.py::{mutant.test}"
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", test]
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        result = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, check=False
        )
    if result.returncode not in (0, 1):
        raise ValueError(f"{test} did not run: {result.stdout[-2000:]}{result.stderr[-2000:]}")
    failed = re.search(r"^FAILED \S+::(\S+)", result.stdout, re.MULTILINE)
    return failed.group(1) if failed else None


def main() -> None:
    """Run the mutants, two at a time; exit 1 when one survives."""
    chosen = [m for m in MUTANTS if not sys.argv[1:] or m.module in sys.argv[1:]]
    survivors = 0
    with (
        tempfile.TemporaryDirectory() as cache,
        concurrent.futures.ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool,
    ):
        for mutant, test in zip(
            chosen, pool.map(killer, chosen, [cache] * len(chosen)), strict=True
        ):
            survivors += test is None
            print(f"{mutant.module}: {mutant.text}  ->  {mutant.mutated}")
            print(f"    {'SURVIVED ' + mutant.test if test is None else 'killed by ' + test}")
            sys.stdout.flush()
    print(f"{len(chosen) - survivors} of {len(chosen)} mutants killed")
    sys.exit(1 if survivors else 0)


if __name__ == "__main__":
    main()
