"""`python -m fmtorch.verify` is `fmtorch verify`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["verify", *sys.argv[1:]])
