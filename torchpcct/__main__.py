"""``python -m torchpcct``: the command line without its installed name.

By its name and not by an import statement: the command line stands above this package.
"""

import runpy

if __name__ == "__main__":
    runpy.run_module("recon.cli", run_name="__main__")
