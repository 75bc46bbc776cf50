"""`python -m fmtorch.verify` runs the command of `fmtorch.commands.verify`."""

from fmtorch.commands.verify import main, run

__all__ = ["main", "run"]

if __name__ == "__main__":
    main()
