"""Everything on disk: FITS, Zarr cubes, artefacts. The only importer of zarr and astropy.io."""
