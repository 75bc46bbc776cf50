"""Others' files: matches that other programs computed, read as data sets (docs/exchange.md)."""
