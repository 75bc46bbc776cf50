"""From outcomes to figures: rows of metrics, summaries with intervals, recall curves, and the loop that makes a run."""
