"""Types only: what an acquisition, a flag, an error is. Imports nothing of the other folders."""
