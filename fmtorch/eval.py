"""`python -m fmtorch.eval` is `fmtorch eval`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["eval", *sys.argv[1:]])
