"""The commands' bodies: each reads artefacts, writes one, and can be called from a notebook."""
