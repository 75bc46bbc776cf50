"""Other libraries' robust estimators behind the same call, one pair at a time: the yardsticks of this project's own.

OpenCV and kornia are always there; PoseLib, MAGSAC++, GC-RANSAC, DEGENSAC and SupeRANSAC by their authors are the extra
`peers`, COLMAP is the extra `colmap`.
"""
