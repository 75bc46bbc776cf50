"""A worker of `workers.generate_all`: draws the scenes named on standard input, one JSON object a line."""

import json
import sys
from pathlib import Path

from fmtorch.data.rendered.generate import Task, generate

for line in sys.stdin:
    job = json.loads(line)
    task = Task.from_json(json.dumps(job["task"]))
    generate(task, Path(job["folder"]))
    print(task.name, flush=True)
