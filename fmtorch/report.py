"""`python -m fmtorch.report` is `fmtorch report`."""

import sys

from fmtorch.commands.main import main

if __name__ == "__main__":
    main(["report", *sys.argv[1:]])
