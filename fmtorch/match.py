"""`python -m fmtorch.match` is `fmtorch match`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["match", *sys.argv[1:]])
