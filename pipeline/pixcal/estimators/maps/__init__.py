"""Maps of a fit: their structure, waves and rings, and offsets corrected by them."""
