"""The table names every public function that a transform applies to."""

import importlib
import inspect

import jaxreg
from tests.transforms.table import TABLE

HOST = {
    "config.load_config",
    "weights.released.available_weights",
    "weights.released.load_pretrained",
}
HOST |= {"scans.many.register_many", "graph.sparse.solve_poses"}
HOST |= {"scans.pair.register", "refine.config.check_options"}
HOST |= {"refine.uncertainty.weak_directions", "refine.uncertainty.about"}
HOST |= {"refine.gicp.generalized", "refine.methods.method_of"}
HOST |= {"geometry.rigid.rotation_angle_deg", "geometry.rigid.nearest_rotation"}
HOST |= {"geometry.frame.measure", "judge.odds.chances"}
HOST |= {"search.learned.load_features", "search.learned.feature_config"}
HOST |= {"search.learned.check_network"}
HOST |= {"search.learned.init_network"}
HOST |= {
    "io.read_cloud",
    "io.writing.write_cloud",
    "view.page.write_page",
    "view.pictures.plot_pair",
}
HOST |= {"view.page.write_registration_page", "scans.prepare.prepare", "training.train"}
HOST |= {f"peers.{name}.load_weights" for name in ("dcp", "cemnet", "idam", "rpmnet", "fmr")}
HOST |= {"peers.rienet.load_rienet", "weights.checkpoint.load_checkpoint"}
HOST |= {"data.procedural.shapes.sample_shape", "refine.config.RefineConfig"}
HOST |= {"network.batch.register_batch", "exported.export_program", "exported.load_exported"}
"""No transform applies to what reads files, numpy arrays on the host, shapes alone or a random key."""
ELSEWHERE = {"batching.map_pairs", "data.pairs.make_pair", "training.batch_loss"}
ELSEWHERE |= {"graph.optimize.optimize_poses", "peers.idam.loss", "peers.rpmnet.loss"}
ELSEWHERE |= {"peers.fmr.loss"}
"""Transformed in their own tests: graph/test_optimize.py, test_batching.py, data/test_pairs.py,
test_training.py and peers/."""
OF_JAXLIE = {"geometry.rigid.to_jaxlie", "geometry.rigid.from_jaxlie"}
"""Need a package that may be missing: tests/geometry/test_rigid.py transforms them where it is."""
HALVES = {"network.matching.gather_rows", "network.matching.collect_rows"}
"""Of `neighborhood_sum` and of its transpose, which knows one as the derivative of the other."""
ROOMS = (
    "geometry.numerics",
    "geometry.eigen3x3",
    "geometry.rigid",
    "geometry.neighbors",
    "geometry.procrustes",
    "network.features",
    "network.matching",
    "network.matching_blocks",
    "network.invariants",
    "network.inliers",
    "network.model",
    "network.losses",
    "peers.dcp",
    "peers.cemnet",
    "peers.idam",
    "peers.rpmnet",
    "peers.fmr",
    "geometry.frame",
    "refine.config",
    "refine.cost",
    "refine.gauss_newton",
    "refine.solve",
    "refine.methods",
    "refine.gicp",
    "refine.point_to_point",
    "geometry.normals",
    "refine.correspondences",
    "refine.point_to_plane",
    "refine.uncertainty",
    "refine.robust",
    "judge.evidence",
    "judge.odds",
    "judge.surface",
    "search.alignment",
    "search.candidates",
    "search.compatibility",
    "search.description",
    "search.descriptors",
    "search.hypotheses",
    "search.learned",
    "search.nearest",
    "search.pipeline",
    "search.ranking",
    "search.stages",
    "search.surface",
)


def public_functions() -> set[str]:
    """Functions and networks that the numerical rooms define under a public name."""
    names = set()
    for room in ROOMS:
        module = importlib.import_module(f"jaxreg.{room}")
        for name, value in vars(module).items():
            record = inspect.isclass(value) and issubclass(value, tuple)
            if name.startswith("_") or not callable(value) or record:
                continue
            if getattr(value, "__module__", None) == module.__name__:
                names.add(f"{room}.{name}")
    for name in jaxreg.__all__:
        value = getattr(jaxreg, name)
        if inspect.isfunction(value):
            names.add(f"{value.__module__.removeprefix('jaxreg.')}.{name}")
    return names - HOST - HALVES - ELSEWHERE - OF_JAXLIE


def test_every_public_function_is_in_the_table():
    missing, gone = public_functions() - set(TABLE), set(TABLE) - public_functions()
    assert not missing, f"give {sorted(missing)} a row in the table of tests/transforms"
    assert not gone, f"take {sorted(gone)} out of the table of tests/transforms"
