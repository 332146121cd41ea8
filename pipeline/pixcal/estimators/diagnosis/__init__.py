"""Evidence of effects in an acquisition: frames, maps, and what their fit absorbs."""
