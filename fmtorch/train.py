"""`python -m fmtorch.train` is `fmtorch train`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
