"""Everything on disk: FITS, cubes, artefacts. Only importer of numcodecs, fsspec, astropy.io."""
