"""Who does the work: threads, processes, a cluster of Dask, shards; one scheduler for every loop over pairs."""
