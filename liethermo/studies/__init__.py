"""Parameter studies: grids and samples of runs, on cores or a cluster, kept in a store."""
