"""Everything on disk: FITS, Zarr cubes, artefacts. Only importer of zarr, fsspec, astropy.io."""
