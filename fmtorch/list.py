"""`python -m fmtorch.list` is `fmtorch list`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["list", *sys.argv[1:]])
