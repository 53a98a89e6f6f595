"""The folder of a run after what may happen to it."""

import signal
import subprocess
import sys

import jax.numpy as jnp
import numpy as np

from jaxreg.config import Config
from jaxreg.weights import checkpoint

KILLED = """
import os, signal, sys
import jax.numpy as jnp
from jaxreg.config import Config
from jaxreg.weights import checkpoint

with checkpoint.open_run(sys.argv[1], Config()) as run:
    for step in (1, 2):
        run.save(step, {"weights": jnp.full((512, 512), float(step))}, error=1.0)
        run.log({"step": step})
        if step == 1:
            run._latest.wait_until_finished()
    # The second save is under way in another thread.
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_run_that_was_killed_during_a_save_goes_on(tmp_path):
    """T24."""
    # What a resumed run then computes is compared bit by bit in the tests of training.
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 3, "lo')  # Killed while it wrote a line, too.
    with checkpoint.open_run(tmp_path, Config()) as run:
        state = run.restore({"weights": jnp.zeros((512, 512), jnp.float32)})
    values = np.unique(state["weights"])
    assert values in ([1.0], [2.0])
    logged = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert len(logged) == int(values[0])
