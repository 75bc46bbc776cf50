"""Other libraries' robust estimators behind the same call, one pair at a time, in the extras `peers` and `colmap`."""
