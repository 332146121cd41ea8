"""Pure array mathematics: no files, no configuration, no scheduling."""
