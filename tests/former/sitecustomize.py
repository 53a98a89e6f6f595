"""Former names of the library, for case scripts that were written with them.

`tests/cases.py` puts this folder on the scripts' path, and Python imports this file as it starts.
Nothing of the library is imported before a script asks for it.
"""

import dataclasses
import functools
import importlib
import importlib.abc
import importlib.machinery
import sys
import time
from types import ModuleType

MODULES = {
    "jaxreg.data.shapes": "jaxreg.data.procedural.shapes",
    "jaxreg.model": "jaxreg.network.model",
    "jaxreg.scoring": "jaxreg.evaluation.score",
}
"""Modules that lie elsewhere today."""
NAMES = {
    "jaxreg.compilation.jit": "jax.jit",
    "jaxreg.config.RegisterConfig": "jaxreg.scans.config.RegisterConfig",
    "jaxreg.evaluation.true_transforms": "jaxreg.data.batches.true_transforms",
    "jaxreg.dense.register_dense": "jaxreg.search.pipeline.register_global",
    "jaxreg.judge.evidence.Evidence": "jaxreg.judge.evidence.Evidence",
    "jaxreg.refine.gicp.gicp": "jaxreg.refine.gicp.gicp",
    "jaxreg.refine.host.refine": "jaxreg.refine.host.refine_on_host",
    "jaxreg.refine.icp.icp": "jaxreg.refine.point_to_point.icp",
    "jaxreg.scans.pair.register": "jaxreg.scans.pair.register",
    "jaxreg.scoring.pair_stream": "jaxreg.evaluation.score.pair_stream",
    "jaxreg.training.load_checkpoint": "jaxreg.weights.checkpoint.load_checkpoint",
}
"""What was called so: what it is called today. The same name twice: its arguments changed."""
SETTINGS = ("iterations", "trim")
"""Arguments that are fields of `config` today."""


def _method(function):
    """`icp` or `refine`, whose settings were once its own arguments."""
    from jaxreg.refine.config import RefineConfig

    @functools.wraps(function)
    def former(*clouds, **given):
        settings = {name: given.pop(name) for name in SETTINGS if name in given}
        if settings:
            given["config"] = RefineConfig(**settings)
        return function(*clouds, **given)

    return former


def _config(today):
    """`RegisterConfig`, whose refinement has a configuration of its own today."""

    def former(*, refine_iterations=None, **given):
        config = today(**given)
        if refine_iterations is None:
            return config
        refine = dataclasses.replace(config.refine, iterations=refine_iterations)
        return dataclasses.replace(config, refine=refine)

    return former


def _registering(register):
    """`register`, which once took the name of the refinement, and told how long it took."""

    @functools.wraps(register)
    def former(*clouds, refine=None, **given):
        if refine is not None:
            config = today("jaxreg.config.RegisterConfig")()
            settings = dataclasses.replace(config.refine, method=refine)
            given["config"] = dataclasses.replace(config, refine=settings)
        begin = time.perf_counter()
        found = register(*clouds, **given)
        object.__setattr__(found, "seconds", time.perf_counter() - begin)
        return found

    return former


def _counted(pair_stream):
    """`pair_stream`, which once returned the number of pairs and all batches."""

    @functools.wraps(pair_stream)
    def former(*arguments, **given):
        stream = pair_stream(*arguments, **given)
        return stream.count, stream.batches()

    return former


def _with_gap(evidence):
    """The evidence for a pose, whose distance of the surfaces was once called the gap."""
    evidence.gap = property(lambda found: found.distance)
    return evidence


_ADAPTED = {
    "jaxreg.config.RegisterConfig": _config,
    "jaxreg.judge.evidence.Evidence": _with_gap,
    "jaxreg.refine.gicp.gicp": _method,
    "jaxreg.refine.icp.icp": _method,
    "jaxreg.scans.pair.register": _registering,
    "jaxreg.scoring.pair_stream": _counted,
}
_TOUCHED = {name.rpartition(".")[0] for name in NAMES} | MODULES.keys()


def today(former: str) -> object:
    """What a former name (with its module) stands for."""
    module, _, name = NAMES[former].rpartition(".")
    found = getattr(importlib.import_module(module), name)
    return _ADAPTED.get(former, lambda same: same)(found)


def _with_former_names(module: ModuleType) -> None:
    """Former names beside today's: looked up when asked for, or replaced where they are the same."""
    for former, name in NAMES.items():
        if former == name and former.rpartition(".")[0] == module.__name__:
            setattr(module, former.rpartition(".")[2], today(former))

    def lookup(name: str) -> object:
        former = f"{module.__name__}.{name}"
        if former in NAMES:
            return today(former)
        if module.__name__ in MODULES:
            return getattr(importlib.import_module(MODULES[module.__name__]), name)
        raise AttributeError(f"module '{module.__name__}' has no attribute '{name}'")

    module.__getattr__ = lookup


class FormerNames(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the modules of the tables: today's, with former names added, or none but these."""

    def find_spec(self, name, path=None, target=None):
        """As every finder."""
        if name not in _TOUCHED:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is None or spec.loader is None:
            return importlib.machinery.ModuleSpec(name, self)
        execute = spec.loader.exec_module

        def execute_and_add(module):
            execute(module)
            _with_former_names(module)

        spec.loader.exec_module = execute_and_add
        return spec

    def create_module(self, spec):
        """An empty one."""

    def exec_module(self, module):
        """Nothing but former names, and those of the module that is in its place today."""
        _with_former_names(module)


sys.meta_path.insert(0, FormerNames())
