"""`python -m fmtorch.warm_up` runs the command of `fmtorch.commands.warm_up`."""

from fmtorch.commands.warm_up import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
