"""``pixcal blind``: an examination of the diagnosis, on data whose effects are withheld."""
