"""The peer of the GMS timings, run by a Python that has opencv-contrib: answers one line with one line, until the end.

A question is the path of an .npz with x0, x1 (N, 2), size0, size1 (h, w), rotation, scale, factor; the answer is the
milliseconds of processor time of one call of matchGMS on one thread, and how many matches it kept.
"""

import sys
import time

import cv2
import numpy as np

cv2.setNumThreads(1)
path = ""
for line in sys.stdin:
    if line.strip() != path:
        path = line.strip()
        case = np.load(path)
        keypoints = [[cv2.KeyPoint(float(x), float(y), 1.0) for x, y in case[name]] for name in ("x0", "x1")]
        matches = [cv2.DMatch(i, i, 0.0) for i in range(len(case["x0"]))]
        sizes = [(int(case[name][1]), int(case[name][0])) for name in ("size0", "size1")]
        options = (bool(case["rotation"]), bool(case["scale"]), float(case["factor"]))
    start = time.process_time()
    kept = cv2.xfeatures2d.matchGMS(*sizes, *keypoints, matches, *options)  # type: ignore[attr-defined]
    print(1e3 * (time.process_time() - start), len(kept), flush=True)
