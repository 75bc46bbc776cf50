"""When two neighbouring matches agree: the numbers of `frame_consistency` and `position_consistency`.

Kernels take those whose names end in 32, which are float32; tensors take the others.
"""

from __future__ import annotations

import math

import numpy as np

WINDOW = 8  # neighbours before and after each match along each curve
CURVES = ((0.0, 0.0), (0.5, math.pi / 4))  # shift of the grid (in thirds of the extent) and rotation of each curve
TOLERANCE = 0.25  # relative prediction error at which agreement falls to about 1/e
SHARPNESS = TOLERANCE**-2 / 8
NOISE = 4.0  # px, keeps close neighbours from being judged by their localisation noise
WORST_RATIO, MIN_VOTE = 0.85, 0.02  # a neighbour votes with WORST_RATIO - ratio, at least MIN_VOTE
MIN_SQUARE, MIN_VOTES = 1e-12, float(np.finfo(np.float32).tiny)  # keep a root's gradient and a quotient finite
FARTHEST = 1e15  # px; a match beyond is none: its squares could overflow

CURVES32 = np.array([(shift, math.cos(angle), math.sin(angle)) for shift, angle in CURVES], np.float32)
SHARPNESS32, NOISE32, FARTHEST32 = np.float32(SHARPNESS), np.float32(NOISE), np.float32(FARTHEST)
WORST_RATIO32, MIN_VOTE32 = np.float32(WORST_RATIO), np.float32(MIN_VOTE)
MIN_SQUARE32, MIN_VOTES32, ONE32 = np.float32(MIN_SQUARE), np.float32(MIN_VOTES), np.float32(1)

TURNS = 16  # hypotheses of the turn that a pair's neighbours have in common
SCALES = tuple(2.0 ** (k / 2) for k in range(-4, 5))  # hypotheses of their change of scale
IDENTITY = SCALES.index(1.0) * TURNS  # the hypothesis scale * TURNS + turn that changes nothing
EDGES = tuple(2.0 ** (k / 2) for k in range(-9, 11, 2))  # of squared scales, halfway between the hypotheses
ANGLES = tuple(2 * math.pi * k / TURNS for k in range(TURNS))
HALF_SECTOR, TWO_SECTORS = math.pi / TURNS, math.pi / 8

EDGES32, _SCALES32 = np.array(EDGES, np.float32), np.array(SCALES, np.float32)[:, None]
_COSINES32, _SINES32 = (np.array([f(angle) for angle in ANGLES], np.float32) for f in (math.cos, math.sin))
MAPS32 = np.stack(np.broadcast_arrays(_SCALES32 * _COSINES32, _SCALES32 * _SINES32, _SCALES32), -1).copy()
"""(scales, turns, 3), of each its cosine and sine, times the scale, and the scale."""
HALF_COSINE32, HALF_SINE32 = np.float32(math.cos(HALF_SECTOR)), np.float32(math.sin(HALF_SECTOR))
TWO_TANGENT32 = np.float32(math.tan(TWO_SECTORS))
