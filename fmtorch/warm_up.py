"""`python -m fmtorch.warm_up` is `fmtorch warm-up`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["warm-up", *sys.argv[1:]])
