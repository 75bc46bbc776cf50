"""Open damaged ONNX files: a program of its own, since a fault of the runtime would end the process.

``python -m tests.reliability.networks file folder count``
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np

from fmtorch.core import NetworkFileError, onnx_session


def main(source: Path, folder: Path, count: int) -> None:
    """Damage the file so often, open it and, where it opens, run it."""
    from tests.reliability.test_damage import damages

    data, outcomes = source.read_bytes(), Counter[str]()
    inputs = onnx_session(source, 1, "").get_inputs()
    shapes = {each.name: [size if isinstance(size, int) else 20 for size in each.shape] for each in inputs}
    feed = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    for number, damage in enumerate(damages(data, count, 0)):
        file = folder / f"{number}.onnx"
        file.write_bytes(damage)
        try:
            session = onnx_session(file, 1, "the command that makes it")
        except NetworkFileError as error:
            assert str(file) in str(error)  # noqa: PT017
            outcomes["told"] += 1
            continue
        try:
            session.run(None, feed)
            outcomes["runs"] += 1
        except RuntimeError:  # which becomes the reason of the pairs that need it
            outcomes["told when it runs"] += 1
    print(dict(outcomes))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
