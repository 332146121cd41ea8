"""Pure array mathematics: no files, no configuration, no scheduling."""

from pixcal.kernels.compiled import settle

settle()
