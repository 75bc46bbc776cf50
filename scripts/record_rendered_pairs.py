"""Records which pairs of a drawn data set can be matched, so that nobody needs to judge them again.

    python scripts/record_rendered_pairs.py ~/.cache/fmtorch/rendered/indoor-test-small-*

adds folders of `rendered` to fmtorch/scenes/pairs.json and drops those of other versions.
"""

import json
import sys
from pathlib import Path

from fmtorch.scenes.dataset import FAMILIES, PLANS, RECORD, SPLITS, digest, recorded_pairs


def main() -> None:
    current = {
        (family, split, size): digest(family, split, 0, PLANS[size, split])
        for family in FAMILIES for split in SPLITS for size in ("small", "full")
    }  # fmt: skip
    record = {name: scenes for name, scenes in recorded_pairs().items() if name in current.values()}
    for folder in map(Path, sys.argv[1:]):
        family, split, size, version = folder.name.split("-")
        name = current[family, split, size]
        if not name.startswith(version):
            raise SystemExit(f"{folder} was drawn by another version of the generator or of OpenCV")
        scenes = sorted(folder.glob("*/scene.json"))
        if len(scenes) != PLANS[size, split].scenes:
            raise SystemExit(f"{folder} holds {len(scenes)} of {PLANS[size, split].scenes} scenes")
        record[name] = {}
        for path in scenes:
            scene = json.loads(path.read_text(encoding="utf-8"))
            record[name][path.parent.name] = {"photographs": len(scene["cameras"]), "pairs": scene["pairs"]}
    lines = (f"{json.dumps(name)}: {json.dumps(record[name])}" for name in sorted(record))
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
