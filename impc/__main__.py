"""`python -m impc`: equivalent to the command `impc`."""

from __future__ import annotations

import os
import sys

# `python -m` puts the working folder first on the path, where a numpy.py among recordings would
# replace numpy. The folder of a checkout stays, for its plants.
if __name__ == "__main__" and not (
    sys.flags.safe_path or os.path.exists(os.path.join(sys.path[0], "impc", "__main__.py"))
):
    del sys.path[0]

from impc.cli.main import main

if __name__ == "__main__":
    main()
