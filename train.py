"""Train a network: `python train.py CONFIG.toml ...`, the same program as `jaxreg train`."""

import sys

from jaxreg.cli.process import restart_with_huge_pages

if __name__ == "__main__":
    restart_with_huge_pages()  # Before anything else is loaded, because it would be loaded twice.
    from jaxreg.cli.train import main

    sys.exit(main())
