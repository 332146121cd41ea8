"""Types only, such as acquisition, flags and errors. Imports nothing from other folders."""
