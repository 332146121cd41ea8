"""How work is planned in memory and run: the only importer of dask."""
