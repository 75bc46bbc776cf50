"""Starts commands quickly: one process imports the libraries and the package, and forks another for each command.

It has also done what each command does first and always alike, see `warm_up`.

Lines of JSON come in on standard input: ``{"start": [module or -c, arguments ...], "cwd": ..., "log": ...,
"errors": ..., "environment": {...}, "before": code}`` is answered by the process's id, ``{"wait": id}`` by its exit
status. What is forked runs a module as ``python -m`` does, or what follows ``-c``, after the code."""

import contextlib
import importlib
import json
import os
import runpy
import sys
import traceback
from typing import Any

LIBRARIES = (
    "torch", "kornia", "cv2", "hydra", "omegaconf", "pyarrow.parquet", "pyarrow.compute",
    "skimage.io", "rich.progress", "scipy.spatial", "numba", "onnxruntime", "lightning", "lightning.pytorch.loggers",
    "torch.utils.tensorboard", "antlr4", "jinja2", "h5py",
    "fmtorch.commands.eval", "fmtorch.commands.match", "fmtorch.commands.pairs", "fmtorch.commands.report",
    "fmtorch.commands.verify", "fmtorch.estimators", "fmtorch.features", "fmtorch.pruning", "fmtorch.matching",
)  # fmt: skip


def run(job: dict[str, Any]) -> None:
    """In the process that was forked: become the command. Never returns."""
    status = 1
    try:
        log, errors = (os.open(str(job[key]), os.O_WRONLY | os.O_CREAT | os.O_APPEND) for key in ("log", "errors"))
        nothing = os.open(os.devnull, os.O_RDONLY)
        for descriptor, source in ((0, nothing), (1, log), (2, errors)):
            os.dup2(source, descriptor)
        os.environ.update(job["environment"])
        os.chdir(str(job["cwd"]))
        module, *arguments = job["start"]
        sys.argv = [module, *arguments]
        sys.path.insert(0, str(job["cwd"]))
        before = job.get("before")
        if before:
            exec(str(before), {})
        if module == "-c":
            sys.argv = ["-c", *arguments[1:]]
            exec(arguments[0], {"__name__": "__main__"})
        else:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def warm_up() -> None:
    """Load what numba needs before its first kernel; read the package's code.
    Without threads, which a fork would lose."""
    with contextlib.suppress(ImportError):
        from numba.core.registry import cpu_target

        cpu_target.target_context.refresh()
    from fmtorch.runs import code_digest, fmtorch_version

    fmtorch_version()
    for name in ("fmtorch.features", "fmtorch.estimators", "fmtorch.matching", "fmtorch.pruning"):
        code_digest(name)


def main() -> None:
    """Serve until standard input is closed."""
    for name in LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    warm_up()
    for line in sys.stdin:
        job = json.loads(line)
        if "wait" in job:
            _, status = os.waitpid(job["wait"], 0)
            print(os.waitstatus_to_exitcode(status), flush=True)
            continue
        child = os.fork()
        if child == 0:
            run(job)
        print(child, flush=True)


if __name__ == "__main__":
    main()
