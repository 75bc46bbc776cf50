"""Other libraries' robust estimators behind the same call, one pair at a time: the yardsticks of this project's own.

OpenCV and kornia are always there; PoseLib, MAGSAC++, GC-RANSAC, DEGENSAC and SupeRANSAC by their authors are the extra
`peers`.
"""

PEERS = {
    "poselib": "poselib", "poselib_shared_focal": "poselib", "magsac_cpp": "pymagsac", "gc_ransac_cpp": "pygcransac",
    "degensac_cpp": "pydegensac", "superansac_cpp": "pysuperansac",
}  # fmt: skip
"""The packages whose versions decide what the functions and presets of these names compute."""
