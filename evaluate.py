"""Evaluate: `python evaluate.py CONFIG.toml ...`, the same program as `jaxreg evaluate`."""

import sys

from jaxreg.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
