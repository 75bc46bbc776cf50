"""`python -m fmtorch.pairs` runs the command of `fmtorch.commands.pairs`."""

from fmtorch.commands.pairs import main, run

__all__ = ["main", "run"]

if __name__ == "__main__":
    main()
