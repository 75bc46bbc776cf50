"""`python -m fmtorch.train` runs the command of `fmtorch.commands.train`."""

from fmtorch.commands.train import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
