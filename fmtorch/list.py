"""`python -m fmtorch.list` runs the command of `fmtorch.commands.list`."""

from fmtorch.commands.list import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
