"""`python -m fmtorch.pairs` is `fmtorch pairs`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["pairs", *sys.argv[1:]])
