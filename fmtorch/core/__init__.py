"""What everything stands on: types, records, random numbers, threads, options, files."""
