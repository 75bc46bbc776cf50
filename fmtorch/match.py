"""`python -m fmtorch.match` runs the command of `fmtorch.commands.match`."""

from fmtorch.commands.match import main, run

__all__ = ["main", "run"]

if __name__ == "__main__":
    main()
